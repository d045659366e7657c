"""Runs as bags, read back by other programs' readers."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.geometry.edges import between
from gvo.geometry.se3 import make_transform
from gvo.io.poses.tf import TfBuffer
from gvo.runs.outputs.bag import RunBag
from gvo.runs.outputs.frames import RunFrames
from gvo.trajectory.trajectory import Trajectory
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    InertialState,
    RelativePose,
    RgbdFrame,
    Status,
    StereoFrame,
)
from gvo.viz.scene import N_SHOWN_POSES
from tests.make.rendered_walk import read_bag
from tests.make.results import estimate_at, loop_of, optimum_of, result_of
from tests.make.tracked import (
    MOUNTED,
    N_FRAMES,
    SECOND_NS,
    START_NS,
    Tracked,
    by_stamp,
    moved,
    tracked,
)

_ESTIMATES = ("raw", "causal", "smoothed")
_Messages = dict[str, list[tuple[int, Any]]]
"""Log times in nanoseconds and messages, by topic."""


@dataclass(frozen=True)
class _Bag:
    """A run, with poses of the base frame, and the messages written of it."""

    run: Tracked
    names: RunFrames
    poses: dict[str, dict[int, Estimate]]
    path: Path
    messages: _Messages

    def stamped(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the stamp of each message, and the message."""
        for _, message in self.messages[topic]:
            yield _stamp_ns(message.header), message


@pytest.fixture(
    scope="module",
    params=[
        ("stereo", "run.mcap", MOUNTED),
        ("rgbd", "run.bag", RunFrames(world="odom", is_world_optical=True)),
    ],
    ids=["base", "camera"],
)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> _Bag:
    sensor, name, names = request.param
    run, path = tracked("handheld", sensor), tmp_path_factory.mktemp("bag") / name
    late = [e for r in run.results for e in r.finished] + list(run.last)
    found = {
        "raw": [result.raw for result in run.results],
        "causal": [result.causal for result in run.results],
        "smoothed": late,
    }
    poses = {
        kind: by_stamp(_mounted(estimate, names.mount(0)) for estimate in estimates)
        for kind, estimates in found.items()
    }
    with RunBag(path, names) as file:
        for frame, result in run.pairs():
            placed = replace(
                result,
                raw=poses["raw"][result.stamp_ns],
                causal=poses["causal"][result.stamp_ns],
                finished=tuple(poses["smoothed"][e.stamp_ns] for e in result.finished),
            )
            file.add_frame(frame, placed)
        file.add_smoothed(poses["smoothed"][e.stamp_ns] for e in run.last)
    return _Bag(run=run, names=names, poses=poses, path=path, messages=read_bag(path))


def _mounted(estimate: Estimate, T_base_cam: FloatArray) -> Estimate:
    """Move a pose to another frame, the covariance by differences of the pose."""
    T_cam_frame = np.linalg.inv(T_base_cam)
    J = np.zeros((6, 6))
    for k, xi in enumerate(1e-6 * np.eye(6)):
        step = T_base_cam @ expm(_hat(xi)) @ T_cam_frame
        J[:, k] = np.concatenate([_rotation_vector(step), step[:3, 3]]) / 1e-6
    return replace(
        estimate,
        T_world_frame=T_base_cam @ estimate.T_world_frame @ T_cam_frame,
        covariance=J @ estimate.covariance @ J.T,
        effects=None if estimate.effects is None else J @ estimate.effects,
    )


def _hat(xi: FloatArray) -> FloatArray:
    x, y, z, *t = xi
    return np.array([[0, -z, y, t[0]], [z, 0, -x, t[1]], [-y, x, 0, t[2]], [0, 0, 0, 0]])


def _rotation_vector(T: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_rotvec())


def _stamp_ns(header: Any) -> int:
    nanosec = header.stamp.nanosec if hasattr(header.stamp, "nanosec") else header.stamp.nanosecs
    return int(header.stamp.sec * SECOND_NS + nanosec)


