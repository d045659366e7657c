"""The cameras of one recording out of calibration files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gvo._text import access_fault
from gvo.config import ImuConfig
from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.geometry.imu import Imu, ImuStream
from gvo.io.calibration.camera_info import (
    make_calibration,
    make_rgbd_calibration,
    pair_of_extrinsics,
    stereo_baseline,
)
from gvo.io.calibration.forms import (
    IMU_DENSITIES,
    DescribedCamera,
    ImuFacts,
    read_calibration_file,
    read_imu_file,
)
from gvo.io.recording import RecordingInfo, Sensor
from gvo.types import FloatArray

CalibrationPaths: TypeAlias = Sequence[Path] | Path | None
"""One file, two of them (left and right), or a folder of them; None where none was given."""
ImageSize: TypeAlias = Callable[[], tuple[int, int]]
"""Returns width and height of the images that are to be read, pixels."""
_SENSOR_FILES = tuple(Path(name) / "sensor.yaml" for name in ("cam0", "cam1"))
# Of a file that was given, or in a folder.
_IMU_FILES = ("", "imu0/sensor.yaml", "mav0/imu0/sensor.yaml")
_OF_IMU = (*IMU_DENSITIES, "delay_s")
_SIDE_FILES = (Path("left.yaml"), Path("right.yaml"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSet:
    """The cameras of one recording, as calibration files have them.

    Parameters
    ----------
    calibrations : tuple of Calibration
        Left and right, or the colour camera.
    origin : str
        The names of the files.
    baseline_from : str
        The key that holds the baseline; empty for one camera.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the rectified left or colour camera to the body of the files, metres.
    depth_scale : float, optional
        Counts per metre of integer depth.
    imu : ImuFacts
        What the first camera says of the IMU beside it.
    """

    calibrations: tuple[Calibration, ...]
    origin: str
    baseline_from: str = ""
    T_body_cam: FloatArray | None = None
    depth_scale: float | None = None
    imu: ImuFacts = field(default_factory=dict)

    @property
    def pair(self) -> tuple[Calibration, Calibration]:
        """Left and right of a stereo pair."""
        left, right = self.calibrations
        return left, right


def read_cameras(
    paths: CalibrationPaths,
    *,
    sensor: Sensor,
    is_rectified: bool,
    image_size: ImageSize | None = None,
    first: int = 0,
) -> CameraSet:
    """Read the calibration of a recording from files.

    Parameters
    ----------
    paths : Path or sequence of Path
        A file or two, in the forms of `read_calibration_file`; or a folder: of EuRoC (`mav0` or
        what holds it), with `left.yaml` and `right.yaml`, or with a single YAML file.
    sensor : {"stereo", "rgbd"}
        What is needed.
    is_rectified : bool
        The images are rectified already, by their names: of a pair with P only that counts. A
        pair without P is taken as the files have it.
    image_size : callable, optional
        Asked where a file does not say the size.
    first : int
        Of a chain of more cameras the left one of the stereo pair.

    Raises
    ------
    CalibrationError
        When a file is malformed, or they do not describe such a camera.
    """
    files = [file for path in paths_of(paths) for file in _files_of(path)]
    described = [camera for file in files for camera in read_calibration_file(file)]
    cameras = [_sized(camera, image_size) for camera in described]
    origin = " + ".join(dict.fromkeys(str(file) for file in files))
    if sensor == "stereo":
        chosen = cameras[first : first + 2] if len(cameras) > 2 else cameras
        return _stereo_set(chosen, origin, is_rectified=is_rectified)
    return _rgbd_set(cameras, origin, is_rectified=is_rectified)


def paths_of(calibration: CalibrationPaths, *own: Path) -> tuple[Path, ...]:
    """Return the paths that were given, else those of the recording itself, which must be there."""
    given = (calibration,) if isinstance(calibration, Path) else tuple(calibration or ())
    for path in () if given else own:
        if fault := access_fault(path):
            raise CalibrationError(f"{path}: {fault}; add it or give --calibration FILE")
    return given or own


def split_imu(calibration: CalibrationPaths) -> tuple[tuple[Path, ...], ImuFacts]:
    """Return the paths of cameras, and what those of an IMU say."""
    given, facts = paths_of(calibration), ImuFacts()
    files = [path / name for path in given for name in _IMU_FILES if (path / name).is_file()]
    said = {file: found for file in files if (found := read_imu_file(file))}
    for found in said.values():
        facts |= found
    return tuple(path for path in given if path not in said), facts


def make_imu(facts: ImuFacts, T_body_cam: FloatArray | None, config: ImuConfig) -> Imu:
    """Return an IMU of what is said of it, and of where the rectified camera is on the body.

    What is configured counts before.
    """
    values = {key: value for key, value in facts.items() if key in _OF_IMU}
    if T_body_cam is not None and "T_body_imu" in facts:
        values["T_camera_imu"] = se3.normalize(se3.invert(T_body_cam) @ facts["T_body_imu"])
    return Imu(**values).with_settings(config)


def with_imu(info: RecordingInfo, stream: ImuStream, what: str, origin: str) -> RecordingInfo:
    """Return what is known of a recording with its IMU; `origin` says what its place comes from."""
    imu = stream.imu
    place = "its place is learnt" if imu.T_camera_imu is None else f"placed by {origin}"
    delay = "learnt" if imu.delay_s is None else f"{1e3 * imu.delay_s:.4g} ms"
    line = f"imu: {what}; {place}, its delay is {delay}"
    return replace(info, imu=stream, decisions=[*info.decisions, line])


def pose_of_rectified(T_body_raw: FloatArray, camera: Calibration) -> FloatArray:
    """Return T_body_cam of the rectified camera of that of the raw one."""
    return T_body_raw @ se3.make_transform(camera.R.T, np.zeros(3))


def _files_of(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        return (path,)
    for root in (path / "mav0", path):
        for names in (_SENSOR_FILES, _SIDE_FILES):
            found = tuple(root / name for name in names if (root / name).is_file())
            if found:
                return found
    files = sorted(file for file in path.iterdir() if file.suffix in (".yaml", ".yml"))
    if len(files) == 1:
        return (files[0],)
    raise CalibrationError(
        f"{path}: expected cam0/sensor.yaml and cam1/sensor.yaml, left.yaml and right.yaml, or one "
        f"YAML file, got {len(files)} of these; give --calibration FILE"
    )


def _sized(camera: DescribedCamera, image_size: ImageSize | None) -> DescribedCamera:
    """Return a camera with the size of the images, where its file does not say it."""
    fields = camera.fields
    if fields.width > 0 and fields.height > 0:
        return camera
    if image_size is None:
        raise CalibrationError(f"{fields.where}: lacks width and height of the images; add them")
    width, height = image_size()
    return replace(camera, fields=replace(fields, width=width, height=height))


def _stereo_set(cameras: list[DescribedCamera], origin: str, *, is_rectified: bool) -> CameraSet:
    if len(cameras) == 1:
        cameras = [*cameras, _twin(cameras[0], origin)]
    left, right = cameras
    T_left_right, key = _extrinsics(left, right)
    is_rectified = is_rectified and T_left_right is None
    pair = (
        make_calibration(left.fields, is_rectified=is_rectified),
        make_calibration(right.fields, is_rectified=is_rectified),
    )
    if T_left_right is not None:
        pair = pair_of_extrinsics(pair, T_left_right, origin)
    stereo_baseline(pair, origin)
    return CameraSet(
        calibrations=pair,
        origin=origin,
        baseline_from=key,
        T_body_cam=_on_body(left, pair[0]),
        imu=left.imu,
    )


def _twin(left: DescribedCamera, origin: str) -> DescribedCamera:
    """Return the right camera of a rectified pair, of which the file describes one camera."""
    if left.focal_x_baseline is None:
        raise CalibrationError(
            f"{origin}: holds one camera, expected two of a stereo pair (left and right, cam0 and "
            "cam1, or two files), or its baseline (Stereo.b, Camera.bf, focal_x_baseline)"
        )
    P = np.hstack([np.reshape(left.fields.K, (3, 3)), [[-left.focal_x_baseline], [0.0], [0.0]]])
    return replace(left, fields=replace(left.fields, P=P))


def _extrinsics(left: DescribedCamera, right: DescribedCamera) -> tuple[FloatArray | None, str]:
    """Return T_left_right of the raw cameras, None if unknown, and the key that tells about it."""
    if right.T_cam_previous is not None:
        return se3.invert(right.T_cam_previous), "the transform between both"
    if left.T_body_cam is not None and right.T_body_cam is not None:
        return se3.invert(left.T_body_cam) @ right.T_body_cam, "the poses of both on the body"
    return None, "P"


def _rgbd_set(cameras: list[DescribedCamera], origin: str, *, is_rectified: bool) -> CameraSet:
    if len(cameras) != 1:
        raise CalibrationError(
            f"{origin}: expected one camera, that of the colour images, got {len(cameras)}: give "
            "a file of that camera alone"
        )
    calibration = make_rgbd_calibration(cameras[0].fields, is_rectified=is_rectified)
    return CameraSet(
        calibrations=(calibration,),
        origin=origin,
        T_body_cam=_on_body(cameras[0], calibration),
        depth_scale=cameras[0].depth_scale,
        imu=cameras[0].imu,
    )


def _on_body(raw: DescribedCamera, camera: Calibration) -> FloatArray | None:
    return None if raw.T_body_cam is None else pose_of_rectified(raw.T_body_cam, camera)
