"""What is explained is what happened in a run."""

from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gvo._trace import Event, Trace
from gvo.backend.keyframe_policy import choose_links
from gvo.config import Config, load_configuration
from gvo.diagnostics.explain import FrameExplanation, explain_frame
from gvo.diagnostics.explain.steps import explain_consensus, explain_refinement
from gvo.errors import GvoError
from gvo.geometry import se3
from gvo.io.frames import frames
from gvo.io.recording import Sensor, Source, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.keyframes import Keyframes
from gvo.odometry.odometry import Odometry
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
def test_the_explained_registration_is_that_of_a_run_bit_for_bit(kind: str, sensor: Sensor) -> None:
    explanation = explained(kind, sensor)
    expected = run(recording(sensor), configuration(kind))[LAST]
    registration, refinement = expected.registration, explanation.refinement
    assert registration is not None
    assert refinement is not None
    assert explanation.matches is not None
    assert explanation.consensus is not None
    matches = explanation.matches
    kept = matches.are_kept
    T_end = refinement.drawn.T_target_source[1]
    assert np.array_equal(se3.invert(T_end), registration.T_reference_current)
    assert explanation.result.registration is not None
    for name in (
        *("T_reference_current", "covariance", "inliers", "matches", "pixels_reference"),
        "pixels_current",
    ):
        shown = getattr(explanation.result.registration, name)
        assert np.array_equal(shown, getattr(registration, name)), name
    assert np.array_equal(refinement.drawn.inliers, registration.inliers)
    assert np.array_equal(matches.partners[kept], registration.pixels_current)
    assert np.array_equal(matches.pixels[kept], registration.pixels_reference)
    assert np.array_equal(explanation.result.causal.T_world_frame, expected.causal.T_world_frame)
    assert np.array_equal(explanation.result.raw.covariance, expected.raw.covariance)


@EACH
def test_each_keypoint_has_one_reason_and_those_kept_are_points(kind: str, sensor: Sensor) -> None:
    explanation = explained(kind, sensor)
    counts = explanation.measured.counts()
    assert sum(counts.values()) == explanation.result.n_keypoints
    assert counts["kept"] == explanation.result.n_points


@EACH
def test_the_keypoints_in_the_budget_are_those_measured(kind: str, sensor: Sensor) -> None:
    explanation = explained(kind, sensor)
    keypoints, measured = explanation.keypoints, explanation.measured.pixels
    kept = keypoints.pixels[keypoints.are_kept]
    assert sorted(kept.tolist()) == sorted(measured.tolist())
    config = explanation.config
    budget = config.klt.n_corners if kind == "klt" else config.features.n_features
    assert len(kept) == min(budget, len(keypoints))


@pytest.mark.parametrize(("kind", "reach_px"), [("klt", 1.0 - 1e-6), ("descriptor", 0.5 + 1e-6)])
def test_subpixel_search_ends_near_the_least_difference(kind: str, reach_px: float) -> None:
    step = explained(kind, "stereo").subpixel
    assert step is not None
    assert step.iterates_px[-1] == step.disparity_px
    assert abs(step.columns_px[step.ssd.argmin()] - step.disparity_px) <= reach_px


@pytest.mark.parametrize("kind", KINDS)
def test_scores_of_keyframes_are_the_odometrys(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict[int, float]] = []
    original = Keyframes.scores

    def scores(self: Keyframes, T: dict) -> dict[int, float]:  # type: ignore[type-arg]
        seen.append(original(self, T))
        return seen[-1]

    chosen_links: list[tuple[list[int], list[int]]] = []

    def choose(*arguments: Any, **options: Any) -> tuple[list[int], list[int]]:
        chosen_links.append(choose_links(*arguments, **options))
        return chosen_links[-1]

    monkeypatch.setattr(Keyframes, "scores", scores)
    monkeypatch.setattr("gvo.odometry.keyframes.choose_links", choose)
    explanation = explain_frame(recording("stereo"), LAST, config=configuration(kind))
    shown = {link.stamp_ns: link.overlap for link in explanation.links}
    assert seen[-1].items() <= shown.items()
    linked = {link.stamp_ns for link in explanation.links if link.kind == "keyframe"}
    chosen, spare = chosen_links[-1]
    assert set(chosen) <= linked <= {*chosen, *spare}
    assert linked


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
    assert all(bool(link.reason) != link.is_accepted for link in links)
    assert {"step", "not linked"} <= {link.kind for link in links}
    assert explanation.result.n_links == sum(link.is_accepted for link in links)
    assert [(each.n_done, each.n_total, each.n_tracked) for each in done] == [
        (n, 7, n) for n in range(1, 7)
    ]


def test_the_samples_are_shown_although_the_prediction_made_them_needless() -> None:
    step = explained("klt", "stereo").consensus
    assert step is not None
    assert len(step.samples.inliers) == step.samples.n_drawn > 0
    assert step.samples.n_inliers is not None
    if step.is_known:
        assert step.n_agreeing_with_prediction is not None
        assert step.n_agreeing_with_prediction >= step.drawn.n_needed


@pytest.mark.parametrize("refine", ["none", "gauss_newton"])
def test_what_happened_after_a_step_is_not_counted_with_it(refine: str) -> None:
    # Samples are drawn where nothing is refined.
    settings = ["frontend.kind=descriptor", f"registration.refine={refine}"]
    config = load_configuration(settings=settings)
    explanation = explain_frame(recording("stereo"), 1, config=config)
    attempt, camera = explanation.attempt, explanation.camera
    later = Event(
        name="ransac.block",
        values={"n_before": 0, "is_valid": np.ones(9_999, np.bool_), "counts": 0, "share": 0.0},
    )
    longer = Trace([*attempt, later, *attempt])
    consensus = explain_consensus(longer, camera, config)
    refinement = explain_refinement(longer, camera, config)
    assert explanation.consensus is not None
    assert explanation.refinement is not None
    assert consensus is not None
    assert refinement is not None
    assert consensus.is_known == (refine != "none")
    assert list(consensus.samples.inliers) == list(explanation.consensus.samples.inliers)
    assert refinement.n_steps == explanation.refinement.n_steps
    assert bool(refinement.n_steps) == (refine != "none")


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
        assert explanation.row_motion_px is not None
        moved_px.append(explanation.row_motion_px)
        # What is shown of the refinement is the last of two rounds, the result.
        assert explanation.refinement is not None
        assert explanation.result.registration is not None
        found = explanation.result.registration
        assert explanation.refinement.n_inliers[1] == found.n_inliers
        # The reference's velocity is known better since its own step: that corrects the result.
        T = se3.invert(explanation.refinement.drawn.T_target_source[1])
        atol = 0.0 if readout_ms == 0.0 else 1e-3
        np.testing.assert_allclose(T, found.T_reference_current, rtol=0.0, atol=atol)
    assert moved_px[0] == 0.0
    assert 0.3 < moved_px[1] < 20.0
    assert moved_px[2] == pytest.approx(2.0 * moved_px[1], rel=0.2)
    assert explain_frame(recording("rgbd"), 0).row_motion_px is None


def test_a_first_frame_is_explained_without_a_motion() -> None:
    explanation = explained("klt", "stereo", 0)
    assert explanation.reference is None
    assert explanation.links == ()
    assert explanation.matches is None
    assert explanation.refinement is None
    assert explanation.measured.are_kept.any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_black_frame_and_the_one_after_are_explained_as_far_as_they_got(kind: str) -> None:
    source = spoiled()
    black = explain_frame(source, BLACK, config=configuration(kind))
    assert black.result.registration is None
    assert black.result.reason
    assert black.refinement is None
    assert black.attempts
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
