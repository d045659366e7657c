"""Write recordings as folders in the layouts of KITTI odometry, EuRoC and TUM RGB-D."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.outputs.compressed_messages import encode_png
from gvo.outputs.conversion import Conversion, check_new
from gvo.outputs.depth_counts import MAX_COUNT, MILLIMETRES, is_in_counts, to_counts
from gvo.outputs.folder_calibrations import (
    body_poses,
    write_camera_info_yaml,
    write_projections,
    write_sensor_yaml,
)
from gvo.sources.frames import ImagePreparer, make_preparers
from gvo.sources.recording import RecordingInfo, Source, StampedImage
from gvo.sources.sync import pair_images
from gvo.trajectory import Trajectory, format_stamp
from gvo.trajectory_files import write_euroc, write_kitti, write_tum
from gvo.types import DepthArray, FaultyFrame

Layout: TypeAlias = Literal["kitti", "euroc", "tum"]
_Progress: TypeAlias = Callable[[int], None]
_Pixels: TypeAlias = NDArray[Any]

_TUM_SCALE = 5000.0


def write_folder(
    source: Source,
    path: str | Path,
    *,
    layout: Layout | None = None,
    rectify: bool = False,
    progress: _Progress | None = None,
) -> Conversion:
    """Write a recording as the folder of a data set, its images as PNG without loss.

    Parameters
    ----------
    source : Source
        The recording.
    path : str or Path
        Folder to make.
    layout : {"kitti", "euroc", "tum"}, optional
        `tum` for RGB-D; for stereo `euroc` where the images are raw and stay so, else `kitti`,
        which holds rectified pairs only: unpaired images are left out.
    rectify : bool
        Write raw images rectified and grey, as the frames hold them.
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When the path exists or cannot be written, the layout does not fit the sensor, or the
        recording cannot be read on.

    Notes
    -----
    TUM keeps depth as counts of 16 bits: millimetres or fifths of them come back bit by bit, other
    depth is rounded to 0.2 mm, or to 1 mm where it reaches beyond 13 m.
    """
    path = Path(path)
    check_new(path)
    layout = _choose(source.info, layout, rectify=rectify)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as parent:
            folder = Path(parent) / path.name
            writer = _WRITERS[layout](folder, source.info, rectify)
            n_images = 0
            for image in writer.select(source.images()):
                n_images += writer.add(image)
                if progress is not None:
                    progress(n_images)
            truth = source.ground_truth()
            n_poses = 0 if truth is None else writer.add_truth(truth)
            writer.close()
            folder.rename(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
    return Conversion(path=path, n_images=n_images, n_poses=n_poses, skipped=tuple(writer.skipped))


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


class _Writer(Protocol):
    """Writes the images of one layout."""

    skipped: list[str]

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Leave out what the layout cannot hold."""
        ...

    def add(self, image: StampedImage) -> int:
        """Write an image and return 1, or note why not and return 0."""
        ...

    def add_truth(self, truth: Trajectory) -> int:
        """Write T_world_cam, and return the number of poses."""
        ...

    def close(self) -> None:
        """Write what is known at the end."""
        ...


