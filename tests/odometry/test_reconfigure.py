"""Another configuration while odometry runs."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.klt import KltFrontend
from gvo.frontend.offsets import RigOffsets
from gvo.io.frames import frames
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.types import Estimate, Frame, FrameResult, RgbdFrame, StereoFrame

N_FRAMES = 8
SECTIONS = (
    *("depth", "frontend", "klt", "features", "stereo", "temporal", "ransac", "registration"),
    *("window", "runtime"),
)


@cache
def recording(sensor: Sensor) -> SyntheticRecording:
    return SyntheticRecording("handheld", sensor, n_frames=3 * N_FRAMES, scale=0.4)


@cache
def recorded(sensor: Sensor) -> tuple[Frame, ...]:
    """Return every third frame, so that the camera moves between two of them."""
    items = list(frames(recording(sensor), Config()))[::3]
    return tuple(item for item in items if isinstance(item, StereoFrame | RgbdFrame))


def change(base: Config, **sections: dict[str, object]) -> Config:
    values = base.model_dump()
    for name, keys in sections.items():
        values[name] |= keys
    return Config.model_validate(values)


def odometry_of(sensor: Sensor, config: Config | None = None) -> Odometry:
    return Odometry(recording(sensor).info.camera, config or Config())


def fingerprint(results: Sequence[FrameResult], last: Sequence[Estimate]) -> list[bytes]:
    finished = [estimate for result in results for estimate in result.finished] + list(last)
    poses = [pose for r in results for pose in (r.raw, r.causal)] + finished
    return [e.T_world_frame.tobytes() + e.covariance.tobytes() for e in poses]


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("kind", ["klt", "descriptor"])
def test_an_equal_configuration_and_one_taken_back_change_no_bit(sensor: Sensor, kind: str) -> None:
    config = change(Config(), frontend={"kind": kind})
    other = change(config, klt={"n_corners": 60}, stereo={"max_depth_m": 60.0}, window={"size": 2})
    untouched, meddled = odometry_of(sensor, config), odometry_of(sensor, config)
    expected = [untouched.track(frame) for frame in recorded(sensor)]
    results = []
    for frame in recorded(sensor):
        meddled.reconfigure(other)
        meddled.reconfigure(config.model_copy(deep=True))
        results.append(meddled.track(frame))
    assert fingerprint(results, meddled.finish()) == fingerprint(expected, untouched.finish())


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_a_change_before_the_first_frame_is_as_if_it_had_always_been(sensor: Sensor) -> None:
    other = change(Config(), klt={"n_corners": 80}, window={"n_links": 2, "kernel": "cauchy"})
    begun, changed = odometry_of(sensor, other), odometry_of(sensor)
    changed.reconfigure(other)
    expected = [begun.track(frame) for frame in recorded(sensor)]
    results = [changed.track(frame) for frame in recorded(sensor)]
    assert fingerprint(results, changed.finish()) == fingerprint(expected, begun.finish())


def test_a_configuration_of_another_type_is_refused() -> None:
    odometry = odometry_of("stereo")
    with pytest.raises(ValueError, match=r"must be a gvo\.Config, got dict"):
        odometry.reconfigure({"window": {}})  # type: ignore[arg-type]
    assert odometry.config == Config()


def test_the_next_frame_is_registered_against_what_the_new_parameters_find() -> None:
    first, second, third, *_ = recorded("stereo")
    odometry = odometry_of("stereo")
    odometry.track(first)
    before = odometry.track(second)
    odometry.reconfigure(change(Config(), klt={"n_corners": 50}))
    after = odometry.track(third)
    assert before.n_matches > 100
    assert 12 <= after.n_matches <= 50


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("kinds", [("klt", "descriptor"), ("descriptor", "klt")])
def test_the_chain_goes_on_over_another_front_end(sensor: Sensor, kinds: tuple[str, str]) -> None:
    former, later = (change(Config(), frontend={"kind": kind}) for kind in kinds)
    odometry = odometry_of(sensor, former)
    results = []
    for index, frame in enumerate(recorded(sensor)):
        if index == N_FRAMES // 2:
            odometry.reconfigure(later)
        results.append(odometry.track(frame))
    assert all(result.reason == "" and result.status == "ok" for result in results)
    truth = recording(sensor).ground_truth().T_world_frame[::3]
    error_m = results[-1].raw.T_world_frame[:3, 3] - truth[-1][:3, 3]
    assert np.linalg.norm(error_m) < 0.02


def constants_of(offsets: RigOffsets) -> dict[str, tuple[float, float]]:
    assert offsets.learnt is not None
    return {**offsets.learnt.constants}


def keyframes_over(config: Config, later: Config) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the keyframes before and after a change; the same few frames come again."""
    odometry = odometry_of("stereo", config)
    for frame in recorded("stereo")[:-1]:
        before = odometry.track(frame).keyframes_ns
    odometry.reconfigure(later)
    return before, odometry.track(recorded("stereo")[-1]).keyframes_ns


