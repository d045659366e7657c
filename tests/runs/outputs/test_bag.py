"""Runs as bags, read back by other programs' readers."""

import errno
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry.se3 import make_transform
from gvo.io.convert.bag_messages import BagWriter
from gvo.io.poses.tf import TfBuffer
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.runs.outputs.bag import RunBag
from gvo.runs.outputs.frames import RunFrames
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    Frame,
    FrameResult,
    RelativePose,
    RgbdFrame,
    Status,
    StereoFrame,
)
from gvo.viz.scene import N_SHOWN_POSES
from tests.recordings import frames_of
from tests.results import estimate_at, loop_of, optimum_of, result_of

_KINDS = pytest.mark.parametrize("name", ["run.mcap", "run.bag"])
_N_FRAMES = 12
_ESTIMATES = ("raw", "causal", "smoothed")
_SECOND_NS = 10**9
_START_NS = 1_403_636_584_763_555_584
# A camera that looks ahead and 20 degrees down, on a robot whose x points ahead and z up.
_T_BASE_CAM = make_transform(
    np.asarray(Rotation.from_euler("ZYX", [-90, 0, -110], degrees=True).as_matrix()),
    np.array([0.3, -0.1, 0.5]),
)
_MOUNTED = RunFrames(base="base_link", camera="/left_optical", T_base_cam=_T_BASE_CAM)
_FRAMES = pytest.mark.parametrize("names", [RunFrames(), _MOUNTED], ids=["camera", "base"])


class _Message(NamedTuple):
    log_time_ns: int
    content: Any

    @property
    def stamp_ns(self) -> int:
        return _stamp_ns(self.content.header)


@dataclass(frozen=True)
class _Run:
    """What odometry gave, by stamp."""

    frames: list[Frame]
    results: list[FrameResult]
    last: tuple[Estimate, ...]

    def estimates(self, T_base_cam: FloatArray) -> dict[str, dict[int, Estimate]]:
        """Return all poses, of a frame that the camera is mounted on."""
        smoothed = [e for r in self.results for e in r.finished] + list(self.last)
        named = {
            "raw": [r.raw for r in self.results],
            "causal": [r.causal for r in self.results],
            "smoothed": smoothed,
        }
        return {
            name: {e.stamp_ns: _mounted(e, T_base_cam) for e in poses}
            for name, poses in named.items()
        }


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
    )


def _hat(xi: FloatArray) -> FloatArray:
    x, y, z, *t = xi
    return np.array([[0, -z, y, t[0]], [z, 0, -x, t[1]], [-y, x, 0, t[2]], [0, 0, 0, 0]])


def _rotation_vector(T: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_rotvec())


def _stamp_ns(header: Any) -> int:
    nanosec = header.stamp.nanosec if hasattr(header.stamp, "nanosec") else header.stamp.nanosecs
    return int(header.stamp.sec * _SECOND_NS + nanosec)


def _track(sensor: Sensor) -> _Run:
    recording = SyntheticRecording("handheld", sensor, n_frames=_N_FRAMES, scale=0.5)
    odometry = Odometry(recording.info.camera, Config())
    seen = frames_of(recording)
    results = [odometry.track(frame) for frame in seen]
    return _Run(frames=seen, results=results, last=odometry.finish())


@pytest.fixture(scope="module")
def stereo_run() -> _Run:
    return _track("stereo")


@pytest.fixture(scope="module", params=["stereo", "rgbd"])
def any_run(request: pytest.FixtureRequest, stereo_run: _Run) -> _Run:
    return stereo_run if request.param == "stereo" else _track("rgbd")


def _written(path: Path, run: _Run, names: RunFrames | None = None) -> dict[str, list[_Message]]:
    """Write the bag of a run, and return its messages by topic."""
    names = names or RunFrames()
    poses = run.estimates(names.mount(0))
    with RunBag(path, names) as bag:
        for frame, result in zip(run.frames, run.results, strict=True):
            bag.add_frame(frame, _placed(result, poses))
        bag.add_smoothed(poses["smoothed"][e.stamp_ns] for e in run.last)
    return _read(path)


