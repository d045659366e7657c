"""Folders in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gvo.config import Config
from gvo.errors import CalibrationError, RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.calibration.files import CalibrationPaths, CameraSet, ImageSize, paths_of, read_cameras
from gvo.io.datasets.files import FolderSource, StampedPath, image_size, read_stamped_rows
from gvo.io.images import MILLIMETRES, read_depth
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory

DEFAULT_SCALE = 5000.0
"""Counts per metre of the benchmark's depth images."""

_PLAUSIBLE_MEDIAN_M = (0.5, 10.0)

# fx, fy, cx, cy and distortion k1, k2, p1, p2, k3 of the benchmark's three colour cameras, as
# published with it (J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
# 2012, doi:10.1109/IROS.2012.6385773); the images of the third are undistorted.
_CAMERAS = {
    "1": (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": ((535.433105, 539.212524, 320.106653, 247.632132), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
_CAMERA_NAME = re.compile(r"(?<![a-z])(?:freiburg|fr)([123])(?![a-z0-9])")


class TumSource(FolderSource):
    """A folder with `rgb.txt` and `depth.txt`.

    The calibration is, first found: the file given, `calibration.yaml` in the folder, the published
    one of the camera that the folder's name tells (freiburg1 or fr1, and so on).

    Parameters
    ----------
    folder : Path
        Such a folder.
    calibration : Path or sequence of Path, optional
        File of the colour camera, see `read_cameras`.
    config : Config, optional
        Of images with 16 bits, and the counts per metre of depth; otherwise those of the
        calibration file; otherwise 5000 as TUM has it, or 1000 where the first depth image only
        makes sense in millimetres.

    Raises
    ------
    RecordingError, CalibrationError
        When files are missing or malformed, or no calibration is known.
    """

    def __init__(
        self, folder: Path, *, calibration: CalibrationPaths = None, config: Config | None = None
    ) -> None:
        self._folder = folder
        images = {name: _list_images(folder / f"{name}.txt") for name in ("rgb", "depth")}
        size = partial(image_size, images["rgb"], config)
        cameras = _find_calibration(folder, paths_of(calibration), size)
        configured = (config or Config()).depth.scale
        if configured is not None:
            scale, reason = configured, "by depth.scale"
        elif cameras.depth_scale is not None:
            scale, reason = cameras.depth_scale, "by the calibration"
        else:
            scale, reason = _assume_scale(path for _, path in images["depth"])
        depth = f"depth: {scale:g} counts per metre, {reason}"
        decisions = [f"calibration: {cameras.origin}", depth]
        load_depth = partial(read_depth, scale=scale)
        super().__init__(folder, cameras, images, decisions, config, load_second=load_depth)

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the colour camera."""
        path = self._folder / "groundtruth.txt"
        return read_trajectory(path) if path.is_file() else None


def _list_images(table: Path) -> list[StampedPath]:
    rows = read_stamped_rows(table, unit_ns=10**9)
    return [(stamp_ns, str(table.parent / name)) for stamp_ns, name in rows]


def _find_calibration(folder: Path, explicit: tuple[Path, ...], size: ImageSize) -> CameraSet:
    beside = folder / "calibration.yaml"
    paths = explicit or ((beside,) if beside.is_file() else ())
    if paths:
        cameras = read_cameras(paths, sensor="rgbd", is_rectified=False, image_size=size)
        return replace(cameras, origin=" + ".join(path.name for path in paths))
    named = _CAMERA_NAME.search(folder.resolve().name.lower())
    if named is None:
        raise CalibrationError(
            f"{folder}: no calibration is known: the name holds none of freiburg1, freiburg2, "
            "freiburg3; add calibration.yaml or give --calibration FILE"
        )
    camera = _published_camera(*_CAMERAS[named[1]])
    origin = f"published for freiburg{named[1]}, by the name of the folder"
    return CameraSet(calibrations=(camera,), origin=origin, depth_scale=DEFAULT_SCALE)


def _published_camera(
    intrinsics: tuple[float, float, float, float], distortion: Sequence[float]
) -> Calibration:
    fx, fy, cx, cy = intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Calibration(
        width=640,
        height=480,
        K=K,
        D=np.array(distortion),
        R=np.eye(3),
        P=np.hstack([K, np.zeros((3, 1))]),
        is_rectified=False,
    )


def _assume_scale(paths: Iterable[str]) -> tuple[float, str]:
    """Choose between the two scales in use by the first depth image that can be read.

    Millimetres where the scene would otherwise be nearer than such a camera can see.
    """
    for path in map(Path, paths):
        try:
            depth = read_depth(path, DEFAULT_SCALE)
        except RecordingError:
            continue  # it becomes a faulty frame later
        if not np.any(np.isfinite(depth)):
            continue
        median = float(np.nanmedian(depth))
        if _is_plausible(median):
            break
        if _is_plausible(median * DEFAULT_SCALE / MILLIMETRES):
            reason = (
                f"because the median of {path.name} would be {median:.2f} m at TUM's "
                f"{DEFAULT_SCALE:g} (--set depth.scale={DEFAULT_SCALE:g} if that is right)"
            )
            return MILLIMETRES, reason
        reason = (
            f"the default of TUM folders, at which the median of {path.name} is an implausible "
            f"{median:.2f} m (--set depth.scale=... changes it)"
        )
        return DEFAULT_SCALE, reason
    return DEFAULT_SCALE, "the default of TUM folders"


def _is_plausible(median_m: float) -> bool:
    return _PLAUSIBLE_MEDIAN_M[0] <= median_m <= _PLAUSIBLE_MEDIAN_M[1]