def _transforms(messages: _Messages) -> Iterator[tuple[str, str, int, FloatArray]]:
    for _, message in messages["/tf"]:
        for transform in message.transforms:
            T = _pose_matrix(transform.transform.translation, transform.transform.rotation)
            header = transform.header
            yield header.frame_id, transform.child_frame_id, _stamp_ns(header), T


def _pose_matrix(t: Any, q: Any) -> FloatArray:
    R = np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix())
    return make_transform(R, np.array([t.x, t.y, t.z]))


def _buffer(messages: _Messages) -> TfBuffer:
    buffer = TfBuffer()
    for topic in ("/tf", "/tf_static"):
        for _, message in messages.get(topic, []):
            for transform in message.transforms:
                buffer.add_message(transform, is_static=topic == "/tf_static")
    return buffer


def _lookup(buffer: TfBuffer, target: str, source: str, stamp_ns: int) -> FloatArray:
    T = buffer.lookup(target, source, stamp_ns)
    assert isinstance(T, np.ndarray), T
    return T


def _points(cloud: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """Decode a cloud by what it says of its fields."""
    assert not cloud.is_bigendian
    kinds = {2: "u1", 7: "<f4"}
    dtype = np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "formats": [kinds[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.point_step * cloud.width
    assert len(bytes(cloud.data)) == cloud.row_step * cloud.height
    return np.frombuffer(bytes(cloud.data), dtype=dtype)


def test_every_topic_comes_once_a_frame_stamped(bag: _Bag) -> None:
    stamps = [frame.stamp_ns for frame in bag.run.frames]
    once = ["/gvo/points", "/gvo/matches/compressed", "/diagnostics"]
    for topic in [*once, *(f"/gvo/{kind}/odometry" for kind in ("raw", "causal", "odom"))]:
        assert [stamp_ns for stamp_ns, _ in bag.stamped(topic)] == stamps
        assert [log_time_ns for log_time_ns, _ in bag.messages[topic]] == stamps
    assert sorted(bag.messages) == sorted(
        [
            *once,
            "/tf",
            *(["/tf_static"] if bag.names.is_world_optical or not bag.names.is_camera else []),
        ]
        + [f"/gvo/{kind}/odometry" for kind in (*_ESTIMATES, "odom")]
        + ["/gvo/raw/path", "/gvo/smoothed/path"]
    )
    assert [path.name for path in bag.path.parent.iterdir()] == [bag.path.name]
    # Smoothed poses appear when they were known.
    known_ns = {e.stamp_ns: r.stamp_ns for r in bag.run.results for e in r.finished}
    assert known_ns
    smoothed = bag.messages["/gvo/smoothed/odometry"]
    assert sorted(_stamp_ns(message.header) for _, message in smoothed) == stamps
    for log_time_ns, message in smoothed:
        assert log_time_ns == known_ns.get(_stamp_ns(message.header), stamps[-1])


def test_tf_holds_the_poses_and_a_camera_hangs_on_each(bag: _Bag) -> None:
    buffer, names = _buffer(bag.messages), bag.names
    found: dict[str, set[int]] = defaultdict(set)
    for parent, child, stamp_ns, T in _transforms(bag.messages):
        if "gvo/odom" in (parent, child):
            continue
        gvo, kind, base = child.split("/")
        assert (parent, gvo, base) == (names.world, "gvo", names.base)
        expected = bag.poses[kind][stamp_ns].T_world_frame
        np.testing.assert_allclose(T, expected, atol=1e-12)
        assert stamp_ns not in found[kind]
        found[kind].add(stamp_ns)
        T_world_cam = _lookup(buffer, names.world, f"gvo/{kind}/{names.camera}", stamp_ns)
        np.testing.assert_allclose(T_world_cam, expected @ names.mount(stamp_ns), atol=1e-12)
    assert found == {kind: set(bag.poses[kind]) for kind in _ESTIMATES}
    # The robot's own tf has a base_link of its own.
    assert not {"base_link", "left_optical"} & set(buffer.frames)
    if names.is_world_optical:  # above it stands a world with z up
        T_flu_world = _lookup(buffer, "odom_flu", "odom", bag.run.frames[-1].stamp_ns)
        ahead, left, up = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]]) @ T_flu_world.T
        np.testing.assert_array_equal([ahead, left, up], np.eye(3, 4))


