"""Stereo pairs: their baseline, from P or from the transform between the cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration, rectify_stereo, stereo_camera
from gvo.io.calibration.camera_info import check_camera
from gvo.types import FloatArray

_MAX_ANGLE_RAD = 1e-3
# How far the baseline of rectified cameras may lean, by the rounding of tf, as a tangent.
_MAX_SLOPE = 0.01
# Up to here two cameras are one: what is left moves no pixel by a tenth.
_ALIKE = 1e-5


def has_baseline(left: Calibration, right: Calibration) -> bool:
    """Tell whether the P of a pair, rectified or not, say how far apart the cameras are."""
    return bool(left.P[0, 3] != right.P[0, 3])


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
    left, right = calibrations
    if (left.width, left.height) == (right.width, right.height) and not has_baseline(left, right):
        raise CalibrationError(
            f"{where}: the baseline must be positive, got none: expected -fx * baseline as the "
            "fourth number of P of the right camera, or the transform between the cameras (tf, "
            "T_cn_cnm1, T_BS); give --calibration FILE that holds either"
        )
    try:
        return stereo_camera(left, right).baseline
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def pair_of_extrinsics(
    raw: tuple[Calibration, Calibration], T_left_right: FloatArray, where: str
) -> tuple[Calibration, Calibration]:
    """Rectify a pair of raw cameras by the transform between them.

    Parameters
    ----------
    raw : tuple of two Calibration
        Left and right; their R and P are not read.
    T_left_right : ndarray of float64, shape (4, 4)
        Maps coordinates of the right raw camera to the left one, metres.
    where : str
        Files or topics, for messages.

    Returns
    -------
    tuple of two Calibration
        Rectified already where the cameras are alike, without distortion and side by side;
        otherwise with R and P of `rectify_stereo`.

    Raises
    ------
    CalibrationError
        When they cannot be rectified.
    """
    left, right = raw
    if _is_rectified_pair(left, right, T_left_right):
        pair = (
            _without_lens(left, left.K, 0.0),
            _without_lens(right, left.K, float(T_left_right[0, 3])),
        )
    else:
        try:
            pair = rectify_stereo(left, right, T_left_right)
        except CalibrationError as error:
            raise CalibrationError(f"{where}: {error}") from error
    for calibration in pair:
        check_camera(calibration, where)
    return pair


def pair_of_baseline(
    rectified: tuple[Calibration, Calibration], T_left_right: FloatArray, where: str
) -> tuple[Calibration, Calibration]:
    """Set the baseline of a rectified pair by the transform between the cameras.

    Parameters
    ----------
    rectified : tuple of two Calibration
        Left and right.
    T_left_right : ndarray of float64, shape (4, 4)
        Maps coordinates of the right rectified camera to the left one, metres.
    where : str
        What told the transform, for messages.

    Raises
    ------
    CalibrationError
        When the transform is more than a shift to the side, as it must be between rectified
        cameras.
    """
    left, right = rectified
    x, y, z = (float(value) for value in T_left_right[:3, 3])
    angle = float(np.linalg.norm(Rotation.from_matrix(T_left_right[:3, :3]).as_rotvec()))
    if angle > _MAX_ANGLE_RAD or np.hypot(y, z) > _MAX_SLOPE * abs(x):
        raise CalibrationError(
            f"{where}: expected rectified cameras side by side, got the right one turned by "
            f"{np.degrees(angle):.2f} deg at x={x:.4g} y={y:.4g} z={z:.4g} m of the left one; "
            "give --calibration FILE"
        )
    P = right.P.copy()
    P[0, 3] = left.P[0, 3] - P[0, 0] * x
    return left, replace(right, P=P)


def _is_rectified_pair(left: Calibration, right: Calibration, T_left_right: FloatArray) -> bool:
    x, y, z = T_left_right[:3, 3]
    is_pinhole = all(
        camera.model != "equidistant" and not np.any(camera.D) for camera in (left, right)
    )
    return bool(
        is_pinhole
        and (left.width, left.height) == (right.width, right.height)
        and np.allclose(left.K, right.K, rtol=_ALIKE, atol=0.0)
        and np.allclose(T_left_right[:3, :3], np.eye(3), rtol=0.0, atol=_ALIKE)
        and np.hypot(y, z) <= _ALIKE * abs(x)
    )


def _without_lens(raw: Calibration, K: FloatArray, baseline: float) -> Calibration:
    P = np.hstack([K, [[-K[0, 0] * baseline], [0.0], [0.0]]])
    return replace(raw, R=np.eye(3), P=P, is_rectified=True)
