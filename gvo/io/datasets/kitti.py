"""Folders of the KITTI odometry benchmark: rectified stereo pairs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.calibration.camera_info import stereo_baseline
from gvo.io.calibration.files import CalibrationPaths, paths_of, read_cameras
from gvo.io.datasets.files import FolderSource, StampedPath, image_size, read_stamped_rows
from gvo.trajectory.formats import read_trajectory
from gvo.trajectory.trajectory import Trajectory

_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


class KittiSource(FolderSource):
    """A sequence folder: `calib.txt`, `times.txt`, `image_0` and `image_1`.

    Where the grey cameras are missing, the colour cameras `image_2` and `image_3` are read. An
    image's number is its row in `times.txt` and in `poses.txt`, so that missing images shift
    nothing.

    Parameters
    ----------
    folder : Path
        Such a folder.
    calibration : Path or sequence of Path, optional
        Files of the pair that replace `calib.txt`, see `read_cameras`.
    config : Config, optional
        Of images with 16 bits; the defaults when left out.

    Raises
    ------
    RecordingError, CalibrationError
        When files are missing or malformed.
    """

    def __init__(
        self, folder: Path, *, calibration: CalibrationPaths = None, config: Config | None = None
    ) -> None:
        self._folder = folder
        times = read_stamped_rows(folder / "times.txt", unit_ns=10**9, n_fields=1)
        self._stamps_ns = [stamp_ns for stamp_ns, _ in times]
        names = _find_pair(folder)
        images = {name: self._list_images(name) for name in names}
        files = paths_of(calibration, folder / "calib.txt")
        cameras = read_cameras(
            files,
            sensor="stereo",
            is_rectified=True,
            image_size=partial(image_size, images[names[0]], config),
            first=int(names[0][-1]),
        )
        P = cameras.calibrations[0].P
        # The centre of the camera in the frame of cam0: P = K [I | -centre].
        self._t_cam0_cam = np.asarray(-np.linalg.solve(P[:, :3], P[:, 3]))
        state = "rectified" if cameras.calibrations[0].is_rectified else "raw"
        decisions = [
            f"calibration: {' + '.join(file.name for file in files)}, {state}",
            f"baseline: {stereo_baseline(cameras.pair, cameras.origin):.4f} m",
        ]
        n_missing = len(self._stamps_ns) - len(images[names[0]])
        if n_missing:
            decisions.append(f"missing: {n_missing} rows of times.txt have no image {names[0]}")
        super().__init__(folder, cameras, images, decisions, config)

    def ground_truth(self) -> Trajectory | None:
        """Return T_world_cam of the left camera; the world is the first grey left camera."""
        official = self._folder.resolve().parents[1] / "poses" / f"{self.info.name}.txt"
        files = filter(Path.is_file, (self._folder / "poses.txt", official))
        return next(map(self._read_truth, files), None)

    def _read_truth(self, path: Path) -> Trajectory:
        T_world_cam0 = read_trajectory(path).T_world_frame
        if len(T_world_cam0) != len(self._stamps_ns):
            raise RecordingError(
                f"{path}: expected {len(self._stamps_ns)} rows as in times.txt, got "
                f"{len(T_world_cam0)}; cut both to the same rows"
            )
        stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
        T_cam0_cam = se3.make_transform(np.eye(3), self._t_cam0_cam)
        is_later = np.concatenate([[True], stamps_ns[1:] > np.maximum.accumulate(stamps_ns)[:-1]])
        return Trajectory(
            stamps_ns=stamps_ns[is_later],
            T_world_frame=(T_world_cam0 @ T_cam0_cam)[is_later],
            stamps_from="times",
        )

    def _list_images(self, name: str) -> list[StampedPath]:
        folder = self._folder / name
        paths = sorted(path for path in folder.iterdir() if path.suffix in _IMAGE_SUFFIXES)
        if not paths:
            raise RecordingError(f"{folder}: holds no .png or .jpg images")
        return [(self._stamp_of(path), str(path)) for path in paths]

    def _stamp_of(self, path: Path) -> int:
        n_rows = len(self._stamps_ns)
        if not path.stem.isascii() or not path.stem.isdigit() or int(path.stem) >= n_rows:
            raise RecordingError(
                f"{path}: expected an image number below {n_rows}, the rows of times.txt"
            )
        return self._stamps_ns[int(path.stem)]


def _find_pair(folder: Path) -> tuple[str, str]:
    for pair in _PAIRS:
        if all((folder / name).is_dir() for name in pair):
            return pair
    raise RecordingError(f"{folder}: expected image_0 and image_1, or image_2 and image_3")
