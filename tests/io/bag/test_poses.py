"""Poses and positions out of topics."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.bag.poses import POSE_TYPES, Positions, read_positions, read_streams
from gvo.io.bag.reader import BagReader
from gvo.io.edges.events import InputFaults
from gvo.io.edges.pose_streams import PoseStream
from gvo.types import FloatArray
from tests.make.bags import ODOMETRY, STAMPED, TRANSFORM, PoseBag

N = 4


def pose(n: int) -> FloatArray:
    return se3.exp(n * np.array([0.1, 0.3, -0.2, 1.0, 0.5, 0.0]))


def covariance_ros(n: int) -> FloatArray:
    """Return a covariance in ROS order that grows with the number of the pose."""
    A = np.random.default_rng(0).normal(size=(6, 6))
    return np.asarray(0.01 * (n + 1) * (A @ A.T + np.eye(6)))


def write(path: Path, topics: dict[str, str], norms: Sequence[float] = (1.0,) * N) -> Path:
    bag = PoseBag(path)
    for name, type_ in topics.items():
        for n, norm in enumerate(norms):
            stamp_ns, covariance = (10 + n) * 10**9 + 7, covariance_ros(n)
            bag.pose(name, type_, stamp_ns, pose(n), norm=norm, covariance=covariance)
    return bag.write()


def read(path: Path, *names: str) -> tuple[PoseStream, InputFaults]:
    faults = InputFaults()
    (stream,) = read_streams(path, names, faults)
    return stream, faults


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("type_", POSE_TYPES)
def test_poses_and_stamps_are_read_of_all_types(tmp_path: Path, name: str, type_: str) -> None:
    stream, faults = read(write(tmp_path / name, {"/poses": type_}))
    assert stream.poses.stamps_ns.tolist() == [(10 + n) * 10**9 + 7 for n in range(N)]
    expected = np.stack([pose(n) for n in range(N)])
    np.testing.assert_allclose(stream.poses.T_world_frame, expected, atol=1e-12)
    assert np.isfinite(stream.covariances).all() == (type_ not in (STAMPED, TRANSFORM))
    assert not faults.warnings()


def test_the_covariance_of_a_message_is_that_of_its_own_perturbations(tmp_path: Path) -> None:
    """Draw poses as ROS means the numbers, and take the covariance of their right errors."""
    stream, _ = read(write(tmp_path / "a.bag", {"/poses": ODOMETRY}))
    rng = np.random.default_rng(1)
    for n, C in enumerate(stream.covariances):
        T, small = pose(n), 1e-3
        draws = rng.multivariate_normal(np.zeros(6), covariance_ros(n), 20000) * small
        drawn = np.tile(T, (len(draws), 1, 1))
        drawn[:, :3, 3] += draws[:, :3]
        drawn[:, :3, :3] = Rotation.from_rotvec(draws[:, 3:]).as_matrix() @ T[:3, :3]
        expected = np.cov(se3.log(se3.invert(T) @ drawn).T) / small**2
        scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert np.abs((C - expected) / scale).max() < 0.06


def test_stamps_that_go_back_are_skipped_and_counted(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    for stamp_ns in (10, 20, 20, 15, 30):
        bag.pose("/poses", STAMPED, stamp_ns, pose(0))
    stream, faults = read(bag.write())
    assert stream.poses.stamps_ns.tolist() == [10, 20, 30]
    (warning,) = faults.warnings()
    assert warning.startswith("2 poses have a stamp that does not advance")


def test_a_topic_tells_its_frames_and_keeps_to_them(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    for n, child in enumerate(["drone", "/drone", "wand", "drone"]):
        bag.pose("/vicon", TRANSFORM, n, pose(n), parent="/room", child=child)
    stream, faults = read(bag.write())
    assert stream.poses.stamps_ns.tolist() == [0, 1, 3]
    assert "wand in room in place of drone in room" in faults.warnings()[0]


NAN, INF = float("nan"), float("inf")
HELSINKI = (60.0, 25.0, 30.0)
# of latitude there: one over the meridian's radius of curvature, a (1 - e^2) / (1 - 3/4 e^2)^1.5
METRE_DEG = np.degrees(1.0 / 6383453.857)


def read_places(path: Path) -> tuple[Positions, InputFaults]:
    faults = InputFaults()
    reader = BagReader(path)
    return read_positions(reader, reader.topics[0], faults), faults


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_fixes_are_east_north_and_up_of_the_first_one(tmp_path: Path, name: str) -> None:
    bag = PoseBag(tmp_path / name)
    for n in (0, 2, 1):
        place = (60.0 + n * METRE_DEG, 25.0, 30.0 + 2.0 * n)
        bag.fix(n * 10**9 + 7, place, frame="/gps_link")
    found, faults = read_places(bag.write())
    assert found.trajectory.stamps_ns.tolist() == [7, 10**9 + 7, 2 * 10**9 + 7]
    np.testing.assert_allclose(
        found.trajectory.positions, [[0, n, 2 * n] for n in range(3)], atol=1e-3
    )
    assert found.child_frame == "gps_link"
    assert found.origin == "east, north, up of 60.0000000 deg, 25.0000000 deg, 30.00 m"
    assert not faults.warnings()


def test_what_is_no_fix_is_skipped_and_counted_and_is_no_origin(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.mcap")
    bag.fix(0, [1.0, 2.0, 3.0], status=-1)
    for n, spoilt in enumerate([(NAN, 25, 0), (60, INF, 0), (60, 25, NAN), (91, 25, 0)], start=1):
        bag.fix(n, spoilt)
    bag.fix(5, HELSINKI, status=2)
    found, faults = read_places(bag.write())
    assert found.trajectory.stamps_ns.tolist() == [5]
    np.testing.assert_array_equal(found.trajectory.positions, [[0.0, 0.0, 0.0]])
    (warning,) = faults.warnings()
    assert warning.startswith("5 messages hold no position and were skipped; the first: /fix at 0")
    assert "status -1" in warning


def test_points_are_positions_in_their_frame(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.point("/leica/position", 1, (1.0, 2.0, 3.0), frame="room")
    bag.point("/leica/position", 2, (NAN, 2.0, 3.0), frame="room")
    found, faults = read_places(bag.write())
    np.testing.assert_array_equal(found.trajectory.positions, [[1.0, 2.0, 3.0]])
    assert (found.child_frame, found.origin) == ("", "")
    assert len(faults.warnings()) == 1
