"""Recordings written as bags and read back."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.geometry.se3 import make_transform
from gvo.io.bag.messages import transform_of
from gvo.io.convert.convert import convert
from gvo.io.frames import frames
from gvo.io.opening import open_recording
from gvo.io.recording import Source
from gvo.trajectory.trajectory import Trajectory
from tests.io.conftest import Tiny
from tests.make.recordings import Held, Item, held
from tests.make.rendered_walk import read_bag

_KINDS = pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
_GENERATIONS = pytest.mark.parametrize("name", ["a.bag", "folder"])
_CAMERA = PinholeCamera(fx=50.1, fy=50.3, cx=23.7, cy=15.9, width=48, height=32)
_START_NS = 1_403_636_584_763_555_584


def _noise(seed: int, *, is_color: bool = False) -> NDArray[np.uint8]:
    shape = (32, 48, 3) if is_color else (32, 48)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _depth(seed: int) -> NDArray[np.float32]:
    depth = np.random.default_rng(seed).uniform(0.4, 5, (32, 48)).astype(np.float32)
    depth[3:5, 7:9] = np.nan
    return depth


def _raw_pair() -> tuple[Calibration, Calibration]:
    rng = np.random.default_rng(1)
    pair = []
    for baseline in (0.0, 0.537 / 3):
        ideal = Calibration.from_camera(_CAMERA, baseline=baseline)
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()
        pair.append(replace(ideal, D=rng.normal(0, 0.05, 5), R=np.asarray(R), is_rectified=False))
    return pair[0], pair[1]


def _truth(n: int) -> Trajectory:
    rng = np.random.default_rng(2)
    R = Rotation.from_rotvec(rng.normal(0, 1, (n, 3))).as_matrix()
    stamps_ns = _START_NS - 50 + 33 * np.arange(n, dtype=np.int64)
    return Trajectory(
        stamps_ns=stamps_ns, T_world_frame=make_transform(np.asarray(R), rng.normal(0, 9, (n, 3)))
    )


def _stereo(*calibrations: Calibration, n: int = 4, **options: Any) -> Held:
    if not calibrations:
        calibrations = (
            Calibration.from_camera(_CAMERA),
            Calibration.from_camera(_CAMERA, baseline=0.2),
        )
    items: list[Item] = [
        (stream, _START_NS + 100 * k, _noise(2 * k + stream)) for k in range(n) for stream in (0, 1)
    ]
    return held("stereo", items, calibrations=calibrations, **options)


def _rgbd(calibration: Calibration, **options: Any) -> Held:
    items: list[Item] = []
    for k in range(4):
        stamp_ns = _START_NS + 10**8 * k
        items.append((1, stamp_ns - 7_000_001, _depth(k)))
        items.append((0, stamp_ns, _noise(k, is_color=k % 2 == 0)))
    return held("rgbd", items, calibrations=(calibration,), **options)


def _fingerprints(source: Source) -> list[tuple[object, ...]]:
    return [Tiny().fingerprint(frame) for frame in frames(source, Config())]


def _assert_same(source: Source, copy: Source) -> None:
    assert _fingerprints(copy) == _fingerprints(source)
    assert copy.info.sensor == source.info.sensor
    assert copy.info.n_images == source.info.n_images
    for mine, theirs in zip(copy.info.calibrations, source.info.calibrations, strict=True):
        for name in ("width", "height", "is_rectified"):
            assert getattr(mine, name) == getattr(theirs, name)
        for name in "KDRP":
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
    mine_truth, truth = copy.ground_truth(), source.ground_truth()
    assert (mine_truth is None) == (truth is None)
    if mine_truth is not None and truth is not None:
        np.testing.assert_array_equal(mine_truth.stamps_ns, truth.stamps_ns)
        np.testing.assert_allclose(mine_truth.T_world_frame, truth.T_world_frame, atol=1e-14)


@_KINDS
@pytest.mark.parametrize(
    "source",
    [
        _stereo(truth=_truth(20)),
        _stereo(*_raw_pair()),
        _rgbd(Calibration.from_camera(_CAMERA)),
        _rgbd(replace(_raw_pair()[0], R=np.eye(3)), truth=_truth(3)),
    ],
    ids=["rectified stereo", "raw stereo", "ideal rgbd", "raw rgbd"],
)
def test_what_is_read_back_is_the_recording(tmp_path: Path, name: str, source: Source) -> None:
    conversion = convert(source, tmp_path / name)
    _assert_same(source, open_recording(tmp_path / name))
    assert conversion.n_images == 8
    assert conversion.skipped == ()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("source", [_stereo(*_raw_pair()), _rgbd(_raw_pair()[0])])
def test_rectified_copies_hold_the_same_frames(tmp_path: Path, source: Source) -> None:
    convert(source, tmp_path / "a.bag", rectify=True)
    copy = open_recording(tmp_path / "a.bag")
    assert all(calibration.is_rectified for calibration in copy.info.calibrations)
    assert _fingerprints(copy) == _fingerprints(source)
    raw = source.info.calibrations[0]
    np.testing.assert_array_equal(copy.info.calibrations[0].P, raw.P)


@_KINDS
def test_another_reader_finds_the_topics_and_the_stamps(tmp_path: Path, name: str) -> None:
    convert(_stereo(truth=_truth(20)), tmp_path / name)
    path = tmp_path / name
    with AnyReader([path]) as reader:
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == {
            "/stereo/left/camera_info": "sensor_msgs/msg/CameraInfo",
            "/stereo/left/image_rect": "sensor_msgs/msg/Image",
            "/stereo/right/camera_info": "sensor_msgs/msg/CameraInfo",
            "/stereo/right/image_rect": "sensor_msgs/msg/Image",
            "/tf": "tf2_msgs/msg/TFMessage",
            "/tf_static": "tf2_msgs/msg/TFMessage",
        }
        log_times = []
        for connection, log_time_ns, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            is_tf = connection.topic.startswith("/tf")
            header = (message.transforms[0] if is_tf else message).header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == log_time_ns
            log_times.append(log_time_ns)
            if connection.topic == "/stereo/left/image_rect":
                assert (header.frame_id, message.encoding) == ("camera_left_optical", "mono8")
        assert log_times == sorted(log_times)
        assert len(log_times) == 16 + 20 + 1


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@settings(max_examples=8)
@given(stamps=st.sets(st.integers(0, 2**31 * 10**9 - 1), min_size=1, max_size=5).map(sorted))
def test_stamps_are_exact_to_the_nanosecond(
    tmp_path_factory: pytest.TempPathFactory, name: str, stamps: list[int]
) -> None:
    path = tmp_path_factory.mktemp("stamps") / name
    items: list[Item] = [(stream, s, _noise(1)) for s in stamps for stream in (0, 1)]
    convert(held("stereo", items, calibrations=_stereo().info.calibrations), path)
    assert [image.stamp_ns for image in open_recording(path).images()] == [
        stamp_ns for stamp_ns in stamps for _ in range(2)
    ]


@_GENERATIONS
def test_frames_whose_stamps_go_back_or_repeat_stay_faulty(tmp_path: Path, name: str) -> None:
    stamps = [10, 30, 20, 40, 40, 50]
    items: list[Item] = [(s, stamp, _noise(n)) for n, stamp in enumerate(stamps) for s in (0, 1)]
    source = held("stereo", items, calibrations=_stereo().info.calibrations)
    convert(source, tmp_path / name)
    copy = _fingerprints(open_recording(tmp_path / name))
    assert copy == _fingerprints(source)
    assert [item[1] for item in copy if item[0] == "faulty"] == [20, 40]


@_GENERATIONS
def test_nothing_is_left_behind_where_writing_fails(tmp_path: Path, name: str) -> None:
    items: list[Item] = [(0, 5, _noise(1)), (1, 5, _noise(2)), (0, -1, _noise(3))]
    source = held("stereo", items, calibrations=_stereo().info.calibrations)
    with pytest.raises(RecordingError, match="the stamp -1 ns cannot be written"):
        convert(source, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def _transforms(path: Path, topic: str) -> list[tuple[int, str, str, NDArray[np.float64]]]:
    found = []
    for log_time_ns, message in read_bag(path)[topic]:
        for one in message.transforms:
            T = transform_of(one.transform.translation, one.transform.rotation)
            assert isinstance(T, np.ndarray)
            found.append((log_time_ns, one.header.frame_id, one.child_frame_id, T))
    return found


@_KINDS
def test_the_cameras_stand_in_tf_before_the_first_image(tmp_path: Path, name: str) -> None:
    source = _stereo(*_raw_pair(), truth=_truth(3))
    T_body_cam = make_transform(_raw_pair()[1].R, np.array([0.3, -0.2, 0.1]))
    source.info = replace(source.info, T_body_cam=T_body_cam, frame_id="cam_left")
    convert(source, tmp_path / name)
    body, right = _transforms(tmp_path / name, "/tf_static")
    assert body[1:3] == ("body", "cam_left")
    np.testing.assert_allclose(body[3], T_body_cam, atol=1e-15)
    assert right[1:3] == ("cam_left", "camera_right_optical")
    np.testing.assert_allclose(right[3][:3, 3], [0.537 / 3, 0, 0], rtol=1e-12)
    assert {pose[1:3] for pose in _transforms(tmp_path / name, "/tf")} == {
        ("world", "ground_truth")
    }
    with AnyReader([tmp_path / name]) as reader:
        (static,) = [one for one in reader.connections if one.topic == "/tf_static"]
        extension: Any = static.ext
        if name == "a.bag":
            assert extension.latching == 1
        else:
            assert extension.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
        assert body[0] == min(log_time_ns for _, log_time_ns, _ in reader.messages())