def test_keyframes_stay_where_new_frames_can_be_registered_with_them() -> None:
    many = Config()
    described = change(many, frontend={"kind": "descriptor"})
    for former, later in [
        (many, change(many, klt={"n_corners": 120})),
        (many, described),  # tracks hold their frames: extracted again
        (described, change(described, features={"n_features": 500})),
    ]:
        before, after = keyframes_over(former, later)
        assert len(before) > 1
        assert set(before) <= set(after)


def test_keyframes_of_other_descriptors_are_released() -> None:
    many = change(Config(), frontend={"kind": "descriptor"})
    before, after = keyframes_over(many, change(many, features={"kind": "sift"}))
    assert len(before) > 1
    # The last frame was extracted again.
    assert set(before) & set(after) <= {recorded("stereo")[-2].stamp_ns}


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
@pytest.mark.parametrize(
    "section", [{"stereo": {"max_depth_m": 90.0}}, {"camera": {"readout_ms": 9.0}}]
)
def test_what_is_learnt_stays_until_its_sections_change(kind: str, section: dict[str, Any]) -> None:
    config = change(Config(), frontend={"kind": kind})
    odometry = odometry_of("stereo", config)
    for frame in recorded("stereo")[:4]:
        odometry.track(frame)
    learnt = odometry.rig_offsets
    assert learnt is not None
    before = constants_of(learnt)
    odometry.reconfigure(change(config, ransac={"n_hypotheses": 64}, klt={"n_corners": 200}))
    odometry.track(recorded("stereo")[4])
    assert odometry.rig_offsets is learnt
    assert constants_of(learnt) != before
    odometry.reconfigure(change(config, **section))
    odometry.track(recorded("stereo")[5])
    renewed = odometry.rig_offsets
    assert renewed is not None
    assert {value for value, _ in constants_of(renewed).values()} == {0.0}
    assert renewed.readout[0] == pytest.approx(0.009 if "camera" in section else 0.0)


def test_what_an_rgbd_camera_taught_outlasts_a_change_of_stereo() -> None:
    odometry = odometry_of("rgbd")
    odometry.track(recorded("rgbd")[0])
    learnt = odometry.rig_offsets
    odometry.reconfigure(change(Config(), stereo={"max_depth_m": 90.0}))
    odometry.track(recorded("rgbd")[1])
    assert odometry.rig_offsets is learnt


def test_the_inflation_that_is_taken_back_is_that_of_the_present_configuration() -> None:
    odometry = odometry_of("stereo", Config())
    odometry.track(recorded("stereo")[0])
    learnt = odometry.rig_offsets
    assert learnt is not None
    for _ in range(99):
        learnt.window_factor.note(0.1)
        learnt.chain_factor.note(0.1)
    odometry.reconfigure(change(Config(), klt={"n_corners": 200}))
    odometry.track(recorded("stereo")[1])
    assert odometry.window.variance_factor < 0.5
    odometry.reconfigure(change(Config(), frontend={"kind": "descriptor"}))
    odometry.track(recorded("stereo")[2])
    assert odometry.rig_offsets is learnt
    assert odometry.window.variance_factor == learnt.chain_factor.value == 1.0


