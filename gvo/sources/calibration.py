"""Calibrations from the fields of `CameraInfo`, checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration, stereo_camera
from gvo.types import FloatArray

MAX_SIDE_PX = 32767
"""Largest width or height of an image, pixels: what OpenCV rectifies."""

MAX_AREA_PX = 100_000_000
"""Most pixels of an image: more is a damaged number, and would not fit into memory."""

_ROTATION_TOLERANCE = 1e-3


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
    if not is_rotation(R):
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


def make_rgbd_calibration(fields: CameraFields, *, is_rectified: bool) -> Calibration:
    """Check the fields of an RGB-D camera's `CameraInfo` and return the calibration.

    Depth is measured along the axis of the raw camera: where rectification turns the camera,
    the depth of a pixel would have to change with it.

    Parameters
    ----------
    fields : CameraFields
        Raw numbers of the colour camera.
    is_rectified : bool
        The images are rectified already: only P counts.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationError
        As `make_calibration`, and when R of raw images is not the identity.
    """
    calibration = make_calibration(fields, is_rectified=is_rectified)
    if not is_rectified and not np.allclose(calibration.R, np.eye(3), atol=_ROTATION_TOLERANCE):
        raise CalibrationError(
            f"{fields.where}: R turns the camera, and depth cannot be turned with it: expected the "
            "identity for an RGB-D camera; give rectified images or a calibration without R"
        )
    return calibration


def is_rotation(matrix: FloatArray) -> bool:
    """Tell whether a matrix of a file, shape (3, 3), is a rotation up to the file's rounding."""
    is_orthogonal = np.allclose(matrix @ matrix.T, np.eye(3), atol=_ROTATION_TOLERANCE)
    return bool(is_orthogonal and np.linalg.det(matrix) > 0)


def check_camera(calibration: Calibration, where: str) -> None:
    """Refuse a calibration whose rectified camera is none, naming where it comes from.

    Parameters
    ----------
    calibration : Calibration
        Of one camera.
    where : str
        File or topic, for the message.

    Raises
    ------
    CalibrationError
        When a focal length or the image size is not positive, or the image is larger than
        `MAX_SIDE_PX` or `MAX_AREA_PX`.
    """
    width, height = calibration.width, calibration.height
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_AREA_PX:
        raise CalibrationError(
            f"{where}: the image size must be at most {MAX_SIDE_PX} px a side and "
            f"{MAX_AREA_PX // 10**6} megapixels, got {width}x{height}; mend the calibration"
        )
    try:
        calibration.pinhole()
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def stereo_baseline(calibrations: tuple[Calibration, Calibration], where: str) -> float:
    """Return the baseline of a rectified pair in metres.

    Parameters
    ----------
    calibrations : tuple of two Calibration
        Left and right.
    where : str
        File or topics, for the message.

    Raises
    ------
    CalibrationError
        When they are no rectified pair, naming where they come from.
    """
    try:
        return stereo_camera(*calibrations).baseline
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


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
