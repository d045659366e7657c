"""Ground truth that gvo finds by itself."""

from pathlib import Path

import numpy as np
import pytest

from gvo.io.bag.reader import BagReader
from gvo.io.poses.ground_truth import BagTruth, find_named_truth, is_named_truth
from gvo.io.poses.tf import read_tf
from gvo.types import Failure
from tests.io.pose_bags import FIX, ODOMETRY, STAMPED, TRANSFORM, PoseBag

POSE = np.eye(4)


def find(path: Path) -> BagTruth | Failure:
    reader = BagReader(path)
    return find_named_truth(reader, read_tf(reader), where=path.name)


@pytest.mark.parametrize(
    "name",
    [
        "groundtruth",
        "/ground_truth/pose",
        "/ground-truth",
        "/drone/groundTruth/odometry",
        "/gt",
        "/gt_pose",
        "/camera/gt",
        "/vicon/firefly_sbx/firefly_sbx",
        "/vicon1",
        "/mocap_node/robot/pose",
        "/optitrack",
        "/leica/position",
        "/vrpn_client_node/drone/pose",
    ],
)
def test_names_of_what_measures_from_outside_are_known(name: str) -> None:
    assert is_named_truth(name)


@pytest.mark.parametrize(
    "name",
    ["/odom", "/odometry/filtered", "/gps/fix", "/height/gtx", "/length", "/viconic", "/amcl_pose"],
)
def test_other_names_are_not(name: str) -> None:
    assert not is_named_truth(name)


@pytest.mark.parametrize("type_", [ODOMETRY, STAMPED, TRANSFORM])
def test_the_only_topic_of_such_a_name_is_taken_beside_odometry(tmp_path: Path, type_: str) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.pose("/odom", ODOMETRY, 1, POSE)
    bag.pose("/mocap/robot", type_, 2, POSE)
    truth = find(bag.write())
    assert isinstance(truth, BagTruth)
    assert truth.decision.startswith(f"/mocap/robot ({type_}), 1 poses")


def test_measured_points_are_taken_as_well(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.point("/leica/position", 1, (1.0, 2.0, 3.0), frame="leica")
    truth = find(bag.write())
    assert isinstance(truth, BagTruth)
    assert not truth.trajectory.has_rotations


def test_of_several_none_is_taken_and_all_are_listed(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.mcap")
    for name in ("/vicon/drone", "/vicon/wand"):
        bag.pose(name, TRANSFORM, 1, POSE)
    found = find(bag.write())
    assert isinstance(found, Failure)
    assert found.reason == (
        f"2 topics are named as ground truth: /vicon/drone ({TRANSFORM}), /vicon/wand "
        f"({TRANSFORM}); choose by --ground-truth topic:/vicon/drone"
    )


def test_odometry_and_fixes_are_never_taken(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.pose("/odom", ODOMETRY, 1, POSE)
    bag.fix(1, [48.0, 11.0, 500.0])
    assert FIX in {topic.type for topic in BagReader(bag.write()).topics}
    found = find(tmp_path / "a.bag")
    assert isinstance(found, Failure)
    assert found.reason == "no frame and no topic is named as ground truth"


def test_the_frame_of_converted_data_sets_comes_first(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.pose("/gt", STAMPED, 1, POSE)
    bag.pose("/vicon", STAMPED, 1, POSE)
    bag.tf(5, "world", "ground_truth", POSE)
    truth = find(bag.write())
    assert isinstance(truth, BagTruth)
    assert truth.is_of_camera
    assert truth.trajectory.stamps_ns.tolist() == [5]


@pytest.mark.recorded
def test_the_truth_of_a_recorded_bag_of_poses_is_found(gvo_data: Path) -> None:
    truth = find(gvo_data / "bags/good/pose_streams.bag")
    assert isinstance(truth, BagTruth)
    assert truth.decision == "groundtruth (geometry_msgs/msg/PoseStamped), 12765 poses"


@pytest.mark.recorded
def test_a_recorded_robot_without_truth_has_none(gvo_data: Path) -> None:
    assert not find(gvo_data / "bags/good/nav2_turtlebot.mcap")