class OwnFrontend(KltFrontend):
    """A front-end of one's own, which is told."""

    told: list[Config]

    def reconfigure(self, config: Config) -> None:
        self.told.append(config)


def test_an_own_front_end_is_told_and_kept() -> None:
    frontend = OwnFrontend(recording("rgbd").info.camera, Config())
    frontend.told = []
    odometry = Odometry(frontend=frontend)
    frames_ = recorded("rgbd")
    odometry.track(frames_[0])
    other = change(Config(), frontend={"kind": "descriptor"}, window={"size": 3})
    odometry.reconfigure(Config())
    odometry.reconfigure(other)
    for frame in frames_[1:]:
        assert odometry.track(frame).reason == ""
    assert frontend.told == [other]
    assert len(odometry.window) <= 3 + len(odometry.window.kept())


def test_an_own_front_end_that_cannot_be_told_goes_on_as_it_is() -> None:
    odometry = Odometry(frontend=DescriptorFrontend(recording("rgbd").info.camera, Config()))
    for frame in recorded("rgbd"):
        odometry.reconfigure(change(odometry.config, frontend={"kind": "klt"}))
        assert odometry.track(frame).reason == ""


def values_of(field: Any) -> st.SearchStrategy[Any]:
    """Return values of a parameter within its range, near its default and at the limits."""
    default, annotation = field.default, field.annotation
    if annotation is bool:
        return st.booleans()
    choices = getattr(annotation, "__args__", ())
    if choices and all(isinstance(choice, str) for choice in choices):
        return st.sampled_from(choices)
    limits = {type(limit).__name__.lower(): limit for limit in field.metadata}
    lowest = limits["ge"].ge if "ge" in limits else limits["gt"].gt + 1e-3
    anchor = lowest + 1 if default is None else default
    highest = max(4 * anchor, lowest)
    if "le" in limits:
        highest = min(highest, limits["le"].le)
    if int in (annotation, *choices):
        numbers: st.SearchStrategy[Any] = st.integers(int(lowest), max(int(highest), int(lowest)))
    else:
        numbers = st.floats(float(lowest), float(highest), allow_subnormal=False)
    return st.none() | numbers if type(None) in choices else numbers


@st.composite
def steps(draw: st.DrawFn, config: Config) -> Config:
    """Return a configuration of which a few sections are drawn anew."""
    chosen = draw(st.lists(st.sampled_from(SECTIONS), unique=True, min_size=1, max_size=4))
    sections = {}
    for name in chosen:
        fields = type(getattr(config, name)).model_fields
        keys = draw(st.lists(st.sampled_from(sorted(fields)), unique=True, min_size=1))
        sections[name] = {key: draw(values_of(fields[key])) for key in keys}
    return change(config, **sections)


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@given(data=st.data())
@settings(max_examples=5)
def test_no_sequence_of_configurations_breaks_it(sensor: Sensor, data: st.DataObject) -> None:
    config = Config()
    odometry = odometry_of(sensor)
    results = []
    for frame in recorded(sensor):
        config = data.draw(st.just(config) | steps(config))
        odometry.reconfigure(config)
        results.append(odometry.track(frame))
    finished = [estimate for result in results for estimate in result.finished]
    finished += odometry.finish()
    stamps = [frame.stamp_ns for frame in recorded(sensor)]
    assert [result.stamp_ns for result in results] == stamps
    assert sorted(estimate.stamp_ns for estimate in finished) == stamps
    for estimate in [*finished, *(e for r in results for e in (r.raw, r.causal))]:
        assert np.isfinite(estimate.T_world_frame).all()
        assert np.isfinite(estimate.covariance).all()


def test_frames_from_before_loops_are_enabled_have_global_poses_too() -> None:
    items = recorded("stereo")
    odometry = odometry_of("stereo", change(Config(), loops={"enabled": False}))
    for frame in items[:4]:
        odometry.track(frame)
    odometry.reconfigure(Config())
    for frame in items[4:]:
        odometry.track(frame)
    stamps_ns = [estimate.stamp_ns for estimate in odometry.optimize().estimates]
    assert stamps_ns == [frame.stamp_ns for frame in items]
