"""The IMU of a bag: which topics, which samples, where it sits."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gvo.config import Config, SyncConfig
from gvo.errors import CalibrationError, RecordingError
from gvo.geometry.imu import ImuSamples, ImuStream
from gvo.geometry.se3 import make_transform
from gvo.io.opening import RecordingOptions, open_recording
from gvo.types import FloatArray
from tests.make.bags import Message, camera_info, image, imu, tf, transform, write

_SECOND = 10**9
_START = 1_700_000_000 * _SECOND
_P_LEFT = [50.0, 0, 23.5, 0, 0, 50.0, 15.5, 0, 0, 0, 1, 0]
_P_RIGHT = [50.0, 0, 23.5, -25.0, 0, 50.0, 15.5, 0, 0, 0, 1, 0]
_T_CAMERA_IMU = make_transform(
    np.asarray(Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix()), np.array([0.1, -0.2, 0.3])
)


def _camera(tiny: Any, *, n: int = 3, place: str = "/s", **options: Any) -> list[Message]:
    messages = []
    for k in range(n):
        for side, P in (("left", _P_LEFT), ("right", _P_RIGHT)):
            stamp_ns, topic = _START + k * _SECOND // 10, f"{place}/{side}"
            info: dict[str, Any] = {"R": np.eye(3), "P": P} | options
            messages.append(camera_info(f"{topic}/camera_info", "camera", stamp_ns, **info))
            pixels, of = tiny.texture(k), {"is_ros1": options.get("is_ros1", True)}
            messages.append(image(f"{topic}/image_rect", pixels, "mono8", stamp_ns, **of))
    return messages


def _sample(k: int) -> tuple[FloatArray, FloatArray]:
    """Return the gyro and the acceleration of a sample, all numbers different."""
    return np.array([k, k + 0.25, -k]) + 0.125, np.array([2.0 * k, 9.81, 0.5 * k])


def _samples(
    topic: str, n: int = 30, *, period_ns: int = _SECOND // 100, **options: Any
) -> list[Message]:
    return [imu(topic, _START + k * period_ns, *_sample(k), **options) for k in range(n)]


def _write(path: Path, messages: Sequence[Message]) -> Path:
    return write(path, sorted(messages, key=lambda message: message[2]))


def _stream(path: Path, **options: Any) -> ImuStream:
    stream = open_recording(path, options=RecordingOptions(**options)).info.imu
    assert stream is not None
    return stream


def _all(stream: ImuStream, start_ns: int = 0) -> ImuSamples:
    parts = list(stream.samples(start_ns))
    return ImuSamples(
        stamps_ns=np.concatenate([part.stamps_ns for part in parts]),
        gyro=np.concatenate([part.gyro for part in parts]),
        acceleration=np.concatenate([part.acceleration for part in parts]),
    )


def _decision(path: Path, **options: Any) -> str:
    source = open_recording(path, options=RecordingOptions(**options))
    (line,) = [line for line in source.info.decisions if line.startswith("imu: ")]
    return line


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_one_topic_gives_all_its_samples_as_they_are(tmp_path: Path, tiny: Any, name: str) -> None:
    of: dict[str, Any] = {"is_ros1": name == "a.bag"}
    bag = _write(tmp_path / name, [*_camera(tiny, **of), *_samples("/imu/data", 700, **of)])
    stream = _stream(bag)
    found, parts = _all(stream), list(stream.samples(0))
    assert stream.name == "/imu/data"
    assert max(map(len, parts)) < 500
    assert found.stamps_ns.tolist() == [_START + 10_000_000 * k for k in range(700)]
    gyro, acceleration = (np.array(rows) for rows in zip(*map(_sample, range(700)), strict=True))
    np.testing.assert_array_equal(found.gyro, gyro)
    np.testing.assert_array_equal(found.acceleration, acceleration)
    assert stream.imu.T_camera_imu is None
    assert stream.imu.delay_s is None
    expected = "imu: /imu/data (700 messages); its place is learnt, its delay is learnt"
    assert _decision(bag) == expected


def test_a_bag_without_an_imu_has_none_and_says_nothing(tmp_path: Path, tiny: Any) -> None:
    info = open_recording(_write(tmp_path / "a.bag", _camera(tiny))).info
    assert info.imu is None
    assert not any("imu" in line for line in info.decisions)


def test_it_is_left_out_if_so_asked(tmp_path: Path, tiny: Any) -> None:
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu")])
    info = open_recording(bag, options=RecordingOptions(imu="none")).info
    assert info.imu is None
    assert not any("imu" in line for line in info.decisions)


def _two(*, zeros: bool, period_ns: int = 15_000_000) -> list[Message]:
    """Return a gyro at 200 Hz and a slower accelerometer, both linear over time."""
    denied = ((), ()) if zeros else (("linear_acceleration",), ("angular_velocity",))
    ramp = np.array([1.0, -2.0, 0.5])
    gyro = [
        imu("/c/gyro/sample", _START + k * 5_000_000, (1.0, k, 0.0), denied=denied[0])
        for k in range(80)
    ]
    accelerations = [
        imu(
            "/c/accel/sample",
            _START + 2_000_000 + k * period_ns,
            acceleration=9.81 + ramp * (2_000_000 + k * period_ns) * 1e-9,
            denied=denied[1],
        )
        for k in range(400_000_000 // period_ns)
    ]
    return [*gyro, *accelerations]


@pytest.mark.parametrize("zeros", [False, True])
def test_accelerations_of_another_topic_are_interpolated_to_the_gyro(
    tmp_path: Path, tiny: Any, zeros: bool
) -> None:
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_two(zeros=zeros)])
    found = _all(_stream(bag))
    # the first comes before any acceleration, the last ones after all
    first_ns, last_ns = _START + 5_000_000, _START + 2_000_000 + 25 * 15_000_000
    stamps_ns = np.arange(first_ns, last_ns + 1, 5_000_000)
    assert found.stamps_ns.tolist() == stamps_ns.tolist()
    np.testing.assert_array_equal(found.gyro[:, 1], (stamps_ns - _START) // 5_000_000)
    expected = 9.81 + np.outer((stamps_ns - _START) * 1e-9, [1.0, -2.0, 0.5])
    np.testing.assert_allclose(found.acceleration, expected, rtol=0, atol=1e-12)
    assert "/c/gyro/sample + /c/accel/sample (80 + 26 messages)" in _decision(bag)


def test_no_acceleration_is_made_up_in_a_hole(tmp_path: Path, tiny: Any) -> None:
    messages = [
        message
        for message in _two(zeros=False)
        if "gyro" in message[0] or not 100 <= (message[2] - _START) // 1_000_000 < 300
    ]
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *messages])
    found = (_all(_stream(bag)).stamps_ns - _START) // 1_000_000
    assert found[found < 150].max() <= 92
    assert found[found > 150].min() >= 302


@pytest.mark.parametrize(("gyro_ms", "accel_ms"), [(0, 0), (0, 30), (30, 0)])
def test_no_sample_of_a_pair_is_lost_between_two_parts(
    tmp_path: Path, tiny: Any, gyro_ms: int, accel_ms: int
) -> None:
    n, messages = 2000, []
    for k in range(n):
        t = _START + k * 5_000_000
        late_ns = (t + gyro_ms * 1_000_000, t + accel_ms * 1_000_000)
        messages.append(imu("/c/gyro", t, (1.0, k, 0.0), log_time_ns=late_ns[0]))
        messages.append(imu("/c/accel", t, acceleration=(k, 9.81, 0.0), log_time_ns=late_ns[1]))
    stream = _stream(_write(tmp_path / "a.bag", [*_camera(tiny), *messages]))
    assert len(list(stream.samples(0))) > 5
    found = _all(stream)
    assert found.stamps_ns.tolist() == [_START + k * 5_000_000 for k in range(n)]
    np.testing.assert_allclose(found.acceleration[:, 0], found.gyro[:, 1], atol=1e-9)


def test_stamps_that_go_back_are_passed_on(tmp_path: Path, tiny: Any) -> None:
    order = [0, 1, 3, 2, 4]
    messages = [
        imu("/imu", _START + k, *_sample(k), log_time_ns=_START + n) for n, k in enumerate(order)
    ]
    stream = _stream(_write(tmp_path / "a.bag", [*_camera(tiny), *messages]))
    assert (_all(stream).stamps_ns - _START).tolist() == order


def test_samples_may_be_asked_for_from_a_stamp_on(tmp_path: Path, tiny: Any) -> None:
    messages = [imu("/imu", _START + k * _SECOND, *_sample(k)) for k in range(100)]
    stream = open_recording(_write(tmp_path / "a.bag", [*_camera(tiny), *messages])).info.imu
    assert stream is not None
    found = _all(stream, _START + 90 * _SECOND)
    assert ((found.stamps_ns - _START) // _SECOND).tolist() == list(range(90, 100))


def test_the_clock_of_the_recorder_counts_for_the_imu_too(tmp_path: Path, tiny: Any) -> None:
    messages = [imu("/imu", 5, *_sample(k), log_time_ns=_START + k) for k in range(4)]
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *messages])
    config = Config(sync=SyncConfig(stamps="recording"))
    stream = open_recording(bag, config=config).info.imu
    assert stream is not None
    assert (_all(stream).stamps_ns - _START).tolist() == [0, 1, 2, 3]


def test_an_imu_by_another_clock_is_not_used(tmp_path: Path, tiny: Any) -> None:
    messages = [imu("/imu", 5 + k, *_sample(k), log_time_ns=_START + k) for k in range(4)]
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *messages])
    assert open_recording(bag).info.imu is None
    expected = "the clock of /imu is 1.7e+09 s before that of the camera"
    assert _decision(bag) == f"imu: none: {expected}"
    with pytest.raises(RecordingError, match=r"/imu is 1\.7e\+09 s before"):
        _stream(bag, imu="/imu")


def test_of_several_the_one_of_the_camera_is_taken_if_a_name_tells_which(
    tmp_path: Path, tiny: Any
) -> None:
    fast, slow = _samples("/mavros/imu", 40), _samples("/s/imu", 20)
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *fast, *slow])
    assert "/s/imu (20 messages), by its name; --imu takes another of /mavros/imu" in _decision(bag)
    bag = _write(tmp_path / "b.bag", [*_camera(tiny), *fast, *_samples("/drone/imu", 20)])
    assert _decision(bag) == "imu: none: --imu chooses one of /mavros/imu, /drone/imu"
    assert _stream(bag, imu="mavros/imu").name == "/mavros/imu"
    near, far = _samples("/robot/cam/imu", 20), _samples("/robot/base/imu", 40)
    bag = _write(tmp_path / "d.bag", [*_camera(tiny, place="/robot/cam"), *far, *near])
    assert "/robot/cam/imu (20 messages), by its name" in _decision(bag)


def test_the_accelerometer_is_that_beside_the_gyro(tmp_path: Path, tiny: Any) -> None:
    messages = []
    for n, place in enumerate(("/back", "/front")):
        for k in range(30):
            t = _START + k * 10_000_000
            messages.append(imu(f"{place}/gyro/sample", t, (1.0, 2.0, 3.0)))
            messages.append(imu(f"{place}/accel/sample", t, acceleration=(n, 0.0, 9.81)))
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *messages])
    for n, place in enumerate(("/back", "/front")):
        stream = _stream(bag, imu=f"{place}/gyro/sample")
        np.testing.assert_array_equal(_all(stream).acceleration[:, 0], n)


def test_a_topic_without_both_is_not_used(tmp_path: Path, tiny: Any) -> None:
    denied = ("angular_velocity", "linear_acceleration")
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/compass", denied=denied)])
    reason = "/compass without both angular velocity and acceleration"
    assert _decision(bag) == f"imu: none: {reason}"
    with pytest.raises(
        RecordingError, match=f"--imu /compass: {reason}; give another one, or none"
    ):
        _stream(bag, imu="/compass")


def test_zeros_are_measured_where_the_topic_is_asked_for(tmp_path: Path, tiny: Any) -> None:
    at_rest = [imu("/imu", _START + k, acceleration=(0.0, 0.0, 9.81)) for k in range(9)]
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *at_rest])
    assert open_recording(bag).info.imu is None
    assert np.all(_all(_stream(bag, imu="/imu")).gyro == 0.0)


def test_an_unknown_topic_is_refused_with_those_there_are(tmp_path: Path, tiny: Any) -> None:
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu", 9)])
    expected = r"has no IMU topic /gyro; it has /imu \(sensor_msgs/msg/Imu, 9\)"
    with pytest.raises(RecordingError, match=expected):
        _stream(bag, imu="/gyro")


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_its_place_is_that_of_tf(tmp_path: Path, tiny: Any, topic: str) -> None:
    half = make_transform(_T_CAMERA_IMU[:3, :3].T, np.array([1.0, 0.0, 0.0]))
    chain = [
        tf(topic, "base", "camera", half, _START),
        tf(topic, "base", "imu", half @ _T_CAMERA_IMU, _START),
    ]
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu"), *chain])
    T = _stream(bag).imu.T_camera_imu
    assert T is not None
    np.testing.assert_allclose(T, _T_CAMERA_IMU, atol=1e-12)
    assert "placed by tf camera -> imu, its delay is learnt" in _decision(bag)


def _kalibr(folder: Path, **cam0: Any) -> Path:
    """Write a chain of raw cameras that are turned, with the IMU 1 cm right of the left one."""
    T_c1_c0 = make_transform(
        np.asarray(Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix()), np.array([-0.5, 0.0, 0.0])
    )
    common = {
        "camera_model": "pinhole",
        "distortion_coeffs": [0.0] * 4,
        "distortion_model": "radtan",
        "intrinsics": [50.0, 50.0, 23.5, 15.5],
        "resolution": [48, 32],
        "rostopic": "/cam0/image_raw",
    }
    chain = {
        "cam0": common | {"T_cam_imu": _T_CAMERA_IMU.tolist()} | cam0,
        "cam1": common | {"T_cn_cnm1": T_c1_c0.tolist()},
    }
    path = folder / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump(chain))
    return path


def _imu_yaml(folder: Path, **changes: Any) -> Path:
    content = {
        "accelerometer_noise_density": 0.01,
        "accelerometer_random_walk": 0.002,
        "gyroscope_noise_density": 0.003,
        "gyroscope_random_walk": 0.0004,
        "rostopic": "/slow",
        "update_rate": 200.0,
    }
    path = folder / "imu.yaml"
    path.write_text(yaml.safe_dump(content | changes))
    return path


def test_what_kalibr_says_counts_before_tf(tmp_path: Path, tiny: Any) -> None:
    elsewhere = make_transform(np.eye(3), np.array([5.0, 6.0, 7.0]))
    messages = [*_camera(tiny), *_samples("/s/imu", 40), *_samples("/slow", 20)]
    bag = _write(tmp_path / "a.bag", [*messages, tf("/tf_static", "camera", "imu", elsewhere)])
    chain = _kalibr(tmp_path, timeshift_cam_imu=0.0125)
    files = (chain, _imu_yaml(tmp_path))
    source = open_recording(bag, options=RecordingOptions(calibration=files))
    stream, camera = source.info.imu, source.info.calibrations[0]
    assert stream is not None
    assert stream.imu.T_camera_imu is not None
    # a point of the IMU, by hand to the raw and to the rectified camera
    assert not np.allclose(camera.R, np.eye(3), atol=1e-3)
    point = np.array([0.3, 0.4, 0.5])
    raw = _T_CAMERA_IMU[:3, :3] @ point + _T_CAMERA_IMU[:3, 3]
    found = stream.imu.T_camera_imu @ np.append(point, 1.0)
    np.testing.assert_allclose(found[:3], camera.R @ raw, atol=1e-12)
    assert stream.imu.delay_s == -0.0125  # t_imu = t_cam + timeshift
    noise = (stream.imu.acceleration_noise, stream.imu.acceleration_walk)
    assert (*noise, stream.imu.gyro_noise, stream.imu.gyro_walk) == (0.01, 0.002, 0.003, 0.0004)
    expected = "/slow (20 messages), as the calibration says; --imu takes another of /s/imu; "
    line = _decision(bag, calibration=files)
    assert line == f"imu: {expected}placed by the calibration, its delay is -12.5 ms"


def test_a_file_of_the_imu_alone_leaves_the_cameras_as_they_are(tmp_path: Path, tiny: Any) -> None:
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu")])
    nested = tmp_path / "imu-out.yaml"
    nested.write_text(yaml.safe_dump({"imu0": yaml.safe_load(_imu_yaml(tmp_path).read_text())}))
    for path in (tmp_path / "imu.yaml", nested):
        source = open_recording(bag, options=RecordingOptions(calibration=path))
        assert "calibration: /s/left/camera_info + /s/right/camera_info" in str(
            source.info.decisions
        )
        assert source.info.imu is not None
        assert source.info.imu.imu.gyro_noise == 0.003
        assert source.info.imu.imu.T_camera_imu is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"gyroscope_noise_density": -1.0},
            "gyroscope_noise_density must be positive and at most 10, got -1",
        ),
        ({"gyroscope_random_walk": "x"}, "gyroscope_random_walk must hold numbers, got 'x'"),
        ({"timeshift_cam_imu": [1, 2]}, "timeshift_cam_imu must hold 1 numbers, got 2"),
        ({"T_BS": [1.0, 2.0]}, r"T_BS must hold 16 numbers, got 2"),
    ],
)
def test_a_damaged_file_of_the_imu_is_refused(
    tmp_path: Path, tiny: Any, changes: dict[str, Any], expected: str
) -> None:
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu")])
    with pytest.raises(CalibrationError, match=rf"imu\.yaml: {expected}"):
        _stream(bag, calibration=_imu_yaml(tmp_path, **changes))


def test_a_file_of_an_imu_that_is_not_there_is_said_not_to_count(tmp_path: Path, tiny: Any) -> None:
    bag = _write(tmp_path / "a.bag", _camera(tiny))
    line = _decision(bag, calibration=_imu_yaml(tmp_path))
    assert line == "imu: none, what is said of one by --calibration is not used"


def test_the_files_of_a_folder_place_the_imu_of_a_bag(tmp_path: Path, tiny: Any) -> None:
    turn = np.asarray(Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix())
    T_body_left = make_transform(turn, np.array([0.1, 0.2, 0.3]))
    T_left_right = make_transform(turn.T, np.array([0.5, 0.0, 0.0]))
    sensors = [tiny.euroc_camera(T) for T in (T_body_left, T_body_left @ T_left_right)]
    folder = tiny.write_euroc(tmp_path / "m", [_START], sensors)
    sensor = folder / "mav0" / "imu0" / "sensor.yaml"
    sensor.parent.mkdir()
    T_BS = T_body_left @ _T_CAMERA_IMU
    sensor.write_text(
        yaml.safe_dump({"T_BS": {"data": T_BS.ravel().tolist()}, "gyroscope_random_walk": 1e-6})
    )
    bag = _write(tmp_path / "a.bag", [*_camera(tiny), *_samples("/imu")])
    files = [folder / "mav0" / f"{name}/sensor.yaml" for name in ("cam0", "cam1", "imu0")]
    for calibration in (files, folder, folder / "mav0"):
        source = open_recording(bag, options=RecordingOptions(calibration=calibration))
        assert source.info.imu is not None
        T = source.info.imu.imu.T_camera_imu
        assert T is not None
        R = source.info.calibrations[0].R
        np.testing.assert_allclose(T[:3, :3], R @ _T_CAMERA_IMU[:3, :3], atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], R @ _T_CAMERA_IMU[:3, 3], atol=1e-12)
        assert source.info.imu.imu.gyro_walk == 1e-6


def test_a_message_that_is_none_is_skipped(tmp_path: Path, tiny: Any) -> None:
    messages = _samples("/imu", 6)
    topic, type_, log_time_ns, _ = messages[3]
    messages[3] = (topic, type_, log_time_ns, b"no message at all")
    stream = _stream(_write(tmp_path / "a.bag", [*_camera(tiny), *messages]))
    assert (_all(stream).stamps_ns - _START).tolist() == [0, 10**7, 2 * 10**7, 4 * 10**7, 5 * 10**7]


def test_samples_of_librealsense_are_placed_by_its_own_transforms(
    tmp_path: Path, tiny: Any
) -> None:
    left, gyro = "/device_0/sensor_0/Infrared_1", "/device_0/sensor_2/Gyro_0"
    T_cam_reference = make_transform(np.eye(3), np.array([0.01, 0.02, 0.03]))
    T_imu_reference = np.linalg.inv(_T_CAMERA_IMU) @ T_cam_reference
    messages = [
        (f"{place}/tf/0", "geometry_msgs/msg/Transform", _START, transform(T))
        for place, T in ((left, T_cam_reference), (gyro, T_imu_reference))
    ]
    for k in range(9):
        t = _START + k * 10_000_000
        accel = "/device_0/sensor_2/Accel_0/imu/data"
        messages.append(imu(f"{gyro}/imu/data", t, (1.0, 2.0, 3.0), frame_id=""))
        messages.append(imu(accel, t, acceleration=(0.0, 9.81, 0.0), frame_id=""))
    for n, P in ((1, _P_LEFT), (2, _P_RIGHT)):
        place = f"/device_0/sensor_0/Infrared_{n}"
        messages.append(camera_info(f"{place}/info/camera_info", "", _START, R=np.eye(3), P=P))
        messages.append(image(f"{place}/image/data", tiny.texture(n), "mono8", _START))
    names = {"left": f"{left}/image/data", "right": "/device_0/sensor_0/Infrared_2/image/data"}
    stream = _stream(_write(tmp_path / "a.bag", messages), **names)
    assert stream.name == f"{gyro}/imu/data"
    T = stream.imu.T_camera_imu
    assert T is not None
    np.testing.assert_allclose(T, _T_CAMERA_IMU, atol=1e-12)
    assert len(_all(stream)) == 9
