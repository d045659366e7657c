"""Topics of poses in bags of both generations, written here and recorded."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.bag.poses import POSE_TYPES, find_topics, open_streams
from gvo.io.bag.reader import BagReader, typestore
from gvo.io.edges.events import InputFaults
from gvo.io.edges.pose_streams import PoseSample
from gvo.types import FloatArray
from tests.io.pose_bags import PoseBag

ODOMETRY, WITH_COVARIANCE, STAMPED, TRANSFORM = POSE_TYPES
N = 4


def pose(n: int) -> FloatArray:
    return se3.exp(n * np.array([0.1, 0.3, -0.2, 1.0, 0.5, 0.0]))


def covariance_ros(n: int) -> FloatArray:
    """Return a covariance in ROS order that grows with the number of the pose."""
    A = np.random.default_rng(0).normal(size=(6, 6))
    return np.asarray(0.01 * (n + 1) * (A @ A.T + np.eye(6)))


class Maker:
    """Makes messages of one generation of ROS."""

    def __init__(self, *, is_ros1: bool) -> None:
        self.store = typestore(is_ros1=is_ros1)
        self._types: dict[str, Any] = self.store.types
        self._sequence = {"seq": 0} if is_ros1 else {}

    def header(self, n: int) -> Any:
        stamp = self._types["builtin_interfaces/msg/Time"](sec=10 + n, nanosec=7)
        return self._types["std_msgs/msg/Header"](stamp=stamp, frame_id="odom", **self._sequence)

    def pose(self, n: int, scale: float = 1.0) -> Any:
        T = pose(n)
        q = scale * Rotation.from_matrix(T[:3, :3]).as_quat()
        return self._types["geometry_msgs/msg/Pose"](
            position=self._types["geometry_msgs/msg/Point"](x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            orientation=self._types["geometry_msgs/msg/Quaternion"](x=q[0], y=q[1], z=q[2], w=q[3]),
        )

    def message(self, type_: str, n: int, scale: float = 1.0) -> Any:
        if type_ == STAMPED:
            return self._types[type_](header=self.header(n), pose=self.pose(n, scale))
        if type_ == TRANSFORM:
            pose = self.pose(n, scale)
            return self._types[type_](
                header=self.header(n),
                child_frame_id="base",
                transform=self._types["geometry_msgs/msg/Transform"](
                    translation=self._types["geometry_msgs/msg/Vector3"](**vars(pose.position)),
                    rotation=pose.orientation,
                ),
            )
        with_covariance = self._types["geometry_msgs/msg/PoseWithCovariance"](
            pose=self.pose(n, scale), covariance=covariance_ros(n).ravel()
        )
        if type_ == WITH_COVARIANCE:
            return self._types[type_](header=self.header(n), pose=with_covariance)
        zero = self._types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = self._types["geometry_msgs/msg/TwistWithCovariance"](
            twist=self._types["geometry_msgs/msg/Twist"](linear=zero, angular=zero),
            covariance=np.zeros(36),
        )
        return self._types[type_](
            header=self.header(n), child_frame_id="base", pose=with_covariance, twist=twist
        )


def write(path: Path, topics: dict[str, str], spoil: Callable[[int], float] | None = None) -> Path:
    is_ros1 = path.suffix == ".bag"
    maker = Maker(is_ros1=is_ros1)
    writer: Any = Writer1(path) if is_ros1 else None
    if writer is None:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path.with_suffix(""), version=8, storage_plugin=plugin)
    with writer:
        for name, type_ in topics.items():
            connection = writer.add_connection(name, type_, typestore=maker.store)
            serialize = maker.store.serialize_ros1 if is_ros1 else maker.store.serialize_cdr
            for n in range(N):
                message = maker.message(type_, n, 1.0 if spoil is None else spoil(n))
                writer.write(connection, n, serialize(message, type_))
    return path if is_ros1 else path.with_suffix("") / path.name


def read(path: Path, *names: str) -> tuple[list[PoseSample], InputFaults]:
    faults = InputFaults()
    (stream,) = open_streams(path, names)
    return list(stream.samples(faults)), faults


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("type_", POSE_TYPES)
def test_poses_and_stamps_are_read_of_all_types(tmp_path: Path, name: str, type_: str) -> None:
    samples, faults = read(write(tmp_path / name, {"/poses": type_}))
    assert [sample.stamp_ns for sample in samples] == [(10 + n) * 10**9 + 7 for n in range(N)]
    for n, sample in enumerate(samples):
        np.testing.assert_allclose(sample.T_world_frame, pose(n), atol=1e-12)
        assert (sample.covariance is None) == (type_ in (STAMPED, TRANSFORM))
    assert not faults


def test_the_covariance_of_a_message_is_that_of_its_own_perturbations(tmp_path: Path) -> None:
    """Draw poses as ROS means the numbers, and take the covariance of their right errors."""
    samples, _ = read(write(tmp_path / "a.bag", {"/poses": ODOMETRY}))
    rng = np.random.default_rng(1)
    for n, sample in enumerate(samples):
        T, small = pose(n), 1e-3
        draws = rng.multivariate_normal(np.zeros(6), covariance_ros(n), 20000) * small
        drawn = np.tile(T, (len(draws), 1, 1))
        drawn[:, :3, 3] += draws[:, :3]
        drawn[:, :3, :3] = Rotation.from_rotvec(draws[:, 3:]).as_matrix() @ T[:3, :3]
        expected = np.cov(se3.log(se3.invert(T) @ drawn).T) / small**2
        C = sample.covariance
        assert C is not None
        scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert np.abs((C - expected) / scale).max() < 0.06


@given(st.integers(0, 2**32 - 1))
def test_conversion_from_ros_order_undoes_the_published_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    R = np.asarray(Rotation.random(rng=rng).as_matrix())
    P = np.block([[np.zeros((3, 3)), R], [R, np.zeros((3, 3))]])
    C = A @ A.T
    np.testing.assert_allclose(se3.covariance_from_ros(P @ C @ P.T, R), C, atol=1e-12)


def test_messages_without_a_rotation_are_skipped_and_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bag", {"/poses": STAMPED}, lambda n: 0.0 if n == 1 else 1.0)
    samples, faults = read(path)
    assert len(samples) == N - 1
    (warning,) = faults.warnings()
    assert warning.startswith("1 messages hold no pose")


def test_the_only_topic_is_taken_and_of_several_one_must_be_chosen(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bag", {"/a": STAMPED, "/b": ODOMETRY})
    with pytest.raises(RecordingError, match=r"--topic NAME.*/a .*/b "):
        open_streams(path, [])
    names = [stream.name for stream in open_streams(path, ["b", "/a"])]
    assert names == ["/b", "/a"]
    with pytest.raises(RecordingError, match=r"no poses on topic /c.*/a .*/b "):
        open_streams(path, ["/c"])


@pytest.mark.recorded
def test_recorded_streams_are_read(gvo_data: Path) -> None:
    path = gvo_data / "bags/good/pose_streams.bag"
    (stream,) = open_streams(path, ["S-PTAM"])
    assert len(list(stream.samples(InputFaults()))) == 5439
    for name in ("tf_example.bag", "realsense_rgbd.bag"):
        path = gvo_data / "bags/good" / name
        with pytest.raises(RecordingError, match="holds no poses"):
            find_topics(BagReader(path), [], name)


@pytest.mark.recorded
def test_recorded_wheel_odometry_has_covariances(gvo_data: Path) -> None:
    (stream,) = open_streams(gvo_data / "bags/good/nav2_turtlebot.mcap", ["/odom"])
    samples = list(stream.samples(InputFaults()))
    assert len(samples) == 2639
    assert all(sample.covariance is not None for sample in samples)


def test_a_topic_tells_its_frames_and_keeps_to_them(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    for n, child in enumerate(["drone", "/drone", "wand", "drone"]):
        bag.pose("/vicon", TRANSFORM, n, pose(n), parent="/room", child=child)
    (stream,) = open_streams(bag.write(), [])
    faults = InputFaults()
    assert [sample.stamp_ns for sample in stream.samples(faults)] == [0, 1, 3]
    assert (stream.parent_frame, stream.child_frame) == ("room", "drone")
    assert "wand in room in place of drone in room" in faults.warnings()[0]
