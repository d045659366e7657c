"""What is not used: by a mask, and what rides with the camera."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.frontend.factory import make_frontend
from gvo.types import Frame, RgbdFrame, StereoFrame
from tests.faults import bonnet
from tests.make.recordings import frames_of

N_FRAMES = 14
BONNET_PX = 18.0  # its disparity: 1.6 m away


@cache
def drive(world: str = "driving", sensor: str = "stereo") -> gvo.SyntheticRecording:
    recording: Any = gvo.SyntheticRecording
    return recording(world, sensor, n_frames=N_FRAMES, seed=1, scale=0.4)  # type: ignore[no-any-return]


def with_bonnet(frame: Frame) -> Frame:
    """Return a frame with what does not move with the world in the lower 33 % of its images."""
    assert isinstance(frame, StereoFrame)
    rng = np.random.default_rng(frame.stamp_ns)
    left, right = (
        bonnet(image, 0, rng, part=0.33, shift_px=shift_px, sigma=0.0)
        for image, shift_px in ((frame.left, 0.0), (frame.right, BONNET_PX))
    )
    return replace(frame, left=left, right=right)


def track(frames: list[Frame], kind: str = "klt") -> gvo.Odometry:
    config = gvo.Config.model_validate({"frontend": {"kind": kind}})
    odometry = gvo.Odometry(drive().info.camera, config)
    for frame in frames:
        odometry.track(frame)
    return odometry


def path_m(odometry: gvo.Odometry, name: str) -> float:
    T = odometry.trajectories()[name].T_world_frame
    return float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())


def told(odometry: gvo.Odometry) -> dict[str, float]:
    assert odometry.rig_offsets is not None
    return odometry.rig_offsets.as_json()


@pytest.mark.parametrize(("kind", "n_lost"), [("klt", 0.2), ("descriptor", 1.0)])
def test_a_bonnet_does_not_shorten_the_path(kind: str, n_lost: float) -> None:
    frames = frames_of(drive())
    plain, covered = track(frames, kind), track([*map(with_bonnet, frames)], kind)
    for name in ("raw", "smoothed"):
        length_m = path_m(plain, name)
        assert abs(path_m(covered, name) - length_m) <= n_lost * length_m / (N_FRAMES - 1)
    assert "carried_corners" not in told(plain)
    assert told(covered)["carried_corners"] > 20
    if kind == "klt":
        assert 10.0 < told(covered)["carried_percent"] < 33.0


def test_a_world_that_moves_on_is_used_again() -> None:
    """Half of the view is at rest as the rest moves; then all of it moves."""
    frames = frames_of(drive())
    still = [with_bonnet(frame) for frame in frames[:6]]
    odometry = track(still)
    frontend: Any = odometry._frontend
    carried = frontend.rig_offsets.carried
    pixels = frontend.extract(still[-1]).corners.carried
    assert carried.holds(pixels).all()
    assert len(pixels) > 20
    for frame in frames[6:]:
        odometry.track(frame)
    assert np.mean(carried.holds(pixels)) < 0.1


@pytest.mark.parametrize("world", ["hovering", "turning"])
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_nothing_rides_with_a_camera_that_hovers_or_turns(world: str, sensor: str) -> None:
    recording = drive(world, sensor)
    odometry = gvo.Odometry(recording.info.camera)
    for frame in frames_of(recording):
        odometry.track(frame)
    assert "carried_corners" not in told(odometry)


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_what_is_masked_is_not_used(sensor: str, kind: str) -> None:
    recording = drive("handheld", sensor)
    first, second = frames_of(recording)[:2]
    frontend: Any
    left: Any = np.full((recording.info.camera.height, recording.info.camera.width), 255, np.uint8)
    right = left.copy()
    left[:, :100], right[:80] = 0, 0
    masks = {"mask": left} | ({"right_mask": right} if sensor == "stereo" else {})
    config = gvo.Config.model_validate({"frontend": {"kind": kind}})
    frontend = make_frontend(recording.info.camera, config)
    plain, masked = (frontend.extract(frame) for frame in (first, replace(first, **masks)))
    limits = [100, 80] if sensor == "stereo" else [100, 0]
    assert np.any(plain.keypoints[:, 0] < 100)
    assert (masked.keypoints >= limits).all()
    assert len(masked) > 50
    # Tracks and matches that end on masked pixels are not used either.
    result = frontend.register(plain, frontend.extract(replace(second, **masks)), None)
    assert isinstance(result, gvo.RelativePose)
    assert (result.pixels_current >= np.array(limits) - 0.5).all()


def test_a_mask_of_another_size_is_no_mask_of_a_frame() -> None:
    image, mask = np.zeros((4, 6), np.uint8), np.ones((6, 4), np.uint8)
    with pytest.raises(ValueError, match=r"a mask of a stereo frame .* \(4, 6\), got uint8 \(6, 4"):
        StereoFrame(stamp_ns=1, left=image, right=image, right_mask=mask)
    depth = np.ones((4, 6), np.float32)
    with pytest.raises(ValueError, match=r"a mask of an RGB-D frame"):
        RgbdFrame(stamp_ns=1, image=image, depth=depth, mask=mask)
    frame = RgbdFrame(stamp_ns=1, image=image, depth=depth, mask=np.eye(4, 6, dtype=np.uint8))
    np.testing.assert_array_equal(np.isfinite(frame.depth), np.eye(4, 6) > 0)
