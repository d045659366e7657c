"""Calibration files of ROS, Kalibr, EuRoC and OpenCV."""

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration, rectify_stereo
from gvo.io.calibration.files import (
    CalibrationPaths,
    CameraSet,
    read_calibration_file,
    read_cameras,
)
from gvo.types import FloatArray

_SIZE = (752, 480)
_K = (
    np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]]),
    np.array([[457.587, 0, 379.999], [0, 456.134, 255.238], [0, 0, 1]]),
)
_D = {
    "plumb_bob": ([-0.283, 0.0740, 1.9e-4, 1.8e-5], [-0.284, 0.0745, -1e-4, -3.6e-5]),
    "equidistant": ([0.0034, 0.0007, -0.0020, 0.0002], [0.0034, 0.0018, -0.0027, 0.0003]),
}
_KALIBR_NAMES = {"plumb_bob": "radtan", "equidistant": "equidistant"}
_EUROC_NAMES = {"plumb_bob": "radial-tangential", "equidistant": "equidistant"}


def _write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def _stereo(paths: CalibrationPaths, *, is_rectified: bool = False) -> CameraSet:
    return read_cameras(paths, sensor="stereo", is_rectified=is_rectified)


def _rgbd(paths: CalibrationPaths) -> CameraSet:
    return read_cameras(paths, sensor="rgbd", is_rectified=False)


def _poses() -> tuple[FloatArray, FloatArray]:
    """Return T_body_cam of the left and the right raw camera."""
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.2, 1.5]).as_matrix()
    T_body_left[:3, 3] = -0.02, -0.06, 0.01
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.015]).as_matrix()
    T_left_right[:3, 3] = 0.11, 0.0003, -0.0002
    return T_body_left, T_body_left @ T_left_right


@cache
def _rig(model: str) -> tuple[Calibration, Calibration]:
    """Return the rectified pair that every file of the rig must give."""
    T_body_left, T_body_right = _poses()
    raw = [
        Calibration(
            width=_SIZE[0],
            height=_SIZE[1],
            K=K,
            D=np.array([*D, 0.0] if model == "plumb_bob" else D),
            R=np.eye(3),
            P=np.zeros((3, 4)),
            is_rectified=False,
            model="plumb_bob" if model == "plumb_bob" else "equidistant",
        )
        for K, D in zip(_K, _D[model], strict=True)
    ]
    return rectify_stereo(raw[0], raw[1], np.linalg.inv(T_body_left) @ T_body_right)


