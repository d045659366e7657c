"""Folders in the ASL layout of the EuRoC MAV data set: raw stereo pairs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration, rectify_stereo
from gvo.sources.calibration import (
    CameraFields,
    is_rotation,
    make_calibration,
    stereo_baseline,
)
from gvo.sources.calibration_files import read_stereo_file, read_yaml
from gvo.sources.folders import FolderSource, StampedPath
from gvo.sources.recording import RecordingInfo
from gvo.sources.tables import read_rows, read_stamp
from gvo.trajectory import Trajectory
from gvo.trajectory_files import read_trajectory
from gvo.types import FloatArray

_TRUTH = Path("state_groundtruth_estimate0") / "data.csv"


class EurocSource(FolderSource):
    """A folder with `cam0` and `cam1`, or the folder of its `mav0`.

    Parameters
    ----------
    folder : Path
        Such a folder.
    calibration : Path, optional
        YAML of `left` and `right`, with R and P, that replaces intrinsics and rectification.

    Raises
    ------
    RecordingError, CalibrationError
        When files are missing or malformed.
    """

    def __init__(self, folder: Path, *, calibration: Path | None = None) -> None:
        self._root = folder / "mav0" if (folder / "mav0").is_dir() else folder
        name = folder.resolve().parent.name if folder.name == "mav0" else folder.resolve().name
        cameras = [self._root / "cam0", self._root / "cam1"]
        left, right = (_list_images(camera) for camera in cameras)
        sensors = [_read_sensor(camera / "sensor.yaml") for camera in cameras]
        self._T_body_left = sensors[0].T_body_cam
        if calibration is not None:
            calibrations = read_stereo_file(calibration, is_rectified=False)
            rectification = f"rectification: R and P of {calibration.name}"
        else:
            T_left_right = se3.invert(sensors[0].T_body_cam) @ sensors[1].T_body_cam
            calibrations = rectify_stereo(sensors[0].raw, sensors[1].raw, T_left_right)
            rectification = "rectification: from T_BS and distortion of cam0 and cam1"
        decisions = [
            f"stereo: cam0 + cam1 ({len(left)} + {len(right)} images)",
            rectification,
            f"baseline: {stereo_baseline(calibrations, str(self._root)):.4f} m",
        ]
        info = RecordingInfo(
            name=name,
            sensor="stereo",
            calibrations=calibrations,
            n_images=len(left),
            decisions=decisions,
        )
        super().__init__(info, left, right)

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the rectified left camera.

        Raises
        ------
        TrajectoryError
            When the file is malformed.
        """
        path = self._root / _TRUTH
        if not path.is_file():
            return None
        truth = read_trajectory(path)
        R_left_rectified = self._info.calibrations[0].R.T
        T_body_cam = self._T_body_left @ se3.make_transform(R_left_rectified, np.zeros(3))
        return Trajectory(
            stamps_ns=truth.stamps_ns, T_world_cam=se3.normalize(truth.T_world_cam @ T_body_cam)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sensor:
    raw: Calibration
    T_body_cam: FloatArray


def _list_images(camera: Path) -> list[StampedPath]:
    table = camera / "data.csv"
    return [
        (
            read_stamp(fields[0], f"{table}, line {number}", unit_ns=1),
            camera / "data" / fields[1],
        )
        for number, fields in read_rows(table, n_fields=2, separator=",")
    ]


def _read_sensor(path: Path) -> _Sensor:
    content = read_yaml(path)
    model = content.get("camera_model", "pinhole")
    if model != "pinhole":
        raise CalibrationError(f"{path}: camera model {model!r} is not supported, expected pinhole")
    fu, fv, cu, cv = _numbers(content, "intrinsics", (4,), path)
    width, height = _numbers(content, "resolution", (2,), path)
    fields = CameraFields(
        where=str(path),
        width=int(width),
        height=int(height),
        model=str(content.get("distortion_model", "radial-tangential")),
        K=[fu, 0.0, cu, 0.0, fv, cv, 0.0, 0.0, 1.0],
        D=content.get("distortion_coefficients") or [],
        R=np.zeros(9),
        P=np.zeros(12),
    )
    T_body_cam = _numbers(content, "T_BS", (4, 4), path)
    if not is_rotation(T_body_cam[:3, :3]):
        raise CalibrationError(f"{path}: T_BS is no rigid transform")
    return _Sensor(
        raw=make_calibration(fields, is_rectified=False), T_body_cam=se3.normalize(T_body_cam)
    )


def _numbers(content: dict[str, Any], key: str, shape: tuple[int, ...], path: Path) -> FloatArray:
    values = content.get(key)
    if isinstance(values, dict):
        values = values.get("data")
    try:
        numbers = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {key} must hold numbers") from error
    if numbers.size != np.prod(shape) or not np.all(np.isfinite(numbers)):
        raise CalibrationError(f"{path}: {key} must hold {np.prod(shape)} finite numbers")
    return numbers.reshape(shape)
