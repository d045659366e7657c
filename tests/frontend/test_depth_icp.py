"""ICP of depth images against rendered poses, and when depth is believed beside colour."""

import functools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import gvo
from gvo.config import Config, DepthConfig
from gvo.frontend.depth_icp import DepthImage, DepthMap, DepthTrust, align_depth_maps
from gvo.frontend.descriptor import as_stereo
from gvo.geometry import se3
from gvo.io.recording import StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.types import DepthArray, Failure, FloatArray, RelativePose, RgbdFrame

N_FRAMES = 40
SCALE = 0.5
STEP = np.array([0.02, -0.025, 0.015, 0.02, -0.03, 0.035])  # 2 degrees, 5 cm


@functools.cache
def recording() -> tuple[gvo.StereoCamera, list[RgbdFrame], FloatArray]:
    rendered = SyntheticRecording("handheld", "rgbd", n_frames=N_FRAMES, scale=SCALE)
    frames = [frame for frame in gvo.frames(rendered) if isinstance(frame, RgbdFrame)]
    camera = as_stereo(rendered.info.camera)
    return camera, frames, rendered.ground_truth().T_world_frame


def depth_map(depth: DepthArray) -> DepthMap:
    return DepthMap.of(depth, recording()[0], DepthConfig())


def align(i: int, j: int, start: FloatArray) -> tuple[RelativePose, FloatArray]:
    """Return the motion from frame i to j and its error, starting off the truth."""
    _, frames, T = recording()
    truth = se3.invert(T[i]) @ T[j]
    found = align_depth_maps(
        depth_map(frames[i].depth), depth_map(frames[j].depth), truth @ se3.exp(start)
    )
    assert isinstance(found, RelativePose)
    return found, se3.log(se3.invert(truth) @ found.T_reference_current)


@pytest.mark.parametrize("start", [STEP, -STEP, STEP[[1, 0, 2, 5, 3, 4]]])
def test_a_motion_of_two_degrees_and_five_centimetres_is_found(start: FloatArray) -> None:
    for i in (0, 15, 30):
        _, error = align(i, i + 5, start)
        assert np.linalg.norm(error[3:]) < 1e-3
        assert np.degrees(np.linalg.norm(error[:3])) < 0.05


def test_errors_are_within_three_times_what_the_covariance_says() -> None:
    measured = [align(i, i + 3, 0.1 * STEP) for i in range(N_FRAMES - 3)]
    nees = [se3.mahalanobis(error, found.covariance) for found, error in measured]
    assert 6.0 / 9.0 < np.mean(nees) < 6.0 * 9.0


def test_a_wall_tells_three_directions_and_leaves_the_others_as_they_were() -> None:
    camera, _, _ = recording()
    rows, columns = np.mgrid[: camera.height, : camera.width]
    inverse = 0.5 + 1e-4 * (columns - camera.cx) - 2e-4 * (rows - camera.cy)
    rng = np.random.default_rng(3)
    noisy = [
        depth_map((1.0 / (inverse + 1e-3 * rng.standard_normal(inverse.shape))).astype(np.float32))
        for _ in range(2)
    ]
    found = align_depth_maps(noisy[0], noisy[1], se3.exp(0.1 * STEP))
    assert isinstance(found, RelativePose)
    sigmas = np.sqrt(np.linalg.eigvalsh(found.covariance))
    assert sigmas[2] < 0.005
    assert sigmas[3] > 0.03
    assert se3.mahalanobis(se3.log(found.T_reference_current), found.covariance) < 6.0 * 9.0
    # Along the wall nothing was measured: the start value stays.
    along = np.cross(np.array([1e-4 * camera.fx, -2e-4 * camera.fy, 0.5]), [1.0, 0.0, 0.0])
    along /= np.linalg.norm(along)
    assert found.T_reference_current[:3, 3] @ along == pytest.approx(
        0.1 * STEP[3:] @ along, abs=5e-4
    )


