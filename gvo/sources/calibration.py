"""Calibrations from the fields of `CameraInfo`, and from YAML files that hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration, stereo_camera
from gvo.types import FloatArray

_ROTATION_TOLERANCE = 1e-3
_FILE_KEYS = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFields:
    """What a `CameraInfo` says, as it stands there.

    Parameters
    ----------
    where : str
        File or topic, for messages.
    width, height : int
        Image size, pixels.
    model : str
        Distortion model.
    K, D, R, P : array_like of float
        9, 0 to 14, 9 and 12 numbers; R and P of zeros mean "not set".
    """

    where: str
    width: int
    height: int
    model: str
    K: ArrayLike
    D: ArrayLike
    R: ArrayLike
    P: ArrayLike


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationFile:
    """What a calibration file holds.

    Parameters
    ----------
    cameras : tuple of CameraFields
        One camera, or left and right.
    depth_scale : float, optional
        Counts per metre of integer depth.
    """

    cameras: tuple[CameraFields, ...]
    depth_scale: float | None = None


def make_calibration(fields: CameraFields, *, is_rectified: bool) -> Calibration:
    """Check the fields of a `CameraInfo` and return the calibration.

    Parameters
    ----------
    fields : CameraFields
        Raw numbers.
    is_rectified : bool
        The images are rectified already: only P counts.

    Raises
    ------
    CalibrationError
        When the camera is not calibrated, its distortion is not `plumb_bob`, or a matrix is
        malformed.
    """
    where = fields.where
    K = _matrix(fields.K, (3, 3), f"{where}: K")
    P = _matrix(fields.P, (3, 4), f"{where}: P")
    R = _matrix(fields.R, (3, 3), f"{where}: R")
    if not np.any(K):
        K = P[:, :3].copy()
    if not np.any(K):
        raise CalibrationError(f"{where}: the camera is not calibrated: K and P are zero")
    if not np.any(P):
        P = np.hstack([K, np.zeros((3, 1))])
    if not np.any(R):
        R = np.eye(3)
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE):
        raise CalibrationError(f"{where}: R is no rotation")
    calibration = Calibration(
        width=fields.width,
        height=fields.height,
        K=K,
        D=_distortion(fields, is_rectified=is_rectified),
        R=R,
        P=P,
        is_rectified=is_rectified,
    )
    check_camera(calibration, where)
    return calibration


def check_camera(calibration: Calibration, where: str) -> None:
    """Refuse a calibration whose rectified camera is none, naming where it comes from.

    Raises
    ------
    CalibrationError
        When a focal length or the image size is not positive.
    """
    try:
        calibration.pinhole()
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def read_calibration_file(path: Path) -> CalibrationFile:
    """Read a calibration in the form of ROS's camera_calibration or of `CameraInfo`.

    Parameters
    ----------
    path : Path
        YAML: `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients`,
        `distortion_model`, optionally `rectification_matrix`, `projection_matrix` and
        `depth_scale` (counts per metre); or `width`, `height`, `k`, `d`, `r`, `p`. A stereo
        pair holds two of them under `left` and `right`.

    Raises
    ------
    CalibrationError
        When it cannot be read or lacks a key.
    """
    content = read_yaml(path)
    if "left" in content and "right" in content:
        cameras = tuple(
            _camera_fields(content[side], f"{path}: {side}") for side in ("left", "right")
        )
        return CalibrationFile(cameras=cameras)
    scale = content.get("depth_scale")
    if scale is not None and not (isinstance(scale, int | float) and 0 < scale < np.inf):
        raise CalibrationError(f"{path}: depth_scale must be a positive number, got {scale!r}")
    return CalibrationFile(
        cameras=(_camera_fields(content, str(path)),),
        depth_scale=None if scale is None else float(scale),
    )


def read_mono_file(path: Path) -> tuple[CameraFields, float | None]:
    """Read one camera, and the depth scale if there is one, from a calibration file.

    Raises
    ------
    CalibrationError
        When it cannot be read or holds a stereo pair.
    """
    file = read_calibration_file(path)
    if len(file.cameras) != 1:
        raise CalibrationError(f"{path}: expected one camera, got left and right")
    return file.cameras[0], file.depth_scale


def read_stereo_file(path: Path, *, is_rectified: bool) -> tuple[Calibration, Calibration]:
    """Read left and right from a calibration file.

    Raises
    ------
    CalibrationError
        When it cannot be read or does not hold both.
    """
    cameras = read_calibration_file(path).cameras
    if len(cameras) != 2:
        raise CalibrationError(
            f"{path}: expected the keys left and right, each with a camera of the stereo pair"
        )
    left, right = (make_calibration(camera, is_rectified=is_rectified) for camera in cameras)
    return left, right


def stereo_baseline(calibrations: tuple[Calibration, Calibration], where: str) -> float:
    """Return the baseline of a rectified pair in metres.

    Raises
    ------
    CalibrationError
        When they are no rectified pair, naming where they come from.
    """
    try:
        return stereo_camera(*calibrations).baseline
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file of keys.

    Raises
    ------
    CalibrationError
        When it is missing, malformed or holds no keys.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: the calibration cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path}: the calibration is no YAML") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: the calibration holds no keys")
    return content


def _camera_fields(content: object, where: str) -> CameraFields:
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{where}: expected the keys of a camera")
    values = {name: _first(content, keys) for name, keys in _FILE_KEYS.items()}
    for name in ("width", "height", "K"):
        if values[name] is None:
            raise CalibrationError(f"{where}: lacks {' or '.join(_FILE_KEYS[name])}")
    for name in ("width", "height"):
        if not isinstance(values[name], int) or values[name] <= 0:
            raise CalibrationError(f"{where}: {name} must be a positive integer")
    return CameraFields(
        where=where,
        width=values["width"],
        height=values["height"],
        model=str(content.get("distortion_model", "plumb_bob")),
        K=values["K"],
        D=[] if values["D"] is None else values["D"],
        R=np.zeros(9) if values["R"] is None else values["R"],
        P=np.zeros(12) if values["P"] is None else values["P"],
    )


def _first(content: Mapping[str, Any], keys: tuple[str, ...]) -> Any:  # noqa: ANN401 - YAML
    value = next((content[key] for key in keys if key in content), None)
    return value.get("data") if isinstance(value, Mapping) else value


def _matrix(values: ArrayLike, shape: tuple[int, int], what: str) -> FloatArray:
    numbers = _numbers(values, what)
    if numbers.size != shape[0] * shape[1]:
        raise CalibrationError(
            f"{what} must hold {shape[0] * shape[1]} numbers, got {numbers.size}"
        )
    return numbers.reshape(shape)


def _numbers(values: ArrayLike, what: str) -> FloatArray:
    try:
        numbers = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{what} must hold numbers, got {values!r}") from error
    if not np.all(np.isfinite(numbers)):
        raise CalibrationError(f"{what} holds a value that is not finite")
    return numbers


def _distortion(fields: CameraFields, *, is_rectified: bool) -> FloatArray:
    D = _numbers(fields.D, f"{fields.where}: D")
    if not np.any(D):
        return np.zeros(5)
    if fields.model.lower() not in ("plumb_bob", "radial-tangential", "radtan"):
        if is_rectified:
            return np.zeros(5)
        raise CalibrationError(
            f"{fields.where}: distortion model {fields.model!r} is not supported, expected "
            "plumb_bob; rectify the images first"
        )
    if D.size not in (4, 5):
        raise CalibrationError(f"{fields.where}: D must hold 4 or 5 numbers, got {D.size}")
    return np.concatenate([D, np.zeros(5 - D.size)])