def _euroc(folder: Path, model: str) -> list[Path]:
    files = []
    for n, (K, D, T) in enumerate(zip(_K, _D[model], _poses(), strict=True)):
        content = {
            "T_BS": {"cols": 4, "rows": 4, "data": T.ravel().tolist()},
            "resolution": list(_SIZE),
            "camera_model": "pinhole",
            "intrinsics": [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
            "distortion_model": _EUROC_NAMES[model],
            "distortion_coefficients": D,
        }
        files.append(_write(folder / "mav0" / f"cam{n}" / "sensor.yaml", content))
    return files


def _kalibr(path: Path, model: str, **changes: Any) -> Path:
    T_body_left, T_body_right = _poses()
    chain: dict[str, Any] = {}
    for n, (K, D, T) in enumerate(zip(_K, _D[model], _poses(), strict=True)):
        chain[f"cam{n}"] = {
            "camera_model": "pinhole",
            "cam_overlaps": [1 - n],
            "distortion_coeffs": D,
            "distortion_model": _KALIBR_NAMES[model],
            "intrinsics": [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
            "resolution": list(_SIZE),
            "rostopic": f"/cam{n}/image_raw",
            "T_cam_imu": np.linalg.inv(T).tolist(),
        }
    chain["cam1"]["T_cn_cnm1"] = (np.linalg.inv(T_body_right) @ T_body_left).tolist()
    chain["cam1"] = {k: v for k, v in (chain["cam1"] | changes).items() if v is not None}
    return _write(path, chain)


def _ros(model: str, side: int) -> dict[str, Any]:
    camera = _rig(model)[side]
    matrices = {
        "camera_matrix": camera.K,
        "distortion_coefficients": camera.D,
        "rectification_matrix": camera.R,
        "projection_matrix": camera.P,
    }
    return {
        "image_width": _SIZE[0],
        "image_height": _SIZE[1],
        "distortion_model": model,
        **{key: {"data": matrix.ravel().tolist()} for key, matrix in matrices.items()},
    }


def _opencv(path: Path, model: str) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for side, camera in zip(("LEFT", "RIGHT"), _rig(model), strict=True):
        storage.write(f"{side}_width", camera.width)
        storage.write(f"{side}_height", camera.height)
        for name in "KDRP":
            storage.write(f"{side}_{name}", np.atleast_2d(getattr(camera, name)))
    storage.release()
    text = path.read_text()  # dots in keys, as ORB-SLAM has them, are read but not written
    for side in ("LEFT", "RIGHT"):
        text = text.replace(f"{side}_", f"{side}.")
    return _write(path, text)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_the_files_of_one_rig_give_one_calibration(tmp_path: Path, model: str) -> None:
    euroc = _euroc(tmp_path / "euroc", model)
    sides = [_write(tmp_path / f"{n}.yaml", _ros(model, n)) for n in range(2)]
    both = {"left": _ros(model, 0), "right": _ros(model, 1)}
    sets: dict[str, CalibrationPaths] = {
        "sensor files": euroc,
        "euroc folder": tmp_path / "euroc",
        "mav0": tmp_path / "euroc" / "mav0",
        "kalibr": _kalibr(tmp_path / "camchain.yaml", model),
        "kalibr with an imu": _kalibr(tmp_path / "imucam.yaml", model, T_cn_cnm1=None),
        "two of ros": sides,
        "left and right": _write(tmp_path / "pair.yaml", both),
    }
    if model == "plumb_bob":
        sets["opencv"] = _opencv(tmp_path / "opencv.yaml", model)
    for name, paths in sets.items():
        found = _stereo(paths)
        for calibration, expected in zip(found.calibrations, _rig(model), strict=True):
            assert (calibration.width, calibration.height) == _SIZE
            assert calibration.model == model
            for matrix in "KDRP":
                np.testing.assert_allclose(
                    getattr(calibration, matrix),
                    getattr(expected, matrix),
                    rtol=1e-9,
                    atol=1e-9,
                    err_msg=f"{matrix} of {name}",
                )


def test_the_pose_on_the_body_is_that_of_the_rectified_camera(tmp_path: Path) -> None:
    T_body_left, _ = _poses()
    R = _rig("plumb_bob")[0].R
    point_cam = np.array([0.3, -0.2, 2.0])
    expected = T_body_left[:3, :3] @ (R.T @ point_cam) + T_body_left[:3, 3]
    for paths in (_euroc(tmp_path, "plumb_bob"), [_kalibr(tmp_path / "k.yaml", "plumb_bob")]):
        T_body_cam = _stereo(paths).T_body_cam
        assert T_body_cam is not None
        np.testing.assert_allclose((T_body_cam @ [*point_cam, 1.0])[:3], expected, atol=1e-12)
    one = _rgbd(_euroc(tmp_path, "plumb_bob")[0])
    assert one.T_body_cam is not None
    np.testing.assert_allclose(one.T_body_cam, T_body_left, atol=1e-12)
    assert one.calibrations[0].P[0, 0] == _K[0][0, 0]
    assert _rgbd(_write(tmp_path / "c.yaml", _ros("plumb_bob", 0) | _UNTURNED)).T_body_cam is None


_UNTURNED = {"rectification_matrix": {"data": np.eye(3).ravel().tolist()}}


def test_a_pair_without_distortion_side_by_side_is_rectified_already(tmp_path: Path) -> None:
    T = np.eye(4)
    T[0, 3] = -0.12
    ideal: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": [50.0, 51.0, 23.5, 15.5],
        "resolution": [48, 32],
        "distortion_model": "none",
        "distortion_coeffs": [],
    }
    path = tmp_path / "k.yaml"
    _write(path, {"cam0": ideal, "cam1": ideal | {"T_cn_cnm1": T.tolist()}})
    left, right = _stereo(path, is_rectified=True).pair
    assert left.is_rectified
    np.testing.assert_array_equal(left.P, [[50, 0, 23.5, 0], [0, 51, 15.5, 0], [0, 0, 1, 0]])
    assert right.P[0, 3] == pytest.approx(-50 * 0.12)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.001, 0.0]).as_matrix()
    _write(path, {"cam0": ideal, "cam1": ideal | {"T_cn_cnm1": T.tolist()}})
    assert not _stereo(path, is_rectified=True).pair[0].is_rectified


def test_of_a_chain_of_four_cameras_the_first_two_are_the_pair(tmp_path: Path) -> None:
    path = _kalibr(tmp_path / "k.yaml", "plumb_bob")
    chain = yaml.safe_load(path.read_text())
    longer = {"cam10": chain["cam0"], "cam2": chain["cam1"]} | chain
    expected = _stereo(path).pair
    found = _stereo(_write(path, longer)).pair
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.P, other.P)


@pytest.mark.parametrize("header", ["%YAML:1.0", "%YAML 1.2"])
@pytest.mark.parametrize(
    ("flag", "n", "model"),
    [(None, 5, "plumb_bob"), (None, 8, "rational_polynomial"), (1, 4, "equidistant")],
)
def test_what_opencv_calibrates_is_read(
    tmp_path: Path, header: str, flag: int | None, n: int, model: str
) -> None:
    path = tmp_path / "camera.yml"
    D = np.linspace(0.01, 0.02, n)[:, None]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 48)
    storage.write("image_height", 32)
    if flag is not None:
        storage.write("fisheye_model", flag)
    storage.write("camera_matrix", np.array([[50.0, 0, 23.5], [0, 51, 15.5], [0, 0, 1]]))
    storage.write("distortion_coefficients", D)
    storage.release()
    body = path.read_text().partition("\n")[2]
    path.write_text(f"{header}\n{body}")
    (calibration,) = _rgbd(path).calibrations
    assert (calibration.model, calibration.width, calibration.height) == (model, 48, 32)
    np.testing.assert_allclose(calibration.D, D.ravel())
    assert calibration.K[1, 1] == 51.0