def test_the_frame_of_rep_105_never_jumps_and_its_correction_leads_to_the_corrected_pose(
    tmp_path: Path,
) -> None:
    names, stamps = MOUNTED, [START_NS + k * SECOND_NS for k in range(5)]
    rng = np.random.default_rng(1)
    steps = [np.eye(4), *(np.asarray(expm(_hat(rng.normal(0.0, 0.1, 6)))) for _ in stamps[1:])]
    T_map_world = np.asarray(expm(_hat(rng.normal(0.0, 1.0, 6))))  # of loops, from some frame on
    corrections = [np.eye(4), np.eye(4), T_map_world, T_map_world, T_map_world]
    with RunBag(tmp_path / "run.mcap", names) as file:
        for stamp_ns, step, T in zip(stamps, steps, corrections, strict=True):
            previous = None if stamp_ns == stamps[0] else step
            _add(file, stamp_ns, T_map_world=T, T_previous_frame=previous)
    buffer = _buffer(read_bag(tmp_path / "run.mcap"))
    T_odom_base = np.eye(4)
    for stamp_ns, step, T in zip(stamps, steps, corrections, strict=True):
        T_odom_base = T_odom_base @ step
        found = _lookup(buffer, "gvo/odom", f"gvo/odom/{names.base}", stamp_ns)
        np.testing.assert_allclose(found, T_odom_base, atol=1e-12)
        T_world_base = T @ _made_up(stamp_ns)[1].causal.T_world_frame
        found = _lookup(buffer, "world", f"gvo/odom/{names.camera}", stamp_ns)
        np.testing.assert_allclose(found, T_world_base @ names.mount(stamp_ns), atol=1e-12)


def test_loops_are_drawn_when_confirmed_and_last_in_global_poses(tmp_path: Path) -> None:
    stamps = [START_NS + k * SECOND_NS for k in range(4)]
    loop = loop_of(stamps[2], stamps[0])
    with RunBag(tmp_path / "run.mcap") as file:
        poses = [_add(file, ns, loops=(loop,) if ns == stamps[2] else ()) for ns in stamps]
        poses = [replace(e, T_world_frame=moved(1.0) @ e.T_world_frame) for e in poses]
        refused = loop_of(stamps[3], stamps[0], "contradicts")
        file.add_optimum(optimum_of(poses[::-1], loop, refused))
    messages = read_bag(tmp_path / "run.mcap")
    (_, causal), (_, last) = messages["/gvo/loops"]
    assert (_stamp_ns(causal.header), causal.ns) == (stamps[2], "causal")
    assert (_stamp_ns(last.header), last.ns) == (stamps[3], "global")
    assert causal.id != last.id
    for message, x in ((causal, 0.0), (last, 1.0)):
        assert (message.header.frame_id, message.type) == ("world", 5)
        assert [(p.x, p.y, p.z) for p in message.points] == [(x, 0, 20), (x, 0, 0)]
        assert message.pose.orientation.w == 1
    _, path = messages["/gvo/global/path"][-1]
    assert [_stamp_ns(p.header) for p in path.poses] == stamps
    assert {p.pose.position.x for p in path.poses} == {1.0}
    assert [_stamp_ns(m.header) for _, m in messages["/gvo/global/odometry"]] == stamps
    T = _lookup(_buffer(messages), "world", "gvo/global/camera_optical", stamps[1])
    np.testing.assert_allclose(T, poses[1].T_world_frame, atol=1e-12)
    assert "loop to 2.0 s before, 87 inliers" in messages["/diagnostics"][2][1].status[0].message


