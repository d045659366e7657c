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
from gvo.geometry.camera import Calibration, rectification_maps, rectify_stereo
from gvo.io.calibration.files import CalibrationPaths, CameraSet, read_cameras
from gvo.io.calibration.forms import read_calibration_file
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


def _stereo(
    paths: CalibrationPaths, *, is_rectified: bool = False, size: tuple[int, int] | None = None
) -> CameraSet:
    image_size = None if size is None else lambda: size
    return read_cameras(paths, sensor="stereo", is_rectified=is_rectified, image_size=image_size)


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


def _openvins(folder: Path, model: str) -> Path:
    """Write a chain that tells where the cameras are in the IMU, and what names it."""
    chain = yaml.safe_load(_kalibr(folder / "kalibr_imucam_chain.yaml", model).read_text())
    del chain["cam1"]["T_cn_cnm1"]
    for camera in chain.values():
        camera["T_imu_cam"] = np.linalg.inv(camera.pop("T_cam_imu")).tolist()
    text = f"%YAML:1.0 # need to specify the file type at the top!\n{yaml.safe_dump(chain)}"
    _write(folder / "kalibr_imucam_chain.yaml", text)
    names = 'relative_config_imu: "imu.yaml"\nrelative_config_imucam: "kalibr_imucam_chain.yaml"\n'
    return _write(folder / "estimator_config.yaml", f"%YAML:1.0\n\nuse_fej: true\n{names}")


def _matrix(T: Any) -> str:
    """Return a matrix as systems write it for OpenCV: no blank, several lines."""
    T = np.atleast_2d(T)
    rows = ",\n           ".join(", ".join(map(repr, row)) for row in T.tolist())
    shape = f"   rows: {T.shape[0]}\n   cols: {T.shape[1]}\n   dt: d\n"
    return f"!!opencv-matrix\n{shape}   data:[{rows}]\n"


def _numbers(model: str, side: int, start: str = "") -> str:
    """Return fx to k4, a line each, that begins so."""
    K = _K[side]
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    names = ["k1", "k2", "p1", "p2"] if model == "plumb_bob" else ["k1", "k2", "k3", "k4"]
    values |= dict(zip(names, _D[model][side], strict=True))
    return "".join(f"{start}{name}: {float(value)!r}\n" for name, value in values.items())


def _orb_slam3(path: Path, model: str, *, is_old: bool = False) -> Path:
    """Write the settings of ORB-SLAM3: of version 1, or those before, which lack the size."""
    kind = "PinHole" if model == "plumb_bob" else "KannalaBrandt8"
    T_body_left, T_body_right = _poses()
    T = np.linalg.inv(T_body_left) @ T_body_right
    text = f'%YAML:1.0\n\nCamera.type: "{kind}"\nViewer.PointSize:2\nCamera.RGB: 1\n'
    text += _numbers(model, 0, "Camera." if is_old else "Camera1.")
    text += _numbers(model, 1, "Camera2.")
    if is_old:
        return _write(path, f"{text}Tlr: {_matrix(T[:3])}Camera.bf: 19.3\n")
    size = f"Camera.width: {_SIZE[0]}\nCamera.height: {_SIZE[1]}\nCamera.newWidth: 600\n"
    return _write(path, f"{text}{size}Stereo.ThDepth: 60.0\nStereo.T_c1_c2: {_matrix(T)}")


def _orb_slam2(path: Path, model: str, matrices: str = "DKRP") -> Path:
    """Write the settings of ORB-SLAM2 of a pair that it rectifies."""
    K = _rig(model)[0].P.astype(object)  # of Python's numbers, whose repr is plain
    text = f"%YAML:1.0\nCamera.fx: {K[0, 0]!r}\nCamera.fy: {K[0, 0]!r}\nCamera.width: {_SIZE[0]}\n"
    text += f"Camera.cx: {K[0, 2]!r}\nCamera.cy: {K[1, 2]!r}\n"
    text += f"Camera.bf: {float(-_rig(model)[1].P[0, 3])!r}\n"
    for side, camera in zip(("LEFT", "RIGHT"), _rig(model), strict=True):
        text += f"{side}.height: {_SIZE[1]}\n{side}.width: {_SIZE[0]}\n"
        text += "".join(f"{side}.{name}: {_matrix(getattr(camera, name))}" for name in matrices)
    return _write(path, text)


