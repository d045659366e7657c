"""Ground truth of tf and of topics, in bags written here and recorded."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.bag.reader import BagReader
from gvo.io.poses.truth import (
    TRUTH_FRAMES,
    BagTruthSpec,
    Poses,
    TfTruth,
    find_named_truth,
    parse_bag_truth,
    parse_truth,
    read_poses,
)
from gvo.types import Failure, FloatArray
from tests.make.bags import ODOMETRY, STAMPED, TRANSFORM, WITH_COVARIANCE, PoseBag

SECOND = 10**9


def pose(n: float) -> FloatArray:
    return se3.exp(n * np.array([0.05, 0.1, -0.2, 1.0, 0.5, 0.0]))


def read(path: Path, spec: BagTruthSpec) -> Poses:
    return read_poses(BagReader(path), spec, where=path.name)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@pytest.mark.parametrize(
    ("type_", "child"),
    [(ODOMETRY, "base"), (TRANSFORM, "base"), (STAMPED, ""), (WITH_COVARIANCE, "")],
)
def test_a_topic_gives_poses_at_the_stamps_of_its_headers(
    tmp_path: Path, name: str, type_: str, child: str
) -> None:
    bag = PoseBag(tmp_path / name)
    for n in (3, 1, 2):  # recorded out of order, at other times than their stamps
        bag.pose("/truth", type_, n * SECOND + 5, pose(n), parent="/map", child="/base")
    truth = read(bag.write(), "truth")
    assert truth.trajectory.stamps_ns.tolist() == [n * SECOND + 5 for n in (1, 2, 3)]
    expected = np.stack([pose(n) for n in (1, 2, 3)])
    np.testing.assert_allclose(truth.trajectory.T_world_frame, expected, atol=1e-12)
    assert truth.trajectory.stamps_from == "topic"
    assert truth.child_frame == child
    assert truth.decision == f"/truth ({type_}), 3 poses{' of base' if child else ''}"


def chain_bag(path: Path) -> PoseBag:
    """Write map -> odom each second, odom -> base each 0.4 s, base -> camera once."""
    bag = PoseBag(path)
    bag.tf(0, "base", "camera", pose(-2), is_static=True)
    for n in range(5):
        bag.tf(n * SECOND, "/map", "/odom", pose(0.1 * n))
    for n in range(12):
        bag.tf(n * SECOND * 2 // 5, "odom", "base", pose(n))
    return bag


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_chain_gives_a_pose_at_each_stamp_of_its_moving_edges(tmp_path: Path, name: str) -> None:
    """The edges are put together here, by scipy's interpolation."""
    truth = read(chain_bag(tmp_path / name).write(), TfTruth(parent="map", child="camera"))
    tenths = sorted({10 * n for n in range(5)} | {4 * n for n in range(11)})
    assert truth.trajectory.stamps_ns.tolist() == [n * SECOND // 10 for n in tenths]
    T_map_odom = between([10 * n for n in range(5)], [pose(0.1 * n) for n in range(5)], tenths)
    T_odom_base = between([4 * n for n in range(12)], [pose(n) for n in range(12)], tenths)
    expected = T_map_odom @ T_odom_base @ pose(-2)
    np.testing.assert_allclose(truth.trajectory.T_world_frame, expected, atol=1e-9)
    assert truth.decision == (
        "tf map -> camera, 13 poses; 1 stamps where not all of the chain is known"
    )
    assert not truth.is_of_camera


def between(stamps: list[int], poses: list[FloatArray], wanted: list[int]) -> FloatArray:
    T = np.stack(poses)
    R = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))(wanted).as_matrix()
    t = np.stack([np.interp(wanted, stamps, T[:, axis, 3]) for axis in range(3)], axis=1)
    return se3.make_transform(R, t)


@pytest.mark.parametrize(
    ("parent", "child", "reason"),
    [
        ("base", "camera", "they do not move in tf"),
        ("map", "basis", "tf holds no frame basis"),
        ("nowhere", "base", "tf holds no frame nowhere"),
    ],
)
def test_a_chain_needs_its_poses(tmp_path: Path, parent: str, child: str, reason: str) -> None:
    path = chain_bag(tmp_path / "a.bag").write()
    with pytest.raises(RecordingError, match=f"holds no poses of {child} in {parent}: {reason}"):
        read(path, TfTruth(parent=parent, child=child))


