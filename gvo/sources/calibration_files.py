"""Calibration files for a recording: one camera or a stereo pair, rectified where need be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.sources.calibration import make_calibration, make_rgbd_calibration
from gvo.sources.calibration_formats import CalibrationFile, DescribedCamera, read_calibration_file
from gvo.sources.recording import Sensor
from gvo.sources.stereo_pairs import pair_of_extrinsics, stereo_baseline
from gvo.types import FloatArray

CalibrationPaths: TypeAlias = Sequence[Path] | Path | None
"""One file, two of them (left and right), or a folder of them; None where none was given."""

_SENSOR_FILES = tuple(Path(name) / "sensor.yaml" for name in ("cam0", "cam1"))
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
        Which key of them told the baseline; empty for one camera.
    T_body_cam : ndarray of float64, shape (4, 4), optional
        Maps the rectified left or colour camera to the body of the files, metres.
    depth_scale : float, optional
        Counts per metre of integer depth.
    """

    calibrations: tuple[Calibration, ...]
    origin: str
    baseline_from: str = ""
    T_body_cam: FloatArray | None = None
    depth_scale: float | None = None

    @property
    def pair(self) -> tuple[Calibration, Calibration]:
        """Left and right of a stereo pair."""
        left, right = self.calibrations
        return left, right


def paths_of(calibration: CalibrationPaths) -> tuple[Path, ...]:
    """Return the paths that were given; none for None."""
    if calibration is None:
        return ()
    return (calibration,) if isinstance(calibration, Path) else tuple(calibration)


def pose_of_rectified(T_body_raw: FloatArray, camera: Calibration) -> FloatArray:
    """Return T_body_cam of the rectified camera, shape (4, 4), of that of the raw one."""
    return T_body_raw @ se3.make_transform(camera.R.T, np.zeros(3))


def read_cameras(paths: CalibrationPaths, *, sensor: Sensor, is_rectified: bool) -> CameraSet:
    """Read the calibration of a recording from files.

    Parameters
    ----------
    paths : Path or sequence of Path
        A file or two, in the forms of `read_calibration_file`; or a folder: of EuRoC (`mav0` or
        what holds it), with `left.yaml` and `right.yaml`, or with a single YAML file.
    sensor : {"stereo", "rgbd"}
        What is needed. Of a chain of more cameras the first two are the stereo pair.
    is_rectified : bool
        The images are rectified already, by their names: of a pair with P only that counts. A
        pair without P is taken as the files have it.

    Raises
    ------
    CalibrationError
        When a file is malformed, or they do not describe such a camera.
    """
    files = [file for path in paths_of(paths) for file in _files_of(path)]
    contents = [read_calibration_file(file) for file in files]
    cameras = [camera for content in contents for camera in content.cameras]
    origin = " + ".join(dict.fromkeys(str(file) for file in files))
    if sensor == "stereo":
        return _stereo_set(cameras, origin, is_rectified=is_rectified)
    return _rgbd_set(cameras, contents, origin, is_rectified=is_rectified)


def _stereo_set(
    cameras: Sequence[DescribedCamera], origin: str, *, is_rectified: bool
) -> CameraSet:
    if len(cameras) < 2:
        raise CalibrationError(
            f"{origin}: holds one camera, expected two of a stereo pair: the keys left and right, "
            "cam0 and cam1, or two files"
        )
    left, right = cameras[:2]
    T_left_right, key = _extrinsics(left, right)
    if T_left_right is None:
        pair = (
            make_calibration(left.fields, is_rectified=is_rectified),
            make_calibration(right.fields, is_rectified=is_rectified),
        )
        key = "P"
    else:
        raw = [make_calibration(camera.fields, is_rectified=False) for camera in (left, right)]
        pair = pair_of_extrinsics((raw[0], raw[1]), T_left_right, origin)
    stereo_baseline(pair, origin)
    return CameraSet(
        calibrations=pair,
        origin=origin,
        baseline_from=key,
        T_body_cam=_on_body(left, pair[0]),
    )


def _rgbd_set(
    cameras: Sequence[DescribedCamera],
    contents: Sequence[CalibrationFile],
    origin: str,
    *,
    is_rectified: bool,
) -> CameraSet:
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
        depth_scale=contents[0].depth_scale,
    )


def _files_of(path: Path) -> tuple[Path, ...]:
    """Return the path itself, or the files of a folder."""
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


def _extrinsics(left: DescribedCamera, right: DescribedCamera) -> tuple[FloatArray | None, str]:
    """Return T_left_right of the raw cameras and the key that told it."""
    if right.T_cam_previous is not None:
        return se3.invert(right.T_cam_previous), "T_cn_cnm1"
    if left.T_body_cam is not None and right.T_body_cam is not None:
        return se3.invert(left.T_body_cam) @ right.T_body_cam, "the poses of both on the body"
    return None, ""


def _on_body(raw: DescribedCamera, camera: Calibration) -> FloatArray | None:
    return None if raw.T_body_cam is None else pose_of_rectified(raw.T_body_cam, camera)