class _Streams:
    """What the layouts share: preparing images, noting what is left out."""

    def __init__(self, info: RecordingInfo, *, rectify: bool) -> None:
        self.info = info
        self.skipped: list[str] = []
        self.is_rectifying = rectify and not info.calibrations[0].is_rectified
        self._preparers: tuple[ImagePreparer, ...] = ()
        if self.is_rectifying:
            self._preparers = make_preparers(info)

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Take all images with a stamp of their own."""
        last_ns: list[int | None] = [None, None]
        for image in images:
            before_ns = last_ns[image.stream]
            if before_ns is not None and image.stamp_ns <= before_ns:
                self.skip(image, f"the stamp does not advance from {before_ns} ns")
                continue
            last_ns[image.stream] = image.stamp_ns
            yield image

    def load(self, image: StampedImage) -> _Pixels | None:
        """Return the pixels to write; None, with a note, where they cannot be read."""
        try:
            pixels = image.load()
            return self._preparers[image.stream](pixels) if self._preparers else pixels
        except RecordingError as error:
            self.skip(image, str(error))
            return None

    def skip(self, image: StampedImage, reason: str) -> None:
        """Note an image that is left out."""
        names = ("left", "right") if self.info.sensor == "stereo" else ("colour", "depth")
        self.skipped.append(f"{names[image.stream]} image at {image.stamp_ns} ns: {reason}")


class _Kitti(_Streams):
    """Rectified pairs by number: `image_0` and `image_1`, in colour `image_2` and `image_3`."""

    def __init__(self, folder: Path, info: RecordingInfo, rectify: bool) -> None:
        super().__init__(info, rectify=True)
        self._folder = folder
        self._stamps_ns: list[int] = []
        self._names: tuple[str, str] | None = None
        folder.mkdir()

    def select(self, images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        """Take the pairs of equal stamps, left before right."""
        for item in pair_images(images, limit_ns=0, partner="right image of the same stamp"):
            if isinstance(item, FaultyFrame):
                self.skipped.append(f"left image at {item.stamp_ns} ns: {item.reason}")
            else:
                yield from item

    def add(self, image: StampedImage) -> int:
        if image.stream == 0:
            self._stamps_ns.append(image.stamp_ns)
        pixels = self.load(image)
        if pixels is None:
            return 0
        if self._names is None:
            is_color = pixels.ndim == 3
            self._names = ("image_2", "image_3") if is_color else ("image_0", "image_1")
            for name in self._names:
                (self._folder / name).mkdir()
        number = len(self._stamps_ns) - 1
        path = self._folder / self._names[image.stream] / f"{number:06d}.png"
        path.write_bytes(encode_png(pixels))
        return 1

    def add_truth(self, truth: Trajectory) -> int:
        """Write a pose for each pair, where there is one for all of them."""
        at_frames = truth.interpolate(np.array(self._stamps_ns, dtype=np.int64))
        if len(at_frames) < len(self._stamps_ns):
            self.skipped.append(
                f"poses.txt: {len(at_frames)} of {len(self._stamps_ns)} pairs lie between true "
                "poses, all are needed"
            )
            return 0
        write_kitti(self._folder / "poses.txt", at_frames)
        return len(at_frames)

    def close(self) -> None:
        lines = [f"{format_stamp(stamp_ns)}\n" for stamp_ns in self._stamps_ns]
        (self._folder / "times.txt").write_text("".join(lines), encoding="utf-8")
        names = self._names or ("image_0", "image_1")
        write_projections(self._folder / "calib.txt", names, self.info.calibrations)


class _Euroc(_Streams):
    """Pairs by stamp, raw or rectified, with the calibration of each camera."""

    def __init__(self, folder: Path, info: RecordingInfo, rectify: bool) -> None:
        super().__init__(info, rectify=rectify)
        self._root = folder / "mav0"
        self._tables: tuple[list[str], list[str]] = ([], [])
        for name in ("cam0", "cam1"):
            (self._root / name / "data").mkdir(parents=True)

    def add(self, image: StampedImage) -> int:
        pixels = self.load(image)
        if pixels is None:
            return 0
        name = f"{image.stamp_ns}.png"
        (self._root / f"cam{image.stream}" / "data" / name).write_bytes(encode_png(pixels))
        self._tables[image.stream].append(f"{image.stamp_ns},{name}\n")
        return 1

    def add_truth(self, truth: Trajectory) -> int:
        folder = self._root / "state_groundtruth_estimate0"
        folder.mkdir()
        write_euroc(folder / "data.csv", body_poses(truth, self.info))
        return len(truth)

    def close(self) -> None:
        for stream, rows in enumerate(self._tables):
            camera = self._root / f"cam{stream}"
            text = "#timestamp [ns],filename\n" + "".join(rows)
            (camera / "data.csv").write_text(text, encoding="utf-8")
            write_sensor_yaml(
                camera / "sensor.yaml", self.info, stream, is_rectified=self.is_rectifying
            )


class _Tum(_Streams):
    """Colour and depth by stamp, with `calibration.yaml`."""

    def __init__(self, folder: Path, info: RecordingInfo, rectify: bool) -> None:
        # Depth that is moved to the colour camera is that of the rectified one.
        super().__init__(info, rectify=rectify or info.depth_view is not None)
        self._folder = folder
        self._tables: tuple[list[str], list[str]] = ([], [])
        self._scale: float | None = None
        self._n_cut = 0
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)

    def add(self, image: StampedImage) -> int:
        pixels = self.load(image)
        if pixels is None:
            return 0
        name = f"{('rgb', 'depth')[image.stream]}/{format_stamp(image.stamp_ns)}.png"
        if image.stream == 1:
            if self._scale is None:
                self._scale = _choose_scale(pixels)
            pixels, n_cut = to_counts(pixels, self._scale)
            self._n_cut += n_cut
        (self._folder / name).write_bytes(encode_png(pixels))
        self._tables[image.stream].append(f"{format_stamp(image.stamp_ns)} {name}\n")
        return 1

    def add_truth(self, truth: Trajectory) -> int:
        write_tum(self._folder / "groundtruth.txt", truth)
        return len(truth)

    def close(self) -> None:
        scale = self._scale or _TUM_SCALE
        for name, rows in zip(("rgb", "depth"), self._tables, strict=True):
            text = f"# {name} images\n# stamp filename\n" + "".join(rows)
            (self._folder / f"{name}.txt").write_text(text, encoding="utf-8")
        write_camera_info_yaml(
            self._folder / "calibration.yaml",
            self.info.calibrations[0],
            is_rectified=self.is_rectifying,
            depth_scale=scale,
        )
        if self._n_cut:
            self.skipped.append(
                f"depth: {self._n_cut} pixels beyond {MAX_COUNT / scale:.1f} m became unknown"
            )


_WRITERS: dict[Layout, Callable[[Path, RecordingInfo, bool], _Writer]] = {
    "kitti": _Kitti,
    "euroc": _Euroc,
    "tum": _Tum,
}


def _choose_scale(depth: DepthArray) -> float:
    """Return counts per metre: those that the depth was made of, where it shows them."""
    for scale in (MILLIMETRES, _TUM_SCALE):
        if is_in_counts(depth, scale):
            return scale
    # Half as far again as the first image shows must fit.
    farthest = 1.5 * float(np.nanmax(depth, initial=0.0))
    return _TUM_SCALE if _TUM_SCALE * farthest < MAX_COUNT else MILLIMETRES