def test_odometry_holds_pose_and_covariance_in_the_order_of_ros(bag: _Bag) -> None:
    for kind, poses in bag.poses.items():
        for stamp_ns, message in bag.stamped(f"/gvo/{kind}/odometry"):
            estimate, pose = poses[stamp_ns], message.pose.pose
            assert message.header.frame_id == bag.names.world
            assert message.child_frame_id == f"gvo/{kind}/{bag.names.base}"
            T = _pose_matrix(pose.position, pose.orientation)
            np.testing.assert_allclose(T, estimate.T_world_frame, atol=1e-12)
            found, expected = message.pose.covariance.reshape(6, 6), _ros_covariance(estimate)
            scale = float(np.abs(estimate.covariance).max())
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * scale)


def _ros_covariance(estimate: Estimate) -> FloatArray:
    """Move the pose a little along each axis and see what changes in the world's axes."""
    T, J = estimate.T_world_frame, np.zeros((6, 6))
    for k, xi in enumerate(1e-6 * np.eye(6)):
        moved = T @ expm(_hat(xi))
        turn = moved @ np.linalg.inv(T)
        J[:, k] = np.concatenate([moved[:3, 3] - T[:3, 3], _rotation_vector(turn)]) / 1e-6
    return np.asarray(J @ estimate.covariance @ J.T)


def test_the_velocity_leads_from_the_pose_before_to_this_one(bag: _Bag) -> None:
    for kind, poses in bag.poses.items():
        known: list[int] = []
        for stamp_ns, message in bag.stamped(f"/gvo/{kind}/odometry"):
            before_ns = max((ns for ns in known if ns < stamp_ns), default=None)
            known.append(stamp_ns)
            velocity = _velocity(message)
            if before_ns is None:
                assert not any(velocity)
                continue
            moved_by = expm(_hat(1e-9 * (stamp_ns - before_ns) * np.array(velocity)))
            T = poses[before_ns].T_world_frame @ moved_by
            np.testing.assert_allclose(T, poses[stamp_ns].T_world_frame, atol=1e-9)
        assert len(known) == N_FRAMES


def test_the_covariance_of_a_measured_velocity_is_that_of_the_registration(bag: _Bag) -> None:
    stamps = [frame.stamp_ns for frame in bag.run.frames]
    for kind in ("raw", "odom"):
        for index, (_, message) in enumerate(bag.messages[f"/gvo/{kind}/odometry"]):
            # Turn first, as of poses.
            found = np.roll(message.twist.covariance.reshape(6, 6), (3, 3), axis=(0, 1))
            registration = bag.run.results[index].registration
            if index == 0 or registration is None:
                np.testing.assert_array_equal(found, -np.eye(6))
                continue
            before, raw = (bag.run.results[n].raw for n in (index - 1, index))
            # What shared errors make of the step comes on top of the noise of the registration.
            both = Trajectory.of([before, raw])
            assert both.effects is not None
            start, end = both.effects
            effects = between(start, end, se3.invert(before.T_world_frame) @ raw.T_world_frame)
            covariance = registration.covariance + effects @ effects.T
            expected = _mounted(replace(raw, covariance=covariance), bag.names.mount(0)).covariance
            elapsed_s = 1e-9 * (stamps[index] - stamps[index - 1])
            np.testing.assert_allclose(found * elapsed_s**2, expected, rtol=1e-4, atol=1e-12)
    for kind in ("causal", "smoothed"):
        for _, message in bag.messages[f"/gvo/{kind}/odometry"]:
            np.testing.assert_array_equal(message.twist.covariance, -np.eye(6).ravel())