def _placed(result: FrameResult, poses: dict[str, dict[int, Estimate]]) -> FrameResult:
    """Return the result with the poses that are to be written."""
    return replace(
        result,
        raw=poses["raw"][result.stamp_ns],
        causal=poses["causal"][result.stamp_ns],
        finished=tuple(poses["smoothed"][e.stamp_ns] for e in result.finished),
    )


def _read(path: Path) -> dict[str, list[_Message]]:
    messages = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, log_time_ns, data in reader.messages():
            content = reader.deserialize(data, connection.msgtype)
            messages[connection.topic].append(_Message(log_time_ns, content))
    return messages


def _transforms(messages: dict[str, list[_Message]]) -> Iterator[tuple[str, str, int, FloatArray]]:
    for message in messages["/tf"]:
        for transform in message.content.transforms:
            T = _pose_matrix(transform.transform.translation, transform.transform.rotation)
            header = transform.header
            yield header.frame_id, transform.child_frame_id, _stamp_ns(header), T


def _pose_matrix(t: Any, q: Any) -> FloatArray:
    R = np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix())
    return make_transform(R, np.array([t.x, t.y, t.z]))


def _buffer(messages: dict[str, list[_Message]]) -> TfBuffer:
    buffer = TfBuffer()
    for topic in ("/tf", "/tf_static"):
        for message in messages[topic]:
            for transform in message.content.transforms:
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


@_KINDS
def test_every_topic_comes_once_a_frame_stamped(tmp_path: Path, any_run: _Run, name: str) -> None:
    messages = _written(tmp_path / name, any_run, _MOUNTED)
    stamps = [frame.stamp_ns for frame in any_run.frames]
    once = ["/gvo/points", "/gvo/matches/compressed", "/diagnostics"]
    for topic in [*once, *(f"/gvo/{kind}/odometry" for kind in ("raw", "causal", "odom"))]:
        assert [m.stamp_ns for m in messages[topic]] == stamps
        assert [m.log_time_ns for m in messages[topic]] == stamps
    assert sorted(m.stamp_ns for m in messages["/gvo/smoothed/odometry"]) == stamps
    assert sorted(messages) == sorted(
        [*once, "/tf", "/tf_static"]
        + [f"/gvo/{kind}/odometry" for kind in (*_ESTIMATES, "odom")]
        + ["/gvo/raw/path", "/gvo/smoothed/path"]
    )
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_mcap_and_mcap_ros2_read_the_same_as_rosbags(tmp_path: Path, stereo_run: _Run) -> None:
    path = tmp_path / "run.mcap"
    expected = _written(path, stereo_run, _MOUNTED)
    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        for _, channel, message, content in reader.iter_decoded_messages():
            found[channel.topic].append(_Message(message.log_time, content))
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, expected.values()))
    assert {topic: len(items) for topic, items in found.items()} == {
        topic: len(items) for topic, items in expected.items()
    }
    for topic, items in expected.items():
        for mine, theirs in zip(found[topic], items, strict=True):
            assert mine.log_time_ns == theirs.log_time_ns
            _assert_equal(mine.content, theirs.content)


def _assert_equal(mine: Any, theirs: Any) -> None:
    """Compare two readers' messages field by field."""
    if hasattr(theirs, "__dataclass_fields__"):
        for field in theirs.__dataclass_fields__:
            if not field.startswith("__") and hasattr(mine, field):
                _assert_equal(getattr(mine, field), getattr(theirs, field))
    elif isinstance(theirs, np.ndarray):
        data = np.frombuffer(mine, np.uint8) if isinstance(mine, bytes | memoryview) else mine
        np.testing.assert_array_equal(np.asarray(data), theirs)
    elif isinstance(theirs, list):
        for one, other in zip(mine, theirs, strict=True):
            _assert_equal(one, other)
    elif isinstance(mine, bytes):
        assert mine == bytes([theirs])
    else:
        assert mine == theirs


@_KINDS
@_FRAMES
def test_tf_holds_the_poses(tmp_path: Path, stereo_run: _Run, name: str, names: RunFrames) -> None:
    messages = _written(tmp_path / name, stereo_run, names)
    expected = stereo_run.estimates(names.mount(0))
    found: dict[str, set[int]] = defaultdict(set)
    for parent, child, stamp_ns, T in _transforms(messages):
        if "gvo/odom" in (parent, child):
            continue
        gvo, kind, tracked = child.split("/")
        assert (parent, gvo, tracked) == ("world", "gvo", names.base)
        np.testing.assert_allclose(T, expected[kind][stamp_ns].T_world_frame, atol=1e-12)
        assert stamp_ns not in found[kind]
        found[kind].add(stamp_ns)
    assert found == {kind: set(expected[kind]) for kind in _ESTIMATES}


