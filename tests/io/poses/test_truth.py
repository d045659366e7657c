"""Truth and estimate in one frame: the same motion seen from two places of one body."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.io.bag.reader import BagReader
from gvo.io.poses.tf import TfBuffer, read_tf
from gvo.io.poses.truth import BagTruthSpec, Poses, TfTruth, Truth, find_truth, in_frame
from gvo.trajectory.evaluation import evaluate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray
from tests.make.bags import ODOMETRY, PoseBag, add_transform

SECOND = 10**9
T_BASE_CAM = se3.exp(np.array([-1.2, 1.1, -1.3, 0.3, 0.1, 0.5]))
seeds = st.integers(min_value=0, max_value=2**32 - 1)


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


@given(seeds)
def test_the_truth_of_the_base_becomes_that_of_the_camera(seed: int) -> None:
    T_map_base = motion(seed=seed)
    truth = truth_of(trajectory(T_map_base), "/base")
    found = framed(truth, mounted(), camera_frame="/cam")
    np.testing.assert_allclose(found.trajectory.T_world_frame, T_map_base @ T_BASE_CAM, atol=1e-9)
    assert found.decision == "it was read; brought from base to cam by tf"
    estimate = trajectory(se3.exp(np.ones(6)) @ T_map_base @ T_BASE_CAM)  # in a world of its own
    assert found.comparable(estimate) is estimate
    evaluation = evaluate(found.trajectory, estimate, name="e")
    assert (evaluation.ate_m, evaluation.rpe_deg) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_the_truth_of_the_camera_follows_its_mount_from_tf_or_from_a_file() -> None:
    truth = truth_of(trajectory(motion() @ T_BASE_CAM), "ground_truth", is_of_camera=True)
    assert framed(truth, TfBuffer()).trajectory is truth.trajectory
    assert framed(truth, TfBuffer(), camera_frame="cam").trajectory is truth.trajectory
    by_tf = framed(truth, mounted(), base_frame="base", camera_frame="cam")
    by_file = framed(truth, TfBuffer(), base_frame="body", T_base_cam=T_BASE_CAM)
    for found in (by_tf, by_file):
        np.testing.assert_allclose(found.trajectory.T_world_frame, motion(), atol=1e-9)


def test_a_mount_from_a_file_goes_with_tf_up_to_the_camera() -> None:
    """The body of the file, which tf does not know, hangs on the camera, which tf knows."""
    T_body_cam = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    truth = truth_of(trajectory(motion()), "base")
    found = framed(truth, mounted(), base_frame="body", camera_frame="cam", T_base_cam=T_body_cam)
    expected = motion() @ T_BASE_CAM @ np.linalg.inv(T_body_cam)
    np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-9)


def test_poses_that_name_no_frame_are_taken_for_the_one_asked_for() -> None:
    truth = truth_of(trajectory(motion()), "")
    for frame, name in (("base", "base"), ("", "the camera")):
        found = framed(truth, TfBuffer(), base_frame=frame)
        assert found.trajectory is truth.trajectory
        assert found.decision.endswith(f"; it names no frame, taken for {name}")


@pytest.mark.parametrize(
    ("camera_frame", "reason"), [("cam", "tf holds no frame"), ("", "does not name: tf cannot")]
)
def test_poses_of_a_frame_out_of_reach_are_not_compared(camera_frame: str, reason: str) -> None:
    truth = truth_of(trajectory(motion()), "vicon/drone")
    found = in_frame(truth, TfBuffer(), camera_frame=camera_frame)
    assert isinstance(found, Failure)
    assert found.reason.startswith("its poses are of vicon/drone, those of the estimate of ")
    assert reason in found.reason


def test_where_the_mount_is_not_known_the_poses_are_left_out() -> None:
    buffer = TfBuffer()
    for n in range(11):  # the camera turns on the base, for the first second
        add_transform(buffer, "base", "cam", n * SECOND // 10, se3.exp(n * np.full(6, 0.1)))
    found = framed(truth_of(trajectory(motion()), "base"), buffer, camera_frame="cam")
    expected = np.stack([motion()[n] @ se3.exp(n * np.full(6, 0.1)) for n in range(11)])
    np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-9)
    assert found.decision.endswith("by tf; 19 left out where tf does not know it")


@given(seeds)
def test_an_estimate_is_moved_to_the_antenna(seed: int) -> None:
    """A turning body draws other circles with its camera than with its antenna."""
    buffer = mounted()
    T_base_gps = se3.exp(np.array([0.1, 0.2, 0.3, -1.0, 0.5, 2.0]))
    add_transform(buffer, "base", "gps", 0, T_base_gps, is_static=True)
    T_map_base = motion(seed=seed)
    antenna = (T_map_base @ T_base_gps)[:, :3, 3]
    stamps_ns = trajectory(T_map_base).stamps_ns
    truth = truth_of(Trajectory.of_positions(stamps_ns, antenna, stamps_from="topic"), "gps")
    found = framed(truth, buffer, camera_frame="cam")
    assert not found.warning
    assert "gps lies at (" in found.decision
    estimate = trajectory(se3.exp(np.ones(6)) @ T_map_base @ T_BASE_CAM)
    moved = evaluate(found.trajectory, found.comparable(estimate), name="e")
    assert moved.ate_m == pytest.approx(0.0, abs=1e-6)
    assert moved.rpe_m is None
    assert evaluate(found.trajectory, estimate, name="e").ate_m > 0.05


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


def robot(path: Path, *, truth: str) -> BagReader:
    """Write the motion of a base with a camera, in tf and on a topic."""
    bag = PoseBag(path)
    bag.tf(0, "base", "cam", T_BASE_CAM, is_static=True)
    for n, T in enumerate(motion()):
        bag.tf(n * SECOND // 10, "odom", "base", T)
        bag.pose(truth, ODOMETRY, n * SECOND // 10, T, child="base")
    return BagReader(bag.write())


@pytest.mark.parametrize("spec", [None, "/gt", TfTruth("odom", "base")])
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_what_is_asked_for_or_named_comes_in_the_frame_of_the_camera(
    tmp_path: Path, spec: BagTruthSpec | None, name: str
) -> None:
    reader = robot(tmp_path / name, truth="/gt")
    for buffer in (None, read_tf(reader)):
        found = find_truth(reader, spec, where=name, camera_frame="cam", buffer=buffer)
        assert isinstance(found, Truth)
        expected = motion() @ T_BASE_CAM
        np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-9)
    as_it_is = find_truth(reader, spec, where=name, base_frame="base", camera_frame="cam")
    assert isinstance(as_it_is, Truth)
    np.testing.assert_allclose(as_it_is.trajectory.T_world_frame, motion(), atol=1e-9)