def _stella(path: Path, model: str, *, is_dotted: bool = False) -> Path:
    """Write the settings of stella_vslam, or of OpenVSLAM before it, with dots."""
    cameras = _rig(model)
    P = cameras[0].P
    camera: dict[str, Any] = {"name": "pair", "setup": "stereo", "model": "perspective"}
    camera |= {"fx": P[0, 0], "fy": P[1, 1], "cx": P[0, 2], "cy": P[1, 2], "k1": 0.0}
    camera |= {"cols": _SIZE[0], "rows": _SIZE[1]}
    camera["focal_x_baseline"] = -cameras[1].P[0, 3]
    rectifier: dict[str, Any] = {} if model == "plumb_bob" else {"model": "fisheye"}
    for side, each in zip(("left", "right"), cameras, strict=True):
        rectifier |= {f"{name}_{side}": getattr(each, name).ravel().tolist() for name in "KDR"}
    parts = {"Camera": camera, "StereoRectifier": rectifier}
    parts = {
        name: {k: v if isinstance(v, str | int | list) else float(v) for k, v in part.items()}
        for name, part in parts.items()
    }
    if is_dotted:
        return _write(path, {f"{n}.{k}": v for n, part in parts.items() for k, v in part.items()})
    return _write(path, parts)


def _vins(folder: Path, model: str) -> Path:
    """Write the configuration of VINS-Fusion and the cameras that it names."""
    text = "%YAML:1.0\n\nimu: 0\nnum_of_cam: 2\n"
    for n, T in enumerate(_poses()):
        camera = f"%YAML:1.0\n---\nimage_width: {_SIZE[0]}\nimage_height: {_SIZE[1]}\n"
        lines = _numbers(model, n, "   ").splitlines(keepends=True)
        if model == "equidistant":
            names = ("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5")
            lines = [
                f"   {name}:{line.partition(':')[2]}"
                for name, line in zip(names, lines, strict=True)
            ]
            camera += f"model_type: KANNALA_BRANDT\nprojection_parameters:\n{''.join(lines)}"
        else:
            camera += f"model_type: PINHOLE\ndistortion_parameters:\n{''.join(lines[4:])}"
            camera += f"projection_parameters:\n{''.join(lines[:4])}"
        _write(folder / f"cam{n}_pinhole.yaml", camera)
        text += f'cam{n}_calib: "cam{n}_pinhole.yaml"\nbody_T_cam{n}: {_matrix(T)}'
    return _write(folder / "stereo_config.yaml", text)


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
        "openvins": _openvins(tmp_path / "openvins", model),
        "its chain": tmp_path / "openvins" / "kalibr_imucam_chain.yaml",
        "vins": _vins(tmp_path / "vins", model),
        "orb-slam3": _orb_slam3(tmp_path / "orb3.yaml", model),
        "orb-slam3 before version 1": _orb_slam3(tmp_path / "old.yaml", model, is_old=True),
        "stella_vslam": _stella(tmp_path / "stella.yaml", model),
        "openvslam": _stella(tmp_path / "openvslam.yaml", model, is_dotted=True),
    }
    if model == "plumb_bob":
        sets["opencv"] = _opencv(tmp_path / "opencv.yaml", model)
        sets["orb-slam2"] = _orb_slam2(tmp_path / "orb2.yaml", model)
        sets["orb-slam2 without P"] = _orb_slam2(tmp_path / "bf.yaml", model, "DKR")
    for name, paths in sets.items():
        found = _stereo(paths, size=_SIZE)
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


_ONE = "fx: 50.0\nfy: 51.0\ncx: 23.5\ncy: 15.5\n"
_P = "50 0 23.5 {} 0 51 15.5 0 0 0 1 0"


def _dotted(start: str, text: str = _ONE) -> str:
    return "".join(f"{start}{line}" for line in text.splitlines(keepends=True))


@pytest.mark.parametrize(
    "text",
    [
        f'%YAML:1.0\nCamera.type: "Rectified"\n{_dotted("Camera1.")}Stereo.b: 0.4\n',
        f"%YAML:1.0\n{_dotted('Camera.')}Camera.k1: 0.0\nCamera.bf: 20.0\nCamera.width: 48\n",
        f"Camera:\n  model: perspective\n{_dotted('  ')}  cols: 48\n  focal_x_baseline: 20\n",
        f"P0: {_P.format(0)}\nP1: {_P.format(-20)}\nP2: {_P.format(1)}\nTr: 1 0 0\n",
        f"calib_time: 09-Jan-2012 13:57\nP_rect_00: {_P.format(0)}\nP_rect_01: {_P.format(-20)}\n",
    ],
)
def test_a_rectified_camera_and_its_baseline_are_a_pair(tmp_path: Path, text: str) -> None:
    path = _write(tmp_path / "camera.txt", text)
    for is_rectified in (False, True):
        left, right = _stereo(path, is_rectified=is_rectified, size=(48, 32)).pair
        assert (left.width, left.height, left.K[1, 1]) == (48, 32, 51.0)
        np.testing.assert_array_equal(left.P, [[50, 0, 23.5, 0], [0, 51, 15.5, 0], [0, 0, 1, 0]])
        assert right.P[0, 3] == pytest.approx(-20.0)
        assert (rectification_maps(left), rectification_maps(right)) == (None, None)