@_KINDS
def test_a_camera_hangs_on_every_estimate(tmp_path: Path, stereo_run: _Run, name: str) -> None:
    buffer = _buffer(_written(tmp_path / name, stereo_run, _MOUNTED))
    for kind, poses in stereo_run.estimates(_T_BASE_CAM).items():
        for stamp_ns, pose in poses.items():
            T_world_cam = _lookup(buffer, "world", f"gvo/{kind}/left_optical", stamp_ns)
            np.testing.assert_allclose(T_world_cam, pose.T_world_frame @ _T_BASE_CAM, atol=1e-12)
    # The robot's own tf has a base_link of its own.
    assert not {"base_link", "left_optical"} & set(buffer.frames)


def test_a_camera_moving_on_the_robot_is_placed_anew(tmp_path: Path, stereo_run: _Run) -> None:
    stamps = [frame.stamp_ns for frame in stereo_run.frames]

    def mount(stamp_ns: int) -> FloatArray:
        turned = _T_BASE_CAM.copy()
        turned[2, 3] += 0.01 * stamps.index(stamp_ns)
        return turned

    poses = {s: r.causal for s, r in zip(stamps, stereo_run.results, strict=True)}
    names = RunFrames(base="base_link", T_base_cam=mount)
    with RunBag(tmp_path / "run.mcap", names) as bag:
        for frame, result in zip(stereo_run.frames, stereo_run.results, strict=True):
            bag.add_frame(frame, result)
    buffer = _buffer(_read(tmp_path / "run.mcap"))
    for stamp_ns in stamps:
        T_world_cam = _lookup(buffer, "world", "gvo/causal/camera_optical", stamp_ns)
        expected = poses[stamp_ns].T_world_frame @ mount(stamp_ns)
        np.testing.assert_allclose(T_world_cam, expected, atol=1e-12)


def test_above_the_world_of_a_camera_stands_one_with_z_up(tmp_path: Path, stereo_run: _Run) -> None:
    names = RunFrames(world="odom", is_world_optical=True)
    buffer = _buffer(_written(tmp_path / "run.mcap", stereo_run, names))
    T_flu_world = _lookup(buffer, "odom_flu", "odom", stereo_run.frames[-1].stamp_ns)
    ahead, left, up = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]]) @ T_flu_world.T
    np.testing.assert_array_equal([ahead, left, up], np.eye(3, 4))
    parents = {parent for parent, *_ in _transforms(_read(tmp_path / "run.mcap"))}
    assert parents == {"odom", "gvo/odom"}


@_KINDS
@_FRAMES
def test_the_frame_of_rep_105_never_jumps_and_its_correction_leads_to_the_corrected_pose(
    tmp_path: Path, name: str, names: RunFrames
) -> None:
    stamps = [_START_NS + k * _SECOND_NS for k in range(5)]
    rng = np.random.default_rng(1)
    steps = [np.eye(4), *(np.asarray(expm(_hat(rng.normal(0.0, 0.1, 6)))) for _ in stamps[1:])]
    T_map_world = np.asarray(expm(_hat(rng.normal(0.0, 1.0, 6))))  # of loops, from some frame on
    corrections = [np.eye(4), np.eye(4), T_map_world, T_map_world, T_map_world]
    with RunBag(tmp_path / name, names) as bag:
        for stamp_ns, step, T in zip(stamps, steps, corrections, strict=True):
            frame, result = _made_up(stamp_ns)  # ten metres from frame to frame
            result = replace(result, T_map_world=T)
            first = stamp_ns == stamps[0]
            bag.add_frame(frame, replace(result, T_previous_frame=None if first else step))
    buffer = _buffer(_read(tmp_path / name))
    T_odom_base = np.eye(4)
    for stamp_ns, step, T in zip(stamps, steps, corrections, strict=True):
        T_odom_base = T_odom_base @ step
        found = _lookup(buffer, "gvo/odom", f"gvo/odom/{names.base}", stamp_ns)
        np.testing.assert_allclose(found, T_odom_base, atol=1e-12)
        T_world_base = T @ _made_up(stamp_ns)[1].causal.T_world_frame
        found = _lookup(buffer, "world", f"gvo/odom/{names.camera}", stamp_ns)
        np.testing.assert_allclose(found, T_world_base @ names.mount(stamp_ns), atol=1e-12)


