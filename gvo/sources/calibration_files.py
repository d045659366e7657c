"""Calibration files: YAML in the form of ROS, one camera or a stereo pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration
from gvo.sources.calibration import CameraFields, make_calibration

_FILE_KEYS = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
}


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

    Parameters
    ----------
    path : Path
        See `read_calibration_file`.

    Returns
    -------
    fields : CameraFields
    depth_scale : float or None
        Counts per metre of integer depth.

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

    Parameters
    ----------
    path : Path
        See `read_calibration_file`.
    is_rectified : bool
        The images are rectified already: only P counts.

    Returns
    -------
    tuple of two Calibration
        Left and right.

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


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file of keys.

    Parameters
    ----------
    path : Path
        Text.

    Returns
    -------
    dict
        Values by key.

    Raises
    ------
    CalibrationError
        When it is missing, malformed or holds no keys.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: the calibration cannot be read: {error}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        # dates and numbers that are none come as ValueError
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