def test_the_velocity_is_that_of_the_imu_where_it_knows_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 6))
    state = InertialState(
        stamp_ns=START_NS + SECOND_NS,
        twist=rng.normal(size=6),
        twist_covariance=A @ A.T,
        up=np.array([0.0, 0.0, 1.0]),
        gyro_bias=np.zeros(3),
        acceleration_bias=np.zeros(3),
        sigmas=np.ones(3),
    )
    with RunBag(tmp_path / "run.mcap", MOUNTED) as file:
        for k, inertial in enumerate((None, state, None)):
            changes: dict[str, Any] = {"inertial": inertial, "T_previous_frame": moved(0.1)}
            pose = _add(file, START_NS + k * SECOND_NS, **changes)
        file.add_smoothed([pose])
    messages = read_bag(tmp_path / "run.mcap")
    for kind in ("raw", "causal", "odom"):
        _, (_, known), (_, after) = messages[f"/gvo/{kind}/odometry"]
        np.testing.assert_array_equal(_velocity(known), state.twist)
        covariance = known.twist.covariance.reshape(6, 6)
        np.testing.assert_allclose(np.roll(covariance, (3, 3), axis=(0, 1)), A @ A.T, atol=1e-12)
        assert not np.allclose(_velocity(after), state.twist)
    ((_, late),) = messages["/gvo/smoothed/odometry"]
    np.testing.assert_array_equal(late.twist.covariance, -np.eye(6).ravel())


def _velocity(message: Any) -> list[float]:
    """Return the angular and the linear velocity."""
    twist = message.twist.twist
    return [getattr(v, axis) for v in (twist.angular, twist.linear) for axis in "xyz"]


def test_points_are_those_matched_in_grey(bag: _Bag) -> None:
    clouds = bag.messages["/gvo/points"]
    assert sum(cloud.width for _, cloud in clouds) > 50 * len(clouds)
    for (_, cloud), (frame, result) in zip(clouds, bag.run.pairs(), strict=True):
        assert cloud.header.frame_id == f"gvo/causal/{bag.names.camera}"
        assert (cloud.height, cloud.is_dense) == (1, True)
        found = _points(cloud)
        if result.registration is None:
            assert len(found) == 0
            continue
        points = np.stack([found[axis] for axis in "xyz"], axis=1)
        np.testing.assert_array_equal(points, result.registration.points_current.astype("f4"))
        np.testing.assert_array_equal(found["inlier"] == 1, result.registration.inliers)
        image = frame.left if isinstance(frame, StereoFrame) else frame.image
        expected = [image[round(v), round(u)] for u, v in result.registration.pixels_current]
        np.testing.assert_array_equal(found["intensity"], expected)


