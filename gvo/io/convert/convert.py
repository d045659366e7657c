"""Write a recording in another form: a bag, or a folder as of KITTI odometry, EuRoC, TUM RGB-D."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeAlias

from gvo.config import Config
from gvo.errors import RecordingError, write_faults
from gvo.io.bag.source import BagSource
from gvo.io.convert import common
from gvo.io.convert.bag_writer import write_bag
from gvo.io.convert.folders import EurocFolder, FolderStreams, KittiFolder, TumFolder
from gvo.io.opening import BAG_SUFFIXES
from gvo.io.recording import RecordingInfo, Source

Layout: TypeAlias = Literal["kitti", "euroc", "tum"]
_Progress: TypeAlias = Callable[[int], None]


def convert(
    source: Source,
    path: str | Path,
    *,
    layout: Literal["bag"] | Layout | None = None,
    rectify: bool = False,
    compress: bool = False,
    config: Config | None = None,
    progress: _Progress | None = None,
) -> common.Conversion:
    """Write a recording as a bag or as a data-set folder.

    Parameters
    ----------
    source : Source
        The recording.
    path : str or Path
        With the suffix of a bag, one file; without a suffix, a folder.
    layout : {"bag", "kitti", "euroc", "tum"}, optional
        Of the folder: where omitted, a bag becomes a data-set folder and such a folder a ROS 2
        bag.
    rectify : bool
        Write raw images rectified and grey, as the frames hold them.
    compress : bool
        Write the images of a bag as PNG; those of data sets are.
    config : Config, optional
        Of which `sync` matters, for the pairs of a KITTI folder.
    progress : callable, optional
        Called with the number of images written so far.

    Returns
    -------
    Conversion

    Raises
    ------
    RecordingError
        When the path exists or cannot be written, the layout does not fit, or no image can be
        read.
    """
    path = Path(path)
    if layout is None and (path.suffix or not isinstance(source, BagSource)):
        layout = "bag"
    if layout == "bag":
        return write_bag(source, path, rectify=rectify, compress=compress, progress=progress)
    if path.suffix in BAG_SUFFIXES:
        raise RecordingError(
            f"{path}: --layout {layout} makes a folder, expected no name of a bag; leave "
            f"{path.suffix} away, or --layout"
        )
    if compress:
        raise RecordingError(f"{path}: --png is for bags; the images of data sets are PNG anyway")
    return write_folder(
        source, path, layout=layout, rectify=rectify, config=config, progress=progress
    )


def write_folder(
    source: Source,
    path: str | Path,
    *,
    layout: Layout | None = None,
    rectify: bool = False,
    config: Config | None = None,
    progress: _Progress | None = None,
) -> common.Conversion:
    """Write a recording as the folder of a data set, its images as PNG without loss.

    Where a recording cannot be read on, what was read is kept, and the reason is in `skipped`.

    Parameters
    ----------
    source, rectify, config, progress
        As of `convert`.
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
    common.check_new(path)
    layout = _choose(source.info, layout, rectify=rectify)
    with (
        write_faults(RecordingError, path),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as parent,
    ):
        folder = Path(parent) / path.name
        left_out = common.LeftOut()
        writer: FolderStreams
        if layout == "kitti":
            writer = KittiFolder(folder, source, left_out, (config or Config()).sync)
        else:
            make = EurocFolder if layout == "euroc" else TumFolder
            writer = make(folder, source, left_out, rectify=rectify)
        n_images, n_poses = _write(writer, source, progress)
        folder.rename(path)
    return common.Conversion(
        path=path, n_images=n_images, n_poses=n_poses, skipped=left_out.lines()
    )


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
    for image in writer.select(common.readable_images(source, writer.left_out)):
        n_images[image.stream] += writer.add(image)
        if progress is not None:
            progress(sum(n_images))
    common.check_images((n_images[0], n_images[1]), source, writer.left_out)
    truth = common.true_poses(source, writer.left_out)
    n_poses = 0 if truth is None else writer.add_truth(truth)
    writer.close()
    return sum(n_images), n_poses
