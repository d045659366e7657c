"""What calibration files of ROS, Kalibr, EuRoC and OpenCV say of their cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gvo.bounded_text import shortened
from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.sources.calibration import is_rotation
from gvo.sources.calibration_yaml import read_yaml
from gvo.sources.camera_fields import CameraFields, RegionOfInterest, read_numbers
from gvo.types import FloatArray

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
    """What a calibration file holds.

    Parameters
    ----------
    cameras : tuple of DescribedCamera
        One camera; left and right; or those of a chain in its order.
    depth_scale : float, optional
        Counts per metre of integer depth.
    """

    cameras: tuple[DescribedCamera, ...]
    depth_scale: float | None = None


def read_calibration_file(path: Path) -> CalibrationFile:
    """Read a calibration file of any known form.

    Parameters
    ----------
    path : Path
        YAML of

        - ROS's camera_calibration: `image_width`, `image_height`, `camera_matrix`,
          `distortion_coefficients`, `distortion_model`, optionally `rectification_matrix` and
          `projection_matrix`; or of `CameraInfo`: `width`, `height`, `k`, `d`, `r`, `p`, with
          `binning_x`, `binning_y` and `roi`; two of them under `left` and `right` are a pair;
        - Kalibr: `cam0`, `cam1` with `intrinsics`, `resolution`, `distortion_model`,
          `distortion_coeffs`, `T_cn_cnm1`, optionally `T_cam_imu`;
        - EuRoC: `intrinsics`, `resolution`, `distortion_model`, `distortion_coefficients`,
          `T_BS`;
        - OpenCV's FileStorage with the keys of ROS, or with `LEFT.K` and so on.

        A file of one camera may hold `depth_scale` (counts per metre).

    Raises
    ------
    CalibrationError
        When it cannot be read or lacks a key.
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
        fields=fields,
        T_body_cam=T_body_cam,
        T_cam_previous=_transform(content, "T_cn_cnm1", where),
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
        width=_positive(values["width"], "width", where),
        height=_positive(values["height"], "height", where),
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
    names = ("x_offset", "y_offset", "width", "height")
    return RegionOfInterest(**{name: _count(content, name, f"{where}: roi") for name in names})


def _count(content: Mapping[Any, Any], key: str, where: str) -> int:
    value = content.get(key, 0)
    if not isinstance(value, int) or not 0 <= value <= _MAX_COUNT:
        raise CalibrationError(
            f"{where}: {key} must be an integer of 0 or more, got {shortened(value)}"
        )
    return int(value)


def _assumed_model(content: Mapping[Any, Any], D: object, where: str) -> str:
    """Tell the model by what OpenCV writes: a flag for fisheyes, else the count decides."""
    if content.get("fisheye_model"):
        return "equidistant"
    n_numbers = read_numbers(D, f"{where}: D").size
    return "rational_polynomial" if n_numbers > 5 else "plumb_bob"


def _positive(value: object, name: str, where: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 < value <= _MAX_COUNT:
        raise CalibrationError(
            f"{where}: {name} must be a positive integer, got {shortened(value)}"
        )
    return value


def _first(content: Mapping[Any, Any], keys: tuple[str, ...]) -> Any:  # noqa: ANN401 - YAML
    return _data(next((content[key] for key in keys if key in content), None))


def _data(value: Any) -> Any:  # noqa: ANN401 - YAML
    return value.get("data") if isinstance(value, Mapping) else value


def _transform(content: Mapping[Any, Any], key: str, where: str) -> FloatArray | None:
    if key not in content:
        return None
    T = _array(content, key, (4, 4), where)
    if not is_rotation(T[:3, :3]) or not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(f"{where}: {key} is no rigid transform")
    return se3.normalize(T)


def _array(content: Mapping[Any, Any], key: str, shape: tuple[int, ...], where: str) -> FloatArray:
    n_expected = int(np.prod(shape))
    value = _data(content.get(key))
    if value is None:
        raise CalibrationError(f"{where}: {key} must hold {n_expected} numbers, it is missing")
    numbers = read_numbers(value, f"{where}: {key}")
    if numbers.size != n_expected:
        raise CalibrationError(f"{where}: {key} must hold {n_expected} numbers, got {numbers.size}")
    return numbers.reshape(shape)