def test_a_message_as_printed_is_a_file_with_its_binning_and_region(tmp_path: Path) -> None:
    text = """header:
  frame_id: camera
height: 64
width: 96
distortion_model: plumb_bob
d: [0.0, 0.0, 0.0, 0.0, 0.0]
k: [100.0, 0.0, 47.0, 0.0, 100.0, 31.0, 0.0, 0.0, 1.0]
binning_x: 2
binning_y: 2
roi: {x_offset: 10, y_offset: 0, height: 64, width: 80, do_rectify: true}
---
"""
    (calibration,) = _rgbd(_write(tmp_path / "c.yaml", text)).calibrations
    assert (calibration.width, calibration.height) == (40, 32)
    assert (calibration.K[0, 0], calibration.K[0, 2]) == (50.0, 18.5)


def test_a_stereo_pair_is_two_cameras(tmp_path: Path, tiny: Any) -> None:
    path = _write(tmp_path / "pair.yaml", tiny.ros_pair(0.4))
    found = _stereo(path, is_rectified=True)
    assert (found.pair[0].P[0, 3], found.pair[1].P[0, 3]) == (0.0, -20.0)
    assert found.baseline_from == "P"
    with pytest.raises(CalibrationError, match=r"expected one camera.* got 2"):
        _rgbd(path)
    mono = _write(tmp_path / "mono.yaml", tiny.ros_camera())
    with pytest.raises(CalibrationError, match="left and right"):
        _stereo(mono, is_rectified=True)
    with pytest.raises(CalibrationError, match=r"mono\.yaml: the baseline must be positive, got n"):
        _stereo([mono, mono])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"camera_model": "omni"}, "camera model 'omni' is not supported, expected pinhole"),
        ({"intrinsics": [1.0, 2.0]}, "intrinsics must hold 4 numbers, got 2"),
        ({"intrinsics": None, "camera_model": "pinhole"}, "lacks image_width"),
        ({"resolution": None}, "resolution must hold 2 numbers, it is missing"),
        ({"resolution": [1280, 480]}, "752x480 and 1280x480"),
        ({"T_cn_cnm1": [[1.0] * 4] * 4}, "T_cn_cnm1 must have .0, 0, 0, 1. as its last row"),
        ({"T_cn_cnm1": [[1.0, 0.0]]}, "T_cn_cnm1 must hold 16 numbers, got 2"),
        ({"T_cn_cnm1": np.eye(4).tolist()}, "side by side"),
        ({"T_cn_cnm1": None, "T_cam_imu": None}, "the baseline must be positive, got none"),
        ({"T_cam_imu": "none"}, "T_cam_imu must hold numbers"),
        ({"distortion_model": "fov"}, "distortion model 'fov' is not supported"),
        ({"distortion_coeffs": [0.1]}, "D of radtan must hold 4 or 5 numbers, got 1"),
        ({"distortion_coeffs": {"k1": 0.1}}, "D must hold numbers"),
    ],
)
def test_a_malformed_chain_is_refused(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    path = _kalibr(tmp_path / "k.yaml", "plumb_bob", **changes)
    with pytest.raises(CalibrationError, match=rf"k\.yaml.*{text}") as caught:
        _stereo(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        *("a: [", "", "- 1", "\x00", "a: " + "[" * 1000, "a: !!int ''"),
        "%YAML:1.0\n---\na: !!opencv-matrix 3",
    ],
)
def test_a_file_that_holds_no_keys_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"c\.yaml"):
        read_calibration_file(path)
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_calibration_file(tmp_path / "none.yaml")


def test_a_folder_that_does_not_tell_which_file_is_refused(tmp_path: Path, tiny: Any) -> None:
    with pytest.raises(CalibrationError, match=r"expected cam0/sensor.yaml .* got 0 of these"):
        _rgbd(tmp_path)
    _write(tmp_path / "a.yaml", tiny.ros_camera())
    assert _rgbd(tmp_path).origin.endswith("a.yaml")
    _write(tmp_path / "b.yml", tiny.ros_camera())
    with pytest.raises(CalibrationError, match="got 2 of these"):
        _rgbd(tmp_path)
    _write(tmp_path / "left.yaml", _ros("plumb_bob", 0))
    _write(tmp_path / "right.yaml", _ros("plumb_bob", 1))
    assert _stereo(tmp_path).baseline_from == "P"
