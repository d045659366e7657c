"""Recordings as folders in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvo.errors import RecordingError
from gvo.outputs.conversion import LeftOut, ideal_calibration
from gvo.outputs.depth_counts import MAX_COUNT, is_in_counts, to_counts
from gvo.outputs.folder_calibrations import write_camera_info_yaml
from gvo.outputs.folder_streams import FolderStreams
from gvo.outputs.image_files import encode_png
from gvo.sources.pixels import MILLIMETRES
from gvo.sources.recording import Source, StampedImage
from gvo.sources.tum import DEFAULT_SCALE, published_calibration
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory, format_stamp
from gvo.types import DepthArray

_SCALES = (MILLIMETRES, DEFAULT_SCALE)
# Half as far again as the first image shows must fit.
_RESERVE = 1.5


class TumFolder(FolderStreams):
    """Colour and depth by stamp, with `calibration.yaml`.

    Parameters
    ----------
    folder : Path
        To be made.
    source : Source
        An RGB-D recording.
    left_out : LeftOut
        Gets what cannot be written.
    rectify : bool
        Write raw images rectified and grey, as it must be where depth is moved to colour.

    Raises
    ------
    RecordingError
        When the name of the folder stands for another camera.
    """

    def __init__(self, folder: Path, source: Source, left_out: LeftOut, *, rectify: bool) -> None:
        rectify = rectify or source.info.depth_view is not None
        super().__init__(source, left_out, rectify=rectify)
        self._folder = folder
        self._tables: tuple[list[str], list[str]] = ([], [])
        calibration = self.info.calibrations[0]
        is_ideal = self.is_rectifying or calibration.is_rectified
        self._calibration = ideal_calibration(calibration) if is_ideal else calibration
        self._scale = self._scale_by_name()
        self._n_cut = 0
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)

    def add(self, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read."""
        pixels = self.load(image)
        if pixels is None:
            return False
        name = f"{('rgb', 'depth')[image.stream]}/{format_stamp(image.stamp_ns)}.png"
        if image.stream == 1:
            if self._scale is None:
                self._scale = _choose_scale(pixels)
            pixels, n_cut = to_counts(pixels, self._scale or DEFAULT_SCALE)
            self._n_cut += n_cut
        (self._folder / name).write_bytes(encode_png(pixels))
        self._tables[image.stream].append(f"{format_stamp(image.stamp_ns)} {name}\n")
        return True

    def add_truth(self, truth: Trajectory) -> int:
        """Write the poses as they are."""
        write_tum(self._folder / "groundtruth.txt", truth)
        return len(truth)

    def close(self) -> None:
        """Write the tables of images and the calibration."""
        scale = self._scale or DEFAULT_SCALE
        for name, rows in zip(("rgb", "depth"), self._tables, strict=True):
            text = f"# {name} images\n# stamp filename\n" + "".join(rows)
            (self._folder / f"{name}.txt").write_text(text, encoding="utf-8")
        path = self._folder / "calibration.yaml"
        write_camera_info_yaml(path, self._calibration, depth_scale=scale)
        if self._n_cut:
            self.left_out.add(
                f"depth: {self._n_cut} pixels beyond {MAX_COUNT / scale:.1f} m became unknown"
            )

    def _scale_by_name(self) -> float | None:
        """Return the scale that the folder's name stands for; None where it stands for none."""
        published = published_calibration(self._folder.name)
        if published is None:
            return None
        mine = self._calibration
        if any(not np.array_equal(getattr(published, name), getattr(mine, name)) for name in "KDP"):
            raise RecordingError(
                f"{self._folder.name}: a TUM folder of this name is read with the published "
                "calibration of freiburg1, 2 or 3, which is not that of the recording; give "
                "another name"
            )
        return DEFAULT_SCALE


def _choose_scale(depth: DepthArray) -> float | None:
    """Return counts per metre: those that the depth was made of, where it shows them."""
    if not np.any(np.isfinite(depth)):
        return None
    for scale in _SCALES:
        if is_in_counts(depth, scale):
            return scale
    farthest = _RESERVE * float(np.nanmax(depth))
    return DEFAULT_SCALE if DEFAULT_SCALE * farthest < MAX_COUNT else MILLIMETRES
