"""Folders in the ASL layout of the EuRoC MAV data set: raw stereo pairs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from gvo.config import Config, ImuConfig
from gvo.errors import CalibrationError, RecordingError
from gvo.geometry import se3
from gvo.geometry.imu import ImuStream
from gvo.io.calibration.camera_info import stereo_baseline
from gvo.io.calibration.files import (
    CalibrationPaths,
    CameraSet,
    make_imu,
    paths_of,
    pose_of_rectified,
    read_cameras,
    with_imu,
)
from gvo.io.calibration.forms import ImuFacts, read_calibration_file, read_imu_file
from gvo.io.datasets.files import FolderSource, StampedPath, image_size, read_stamped_rows
from gvo.io.datasets.imu_table import read_imu_table
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
    config : Config, optional
        Of images with 16 bits; the defaults when left out.
    imu : ImuFacts, optional
        What counts before what `imu0` says of itself; None: the IMU is left out.

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
        config: Config | None = None,
        imu: ImuFacts | None = None,
    ) -> None:
        self._root = folder / "mav0" if (folder / "mav0").is_dir() else folder
        images = {name: _list_images(self._root / name) for name in ("cam0", "cam1")}
        sensors = [self._root / name / "sensor.yaml" for name in images]
        files = paths_of(calibration, *sensors)
        size = partial(image_size, images["cam0"], config)
        cameras = read_cameras(files, sensor="stereo", is_rectified=False, image_size=size)
        rectification = "from T_BS and distortion of cam0 and cam1"
        if calibration:
            key = "R and P" if cameras.baseline_from == "P" else cameras.baseline_from
            rectification = f"{key} of {' + '.join(file.name for file in files)}"
        self._T_body_cam = _pose_on_body(cameras, sensors[0])
        decisions = [
            f"rectification: {rectification}",
            f"baseline: {stereo_baseline(cameras.pair, str(self._root)):.4f} m",
        ]
        cameras = replace(cameras, T_body_cam=self._T_body_cam)
        named = folder.resolve().parent if folder.name == "mav0" else folder
        super().__init__(named, cameras, images, decisions, config)
        table = self._root / "imu0" / "data.csv"
        if imu is not None and table.is_file():
            self._add_imu(table, {**imu, **cameras.imu}, (config or Config()).imu)

    def _add_imu(self, table: Path, given: ImuFacts, config: ImuConfig) -> None:
        """Add the IMU to what is known; its clock is that of the cameras, if nothing else is said.

        The first samples are read, so that a file of another form is refused before any work.
        """
        sensor = table.with_name("sensor.yaml")
        own = read_imu_file(sensor) if sensor.is_file() else {}
        imu = make_imu({"delay_s": 0.0, **own, **given}, self._T_body_cam, config)
        if next(read_imu_table(table, 0), None) is None:
            raise RecordingError(f"{table}: holds no rows; mend it, or give --imu none")
        stream = ImuStream(name="imu0", imu=imu, samples=partial(read_imu_table, table))
        self.info = with_imu(self.info, stream, "imu0", "the calibration")

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the rectified left camera."""
        path = self._root / _TRUTH
        if not path.is_file():
            return None
        truth = read_trajectory(path)
        return Trajectory(
            stamps_ns=truth.stamps_ns,
            T_world_frame=se3.normalize(truth.T_world_frame @ self._T_body_cam),
        )


def _pose_on_body(cameras: CameraSet, sensor: Path) -> FloatArray:
    """Return T_body_cam of the rectified left camera, of the folder's own file if need be."""
    if cameras.T_body_cam is not None:
        return cameras.T_body_cam
    (described,) = read_calibration_file(sensor)
    if described.T_body_cam is None:
        raise CalibrationError(f"{sensor}: T_BS must hold 16 numbers, it is missing")
    return pose_of_rectified(described.T_body_cam, cameras.calibrations[0])


def _list_images(camera: Path) -> list[StampedPath]:
    rows = read_stamped_rows(camera / "data.csv", unit_ns=1, separator=",")
    return [(stamp_ns, str(camera / "data" / name)) for stamp_ns, name in rows]
