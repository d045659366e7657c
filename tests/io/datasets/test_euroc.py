"""EuRoC folders."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError, RecordingError
from gvo.geometry.imu import Imu
from gvo.io.datasets.euroc import EurocSource
from gvo.io.opening import RecordingOptions, open_recording

_STAMPS = (1403636584763555584, 1403636584813555456)


def _poses() -> tuple[Any, Any]:
    """Return T_body_left and T_body_right: turned, the right one 0.5 m along the left x axis."""
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix()
    T_body_left[:3, 3] = 0.1, 0.2, -0.3
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.015]).as_matrix()
    T_left_right[0, 3] = 0.5
    return T_body_left, T_body_left @ T_left_right


def _write(folder: Path, tiny: Any, **changes: Any) -> Path:
    sensors = [tiny.euroc_camera(T_body_cam, **changes) for T_body_cam in _poses()]
    return Path(tiny.write_euroc(folder, _STAMPS, sensors))


def test_the_folder_and_its_mav0_are_the_same_recording(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "MH_01", tiny)
    for source in (EurocSource(folder), EurocSource(folder / "mav0")):
        assert source.info.name == "MH_01"
        images = list(source.images())
        assert [image.stamp_ns for image in images] == [s for s in _STAMPS for _ in range(2)]
        np.testing.assert_array_equal(images[3].load(), tiny.texture(11))


def test_the_truth_is_that_of_the_rectified_left_camera(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    assert EurocSource(folder).ground_truth() is None
    states = folder / "mav0" / "state_groundtruth_estimate0"
    states.mkdir()
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y []"
    row = f"{_STAMPS[0]},1,2,3,0.8,0,0.6,0"
    (states / "data.csv").write_text(f"{header}, q_RS_z []\n{row}\n")
    source = EurocSource(folder)
    truth = source.ground_truth()
    assert truth is not None
    # a point of the rectified camera, by hand through raw camera and body to the world
    point_rectified = np.array([0.3, -0.2, 2.0])
    point_raw = source.info.calibrations[0].R.T @ point_rectified
    T_body_left, _ = _poses()
    point_body = T_body_left[:3, :3] @ point_raw + T_body_left[:3, 3]
    expected = Rotation.from_quat([0, 0.6, 0, 0.8]).apply(point_body) + np.array([1, 2, 3])
    found = truth.T_world_frame[0] @ np.append(point_rectified, 1.0)
    np.testing.assert_allclose(found[:3], expected, atol=1e-12)
    assert truth.stamps_ns.tolist() == [_STAMPS[0]]


def test_a_missing_table_is_refused_and_a_missing_image_is_not(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    (folder / "mav0/cam1/data" / f"{_STAMPS[1]}.png").unlink()
    image = list(EurocSource(folder).images())[3]
    with pytest.raises(RecordingError, match="missing"):
        image.load()
    (folder / "mav0/cam1/data.csv").unlink()
    with pytest.raises(RecordingError, match=r"data\.csv: cannot be read: No such file"):
        EurocSource(folder)


def test_the_pose_on_the_body_is_that_of_the_rectified_camera(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    T_body_left, _ = _poses()
    sensors = [folder / "mav0" / f"cam{n}" / "sensor.yaml" for n in range(2)]
    (tmp_path / "pair.yaml").write_text(yaml.safe_dump(tiny.ros_pair()))
    for calibration in (None, sensors, folder, folder / "mav0", tmp_path / "pair.yaml"):
        info = EurocSource(folder, calibration=calibration).info
        assert info.T_body_cam is not None
        R = info.calibrations[0].R
        np.testing.assert_allclose(info.T_body_cam[:3, :3], T_body_left[:3, :3] @ R.T, atol=1e-12)
        np.testing.assert_allclose(info.T_body_cam[:3, 3], T_body_left[:3, 3], atol=1e-12)


_ROWS = [f"{_STAMPS[0] + k * 5_000_000},{k},-0.25,{k}e-3,9.81,{2 * k},0.1" for k in range(1200)]


def _with_imu(folder: Path, tiny: Any, rows: list[str] = _ROWS, **changes: Any) -> Path:
    """Write a folder with an IMU that sits turned on the body; keys of value None are left out."""
    T_body_imu = np.eye(4)
    T_body_imu[:3, :3] = Rotation.from_euler("xyz", [-0.4, 0.5, 0.6]).as_matrix()
    T_body_imu[:3, 3] = 0.02, 0.03, 0.04
    content = {
        "T_BS": {"cols": 4, "rows": 4, "data": T_body_imu.ravel().tolist()},
        "rate_hz": 200,
        "gyroscope_noise_density": 1e-4,
        "gyroscope_random_walk": 2e-5,
        "accelerometer_noise_density": 3e-3,
        "accelerometer_random_walk": 4e-3,
    }
    sensor = _write(folder, tiny) / "mav0" / "imu0" / "sensor.yaml"
    sensor.parent.mkdir()
    content = {key: value for key, value in (content | changes).items() if value is not None}
    sensor.write_text(yaml.safe_dump(content))
    text = "#timestamp [ns],w_RS_S_x [rad s^-1],...\r\n" + "".join(f"{row}\r\n" for row in rows)
    sensor.with_name("data.csv").write_text(text)
    return folder


def test_the_imu_of_a_folder_is_placed_in_the_rectified_camera(tmp_path: Path, tiny: Any) -> None:
    source = open_recording(_with_imu(tmp_path / "m", tiny))
    stream = source.info.imu
    assert stream is not None
    assert stream.imu.T_camera_imu is not None
    # a point of the IMU, by hand to the body, the raw and the rectified camera
    point = np.array([0.3, 0.4, 0.5])
    R = Rotation.from_euler("xyz", [-0.4, 0.5, 0.6])
    T_body_left, _ = _poses()
    body = R.apply(point) + np.array([0.02, 0.03, 0.04])
    raw = T_body_left[:3, :3].T @ (body - T_body_left[:3, 3])
    found = stream.imu.T_camera_imu @ np.append(point, 1.0)
    np.testing.assert_allclose(found[:3], source.info.calibrations[0].R @ raw, atol=1e-12)
    assert stream.imu.delay_s == 0.0
    assert (stream.imu.gyro_noise, stream.imu.gyro_walk) == (1e-4, 2e-5)
    assert (stream.imu.acceleration_noise, stream.imu.acceleration_walk) == (3e-3, 4e-3)
    line = "imu: imu0; placed by the calibration, its delay is 0 ms"
    assert line in source.info.decisions


@pytest.mark.parametrize("start", [0, 1000])
def test_samples_are_those_of_the_table_from_a_stamp_on(
    tmp_path: Path, tiny: Any, start: int
) -> None:
    stream = open_recording(_with_imu(tmp_path / "m", tiny)).info.imu
    assert stream is not None
    parts = list(stream.samples(_STAMPS[0] + start * 5_000_000))
    assert max(map(len, parts)) <= 500
    k = np.arange(start, 1200)
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    np.testing.assert_array_equal(stamps_ns, _STAMPS[0] + k * 5_000_000)
    gyro = np.concatenate([part.gyro for part in parts])
    np.testing.assert_array_equal(gyro, np.stack([k, 0 * k - 0.25, k / 1e3], axis=1))
    acceleration = np.concatenate([part.acceleration for part in parts])
    np.testing.assert_array_equal(acceleration, np.stack([0 * k + 9.81, 2 * k, 0 * k + 0.1], 1))


def test_a_folder_without_an_imu_has_none_nor_has_one_without_asking(
    tmp_path: Path, tiny: Any
) -> None:
    assert open_recording(_write(tmp_path / "a", tiny)).info.imu is None
    folder = _with_imu(tmp_path / "c", tiny)
    (folder / "mav0/imu0/data.csv").unlink()
    assert open_recording(folder).info.imu is None
    folder = _with_imu(tmp_path / "b", tiny)
    info = open_recording(folder, options=RecordingOptions(imu="none")).info
    assert info.imu is None
    assert not any("imu" in line for line in info.decisions)
    with pytest.raises(RecordingError, match="--imu chooses a topic of a bag"):
        open_recording(folder, options=RecordingOptions(imu="/imu"))


def test_what_the_folder_does_not_say_is_learnt_or_usual(tmp_path: Path, tiny: Any) -> None:
    folder = _with_imu(tmp_path / "m", tiny, T_BS=None, gyroscope_noise_density=None)
    stream = open_recording(folder).info.imu
    assert stream is not None
    assert stream.imu.T_camera_imu is None
    assert stream.imu.gyro_noise == Imu().gyro_noise
    (folder / "mav0/imu0/sensor.yaml").unlink()
    stream = open_recording(folder).info.imu
    assert stream is not None
    assert stream.imu.T_camera_imu is None
    assert stream.imu.delay_s == 0.0


def test_files_count_before_those_of_the_folder(tmp_path: Path, tiny: Any) -> None:
    folder = _with_imu(tmp_path / "m", tiny)
    own = open_recording(folder).info.imu
    path = tmp_path / "imu.yaml"
    path.write_text(yaml.safe_dump({"gyroscope_noise_density": 0.5, "timeshift_cam_imu": -0.25}))
    stream = open_recording(folder, options=RecordingOptions(calibration=path)).info.imu
    assert own is not None
    assert stream is not None
    assert (stream.imu.gyro_noise, stream.imu.delay_s) == (0.5, 0.25)
    assert stream.imu.acceleration_noise == 3e-3
    np.testing.assert_array_equal(stream.imu.T_camera_imu, own.imu.T_camera_imu)
    # the folder itself, given as a calibration, says the same
    again = open_recording(folder, options=RecordingOptions(calibration=folder)).info.imu
    assert again is not None
    assert again.imu.T_camera_imu is not None
    assert own.imu.T_camera_imu is not None
    np.testing.assert_allclose(again.imu.T_camera_imu, own.imu.T_camera_imu, atol=1e-12)


_ROW = (
    r"expected a stamp in nanoseconds, three numbers of the gyro in rad/s and three of the "
    r"acceleration in m/s\^2, got "
)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([], r"data\.csv: holds no rows"),
        (["1,2,3,4,5,6"], rf"data\.csv, line 2: {_ROW}1,2,3,4,5,6; mend it, or give --imu none"),
        ([*_ROWS[:3], "7,0,0,0,x,0,0"], rf"line 5: {_ROW}7,0,0,0,x,0,0"),
        (["1.5,0,0,0,0,0,0"], rf"line 2: {_ROW}1\.5,0,0,0,0,0,0"),
        (["99999999999999999999,0,0,0,0,0,0"], rf"line 2: {_ROW}9+,0,0,0,0,0,0"),
    ],
)
def test_a_table_of_another_form_is_refused(
    tmp_path: Path, tiny: Any, rows: list[str], expected: str
) -> None:
    with pytest.raises(RecordingError, match=expected):
        open_recording(_with_imu(tmp_path / "m", tiny, rows))


def test_a_damaged_sensor_is_refused(tmp_path: Path, tiny: Any) -> None:
    folder = _with_imu(tmp_path / "m", tiny, accelerometer_random_walk=0.0)
    expected = "accelerometer_random_walk must be positive and at most 10, got 0"
    with pytest.raises(CalibrationError, match=expected):
        open_recording(folder)


def test_damage_far_behind_is_told_with_its_line(tmp_path: Path, tiny: Any) -> None:
    stream = open_recording(_with_imu(tmp_path / "m", tiny, [*_ROWS[:1100], "oh"])).info.imu
    assert stream is not None
    samples = stream.samples(0)
    assert sum(len(next(samples)) for _ in range(2)) == 1000
    with pytest.raises(RecordingError, match=r"data\.csv, line 1102: .* got oh; mend it"):
        next(samples)


def test_a_chain_of_kalibr_places_the_imu_of_a_folder(tmp_path: Path, tiny: Any) -> None:
    folder = _with_imu(tmp_path / "m", tiny)
    T_body_left, T_body_right = _poses()
    common = {
        "camera_model": "pinhole",
        "intrinsics": [50.0, 50.0, 23.5, 15.5],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.0] * 4,
        "resolution": list(tiny.size),
        "timeshift_cam_imu": 0.0,
    }
    chain = {
        f"cam{n}": common | {"T_cam_imu": np.linalg.inv(T).tolist()}
        for n, T in enumerate((T_body_left, T_body_right))
    }
    (tmp_path / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump({"gyroscope_random_walk": 7e-6}))
    files = (tmp_path / "imu.yaml", tmp_path / "camchain-imucam.yaml")
    source = open_recording(folder, options=RecordingOptions(calibration=files))
    assert source.info.imu is not None
    T_rectified_left = np.eye(4)
    T_rectified_left[:3, :3] = source.info.calibrations[0].R
    expected = T_rectified_left @ np.linalg.inv(T_body_left)
    assert source.info.imu.imu.T_camera_imu is not None
    np.testing.assert_allclose(source.info.imu.imu.T_camera_imu, expected, atol=1e-12)
    assert (source.info.imu.imu.gyro_walk, source.info.imu.imu.acceleration_walk) == (7e-6, 4e-3)
    assert "its delay is 0 ms" in source.info.decisions[-1]
