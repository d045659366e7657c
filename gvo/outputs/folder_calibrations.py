"""The calibration files of data-set folders, written without loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gvo.geometry.camera import Calibration
from gvo.outputs.conversion import ideal_calibration
from gvo.types import FloatArray

_EUROC_MODELS = {"plumb_bob": "radial-tangential"}


def write_projections(
    path: Path, names: tuple[str, str], calibrations: tuple[Calibration, ...]
) -> None:
    """Write the `calib.txt` of a KITTI folder.

    Parameters
    ----------
    path : Path
        File to write.
    names : tuple of two str
        `image_N` of left and right: the rows are `PN`.
    calibrations : tuple of Calibration
        Of left and right; their P is written.
    """
    lines = [
        f"P{name[-1]}: {' '.join(repr(float(value)) for value in calibration.P.ravel())}\n"
        for name, calibration in zip(names, calibrations, strict=True)
    ]
    path.write_text("".join(lines), encoding="utf-8")


def write_sensor_yaml(
    path: Path, calibration: Calibration, *, T_body_sensor: FloatArray, is_rectified: bool
) -> None:
    """Write the `sensor.yaml` of one camera of an EuRoC folder.

    Parameters
    ----------
    path : Path
        File to write.
    calibration : Calibration
        Of the recording.
    T_body_sensor : ndarray of float64, shape (4, 4)
        Maps the camera, as its images are written, to the body, metres.
    is_rectified : bool
        The images that are written are rectified, whatever the recording's are.
    """
    written = ideal_calibration(calibration) if is_rectified else calibration
    K = written.K
    content: dict[str, Any] = {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": _numbers(T_body_sensor)},
        "resolution": [written.width, written.height],
        "camera_model": "pinhole",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "distortion_model": _EUROC_MODELS.get(written.model, written.model),
        "distortion_coefficients": _numbers(written.D),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def write_camera_info_yaml(path: Path, calibration: Calibration, *, depth_scale: float) -> None:
    """Write a calibration as ROS's camera_calibration does, with the scale of the depth.

    Parameters
    ----------
    path : Path
        File to write.
    calibration : Calibration
        Of the colour images that are written.
    depth_scale : float
        Counts per metre.
    """
    D = calibration.D
    content = {
        "image_width": calibration.width,
        "image_height": calibration.height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": _numbers(calibration.K)},
        "distortion_model": calibration.model,
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": _numbers(D)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": _numbers(calibration.R)},
        "projection_matrix": {"rows": 3, "cols": 4, "data": _numbers(calibration.P)},
        "depth_scale": depth_scale,
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _numbers(values: FloatArray) -> list[float]:
    return [float(value) for value in np.ravel(values)]