def test_images_of_other_places_and_repeated_or_late_ones_fail() -> None:
    camera, frames, _ = recording()
    first, second = (DepthImage(frame, camera, DepthConfig()) for frame in frames[:2])
    late = replace(frames[1], depth_stamp_ns=frames[1].stamp_ns + 10_000_000)
    repeated = replace(frames[1], depth=frames[0].depth)
    far = replace(frames[1], depth=frames[1].depth + np.float32(2.0))
    for frame, reason in ((late, "together"), (repeated, "repeated"), (far, "fit each other")):
        result = first.align(DepthImage(frame, camera, DepthConfig()), np.eye(4))
        assert isinstance(result, Failure)
        assert reason in result.reason
    assert first.align(second, np.eye(4))


def test_a_frame_knows_when_its_depth_was_taken() -> None:
    rendered = SyntheticRecording("handheld", "rgbd", n_frames=2, scale=0.2)
    moved = [
        replace(image, stamp_ns=image.stamp_ns + 7 * image.stream) for image in rendered.images()
    ]

    class Recorded:
        info = rendered.info
        ground_truth = rendered.ground_truth

        def images(self) -> Iterator[StampedImage]:
            return iter(moved)

    frames = [frame for frame in gvo.frames(Recorded()) if isinstance(frame, RgbdFrame)]
    assert [frame.depth_stamp_ns for frame in frames] == [frame.stamp_ns + 7 for frame in frames]
    assert len(frames) == 2


def feed(trust: DepthTrust, error_sigmas: float, n: int = 60) -> int:
    """Measure motions by colour and depth that differ by so many sigmas; return how many."""
    rng = np.random.default_rng(0)
    n_measured = 0
    for _ in range(n):
        if trust.is_due():
            n_measured += 1
            trust.note(*measured_twice(rng, error_sigmas))
    return n_measured


def measured_twice(
    rng: np.random.Generator, error_sigmas: float
) -> tuple[RelativePose, RelativePose]:
    covariance = 1e-6 * np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    T = se3.exp(STEP)
    difference = np.sqrt(2.0 * np.diag(covariance)) * rng.standard_normal(6) * error_sigmas
    return (
        RelativePose(T_reference_current=T, covariance=covariance),
        RelativePose(T_reference_current=T @ se3.exp(difference), covariance=covariance),
    )


def test_depth_that_agrees_is_tried_now_and_then_and_gives_no_edge() -> None:
    trust = DepthTrust()
    assert feed(trust, 1.0, n=400) < 40
    assert not trust.is_on
    assert trust.variance_factor == 1.0


def test_depth_that_contradicts_gives_edges_as_wide_as_the_contradiction() -> None:
    trust = DepthTrust()
    feed(trust, 8.0, n=200)
    assert trust.is_on
    # The difference is that of two measurements of equal noise.
    assert trust.variance_factor == pytest.approx(2.0 * 8.0**2, rel=0.5)
    feed(trust, 1.0, n=100)
    assert not trust.is_on


@functools.cache
def small() -> tuple[gvo.PinholeCamera, list[RgbdFrame]]:
    rendered = SyntheticRecording("handheld", "rgbd", n_frames=80, scale=0.35)
    assert isinstance(rendered.info.camera, gvo.PinholeCamera)
    return rendered.info.camera, [
        frame for frame in gvo.frames(rendered) if isinstance(frame, RgbdFrame)
    ]


def depth_links(shift_px: int, n_frames: int) -> int:
    """Return the number of depth edges of a run whose depth is moved against colour."""
    camera, frames = small()
    odometry = gvo.Odometry(camera, Config.model_validate({"camera": {"readout_ms": 0.0}}))
    n_links = 0
    for frame in frames[:n_frames]:
        moved = np.roll(frame.depth, shift_px, axis=1)
        moved[:, :shift_px] = np.nan
        result = odometry.track(replace(frame, depth=moved))
        links = [link for link in result.links if link.kind == "depth"]
        n_links += sum(link.is_accepted for link in links)
    return n_links


def test_depth_edges_are_off_where_depth_is_registered_and_on_where_it_is_not() -> None:
    assert depth_links(0, 80) == 0
    assert depth_links(8, 80) > 10
