"""Write recordings as folders in the layouts of KITTI odometry, EuRoC and TUM RGB-D."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeAlias

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.convert.common import (
    Conversion,
    LeftOut,
    check_images,
    check_new,
    readable_images,
    true_poses,
)
from gvo.io.convert.folders import EurocFolder, FolderStreams, KittiFolder, TumFolder
from gvo.io.recording import RecordingInfo, Source

Layout: TypeAlias = Literal["kitti", "euroc", "tum"]
_Progress: TypeAlias = Callable[[int], None]


def write_folder(
    source: Source,
    path: str | Path,
    *,
    layout: Layout | None = None,
    rectify: bool = False,
    config: Config | None = None,
    progress: _Progress | None = None,
) -> Conversion:
    """Write a recording as the folder of a data set, its images as PNG without loss.

    Where a recording cannot be read on, what was read is kept, and the reason is in `skipped`.

    Parameters
    ----------
    source, rectify, config, progress
        As of `gvo.io.convert.convert.convert`.
    path : str or Path
        Folder to make.
    layout : {"kitti", "euroc", "tum"}, optional
        `tum` for RGB-D; for stereo `euroc` where the images are raw and stay so, else `kitti`,
        which holds rectified pairs only: unpaired images are left out.

    Returns
    -------
    Conversion

    Raises
    ------
    RecordingError
        When the path exists or cannot be written, the layout does not fit the sensor, the name
        stands for another camera, or no image can be read.

    Notes
    -----
    TUM keeps depth as counts of 16 bits: millimetres or fifths of them come back bit by bit, other
    depth is rounded to 0.2 mm, or to 1 mm where it reaches beyond 13 m.

    EuRoC does not keep R and P: its readers rectify anew, by K, D and the places of the cameras.
    """
    path = Path(path)
    check_new(path)
    layout = _choose(source.info, layout, rectify=rectify)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as parent:
            folder = Path(parent) / path.name
            left_out = LeftOut()
            writer: FolderStreams
            if layout == "kitti":
                writer = KittiFolder(folder, source, left_out, (config or Config()).sync)
            else:
                make = EurocFolder if layout == "euroc" else TumFolder
                writer = make(folder, source, left_out, rectify=rectify)
            n_images, n_poses = _write(writer, source, progress)
            folder.rename(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
    return Conversion(path=path, n_images=n_images, n_poses=n_poses, skipped=left_out.lines())


def _choose(info: RecordingInfo, layout: Layout | None, *, rectify: bool) -> Layout:
    if info.sensor == "rgbd":
        fitting: tuple[Layout, ...] = ("tum",)
    elif info.calibrations[0].is_rectified or rectify:
        fitting = ("kitti", "euroc")
    else:
        fitting = ("euroc", "kitti")
    if layout is None:
        return fitting[0]
    if layout not in fitting:
        raise RecordingError(
            f"{info.name}: a {info.sensor} recording cannot have the layout {layout}, expected "
            f"{' or '.join(fitting)}"
        )
    return layout


def _write(writer: FolderStreams, source: Source, progress: _Progress | None) -> tuple[int, int]:
    """Return the number of images, and of true poses."""
    n_images = [0, 0]
    for image in writer.select(readable_images(source, writer.left_out)):
        n_images[image.stream] += writer.add(image)
        if progress is not None:
            progress(sum(n_images))
    check_images((n_images[0], n_images[1]), source, writer.left_out)
    truth = true_poses(source, writer.left_out)
    n_poses = 0 if truth is None else writer.add_truth(truth)
    writer.close()
    return sum(n_images), n_poses