def test_truth_of_converted_data_sets_is_of_the_camera_at_stamps_of_files(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.tf(5, "/world", "/ground_truth", pose(1))
    bag.tf(7, "world", "ground_truth", pose(2))
    bag.tf(6, "world", "base_link", pose(3))
    bag.tf(8, "map", "ground_truth", pose(4))
    truth = read(bag.write(), TRUTH_FRAMES)
    assert truth.is_of_camera
    assert truth.trajectory.stamps_from == "file"
    assert truth.trajectory.stamps_ns.tolist() == [5, 7]
    np.testing.assert_allclose(truth.trajectory.T_world_frame, [pose(1), pose(2)], atol=1e-12)


POSE = np.eye(4)


def find(path: Path) -> Poses | Failure:
    reader = BagReader(path)
    return find_named_truth(reader, path.name)


def test_names_of_what_measures_from_outside_are_known(tmp_path: Path) -> None:
    known = [
        *("groundtruth", "/ground_truth/pose", "/ground-truth", "/drone/groundTruth/odometry"),
        *("/gt", "/gt_pose", "/camera/gt", "/vicon/firefly_sbx/firefly_sbx", "/vicon1"),
        *("/mocap_node/robot/pose", "/optitrack", "/leica/position"),
        "/vrpn_client_node/drone/pose",
    ]
    others = ["/odom", "/odometry/filtered", "/gps/pose", "/height/gtx", "/length", "/viconic"]
    bag = PoseBag(tmp_path / "a.bag")
    for name in (*known, *others):
        bag.pose(name, STAMPED, 1, POSE)
    found = find(bag.write())
    assert isinstance(found, Failure)
    assert found.reason.startswith(f"{len(known)} topics")
    assert all(f"{name} (" in found.reason for name in known)


@pytest.mark.parametrize("type_", [ODOMETRY, STAMPED, TRANSFORM])
def test_the_only_topic_of_such_a_name_is_taken_beside_odometry(tmp_path: Path, type_: str) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.pose("/odom", ODOMETRY, 1, POSE)
    bag.pose("/mocap/robot", type_, 2, POSE)
    truth = find(bag.write())
    assert isinstance(truth, Poses)
    assert truth.decision.startswith(f"/mocap/robot ({type_}), 1 poses")


def test_the_frame_of_converted_data_sets_comes_first(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.pose("/gt", STAMPED, 1, POSE)
    bag.pose("/vicon", STAMPED, 1, POSE)
    bag.tf(5, "world", "ground_truth", POSE)
    truth = find(bag.write())
    assert isinstance(truth, Poses)
    assert truth.is_of_camera
    assert truth.trajectory.stamps_ns.tolist() == [5]


names = st.text("abcxyz_019", min_size=1, max_size=8)


@given(names, names)
def test_a_chain_of_tf_is_two_frames_with_or_without_a_slash(parent: str, child: str) -> None:
    if parent == child:
        child += "x"
    for text in (f"tf:{parent}:{child}", f"tf:/{parent}:/{child}"):
        assert parse_truth(text) == TfTruth(parent=parent, child=child)


@given(names)
def test_a_topic_has_a_slash_or_is_called_one(name: str) -> None:
    assert parse_bag_truth(name) == parse_truth(f"topic:{name}") == name
    slashed = f"/{name}/pose"
    assert parse_truth(f"/{name}/pose") == parse_truth(f"topic:/{name}/pose") == slashed


def test_a_file_that_exists_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tf:map:base"
    path.touch()
    assert parse_truth(str(path)) == path
    monkeypatch.chdir(tmp_path)
    assert parse_truth("tf:map:base") == Path("tf:map:base")
    path.unlink()
    assert parse_truth("tf:map:base") == TfTruth(parent="map", child="base")


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ("tf:map tf:map: tf::base tf:a:b:c tf:a:a tf:/:b", "expected two frames, as in tf:map"),
        ("truth.missing.txt no/such/truth.csv tff:a:b", "no such file; expected .*tf:PARENT:CHILD"),
        ("topic: topic:/", "names no topic"),
    ],
)
def test_what_names_no_truth_is_refused_with_what_is_expected(texts: str, said: str) -> None:
    for text in texts.split():
        with pytest.raises(TrajectoryError, match=said):
            parse_truth(text)