def test_pictures_and_diagnostics_are_those_of_the_frame(bag: _Bag) -> None:
    pictures, told = bag.messages["/gvo/matches/compressed"], bag.messages["/diagnostics"]
    for (_, shown), (_, message), (frame, result) in zip(
        pictures, told, bag.run.pairs(), strict=True
    ):
        image = frame.left if isinstance(frame, StereoFrame) else frame.image
        assert shown.format == "jpeg"
        assert shown.header.frame_id == f"gvo/causal/{bag.names.camera}"
        picture = cv2.imdecode(np.asarray(shown.data), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (*image.shape, 3)
        assert np.median(np.abs(picture[60:].mean(axis=2) - image[60:])) < 6
        (status,) = message.status
        values = {pair.key: pair.value for pair in status.values}
        assert (status.level, status.hardware_id) == (0, bag.names.camera)
        assert status.message.startswith("ok: ")
        counts = [int(values[name]) for name in ("inliers", "matches", "links")]
        assert counts == [result.n_inliers, result.n_matches, result.n_links]
        for stage, ms in result.stage_ms.items():
            assert float(values[f"{stage} [ms]"]) == pytest.approx(ms, abs=1e-3)


def _made_up(stamp_ns: int, status: Status = Status.OK) -> tuple[Frame, FrameResult]:
    """Return a small frame and a pose ten metres a second ahead."""
    T = np.eye(4)
    T[2, 3] = 10e-9 * (stamp_ns - START_NS)
    pose = estimate_at(stamp_ns, T, covariance=1e-4 * np.eye(6), status=status)
    registration = RelativePose(T_reference_current=np.eye(4), covariance=np.eye(6))
    is_tied = status in (Status.OK, Status.RESUMED)
    reason = "" if is_tied else "too dark"
    registered = registration if is_tied else None
    result = result_of(pose, status=status, reason=reason, registration=registered)
    image = np.zeros((8, 8), dtype=np.uint8)
    return RgbdFrame(stamp_ns=stamp_ns, image=image, depth=np.ones((8, 8), np.float32)), result


def _add(file: RunBag, stamp_ns: int, status: Status = Status.OK, **changes: Any) -> Estimate:
    frame, result = _made_up(stamp_ns, status)
    raw = replace(result.raw, status=Status.OK if result.registration else Status.COASTING)
    file.add_frame(frame, replace(result, raw=raw, **changes))
    return result.causal


def test_paths_on_the_way_come_once_a_second_and_stay_short(tmp_path: Path) -> None:
    n_seconds, rate = 13, 40
    stamps = [START_NS + k * SECOND_NS // rate for k in range(n_seconds * rate)]
    with RunBag(tmp_path / "run.mcap") as file:
        # Smoothed poses come late, in pairs, the later one first.
        poses: list[Estimate] = []
        for k, stamp_ns in enumerate(stamps):
            poses.append(_add(file, stamp_ns))
            if k > 2 and k % 2:
                file.add_smoothed([poses[k - 2], poses[k - 3]])
        file.add_smoothed(poses[-2:])
    messages = read_bag(tmp_path / "run.mcap")
    for kind in ("raw", "smoothed"):
        *way, (_, last) = messages[f"/gvo/{kind}/path"]
        seconds = [START_NS + k * SECOND_NS for k in range(1, n_seconds)]
        assert [_stamp_ns(message.header) for _, message in way] == seconds
        assert [_stamp_ns(pose.header) for pose in last.poses] == stamps
        for _, message in way:
            shown = [_stamp_ns(pose.header) for pose in message.poses]
            n_known = stamps.index(_stamp_ns(message.header)) + 1
            assert shown == sorted(set(shown))
            assert min(n_known - 4, N_SHOWN_POSES // 2) <= len(shown) <= N_SHOWN_POSES
            assert stamps.index(shown[-1]) >= n_known - 4


def test_frames_without_a_registration_are_told_and_have_no_points(tmp_path: Path) -> None:
    statuses = [Status.OK, Status.COASTING, Status.LOST, Status.RESUMED, Status.OK]
    with RunBag(tmp_path / "run.bag") as file:
        file.add_faulty(FaultyFrame(stamp_ns=START_NS - 5, reason="before the first frame"))
        for k, status in enumerate(statuses):
            _add(file, START_NS + k * SECOND_NS, status)
        file.add_faulty(FaultyFrame(stamp_ns=START_NS + 7, reason="torn"))
    messages = read_bag(tmp_path / "run.bag")
    told = [message.status[0] for _, message in messages["/diagnostics"]]
    assert [status.level for status in told] == [0, 1, 2, 1, 0, 2]
    assert "too dark" in told[1].message
    assert told[-1].message == "skipped: torn"
    assert [cloud.width for _, cloud in messages["/gvo/points"]] == [0] * 5
    # Coasting is no measurement, and the frame after it is tied to an older one.
    odometry = messages["/gvo/raw/odometry"]
    assert [message.twist.covariance[0] for _, message in odometry] == [-1, -1, -1, -1, 1]


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    taken = tmp_path / "taken.mcap"
    taken.write_text("mine")
    for path, words in (
        (taken, r"taken\.mcap: exists already"),
        (tmp_path / "run.db3", r"\.mcap \(ROS 2\) or \.bag \(ROS 1\), got run\.db3"),
        (taken / "run.mcap", "cannot be written"),
    ):
        with pytest.raises(RecordingError, match=words):
            RunBag(path)
    with (
        RunBag(tmp_path / "run.mcap") as file,
        pytest.raises(RecordingError, match="cannot be written, expected 0 to"),
    ):
        _add(file, 2**31 * SECOND_NS)  # the stamp does not fit
    assert [path.name for path in tmp_path.iterdir()] == ["taken.mcap"]
    assert taken.read_text() == "mine"