@pytest.mark.parametrize(
    ("text", "scale"),
    [
        (f"%YAML:1.0\n{_dotted('Camera1.')}Stereo.b: 0.07\nRGBD.DepthMapFactor: 5000.0", 5000.0),
        (f"%YAML:1.0\n{_dotted('Camera.')}Camera.bf: 40.0\nDepthMapFactor: 1.0", None),
        (
            f"Camera:\n  setup: RGBD\n{_dotted('  ')}Preprocessing:\n  depthmap_factor: 1000.0",
            1000.0,
        ),
        (f"{_dotted('Camera.')}Camera.setup: RGBD\ndepthmap_factor: 5000.0", 5000.0),
    ],
)
def test_an_rgbd_camera_has_the_factor_of_its_depth(
    tmp_path: Path, text: str, scale: float | None
) -> None:
    path = _write(tmp_path / "c.yaml", text)
    found = read_cameras(path, sensor="rgbd", is_rectified=False, image_size=lambda: (48, 32))
    assert found.depth_scale == scale
    assert (found.calibrations[0].width, found.calibrations[0].K[0, 2]) == (48, 23.5)
    with pytest.raises(CalibrationError, match=r"c\.yaml.* lacks width and height"):
        _rgbd(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"Camera:\n  model: equirectangular\n{_dotted('  ')}", "stella_vslam.*'equirectangular'"),
        ("model_type: MEI\nprojection_parameters:\n  gamma1: 9.0\n", "model 'MEI' is not supp"),
        ("Camera.type: PinHole\nCamera.fx: 9.0\n", "ORB-SLAM: lacks .* fy, cx, cy"),
        (f"{_dotted('Camera1.')}", "holds one camera.*Stereo.b, Camera.bf"),
        ("cam0_calib: none.yaml", r"none\.yaml: does not exist; c\.yaml names it"),
        ("cam0_calib: c.yaml", "not a calibration that gvo knows"),
        ("relative_config_imucam: [c.yaml]", "does not exist"),
        ('relative_config_imucam: "\\0"', "does not exist"),
        ("value0: {T_imu_cam: []}", "not a calibration .* ORB-SLAM, stella_vslam, VINS, OpenVINS"),
        (f"{_dotted('Camera.')}Camera.bf: x\n", "bf must hold numbers"),
        ("Camera: {K: x, bf: 1}\n", "K must hold numbers, got 'x'"),
        ("Camera: {K: [1, 2], fx: 1}\nStereo: {b: 1}\n", "K must hold 9 numbers, got 2"),
        ("Camera: 1\n", "ORB-SLAM: lacks"),
        ("Camera: 1\nCamera.fx: 1\n", "ORB-SLAM: lacks"),
        ("P0: 1 2\nP1: 1 2\n", "P0: P must hold 12 numbers, got 2"),
        (
            f"{_dotted('Camera.')}Camera.bf: 9.0\n{_dotted('LEFT.')}{_dotted('RIGHT.')}",
            "LEFT lacks R, its rotation",
        ),
    ],
)
def test_what_is_not_supported_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = _write(tmp_path / "c.yaml", text)
    with pytest.raises(CalibrationError, match=message) as caught:
        _stereo(path, size=(48, 32))
    assert "\n" not in str(caught.value)


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
        ({"camera_model": "omni"}, "model 'omni' is not supported, expected plumb_bob .pinhole"),
        ({"intrinsics": [1.0, 2.0]}, "intrinsics must hold 4 numbers, got 2"),
        ({"intrinsics": None, "camera_model": "pinhole"}, "lacks camera_matrix, intrinsics or fx,"),
        ({"resolution": None}, "lacks width and height of the images"),
        ({"resolution": [1280, 480]}, "752x480 and 1280x480"),
        ({"T_cn_cnm1": [[1.0] * 4] * 4}, "T_cn_cnm1 must have .0, 0, 0, 1. as its last row"),
        ({"T_cn_cnm1": [[1.0], 0.0]}, "T_cn_cnm1 must hold numbers"),
        ({"T_cn_cnm1": [[1.0, 0.0]]}, "T_cn_cnm1 must hold 16 numbers, got 2"),
        ({"T_cn_cnm1": np.eye(4).tolist()}, "side by side"),
        ({"T_cn_cnm1": None, "T_cam_imu": None}, "the baseline must be positive, got none"),
        ({"T_cam_imu": "none"}, "T_cam_imu must hold numbers"),
        ({"distortion_model": "fov"}, "model 'fov' is not supported"),
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
