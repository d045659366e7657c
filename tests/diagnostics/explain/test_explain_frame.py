"""What is explained is what happened in a run."""

from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import gvo
from gvo.config import Config, load_configuration
from gvo.diagnostics.explain import FrameExplanation, explain_frame
from gvo.errors import GvoError
from gvo.io.frames import frames
from gvo.io.recording import Sensor, Source, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FaultyFrame, FrameResult, Progress
from tests.recordings import Held, hold

KINDS = ("klt", "descriptor")
SENSORS: tuple[Sensor, ...] = ("stereo", "rgbd")
EACH = pytest.mark.parametrize(("kind", "sensor"), [*product(KINDS, SENSORS)])
LAST = 4
BLACK = 2


def spoiled(*, is_faulty: bool = False) -> Held:
    """Return a recording with a black frame, or one whose images cannot be read."""

    def spoil(image: StampedImage) -> NDArray[Any]:
        return np.zeros((3, 3), np.uint8) if is_faulty else np.zeros_like(image.load())

    whole = hold(recording("stereo"))
    return replace(whole, truth=None).mapped(
        lambda image, n: replace(image, load=partial(spoil, image)) if n == BLACK else image
    )


def configuration(kind: str) -> Config:
    return load_configuration(settings=[f"frontend.kind={kind}"])


@cache
def recording(sensor: Sensor) -> SyntheticRecording:
    return SyntheticRecording("handheld", sensor, n_frames=LAST + 1, scale=0.4)


def run(source: Source, config: Config) -> list[FrameResult]:
    odometry = Odometry(source.info.camera, config)
    return [
        odometry.track(frame)
        for frame in frames(source, config)
        if not isinstance(frame, FaultyFrame)
    ]


@cache
def explained(kind: str, sensor: Sensor, index: int = LAST) -> FrameExplanation:
    return explain_frame(recording(sensor), index, config=configuration(kind))


@EACH
def test_it_ends_with_the_pose_of_a_run_bit_for_bit(
    kind: str, sensor: Sensor, tmp_path: Path
) -> None:
    source, config = recording(sensor), configuration(kind)
    outputs = gvo.RunOutputs(report=False)
    gvo.run_recording(source, tmp_path / "run", config=config, outputs=outputs)
    written = gvo.read_trajectory(tmp_path / "run" / "causal.txt")
    found = explained(kind, sensor).result.causal
    shown = tmp_path / "shown.txt"
    T = found.T_world_frame[np.newaxis]
    write_tum(shown, Trajectory(stamps_ns=np.array([found.stamp_ns]), T_world_frame=T))
    assert shown.read_text() == (tmp_path / "run" / "causal.txt").read_text().splitlines(True)[LAST]
    assert written.stamps_ns[LAST] == found.stamp_ns


@EACH
@pytest.mark.parametrize("index", [1, LAST])
def test_what_is_repeated_is_what_happened_bit_for_bit(
    kind: str, sensor: Sensor, index: int
) -> None:
    explanation = explained(kind, sensor, index)
    expected = run(recording(sensor), configuration(kind))[index]
    registration, repeated = expected.registration, explanation.registration
    assert registration is not None
    assert repeated is not None
    assert explanation.result.registration is not None
    for name in (
        *("T_reference_current", "covariance", "inliers", "matches", "pixels_reference"),
        "pixels_current",
    ):
        shown = getattr(explanation.result.registration, name)
        assert np.array_equal(shown, getattr(registration, name)), name
    assert np.array_equal(explanation.result.causal.T_world_frame, expected.causal.T_world_frame)
    assert np.array_equal(explanation.result.raw.covariance, expected.raw.covariance)
    matches, kept = repeated.matches, repeated.matches.are_kept
    # The points of descriptors are in the order of the matches, not of the reference.
    order = np.argsort(registration.matches[:, 0])
    assert np.array_equal(matches.partners[kept], registration.pixels_current[order])
    assert np.array_equal(matches.pixels[kept], registration.pixels_reference[order])
    assert repeated.residuals_px is not None
    after = np.abs(repeated.residuals_px[1][repeated.inliers])
    assert np.median(after) <= np.median(np.abs(repeated.residuals_px[0][repeated.inliers])) + 0.02
    assert repeated.consensus >= 0.5 * registration.n_inliers


@EACH
def test_each_keypoint_has_one_reason_and_those_kept_are_points(kind: str, sensor: Sensor) -> None:
    explanation = explained(kind, sensor)
    counts = explanation.measured.counts()
    assert sum(counts.values()) == explanation.result.n_keypoints
    assert counts["kept"] == explanation.result.n_points


@pytest.mark.parametrize("sensor", SENSORS)
def test_one_corner_is_followed_to_the_peak_of_its_correlation(sensor: Sensor) -> None:
    explanation = explained("klt", sensor)
    corner = explanation.corner
    assert corner is not None
    best = corner.columns[corner.correlations.argmax()]
    assert abs(best - corner.end) <= 1.0
    assert corner.correlations.max() > 0.8
    if sensor == "stereo":
        assert corner.end == pytest.approx(corner.pixel[0] - corner.partner[0])
        shown = explanation.measured.pixels[explanation.measured.are_kept]
        assert corner.pixel.tolist() in shown.tolist()
    assert explained("descriptor", sensor).corner is None


