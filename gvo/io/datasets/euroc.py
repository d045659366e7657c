"""Folders in the ASL layout of the EuRoC MAV data set: raw stereo pairs."""

from __future__ import annotations

from pathlib import Path

from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.io.calibration.files import (
    CalibrationPaths,
    CameraSet,
    paths_of,
    pose_of_rectified,
    read_calibration_file,
    read_cameras,
)
from gvo.io.calibration.stereo_pair import stereo_baseline
from gvo.io.datasets.files import FolderSource, StampedPath, read_rows, read_stamp
from gvo.io.images import FULL_RANGE, GreyRange
from gvo.io.recording import RecordingInfo
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray

_TRUTH = Path("state_groundtruth_estimate0") / "data.csv"


class EurocSource(FolderSource):
    """A folder with `cam0` and `cam1`, or the folder of its `mav0`.

    Parameters
    ----------
    folder : Path
        Such a folder.
    calibration : Path or sequence of Path, optional
        Files of the pair that replace intrinsics and rectification, see `read_cameras`; where
        they say where the cameras are on the body, that counts, too.
    grey_range : GreyRange
        Of images with 16 bits.

    Raises
    ------
    RecordingError, CalibrationError
        When files are missing or malformed.
    """

    def __init__(
        self,
        folder: Path,
        *,
        calibration: CalibrationPaths = None,
        grey_range: GreyRange = FULL_RANGE,
    ) -> None:
        self._root = folder / "mav0" if (folder / "mav0").is_dir() else folder
        name = folder.resolve().parent.name if folder.name == "mav0" else folder.resolve().name
        cameras = [self._root / "cam0", self._root / "cam1"]
        left, right = (_list_images(camera) for camera in cameras)
        sensors = [camera / "sensor.yaml" for camera in cameras]
        files = paths_of(calibration)
        if files:
            found = read_cameras(files, sensor="stereo", is_rectified=False)
            names = " + ".join(file.name for file in files)
            key = "R and P" if found.baseline_from == "P" else found.baseline_from
            rectification = f"rectification: {key} of {names}"
        else:
            found = read_cameras(sensors, sensor="stereo", is_rectified=False)
            rectification = "rectification: from T_BS and distortion of cam0 and cam1"
        self._T_body_cam = _pose_on_body(found, sensors[0])
        decisions = [
            f"stereo: cam0 + cam1 ({len(left)} + {len(right)} images)",
            rectification,
            f"baseline: {stereo_baseline(found.pair, str(self._root)):.4f} m",
        ]
        info = RecordingInfo(
            name=name,
            sensor="stereo",
            calibrations=found.calibrations,
            n_images=len(left),
            decisions=decisions,
            T_body_cam=self._T_body_cam,
        )
        super().__init__(info, left, right, grey_range=grey_range)

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
        return Trajectory(
            stamps_ns=truth.stamps_ns,
            T_world_cam=se3.normalize(truth.T_world_cam @ self._T_body_cam),
        )


def _pose_on_body(cameras: CameraSet, sensor: Path) -> FloatArray:
    """Return T_body_cam of the rectified left camera, of the folder's own file if need be."""
    if cameras.T_body_cam is not None:
        return cameras.T_body_cam
    (described,) = read_calibration_file(sensor).cameras
    if described.T_body_cam is None:
        raise CalibrationError(f"{sensor}: T_BS must hold 16 numbers, it is missing")
    return pose_of_rectified(described.T_body_cam, cameras.calibrations[0])


def _list_images(camera: Path) -> list[StampedPath]:
    table = camera / "data.csv"
    return [
        (
            read_stamp(fields[0], f"{table}, line {number}", unit_ns=1),
            camera / "data" / fields[1],
        )
        for number, fields in read_rows(table, n_fields=2, separator=",")
    ]