@_KINDS
def test_loops_are_drawn_when_confirmed_and_last_in_global_poses(tmp_path: Path, name: str) -> None:
    stamps = [_START_NS + k * _SECOND_NS for k in range(4)]
    loop = loop_of(stamps[2], stamps[0])
    aside = np.eye(4)
    aside[0, 3] = 1.0
    with RunBag(tmp_path / name) as bag:
        poses = []
        for stamp_ns in stamps:
            frame, result = _made_up(stamp_ns)
            loops = (loop,) if stamp_ns == stamps[2] else ()
            bag.add_frame(frame, replace(result, loops=loops))
            poses.append(replace(result.causal, T_world_frame=aside @ result.causal.T_world_frame))
        bag.add_optimum(optimum_of(poses[::-1], loop, loop_of(stamps[3], stamps[0], "contradicts")))
    messages = _read(tmp_path / name)
    causal, last = messages["/gvo/loops"]
    assert [(m.stamp_ns, m.content.ns) for m in (causal, last)] == [
        (stamps[2], "causal"),
        (stamps[3], "global"),
    ]
    assert causal.content.id != last.content.id
    for message, x in ((causal, 0.0), (last, 1.0)):
        assert (message.content.header.frame_id, message.content.type) == ("world", 5)
        assert [(p.x, p.y, p.z) for p in message.content.points] == [(x, 0, 20), (x, 0, 0)]
        assert message.content.pose.orientation.w == 1
    path = messages["/gvo/global/path"][-1].content
    assert [_stamp_ns(p.header) for p in path.poses] == stamps
    assert {p.pose.position.x for p in path.poses} == {1.0}
    assert [m.stamp_ns for m in messages["/gvo/global/odometry"]] == stamps
    T = _lookup(_buffer(messages), "world", "gvo/global/camera_optical", stamps[1])
    np.testing.assert_allclose(T, poses[1].T_world_frame, atol=1e-12)
    told = messages["/diagnostics"][2].content.status[0]
    assert "loop to 2.0 s before, 87 inliers" in told.message


@_KINDS
@_FRAMES
def test_odometry_holds_pose_and_covariance_in_the_order_of_ros(
    tmp_path: Path, any_run: _Run, name: str, names: RunFrames
) -> None:
    messages = _written(tmp_path / name, any_run, names)
    for kind, poses in any_run.estimates(names.mount(0)).items():
        for message in messages[f"/gvo/{kind}/odometry"]:
            content, estimate = message.content, poses[message.stamp_ns]
            assert content.header.frame_id == "world"
            assert content.child_frame_id == f"gvo/{kind}/{names.base}"
            pose = content.pose.pose
            T = _pose_matrix(pose.position, pose.orientation)
            np.testing.assert_allclose(T, estimate.T_world_frame, atol=1e-12)
            np.testing.assert_allclose(
                content.pose.covariance.reshape(6, 6),
                _ros_covariance(estimate),
                rtol=1e-5,
                atol=1e-5 * np.abs(estimate.covariance).max(initial=0),
            )


def _ros_covariance(estimate: Estimate) -> FloatArray:
    """Move the pose a little along each axis and see what changes in the world's axes."""
    T, J = estimate.T_world_frame, np.zeros((6, 6))
    for k, xi in enumerate(1e-6 * np.eye(6)):
        moved = T @ expm(_hat(xi))
        turn = moved @ np.linalg.inv(T)
        J[:, k] = np.concatenate([moved[:3, 3] - T[:3, 3], _rotation_vector(turn)]) / 1e-6
    return np.asarray(J @ estimate.covariance @ J.T)


