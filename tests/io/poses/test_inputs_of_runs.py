"""What a run is given besides the recording: frames, true poses, and where they are refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.errors import TrajectoryError
from gvo.io.poses.base_frame import BaseFrame, find_base_frame
from gvo.io.poses.inputs import read_compared, read_ground_truth, read_truth, recorded_truth
from gvo.io.poses.truth import Truth, initial_pose
from gvo.io.recording import Source
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure
from tests.make.bags import ODOMETRY, TRANSFORM, PoseBag
from tests.make.rendered_walk import (
    STAMPS_NS,
    START_NS,
    T_BASE_CAM,
    Walk,
    on_a_robot,
    true_poses,
)


@pytest.fixture
def robot(walk_bag: Path, tmp_path: Path) -> Source:
    return gvo.open_recording([walk_bag, on_a_robot(tmp_path / "tf.mcap").write()])


@pytest.mark.parametrize("name", ["base_link", "/base_link"])
def test_the_place_of_the_camera_comes_from_the_chain_of_tf(robot: Source, name: str) -> None:
    frame = find_base_frame(robot, name)
    assert frame.name == "base_link"
    assert frame.fixed_mount is not None
    np.testing.assert_allclose(frame.fixed_mount, T_BASE_CAM, atol=1e-12)


def test_poses_of_a_frame_out_of_reach_are_refused_if_asked(walk_bag: Path, tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "truth.mcap")
    bag.pose("/robot", ODOMETRY, START_NS, np.eye(4), child="base_link")
    source = gvo.open_recording([walk_bag, bag.write()])
    with pytest.raises(TrajectoryError, match=r"--ground-truth /robot: its poses are of base_link"):
        read_truth(source, "/robot")


def test_what_is_in_a_bag_cannot_be_asked_of_a_folder(tmp_path: Path) -> None:
    with pytest.raises(
        TrajectoryError, match=r"/robot: names something in a bag, but walk is not a bag"
    ):
        read_truth(Walk(), "/robot")
    write_tum(tmp_path / "poses.txt", Walk().true_poses())
    truth = read_truth(Walk(), str(tmp_path / "poses.txt"))
    np.testing.assert_allclose(truth.trajectory.T_world_frame, true_poses(STAMPS_NS), atol=1e-8)


def test_the_truth_of_a_folder_follows_the_frame_asked_for() -> None:
    found = recorded_truth(Walk(has_truth=True), base_frame=BaseFrame("body", T_BASE_CAM))
    assert isinstance(found, Truth)
    expected = true_poses(STAMPS_NS) @ np.linalg.inv(T_BASE_CAM)
    np.testing.assert_allclose(found.trajectory.T_world_frame, expected, atol=1e-12)
    assert not recorded_truth(Walk())


def framed(trajectory: Trajectory) -> Truth:
    return Truth(trajectory=trajectory, T_base_point=np.eye(4), decision="")


def test_the_initial_pose_lies_between_the_true_ones_around_the_first_frame() -> None:
    stamps_ns = np.array([START_NS - 30, START_NS + 10], dtype=np.int64)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    poses[1, :3, 3] = 4.0, 0.0, 8.0
    T = initial_pose(framed(Trajectory(stamps_ns=stamps_ns, T_world_frame=poses)), START_NS)
    np.testing.assert_allclose(T[:3, 3], [3.0, 0.0, 6.0])
    rotation = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    np.testing.assert_allclose(rotation, [0.0, 0.0, 0.3], atol=1e-12)
    late = framed(Trajectory(stamps_ns=stamps_ns + 100, T_world_frame=poses))
    np.testing.assert_array_equal(initial_pose(late, START_NS), poses[0])


def test_without_a_true_pose_at_the_first_frame_it_cannot_start_there() -> None:
    with pytest.raises(TrajectoryError, match=r"--initial-pose truth: there is no .*: nothing"):
        initial_pose(Failure(reason="nothing"), START_NS)
    positions = Trajectory.of_positions(STAMPS_NS, np.zeros((len(STAMPS_NS), 3)))
    with pytest.raises(TrajectoryError, match="has no rotations"):
        initial_pose(framed(positions), START_NS)
    past = Trajectory(stamps_ns=STAMPS_NS - 10**12, T_world_frame=true_poses(STAMPS_NS))
    with pytest.raises(TrajectoryError, match="ends before the first frame"):
        initial_pose(framed(past), START_NS)


def test_true_poses_are_read_from_files_folders_and_bags(tmp_path: Path) -> None:
    truth = Walk().true_poses()
    write_tum(tmp_path / "groundtruth.txt", truth)
    bag = PoseBag(tmp_path / "truth.bag")
    for stamp_ns, T in zip(truth.stamps_ns.tolist(), truth.T_world_frame, strict=True):
        bag.pose("/vicon/cam", TRANSFORM, stamp_ns, T, child="cam")
        bag.tf(stamp_ns, "map", "cam", T)
    path = bag.write()
    for text in (
        tmp_path,
        tmp_path / "groundtruth.txt",
        path,
        f"{path}#tf:map:cam",
        f"{path}#/vicon/cam",
    ):
        found = read_ground_truth(str(text))
        np.testing.assert_array_equal(found.stamps_ns, truth.stamps_ns)
        np.testing.assert_allclose(found.T_world_frame, truth.T_world_frame, atol=1e-8)


def test_estimates_get_the_shortest_names_that_differ(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a/raw.txt", "b/raw.txt", "b/smoothed.txt")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        write_tum(path, Walk().true_poses())
    texts = [str(path) for path in paths]
    assert list(read_compared(texts[0], texts)[1]) == ["a/raw", "b/raw", "smoothed"]
    assert len(read_compared(texts[0], [texts[0], texts[0]])[1]) == 2
