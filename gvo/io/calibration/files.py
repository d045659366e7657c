"""Calibration files of ROS, Kalibr, EuRoC, OpenCV."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml

from gvo._text import MAX_CHARACTERS, YamlError, access_fault, load_yaml, read_text, shortened
from gvo.errors import CalibrationError, named_faults
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.io.calibration.camera_info import (
    ROTATION_TOLERANCE,
    CameraFields,
    RegionOfInterest,
    make_calibration,
    make_rgbd_calibration,
    pair_of_extrinsics,
    read_array,
    read_numbers,
    stereo_baseline,
)
from gvo.io.recording import Sensor
from gvo.types import FloatArray

_OPENCV_HEADER = "%YAML:"
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"
_FORMATS = (
    "expected a camera of ROS (camera_info), Kalibr (camchain), EuRoC (sensor.yaml) or OpenCV"
)
_ROS_KEYS = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
}
_KALIBR_CAMERA = re.compile(r"cam([0-9]{1,3})")
_MAX_COUNT = 2**31 - 1
_SIDES = (("left", "right"), ("LEFT", "RIGHT"))
CalibrationPaths: TypeAlias = Sequence[Path] | Path | None
"""One file, two of them (left and right), or a folder of them; None where none was given."""
_SENSOR_FILES = tuple(Path(name) / "sensor.yaml" for name in ("cam0", "cam1"))
_SIDE_FILES = (Path("left.yaml"), Path("right.yaml"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSet:
    """The cameras of one recording, as calibration files have them.

    Parameters
    ----------
    calibrations : tuple of Calibration
        Left and right, or the colour camera.
    origin : str
        The names of the files.
    baseline_from : str
        The key that holds the baseline; empty for one camera.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the rectified left or colour camera to the body of the files, metres.
    depth_scale : float, optional
        Counts per metre of integer depth.
    """

    calibrations: tuple[Calibration, ...]
    origin: str
    baseline_from: str = ""
    T_body_cam: FloatArray | None = None
    depth_scale: float | None = None

    @property
    def pair(self) -> tuple[Calibration, Calibration]:
        """Left and right of a stereo pair."""
        left, right = self.calibrations
        return left, right


def read_cameras(paths: CalibrationPaths, *, sensor: Sensor, is_rectified: bool) -> CameraSet:
    """Read the calibration of a recording from files.

    Parameters
    ----------
    paths : Path or sequence of Path
        A file or two, in the forms of `read_calibration_file`; or a folder: of EuRoC (`mav0` or
        what holds it), with `left.yaml` and `right.yaml`, or with a single YAML file.
    sensor : {"stereo", "rgbd"}
        What is needed. Of a chain of more cameras the first two are the stereo pair.
    is_rectified : bool
        The images are rectified already, by their names: of a pair with P only that counts. A
        pair without P is taken as the files have it.

    Raises
    ------
    CalibrationError
        When a file is malformed, or they do not describe such a camera.
    """
    files = [file for path in paths_of(paths) for file in _files_of(path)]
    contents = [read_calibration_file(file) for file in files]
    cameras = [camera for content in contents for camera in content.cameras]
    origin = " + ".join(dict.fromkeys(str(file) for file in files))
    if sensor == "stereo":
        return _stereo_set(cameras, origin, is_rectified=is_rectified)
    depth_scale = contents[0].depth_scale if contents else None
    return _rgbd_set(cameras, origin, depth_scale, is_rectified=is_rectified)


def paths_of(calibration: CalibrationPaths, *own: Path) -> tuple[Path, ...]:
    """Return the paths that were given, else those of the recording itself, which must be there."""
    given = (calibration,) if isinstance(calibration, Path) else tuple(calibration or ())
    for path in () if given else own:
        if fault := access_fault(path):
            raise CalibrationError(f"{path}: {fault}; add it or give --calibration FILE")
    return given or own


def pose_of_rectified(T_body_raw: FloatArray, camera: Calibration) -> FloatArray:
    """Return T_body_cam of the rectified camera of that of the raw one."""
    return T_body_raw @ se3.make_transform(camera.R.T, np.zeros(3))


def _files_of(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        return (path,)
    for root in (path / "mav0", path):
        for names in (_SENSOR_FILES, _SIDE_FILES):
            found = tuple(root / name for name in names if (root / name).is_file())
            if found:
                return found
    files = sorted(file for file in path.iterdir() if file.suffix in (".yaml", ".yml"))
    if len(files) == 1:
        return (files[0],)
    raise CalibrationError(
        f"{path}: expected cam0/sensor.yaml and cam1/sensor.yaml, left.yaml and right.yaml, or one "
        f"YAML file, got {len(files)} of these; give --calibration FILE"
    )


def _stereo_set(cameras: list[DescribedCamera], origin: str, *, is_rectified: bool) -> CameraSet:
    if len(cameras) < 2:
        raise CalibrationError(
            f"{origin}: holds one camera, expected two of a stereo pair: the keys left and right, "
            "cam0 and cam1, or two files"
        )
    left, right = cameras[:2]
    T_left_right, key = _extrinsics(left, right)
    is_rectified = is_rectified and T_left_right is None
    pair = (
        make_calibration(left.fields, is_rectified=is_rectified),
        make_calibration(right.fields, is_rectified=is_rectified),
    )
    if T_left_right is not None:
        pair = pair_of_extrinsics(pair, T_left_right, origin)
    stereo_baseline(pair, origin)
    return CameraSet(
        calibrations=pair, origin=origin, baseline_from=key, T_body_cam=_on_body(left, pair[0])
    )


def _extrinsics(left: DescribedCamera, right: DescribedCamera) -> tuple[FloatArray | None, str]:
    """Return T_left_right of the raw cameras, None if unknown, and the key that tells about it."""
    if right.T_cam_previous is not None:
        return se3.invert(right.T_cam_previous), "T_cn_cnm1"
    if left.T_body_cam is not None and right.T_body_cam is not None:
        return se3.invert(left.T_body_cam) @ right.T_body_cam, "the poses of both on the body"
    return None, "P"


def _rgbd_set(
    cameras: list[DescribedCamera], origin: str, depth_scale: float | None, *, is_rectified: bool
) -> CameraSet:
    if len(cameras) != 1:
        raise CalibrationError(
            f"{origin}: expected one camera, that of the colour images, got {len(cameras)}: give "
            "a file of that camera alone"
        )
    calibration = make_rgbd_calibration(cameras[0].fields, is_rectified=is_rectified)
    return CameraSet(
        calibrations=(calibration,),
        origin=origin,
        T_body_cam=_on_body(cameras[0], calibration),
        depth_scale=depth_scale,
    )


def _on_body(raw: DescribedCamera, camera: Calibration) -> FloatArray | None:
    return None if raw.T_body_cam is None else pose_of_rectified(raw.T_body_cam, camera)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescribedCamera:
    """A camera of a calibration file.

    Parameters
    ----------
    fields : CameraFields
        As they stand there, not checked.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the raw camera to the body (EuRoC: T_BS, Kalibr: the inverse of T_cam_imu), metres.
    T_cam_previous : ndarray of float64, shape (4, 4), optional
        Maps the raw camera before it in a chain to this one (Kalibr: T_cn_cnm1), metres.
    """

    fields: CameraFields
    T_body_cam: FloatArray | None = None
    T_cam_previous: FloatArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationFile:
    """One camera, a pair or a chain; and the counts per metre of integer depth."""

    cameras: tuple[DescribedCamera, ...]
    depth_scale: float | None = None


def read_calibration_file(path: Path) -> CalibrationFile:
    """Read a calibration file: YAML of any of these forms.

    - ROS's camera_calibration: `image_width`, `image_height`, `camera_matrix`,
      `distortion_coefficients`, `distortion_model`, optionally `rectification_matrix` and
      `projection_matrix`; or of `CameraInfo`: `width`, `height`, `k`, `d`, `r`, `p`, with
      `binning_x`, `binning_y` and `roi`; two of them under `left` and `right` are a pair;
    - Kalibr: `cam0`, `cam1` with `intrinsics`, `resolution`, `distortion_model`,
      `distortion_coeffs`, `T_cn_cnm1`, optionally `T_cam_imu`;
    - EuRoC: `intrinsics`, `resolution`, `distortion_model`, `distortion_coefficients`, `T_BS`;
    - OpenCV's FileStorage with the keys of ROS, or with `LEFT.K` and so on.

    A file of one camera may hold `depth_scale` (counts per metre).
    """
    content = read_yaml(path)
    chain = {int(match[1]): key for key in content if (match := _KALIBR_CAMERA.fullmatch(str(key)))}
    if chain:
        keys = [chain[number] for number in sorted(chain)]
        cameras = (_described(content[key], f"{path}: {key}") for key in keys)
        return CalibrationFile(cameras=tuple(cameras))
    for sides in _SIDES:
        pair = [_of_side(content, side) for side in sides]
        if all(part is not None for part in pair):
            described = map(_described, pair, (f"{path}: {side}" for side in sides))
            return CalibrationFile(cameras=tuple(described))
    scale = content.get("depth_scale")
    is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if scale is not None and not (is_number and 0 < scale < np.inf):
        raise CalibrationError(
            f"{path}: depth_scale must be a positive number, got {shortened(scale)}"
        )
    return CalibrationFile(
        cameras=(_described(content, str(path)),),
        depth_scale=None if scale is None else float(scale),
    )


def _of_side(content: Mapping[Any, Any], side: str) -> object:
    """Return the camera under a key, or the keys that begin with it as ORB-SLAM has them."""
    if side in content:
        return content[side]
    start = f"{side}."
    keys = [key for key in content if isinstance(key, str) and key.startswith(start)]
    return {key.removeprefix(start): content[key] for key in keys} or None


def _described(content: object, where: str) -> DescribedCamera:
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{where}: expected the keys of a camera")
    if "intrinsics" in content:
        return _of_intrinsics(content, where)
    return DescribedCamera(fields=_of_matrices(content, where))


def _of_intrinsics(content: Mapping[Any, Any], where: str) -> DescribedCamera:
    """Read a camera of Kalibr or EuRoC."""
    camera_model = content.get("camera_model", "pinhole")
    if camera_model != "pinhole":
        raise CalibrationError(
            f"{where}: camera model {shortened(camera_model)} is not supported, expected pinhole"
        )
    fu, fv, cu, cv = _array(content, "intrinsics", (4,), where)
    width, height = _array(content, "resolution", (2,), where)
    D = content.get("distortion_coefficients", content.get("distortion_coeffs"))
    fields = CameraFields(
        where=where,
        width=int(width),
        height=int(height),
        model=str(content.get("distortion_model", "radial-tangential")),
        K=[fu, 0.0, cu, 0.0, fv, cv, 0.0, 0.0, 1.0],
        D=[] if D is None else D,
        R=np.zeros(9),
        P=np.zeros(12),
        is_distorted_by_zeros=True,
    )
    T_body_cam = _transform(content, "T_BS", where)
    T_cam_imu = _transform(content, "T_cam_imu", where)
    if T_body_cam is None and T_cam_imu is not None:
        T_body_cam = se3.invert(T_cam_imu)
    return DescribedCamera(
        fields=fields, T_body_cam=T_body_cam, T_cam_previous=_transform(content, "T_cn_cnm1", where)
    )


def _of_matrices(content: Mapping[Any, Any], where: str) -> CameraFields:
    """Read a camera of ROS or OpenCV."""
    values = {name: _first(content, keys) for name, keys in _ROS_KEYS.items()}
    for name in ("width", "height", "K"):
        if values[name] is None:
            raise CalibrationError(f"{where}: lacks {' or '.join(_ROS_KEYS[name])}; {_FORMATS}")
    D = [] if values["D"] is None else values["D"]
    return CameraFields(
        where=where,
        width=_integer(values["width"], f"{where}: width", least=1),
        height=_integer(values["height"], f"{where}: height", least=1),
        model=str(content.get("distortion_model") or _assumed_model(content, D, where)),
        K=values["K"],
        D=D,
        R=np.zeros(9) if values["R"] is None else values["R"],
        P=np.zeros(12) if values["P"] is None else values["P"],
        binning=(_count(content, "binning_x", where), _count(content, "binning_y", where)),
        roi=_region(content.get("roi"), where),
    )


def _region(content: object, where: str) -> RegionOfInterest:
    if not isinstance(content, Mapping):
        return RegionOfInterest()
    counts = {name: _count(content, name, f"{where}: roi") for name in RegionOfInterest.__slots__}
    return RegionOfInterest(**counts)


def _count(content: Mapping[Any, Any], key: str, where: str) -> int:
    return _integer(content.get(key, 0), f"{where}: {key}", least=0)


def _integer(value: object, what: str, *, least: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= _MAX_COUNT:
        raise CalibrationError(
            f"{what} must be an integer of {least} or more, got {shortened(value)}"
        )
    return value


def _assumed_model(content: Mapping[Any, Any], D: object, where: str) -> str:
    """Tell the model by what OpenCV writes: a flag for fisheyes, else the count decides."""
    if content.get("fisheye_model"):
        return "equidistant"
    n_numbers = read_numbers(D, f"{where}: D").size
    return "rational_polynomial" if n_numbers > 5 else "plumb_bob"


def _first(content: Mapping[Any, Any], keys: tuple[str, ...]) -> Any:  # noqa: ANN401 - YAML
    return _data(next((content[key] for key in keys if key in content), None))


def _data(value: Any) -> Any:  # noqa: ANN401 - YAML
    return value.get("data") if isinstance(value, Mapping) else value


def _transform(content: Mapping[Any, Any], key: str, where: str) -> FloatArray | None:
    if key not in content:
        return None
    T = _array(content, key, (4, 4), where)
    T[3] = np.round(T[3], 6)  # programs that invert transforms write their rounding
    fault = se3.transform_fault(T, tolerance=ROTATION_TOLERANCE)
    if fault:
        raise CalibrationError(f"{where}: {key} {fault}")
    return se3.normalize(T)


def _array(content: Mapping[Any, Any], key: str, shape: tuple[int, ...], where: str) -> FloatArray:
    value = _data(content.get(key))
    if value is None:
        n_expected = int(np.prod(shape))
        raise CalibrationError(f"{where}: {key} must hold {n_expected} numbers, it is missing")
    return read_array(value, shape, f"{where}: {key}")


def read_yaml(path: Path) -> dict[Any, Any]:
    """Read a YAML file of keys; of several documents, as `ros2 topic echo` prints, the first."""
    try:
        with named_faults(CalibrationError, path, "the calibration cannot be read"):
            text = read_text(path, max_bytes=MAX_CHARACTERS)
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: the calibration is not text") from error
    if text.startswith(_OPENCV_HEADER):
        text = text.partition("\n")[2]  # with its colon it is no directive of YAML
    try:
        # Of several documents, as `ros2 topic echo` prints them, the first counts.
        content = load_yaml(text, _Loader)
    except YamlError as error:
        raise CalibrationError(f"{path}: the calibration is not YAML ({error})") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: the calibration holds no keys")
    return content


class _Loader(yaml.SafeLoader):
    """Reads the matrices of OpenCV as the keys that they consist of."""


_Loader.add_constructor(_OPENCV_MATRIX, partial(_Loader.construct_mapping, deep=True))
