"""Truth and estimate in one frame: the same motion seen from two places of one body."""

import numpy as np

from gvo.geometry import se3
from gvo.io.poses.tf import TfBuffer
from gvo.io.poses.truth import Poses, Truth, in_frame
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from tests.make.bags import add_transform

SECOND = 10**9
T_BASE_CAM = se3.exp(np.array([-1.2, 1.1, -1.3, 0.3, 0.1, 0.5]))


def motion(n: int = 30, seed: int = 0) -> FloatArray:
    twists = np.random.default_rng(seed).normal(size=(n, 6)) * [0.1, 0.1, 0.3, 0.1, 0.1, 0.1]
    twists[:, 3] += 0.5
    poses = [np.eye(4)]
    for step in se3.exp(twists[1:]):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def trajectory(poses: FloatArray) -> Trajectory:
    stamps_ns = np.arange(len(poses)) * SECOND // 10
    return Trajectory(stamps_ns=stamps_ns, T_world_frame=poses, stamps_from="topic")


def truth_of(found: Trajectory, child: str, *, is_of_camera: bool = False) -> Poses:
    return Poses(
        trajectory=found,
        child_frame=child,
        decision="it was read",
        is_of_camera=is_of_camera,
    )


def mounted() -> TfBuffer:
    buffer = TfBuffer()
    add_transform(buffer, "base", "cam", 0, T_BASE_CAM, is_static=True)
    return buffer


def framed(*arguments: Poses | TfBuffer, **options: object) -> Truth:
    found = in_frame(*arguments, **options)  # type: ignore[arg-type]
    assert isinstance(found, Truth)
    return found


def test_a_mount_from_a_file_goes_with_tf_up_to_the_camera() -> None:
    """The body of the file, which tf does not know, hangs on the camera, which tf knows."""
    T_body_cam = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    truth = truth_of(trajectory(motion()), "base")
    found = framed(truth, mounted(), base_frame="body", camera_frame="cam", T_base_cam=T_body_cam)
    expected = motion() @ T_BASE_CAM @ np.linalg.inv(T_body_cam)
    np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-9)


def test_where_the_mount_is_not_known_the_poses_are_left_out() -> None:
    buffer = TfBuffer()
    for n in range(11):  # the camera turns on the base, for the first second
        add_transform(buffer, "base", "cam", n * SECOND // 10, se3.exp(n * np.full(6, 0.1)))
    found = framed(truth_of(trajectory(motion()), "base"), buffer, camera_frame="cam")
    expected = np.stack([motion()[n] @ se3.exp(n * np.full(6, 0.1)) for n in range(11)])
    np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-9)
    assert found.decision.endswith("by tf; 19 left out where tf does not know it")


def test_an_antenna_whose_place_is_not_known_is_compared_with_a_warning() -> None:
    positions = Trajectory.of_positions(np.arange(3), np.eye(3))
    moving = TfBuffer()
    for n in range(3):
        add_transform(moving, "cam", "gps", n, se3.exp(n * np.ones(6)))
    for buffer, reason in ((TfBuffer(), "holds no frame"), (moving, "tf moves gps against cam")):
        found = framed(truth_of(positions, "gps"), buffer, camera_frame="cam")
        assert reason in found.warning
        assert found.warning.endswith("the errors include its lever arm")
        np.testing.assert_array_equal(found.T_base_point, np.eye(4))
