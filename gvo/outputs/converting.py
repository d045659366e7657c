"""Write a recording in another form: a bag, or the folder of a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from gvo.errors import RecordingError
from gvo.outputs.bag_writer import convert
from gvo.outputs.conversion import Conversion
from gvo.outputs.folder_writer import Layout, write_folder
from gvo.sources.bag import BagSource
from gvo.sources.recording import Source


def convert_recording(
    source: Source,
    path: str | Path,
    *,
    layout: Literal["bag"] | Layout | None = None,
    rectify: bool = False,
    compress: bool = False,
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
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When the path exists or cannot be written, or the layout does not fit.
    """
    path = Path(path)
    is_folder = (
        not path.suffix and isinstance(source, BagSource) if layout is None else (layout != "bag")
    )
    if not is_folder:
        return convert(source, path, rectify=rectify, compress=compress, progress=progress)
    if compress:
        raise RecordingError(f"{path}: --png is for bags; the images of data sets are PNG anyway")
    chosen: Layout | None = None if layout is None or layout == "bag" else layout
    return write_folder(source, path, layout=chosen, rectify=rectify, progress=progress)
