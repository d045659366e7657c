"""Folders in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from gvo.errors import CalibrationError, RecordingError
from gvo.geometry.camera import Calibration
from gvo.sources.calibration import CameraFields, make_calibration, read_mono_file
from gvo.sources.folders import StampedPath, merge_streams
from gvo.sources.pixels import read_depth
from gvo.sources.recording import RecordingInfo, StampedImage
from gvo.sources.tables import parse_seconds, read_rows
from gvo.trajectory import Trajectory
from gvo.trajectory_files import read_trajectory

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


class TumSource:
    """A folder with `rgb.txt` and `depth.txt`.

    The calibration is, first found: the file given, `calibration.yaml` in the folder, the
    published one of the camera that the folder's name tells (freiburg1 or fr1, and so on).

    Parameters
    ----------
    folder : Path
        Such a folder.
    calibration : Path, optional
        YAML of the colour camera.
    depth_scale : float, optional
        Counts per metre; otherwise that of the calibration file, or 5000.

    Raises
    ------
    RecordingError, CalibrationError
        When files are missing or malformed, or no calibration is known.
    """

    def __init__(
        self, folder: Path, *, calibration: Path | None = None, depth_scale: float | None = None
    ) -> None:
        self._folder = folder
        self._color = _list_images(folder / "rgb.txt")
        self._depth = _list_images(folder / "depth.txt")
        camera, from_file, origin = _find_calibration(folder, calibration)
        self._scale = depth_scale or from_file or DEFAULT_SCALE
        decisions = [
            f"rgbd: rgb + depth ({len(self._color)} + {len(self._depth)} images)",
            f"calibration: {origin}",
        ]
        if depth_scale is not None:
            origin_of_scale = "depth.scale"
        else:
            origin_of_scale = "the calibration file" if from_file else "the default of TUM folders"
        decisions.append(f"depth: {self._scale:g} counts per metre, by {origin_of_scale}")
        if depth_scale is None and from_file is None:
            decisions += _doubt_scale([path for _, path in self._depth], self._scale)
        self._info = RecordingInfo(
            name=folder.resolve().name,
            sensor="rgbd",
            calibrations=(camera,),
            n_images=len(self._color),
            decisions=decisions,
        )

    @property
    def info(self) -> RecordingInfo:
        """What is known before the first image."""
        return self._info

    def images(self) -> Iterator[StampedImage]:
        """Yield colour and depth images by stamp."""
        return merge_streams(self._color, self._depth, partial(read_depth, scale=self._scale))

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the colour camera.

        Raises
        ------
        TrajectoryError
            When the file is malformed.
        """
        path = self._folder / "groundtruth.txt"
        return read_trajectory(path) if path.is_file() else None


def _list_images(table: Path) -> list[StampedPath]:
    return [
        (parse_seconds(fields[0], f"{table}, line {number}"), table.parent / fields[1])
        for number, fields in read_rows(table, n_fields=2)
    ]


def _find_calibration(folder: Path, explicit: Path | None) -> tuple[Calibration, float | None, str]:
    """Return the camera, the depth scale of its file, and where it comes from."""
    path = explicit or folder / "calibration.yaml"
    if explicit is not None or path.is_file():
        fields, scale = read_mono_file(path)
        return make_calibration(fields, is_rectified=False), scale, path.name
    name = folder.resolve().name.lower()
    for number, (intrinsics, distortion) in _CAMERAS.items():
        if f"freiburg{number}" in name or f"fr{number}" in name:
            camera = _published_camera(intrinsics, distortion)
            return camera, None, f"freiburg{number}, by the name of the folder"
    raise CalibrationError(
        f"{folder}: no calibration is known: the name holds none of freiburg1, freiburg2, "
        "freiburg3; add calibration.yaml or give --calibration FILE"
    )


def _published_camera(
    intrinsics: tuple[float, float, float, float], distortion: Sequence[float]
) -> Calibration:
    fx, fy, cx, cy = intrinsics
    fields = CameraFields(
        where="published calibration",
        width=640,
        height=480,
        model="plumb_bob",
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        D=distortion,
        R=np.zeros(9),
        P=np.zeros(12),
    )
    return make_calibration(fields, is_rectified=False)


def _doubt_scale(paths: Sequence[Path], scale: float) -> list[str]:
    """Return a line of advice where the first depth image makes no sense at this scale."""
    for path in paths:
        try:
            depth = read_depth(path, scale)
        except RecordingError:
            continue  # it becomes a faulty frame later
        if not np.any(np.isfinite(depth)):
            continue
        median = float(np.nanmedian(depth))
        if _PLAUSIBLE_MEDIAN_M[0] <= median <= _PLAUSIBLE_MEDIAN_M[1]:
            return []
        other = 1000 if median < _PLAUSIBLE_MEDIAN_M[0] else 5000
        return [
            f"depth: a median of {median:.2f} m in {path.name} is implausible; if its counts are "
            f"per 1/{other} m, use --set depth.scale={other}"
        ]
    return []
