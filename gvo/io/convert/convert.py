"""Write a recording in another form: a bag, or a folder as of KITTI odometry, EuRoC, TUM RGB-D."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from gvo.config import Config
from gvo.errors import RecordingError, write_faults
from gvo.io.bag.source import BagSource
from gvo.io.convert.bag import BagForm
from gvo.io.convert.folders import EurocForm, KittiForm, TumForm
from gvo.io.convert.plan import Form
from gvo.io.opening import BAG_SUFFIXES
from gvo.io.recording import RecordingInfo, Source
from gvo.io.run_folder.line_file import check_new

Layout: TypeAlias = Literal["bag", "kitti", "euroc", "tum"]

_FORMS: dict[Layout, type[Form]] = {
    "bag": BagForm,
    "kitti": KittiForm,
    "euroc": EurocForm,
    "tum": TumForm,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion wrote.

    Parameters
    ----------
    path : Path
        The new bag or folder.
    n_images : int
        Images written, of both streams.
    n_poses : int
        Poses of the ground truth written.
    skipped : tuple of str
        What was left out and why, a line each: an image, the ground truth, the rest of a
        recording that cannot be read on.
    """

    path: Path
    n_images: int
    n_poses: int
    skipped: tuple[str, ...]


def convert(
    source: Source,
    path: str | Path,
    *,
    layout: Layout | None = None,
    rectify: bool = False,
    compress: bool = False,
    config: Config | None = None,
    progress: Callable[[int], None] | None = None,
) -> Conversion:
    """Write a recording as a bag or as a data-set folder.

    Where a recording cannot be read on, what was read is kept, and the reason is in `skipped`.

    Parameters
    ----------
    source : Source
        The recording.
    path : str or Path
        `.bag`: a bag of ROS 1. `.mcap` or `.db3`: a single file of ROS 2. No suffix: a folder.
    layout : {"bag", "kitti", "euroc", "tum"}, optional
        Of the folder: where omitted, a bag becomes a data-set folder (`tum` for RGB-D; for stereo
        `euroc` where the images are raw and stay so, else `kitti`, which holds rectified pairs
        only) and such a folder a ROS 2 bag.
    rectify : bool
        Write raw images rectified and grey, as the frames hold them.
    compress : bool
        Write the images of a bag as PNG; those of data sets are. Depth becomes PNG where the first
        image is of whole millimetres.
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
        When the path exists or cannot be written, the layout does not fit, a stamp does not fit,
        or no image can be read.

    Notes
    -----
    TUM keeps depth as counts of 16 bits: millimetres or fifths of them come back bit by bit, other
    depth is rounded to 0.2 mm, or to 1 mm where it reaches beyond 13 m.

    EuRoC does not keep R and P: its readers rectify anew, by K, D and the places of the cameras.
    """
    path = Path(path)
    if layout is None and (path.suffix or not isinstance(source, BagSource)):
        layout = "bag"
    _check(path, layout, compress=compress)
    layout = layout if layout == "bag" else _choose(source.info, layout, rectify=rectify)
    sync = (config or Config()).sync
    rectify = rectify or layout == "kitti"
    options: dict[str, Any] = {"rectify": rectify, "compress": compress, "sync": sync}
    n_images = [0, 0]
    with (
        write_faults(RecordingError, path, WriterError1, WriterError2),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as folder,
    ):
        with _FORMS[layout](Path(folder) / path.name, source, **options) as form:
            for image in form.images():
                pixels = form.pixels(image)
                if pixels is None:
                    continue
                form.write(image, pixels)
                n_images[image.stream] += 1
                if progress is not None:
                    progress(sum(n_images))
            if not all(n_images):
                name = source.info.stream_names[n_images.index(0)]
                reason = "; ".join(form.skipped[:1]) or "the recording holds none"
                raise RecordingError(
                    f"{source.info.name}: no {name} image can be written: {reason}"
                )
            form.finish()
        form.path.rename(path)
    return Conversion(path=path, n_images=sum(n_images), n_poses=form.n_poses, skipped=form.skipped)


def _check(path: Path, layout: Layout | None, *, compress: bool) -> None:
    if layout == "bag" and path.suffix not in (*BAG_SUFFIXES, ""):
        raise RecordingError(
            f"{path}: expected a name ending in .bag, .mcap or .db3, or a folder name without "
            f"a suffix, got {path.suffix}; give --layout for the folder of a data set"
        )
    if layout != "bag" and path.suffix in BAG_SUFFIXES:
        raise RecordingError(
            f"{path}: --layout {layout} makes a folder, expected no name of a bag; leave "
            f"{path.suffix} away, or --layout"
        )
    if layout != "bag" and compress:
        raise RecordingError(f"{path}: --png is for bags; the images of data sets are PNG anyway")
    check_new(path)


def _choose(info: RecordingInfo, layout: Layout | None, *, rectify: bool) -> Layout:
    """Return the layout of a folder: the one asked for, else the one that fits best."""
    fitting: tuple[Layout, ...] = ("euroc", "kitti")
    if info.sensor == "rgbd":
        fitting = ("tum",)
    elif info.calibrations[0].is_rectified or rectify:
        fitting = ("kitti", "euroc")
    if layout is None:
        return fitting[0]
    if layout not in fitting:
        raise RecordingError(
            f"{info.name}: a {info.sensor} recording cannot have the layout {layout}, expected "
            f"{' or '.join(fitting)}"
        )
    return layout