@_FRAMES
def test_the_velocity_leads_from_the_pose_before_to_this_one(
    tmp_path: Path, stereo_run: _Run, names: RunFrames
) -> None:
    messages = _written(tmp_path / "run.mcap", stereo_run, names)
    for kind, poses in stereo_run.estimates(names.mount(0)).items():
        known: list[int] = []
        for message in messages[f"/gvo/{kind}/odometry"]:
            earlier = [stamp_ns for stamp_ns in known if stamp_ns < message.stamp_ns]
            known.append(message.stamp_ns)
            if not earlier:
                assert not _velocity(message).any()
                continue
            elapsed_s = 1e-9 * (message.stamp_ns - max(earlier))
            T = poses[max(earlier)].T_world_frame @ expm(_hat(elapsed_s * _velocity(message)))
            np.testing.assert_allclose(T, poses[message.stamp_ns].T_world_frame, atol=1e-9)
        assert len(known) == _N_FRAMES


def _velocity(message: _Message) -> FloatArray:
    twist = message.content.twist.twist
    return np.array([getattr(v, axis) for v in (twist.angular, twist.linear) for axis in "xyz"])


@_FRAMES
@pytest.mark.parametrize("kind", ["raw", "odom"])
def test_the_covariance_of_a_measured_velocity_is_that_of_the_registration(
    tmp_path: Path, stereo_run: _Run, names: RunFrames, kind: str
) -> None:
    messages = _written(tmp_path / "run.mcap", stereo_run, names)
    stamps = [frame.stamp_ns for frame in stereo_run.frames]
    order = [3, 4, 5, 0, 1, 2]
    for index, message in enumerate(messages[f"/gvo/{kind}/odometry"]):
        found = message.content.twist.covariance.reshape(6, 6)[np.ix_(order, order)]
        registration = stereo_run.results[index].registration
        if index == 0 or registration is None:
            np.testing.assert_array_equal(found, -np.eye(6))
            continue
        step = replace(stereo_run.results[index].raw, covariance=registration.covariance)
        expected = _mounted(step, names.mount(0)).covariance
        elapsed_s = 1e-9 * (stamps[index] - stamps[index - 1])
        np.testing.assert_allclose(found * elapsed_s**2, expected, rtol=1e-4, atol=1e-12)
    for other in ("causal", "smoothed"):
        for message in messages[f"/gvo/{other}/odometry"]:
            np.testing.assert_array_equal(message.content.twist.covariance, -np.eye(6).ravel())


def test_a_registration_that_the_window_refused_is_not_the_velocitys_in_odom(
    tmp_path: Path,
) -> None:
    with RunBag(tmp_path / "run.mcap") as bag:
        for k, status in enumerate([Status.OK, Status.OK, Status.COASTING]):
            frame, result = _made_up(_START_NS + k * _SECOND_NS)
            causal = replace(result.causal, status=status)
            bag.add_frame(frame, replace(result, causal=causal, T_previous_frame=np.eye(4)))
    messages = _read(tmp_path / "run.mcap")
    for kind, expected in (("raw", [-1, 1, 1]), ("odom", [-1, 1, -1])):
        covariances = [m.content.twist.covariance for m in messages[f"/gvo/{kind}/odometry"]]
        assert [covariance[0] for covariance in covariances] == expected


@_KINDS
def test_points_are_those_matched_in_grey(tmp_path: Path, any_run: _Run, name: str) -> None:
    clouds = _written(tmp_path / name, any_run, _MOUNTED)["/gvo/points"]
    assert sum(m.content.width for m in clouds) > 50 * len(clouds)
    for message, frame, result in zip(clouds, any_run.frames, any_run.results, strict=True):
        cloud = message.content
        assert (cloud.header.frame_id, cloud.height) == ("gvo/causal/left_optical", 1)
        assert cloud.is_dense
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


