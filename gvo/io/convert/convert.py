"""Write a recording in another form: a bag, or the folder of a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.bag.source import BagSource
from gvo.io.convert.bag_writer import write_bag
from gvo.io.convert.common import Conversion
from gvo.io.convert.folder_writer import Layout, write_folder
from gvo.io.opening import BAG_SUFFIXES
from gvo.io.recording import Source


def convert(
    source: Source,
    path: str | Path,
    *,
    layout: Literal["bag"] | Layout | None = None,
    rectify: bool = False,
    compress: bool = False,
    config: Config | None = None,
    progress: Callable[[int], None] | None = None,
) -> Conversion:
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