@pytest.mark.parametrize("kind", KINDS)
def test_each_keyframe_has_an_edge_or_the_reason_why_not(kind: str) -> None:
    source = SyntheticRecording("driving", "stereo", n_frames=7, scale=0.4)
    # So few links that a keyframe is left out.
    config = load_configuration(settings=[f"frontend.kind={kind}", "window.n_links=2"])
    done: list[Progress] = []
    explanation = explain_frame(source, 6, config=config, on_progress=done.append)
    before = run(source, config)[5]
    links = explanation.links
    assert links[0].kind == "step"
    assert links[0].stamp_ns == before.stamp_ns
    stamps_ns = [link.stamp_ns for link in links]
    assert sorted(stamps_ns) == sorted({before.stamp_ns, *before.keyframes_ns})
    assert all(0.0 <= link.overlap <= 1.0 for link in links)
    assert links[0].overlap > 0.5
    for link in links:
        if link.reason == "too little overlap":
            assert link.overlap < config.window.min_overlap
    assert all(bool(link.reason) != link.is_accepted for link in links)
    assert {"step", "not linked"} <= {link.kind for link in links}
    assert explanation.result.n_links == sum(link.is_accepted for link in links)
    assert [(each.n_done, each.n_total, each.n_tracked) for each in done] == [
        (n, 7, n) for n in range(1, 7)
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_prediction_the_matches_agree_by_ransac(kind: str) -> None:
    found = explained(kind, "stereo").registration
    settings = [f"frontend.kind={kind}", "registration.refine=none"]
    config = load_configuration(settings=settings)
    explanation = explain_frame(recording("stereo"), LAST, config=config)
    unpredicted = explanation.registration
    assert found is not None
    assert unpredicted is not None
    assert (found.is_known, unpredicted.is_known) == (True, False)
    assert (unpredicted.consensus > 0) == (explanation.result.registration is not None)


def test_the_offsets_of_the_rig_are_those_that_the_frame_was_measured_with() -> None:
    config, source = configuration("klt"), recording("stereo")
    odometry = Odometry(source.info.camera, config)
    for frame in frames(source, config):
        assert not isinstance(frame, FaultyFrame)
        odometry.track(frame)
    # What the last frame taught takes effect with the next one.
    offsets, explanation = odometry.rig_offsets, explained("klt", "stereo")
    assert offsets is not None
    assert explanation.offset_px == offsets.disparity_px
    assert explanation.row_offset_px == offsets.row.value != 0.0
    assert explanation.readout_ms == 1e3 * offsets.readout_s


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_told_how_far_rows_are_moved_for_the_readout_assumed(kind: str) -> None:
    moved_px = []
    for readout_ms in (0.0, 12.0, 24.0):
        config = load_configuration(
            settings=[f"frontend.kind={kind}", f"camera.readout_ms={readout_ms}"]
        )
        explanation = explain_frame(recording("rgbd"), LAST, config=config)
        assert explanation.readout_ms == readout_ms
        repeated = explanation.registration
        assert repeated is not None
        moved_px.append(repeated.row_motion_px)
        found = explanation.result.registration
        assert found is not None
        assert np.array_equal(repeated.inliers, found.inliers)
    assert moved_px[0] == 0.0
    assert 0.3 < moved_px[1] < 20.0
    assert moved_px[2] == pytest.approx(2.0 * moved_px[1], rel=0.2)


def test_a_first_frame_is_explained_without_a_motion() -> None:
    explanation = explained("klt", "stereo", 0)
    assert explanation.reference is None
    assert explanation.links == ()
    assert explanation.registration is None
    assert explanation.attempts == ()
    assert explanation.measured.are_kept.any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_black_frame_and_the_one_after_are_explained_as_far_as_they_got(kind: str) -> None:
    source = spoiled()
    black = explain_frame(source, BLACK, config=configuration(kind))
    assert black.result.registration is None
    assert black.result.reason
    assert black.registration is not None
    assert black.registration.residuals_px is None
    assert black.attempts[-1].endswith(black.result.reason)
    after = explain_frame(source, BLACK + 1, config=configuration(kind))
    assert after.result.registration is not None
    assert after.reference_index == BLACK - 1


def test_a_faulty_frame_is_refused_in_one_line_and_counts() -> None:
    source = spoiled(is_faulty=True)
    with pytest.raises(GvoError, match=f"frame {BLACK} is faulty") as error:
        explain_frame(source, BLACK)
    assert "\n" not in str(error.value)
    after = explain_frame(source, BLACK + 1)
    assert after.index == BLACK + 1
    assert after.reference_index == BLACK - 1


@pytest.mark.parametrize(
    ("index", "kind", "words"),
    [(LAST + 1, GvoError, f"no frame {LAST + 1}.*up to {LAST}"), (-1, ValueError, "0 or more")],
)
def test_a_frame_not_there_is_refused(index: int, kind: type[Exception], words: str) -> None:
    with pytest.raises(kind, match=words):
        explain_frame(recording("stereo"), index)