def test_pictures_show_the_image_with_its_matches(tmp_path: Path, stereo_run: _Run) -> None:
    messages = _written(tmp_path / "run.mcap", stereo_run)["/gvo/matches/compressed"]
    for message, frame in zip(messages, stereo_run.frames, strict=True):
        assert isinstance(frame, StereoFrame)
        assert message.content.format == "jpeg"
        assert message.content.header.frame_id == "gvo/causal/camera_optical"
        picture = cv2.imdecode(message.content.data, cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (*frame.left.shape, 3)
        below = picture[60:].mean(axis=2) - frame.left[60:]
        assert np.median(np.abs(below)) < 6


def test_diagnostics_count_and_time_each_frame(tmp_path: Path, stereo_run: _Run) -> None:
    messages = _written(tmp_path / "run.mcap", stereo_run)["/diagnostics"]
    for message, result in zip(messages, stereo_run.results, strict=True):
        (status,) = message.content.status
        values = {pair.key: pair.value for pair in status.values}
        assert (status.level, status.hardware_id) == (0, "camera_optical")
        assert status.message.startswith("ok: ")
        assert int(values["inliers"]) == result.n_inliers
        assert int(values["matches"]) == result.n_matches
        assert int(values["links"]) == result.n_links
        for stage, ms in result.stage_ms.items():
            assert float(values[f"{stage} [ms]"]) == pytest.approx(ms, abs=1e-3)


@_KINDS
def test_paths_end_with_all_poses(tmp_path: Path, stereo_run: _Run, name: str) -> None:
    messages = _written(tmp_path / name, stereo_run, _MOUNTED)
    for kind in ("raw", "smoothed"):
        poses = stereo_run.estimates(_T_BASE_CAM)[kind]
        path = messages[f"/gvo/{kind}/path"][-1].content
        assert path.header.frame_id == "world"
        assert [_stamp_ns(p.header) for p in path.poses] == sorted(poses)
        for pose, stamp_ns in zip(path.poses, sorted(poses), strict=True):
            T = _pose_matrix(pose.pose.position, pose.pose.orientation)
            np.testing.assert_allclose(T, poses[stamp_ns].T_world_frame, atol=1e-12)


def _made_up(stamp_ns: int, status: Status = Status.OK) -> tuple[Frame, FrameResult]:
    """Return a small frame and a pose ten metres a second ahead."""
    T = np.eye(4)
    T[2, 3] = 10e-9 * (stamp_ns - _START_NS)
    pose = estimate_at(stamp_ns, T, covariance=1e-4 * np.eye(6), status=status)
    registration = RelativePose(T_reference_current=np.eye(4), covariance=np.eye(6))
    is_tied = status in (Status.OK, Status.RESUMED)
    reason = "" if is_tied else "too dark"
    registered = registration if is_tied else None
    result = result_of(pose, status=status, reason=reason, registration=registered)
    image = np.zeros((8, 8), dtype=np.uint8)
    return RgbdFrame(stamp_ns=stamp_ns, image=image, depth=np.ones((8, 8), np.float32)), result


def _add(bag: RunBag, stamp_ns: int, status: Status = Status.OK) -> Estimate:
    frame, result = _made_up(stamp_ns, status)
    raw = replace(result.raw, status=Status.OK if result.registration else Status.COASTING)
    bag.add_frame(frame, replace(result, raw=raw))
    return result.causal


def test_paths_on_the_way_come_once_a_second_and_stay_short(tmp_path: Path) -> None:
    n_seconds, rate = 70, 10
    stamps = [_START_NS + k * _SECOND_NS // rate for k in range(n_seconds * rate)]
    with RunBag(tmp_path / "run.mcap") as bag:
        # Smoothed poses come late, in pairs, the later one first.
        poses = [_add(bag, stamps[0]), _add(bag, stamps[1])]
        for k in range(2, len(stamps)):
            poses.append(_add(bag, stamps[k]))
            if k % 2:
                bag.add_smoothed([poses[k - 2], poses[k - 3]])
        bag.add_smoothed(poses[-2:])
    messages = _read(tmp_path / "run.mcap")
    for kind in ("raw", "smoothed"):
        *way, last = messages[f"/gvo/{kind}/path"]
        assert [m.stamp_ns for m in way] == [_START_NS + k * _SECOND_NS for k in range(1, 70)]
        assert [_stamp_ns(p.header) for p in last.content.poses] == stamps
        for message in way:
            shown = [_stamp_ns(p.header) for p in message.content.poses]
            n_known = stamps.index(message.stamp_ns) + 1
            assert shown == sorted(set(shown))
            assert min(n_known - 4, N_SHOWN_POSES // 2) <= len(shown) <= N_SHOWN_POSES
            assert stamps.index(shown[-1]) >= n_known - 4


def test_smoothed_poses_appear_when_they_were_known(tmp_path: Path, stereo_run: _Run) -> None:
    messages = _written(tmp_path / "run.mcap", stereo_run)["/gvo/smoothed/odometry"]
    known_ns = {
        estimate.stamp_ns: result.stamp_ns
        for result in stereo_run.results
        for estimate in result.finished
    }
    assert known_ns
    for message in messages:
        last_ns = stereo_run.frames[-1].stamp_ns
        assert message.log_time_ns == known_ns.get(message.stamp_ns, last_ns)


def test_frames_without_a_registration_are_told_and_have_no_points(tmp_path: Path) -> None:
    statuses = [Status.OK, Status.COASTING, Status.LOST, Status.RESUMED, Status.OK]
    with RunBag(tmp_path / "run.bag") as bag:
        bag.add_faulty(FaultyFrame(stamp_ns=_START_NS - 5, reason="before the first frame"))
        for k, status in enumerate(statuses):
            _add(bag, _START_NS + k * _SECOND_NS, status)
        bag.add_faulty(FaultyFrame(stamp_ns=_START_NS + 7, reason="torn"))
    messages = _read(tmp_path / "run.bag")
    told = [m.content.status[0] for m in messages["/diagnostics"]]
    assert [status.level for status in told] == [0, 1, 2, 1, 0, 2]
    assert "too dark" in told[1].message
    assert told[-1].message == "skipped: torn"
    assert [m.content.width for m in messages["/gvo/points"]] == [0] * 5
    # Coasting is no measurement, and the frame after it is tied to an older one.
    covariances = [m.content.twist.covariance for m in messages["/gvo/raw/odometry"]]
    assert [covariance[0] for covariance in covariances] == [-1, -1, -1, -1, 1]


@_KINDS
def test_an_interrupted_run_leaves_what_was_computed(tmp_path: Path, name: str) -> None:
    def run_until_interrupted() -> None:
        with RunBag(tmp_path / name) as bag:
            bag.add_smoothed([_add(bag, _START_NS)])
            _add(bag, _START_NS + 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_until_interrupted()
    messages = _read(tmp_path / name)
    assert len(messages["/gvo/raw/odometry"]) == 2
    assert len(messages["/gvo/raw/path"][-1].content.poses) == 2
    assert len(messages["/gvo/smoothed/path"][-1].content.poses) == 1


@_KINDS
def test_without_a_frame_no_file_is_left(tmp_path: Path, name: str) -> None:
    with RunBag(tmp_path / name):
        assert len(list(tmp_path.iterdir())) == 1
    assert list(tmp_path.iterdir()) == []


@_KINDS
def test_the_folder_is_made_and_closing_twice_does_no_harm(tmp_path: Path, name: str) -> None:
    with RunBag(tmp_path / "new" / "folder" / name) as bag:
        _add(bag, _START_NS)
        bag.close()
    assert len(_read(tmp_path / "new" / "folder" / name)["/gvo/points"]) == 1


def test_what_cannot_be_written_is_refused_before_the_run(tmp_path: Path) -> None:
    taken = tmp_path / "taken.mcap"
    taken.write_text("mine")
    with pytest.raises(RecordingError, match=r"taken\.mcap: exists already"):
        RunBag(taken)
    with pytest.raises(RecordingError, match=r"\.mcap \(ROS 2\) or \.bag \(ROS 1\), got run\.db3"):
        RunBag(tmp_path / "run.db3")
    with pytest.raises(RecordingError, match="cannot be written"):
        RunBag(taken / "run.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.mcap"]
    assert taken.read_text() == "mine"


@_KINDS
def test_a_full_disk_ends_the_run_with_one_line(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = RunBag(tmp_path / name)
    _add(bag, _START_NS)

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BagWriter, "write", refuse)
    with pytest.raises(RecordingError, match=f"{name}: cannot be written: No space left"):
        _add(bag, _START_NS + 1)
    with pytest.raises(RecordingError, match=f"{name}: cannot be written: No space left"):
        bag.close()
    assert list(tmp_path.iterdir()) == []


def test_a_stamp_that_does_not_fit_is_refused_in_one_line(tmp_path: Path) -> None:
    with (
        RunBag(tmp_path / "run.mcap") as bag,
        pytest.raises(RecordingError, match="cannot be written, expected 0 to"),
    ):
        _add(bag, 2**31 * _SECOND_NS)
