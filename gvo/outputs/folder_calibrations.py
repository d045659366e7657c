"""The calibration files of data-set folders, written without loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.sources.recording import RecordingInfo
from gvo.trajectory import Trajectory
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


def write_sensor_yaml(path: Path, info: RecordingInfo, stream: int, *, is_rectified: bool) -> None:
    """Write the `sensor.yaml` of one camera of an EuRoC folder.

    Parameters
    ----------
    path : Path
        File to write.
    info : RecordingInfo
        Of a stereo recording.
    stream : int
        0: left, 1: right.
    is_rectified : bool
        The images that are written are rectified, whatever the recording's are.
    """
    calibration = info.calibrations[stream]
    is_ideal = calibration.is_rectified or is_rectified
    K = calibration.P[:, :3] if is_ideal else calibration.K
    D = np.zeros(4) if is_ideal else calibration.D
    model = "plumb_bob" if is_ideal else calibration.model
    content: dict[str, Any] = {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": _numbers(_body_pose(info, stream, is_ideal))},
        "resolution": [calibration.width, calibration.height],
        "camera_model": "pinhole",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "distortion_model": _EUROC_MODELS.get(model, model),
        "distortion_coefficients": _numbers(D),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def body_poses(truth: Trajectory, info: RecordingInfo) -> Trajectory:
    """Return the poses of the body that the written `T_BS` refer to.

    Parameters
    ----------
    truth : Trajectory
        T_world_cam of the rectified left camera.
    info : RecordingInfo
        Its T_body_cam; without one, the rectified left camera is the body.
    """
    if info.T_body_cam is None:
        return truth
    return truth.transformed(se3.invert(info.T_body_cam))


def write_camera_info_yaml(
    path: Path, calibration: Calibration, *, is_rectified: bool, depth_scale: float
) -> None:
    """Write a calibration as ROS's camera_calibration does, with the scale of the depth.

    Parameters
    ----------
    path : Path
        File to write.
    calibration : Calibration
        Of the colour camera.
    is_rectified : bool
        The images that are written are rectified, whatever the recording's are.
    depth_scale : float
        Counts per metre.
    """
    is_ideal = calibration.is_rectified or is_rectified
    K = calibration.P[:, :3] if is_ideal else calibration.K
    R = np.eye(3) if is_ideal else calibration.R
    D = np.zeros(5) if is_ideal else calibration.D
    content = {
        "image_width": calibration.width,
        "image_height": calibration.height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": _numbers(K)},
        "distortion_model": "plumb_bob" if is_ideal else calibration.model,
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": _numbers(D)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": _numbers(R)},
        "projection_matrix": {"rows": 3, "cols": 4, "data": _numbers(calibration.P)},
        "depth_scale": depth_scale,
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _body_pose(info: RecordingInfo, stream: int, is_ideal: bool) -> FloatArray:
    """Return T_body_sensor of a camera as its images are written."""
    T_body_cam = np.eye(4) if info.T_body_cam is None else info.T_body_cam
    left, right = info.calibrations
    baseline = float(left.P[0, 3] - right.P[0, 3]) / float(left.P[0, 0])
    T_cam_rectified = se3.make_transform(np.eye(3), np.array([stream * baseline, 0.0, 0.0]))
    R_rectified_raw = np.eye(3) if is_ideal else info.calibrations[stream].R
    return np.asarray(
        T_body_cam @ T_cam_rectified @ se3.make_transform(R_rectified_raw, np.zeros(3))
    )


def _numbers(values: FloatArray) -> list[float]:
    return [float(value) for value in np.ravel(values)]
