"""What is explained is what happened in a run."""

from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import gvo
from gvo.backend.keyframe_policy import MIN_OVERLAP
from gvo.config import Config
from gvo.diagnostics.explain import explain_frame
from gvo.errors import GvoError
from gvo.io.recording import Sensor, Source, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FrameResult, Progress
from tests.make.explained import KINDS, LAST, configuration, explained, recording
from tests.make.recordings import Held, frames_of, hold

SENSORS: tuple[Sensor, ...] = ("stereo", "rgbd")
EACH = pytest.mark.parametrize(("kind", "sensor"), [*product(KINDS, SENSORS)])
BLACK = 2


def spoiled(*, is_faulty: bool = False) -> Held:
    """Return a recording with a black frame, or one whose images cannot be read."""

    def spoil(image: StampedImage) -> NDArray[Any]:
        return np.zeros((3, 3), np.uint8) if is_faulty else np.zeros_like(image.load())

    return replace(hold(recording("stereo")), truth=None).mapped(
        lambda image, n: replace(image, load=partial(spoil, image)) if n == BLACK else image
    )


def run(source: Source, config: Config) -> list[FrameResult]:
    odometry = Odometry(source.info.camera, config)
    return [odometry.track(frame) for frame in frames_of(source)]


@EACH
def test_it_ends_with_the_pose_of_a_run_bit_for_bit(
    kind: str, sensor: Sensor, tmp_path: Path
) -> None:
    outputs = gvo.RunOutputs(report=False)
    config = configuration(kind)
    gvo.run_recording(recording(sensor), tmp_path / "run", config=config, outputs=outputs)
    found = explained(kind, sensor).result.causal
    shown = tmp_path / "shown.txt"
    T = found.T_world_frame[np.newaxis]
    write_tum(shown, Trajectory(stamps_ns=np.array([found.stamp_ns]), T_world_frame=T))
    assert shown.read_text() == (tmp_path / "run" / "causal.txt").read_text().splitlines(True)[LAST]


@EACH
def test_what_is_repeated_is_what_happened_bit_for_bit(kind: str, sensor: Sensor) -> None:
    explanation = explained(kind, sensor)
    expected = run(recording(sensor), configuration(kind))[LAST]
    registration, repeated = expected.registration, explanation.registration
    assert registration is not None
    assert repeated is not None
    shown = explanation.result.registration
    for name in ("T_reference_current", "covariance", "inliers", "matches", "pixels_current"):
        assert np.array_equal(getattr(shown, name), getattr(registration, name)), name
    assert np.array_equal(explanation.result.raw.covariance, expected.raw.covariance)
    matches, kept = repeated.matches, repeated.matches.are_kept
    # The points of descriptors are in the order of the matches, not of the reference.
    order = np.argsort(registration.matches[:, 0])
    assert np.array_equal(matches.partners[kept], registration.pixels_current[order])
    assert np.array_equal(matches.pixels[kept], registration.pixels_reference[order])
    assert repeated.residuals_px is not None
    before, after = np.median(np.abs(repeated.residuals_px[:, repeated.inliers]), axis=(1, 2))
    assert after <= before + 0.02
    assert repeated.n_consensus >= 0.5 * registration.n_inliers
    # Each keypoint has one reason, and those kept are the points.
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
    config = configuration(kind, "window.n_links=2")  # so few that a keyframe is left out
    done: list[Progress] = []
    explanation = explain_frame(source, 6, config=config, on_progress=done.append)
    before, links = run(source, config)[5], explanation.links
    assert (links[0].kind, links[0].stamp_ns) == ("step", before.stamp_ns)
    stamps_ns = [link.stamp_ns for link in links]
    assert sorted(stamps_ns) == sorted({before.stamp_ns, *before.keyframes_ns})
    assert all(0.0 <= link.overlap <= 1.0 for link in links)
    assert links[0].overlap > 0.5
    for link in links:
        assert bool(link.reason) != link.is_accepted
        if link.reason == "too little overlap":
            assert link.overlap < MIN_OVERLAP
    assert {"step", "not linked"} <= {link.kind for link in links}
    assert explanation.result.n_links == sum(link.is_accepted for link in links)
    assert [(each.n_done, each.n_total, each.n_tracked) for each in done] == [
        (n, 7, n) for n in range(1, 7)
    ]


def test_the_offsets_of_the_rig_are_those_that_the_frame_was_measured_with() -> None:
    source = recording("stereo")
    odometry = Odometry(source.info.camera, configuration("klt"))
    for frame in frames_of(source):
        odometry.track(frame)
    # What the last frame taught takes effect with the next one.
    offsets, explanation = odometry.rig_offsets, explained("klt", "stereo")
    assert offsets is not None
    assert explanation.offsets.lens[0] == offsets.lens[0]
    assert explanation.offsets.rows[0] == offsets.rows[0] != 0.0
    assert explanation.offsets.readout_s == offsets.readout_s


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_told_how_far_rows_are_moved_for_the_readout_assumed(kind: str) -> None:
    moved_px = []
    for readout_ms in (12.0, 24.0):
        explanation = explained(kind, "rgbd", LAST, f"camera.readout_ms={readout_ms}")
        assert 1e3 * explanation.offsets.readout_s == readout_ms
        assert explanation.registration is not None
        moved_px.append(explanation.registration.row_motion_px)
    assert 0.3 < moved_px[0] < 20.0
    assert moved_px[1] == pytest.approx(2.0 * moved_px[0], rel=0.2)


def test_a_first_frame_is_explained_without_a_motion() -> None:
    explanation = explained("klt", "stereo", 0)
    assert (explanation.reference, explanation.registration) == (None, None)
    assert explanation.links == ()
    assert explanation.measured.are_kept.any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_black_frame_and_the_one_after_are_explained_as_far_as_they_got(kind: str) -> None:
    black = explain_frame(spoiled(), BLACK, config=configuration(kind))
    assert black.result.registration is None
    assert black.registration is not None
    assert black.registration.residuals_px is None
    assert black.registration.attempts[-1].endswith(f": {black.result.reason}")
    after = explain_frame(spoiled(), BLACK + 1, config=configuration(kind))
    assert after.result.registration is not None
    assert after.reference_index == BLACK - 1


@pytest.mark.parametrize(
    ("source", "index", "kind", "words"),
    [
        (spoiled(is_faulty=True), BLACK, GvoError, f"frame {BLACK} is faulty"),
        (recording("stereo"), LAST + 1, GvoError, f"no frame {LAST + 1}.*up to {LAST}"),
        (recording("stereo"), -1, ValueError, "0 or more"),
    ],
)
def test_a_frame_not_there_is_refused_in_one_line(
    source: Source, index: int, kind: type[Exception], words: str
) -> None:
    with pytest.raises(kind, match=words) as error:
        explain_frame(source, index)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("sensor", "every", "first", "place"),
    [
        ("stereo", 14, "its motion predicts the next attempt", "predicted pixels"),
        ("rgbd", 25, "not registered", "pixels that descriptors predict"),
    ],
)
def test_only_a_search_that_found_a_motion_is_said_to_predict_the_next(
    sensor: Sensor, every: int, first: str, place: str
) -> None:
    turning = SyntheticRecording("turning", sensor, n_frames=2 * every, scale=0.5)
    found = explain_frame(turning, 1, excerpt=gvo.Excerpt(every=every)).registration
    assert found is not None
    assert found.attempts[0] == f"wide search around the previous pixels: {first}"
    assert found.attempts[1].startswith(f"near search around the {place}: registered, ")
    assert len(found.attempts) == 2
    assert len(found.inliers) == found.matches.are_kept.sum()
