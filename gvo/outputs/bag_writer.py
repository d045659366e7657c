"""Write recordings as bags of ROS 1 or ROS 2, without loss."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration
from gvo.outputs.bag_messages import (
    BagWriter,
    Header,
    write_camera_info,
    write_image,
    write_truth,
)
from gvo.outputs.compressed_messages import write_compressed, write_compressed_depth
from gvo.outputs.conversion import Conversion, check_new
from gvo.outputs.depth_counts import MILLIMETRES, is_in_counts
from gvo.sources.frames import ImagePreparer, make_preparers
from gvo.sources.recording import Source, StampedImage
from gvo.types import FloatArray

_SUFFIXES = (".bag", ".mcap", ".db3", "")
_Progress: TypeAlias = Callable[[int], None]


def convert(
    source: Source,
    path: str | Path,
    *,
    rectify: bool = False,
    compress: bool = False,
    progress: _Progress | None = None,
) -> Conversion:
    """Write a recording as a bag.

    The frames read back from it are those of the source, bit by bit. A stereo pair becomes
    `/stereo/left/image_rect` and `/stereo/right/image_rect`, or `image_raw` where the source is
    not rectified; an RGB-D camera becomes `/camera/rgb/image_rect_color`, or `image_color`, and
    `/camera/depth/image` in metres (32FC1, NaN = unknown). Each image has a `CameraInfo` of its
    stamp beside it. The ground truth is written to `/tf`: `world` to `ground_truth`, the pose
    of the rectified camera.

    Parameters
    ----------
    source : Source
        The recording.
    path : str or Path
        `.bag`: ROS 1. `.mcap` or `.db3`: a single file of ROS 2. No suffix: a ROS 2 bag folder.
    rectify : bool
        Write raw images rectified and grey, as the frames hold them.
    compress : bool
        Write images as PNG, topics `.../compressed` and, for depth of whole millimetres,
        `.../compressedDepth`; other depth stays as it is.
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When the path exists, has another suffix or cannot be written, or a stamp does not fit.
    """
    path = Path(path)
    _check_target(path)
    plan = _plan(source, rectify=rectify, compress=compress)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as folder:
            with BagWriter(Path(folder) / path.name) as bag:
                conversion = _write(bag, source, plan, path=path, progress=progress)
            bag.result.rename(path)
    except (OSError, WriterError1, WriterError2) as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    return conversion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stream:
    """Where one stream goes."""

    topic: str
    frame_id: str
    calibration: Calibration
    prepare: ImagePreparer | None
    is_compressed: bool

    @property
    def info_topic(self) -> str:
        return f"{self.topic.rpartition('/')[0]}/camera_info"

    def write(self, bag: BagWriter, pixels: NDArray[Any], header: Header) -> None:
        """Write an image, as PNG where that was asked for."""
        if not self.is_compressed:
            write_image(bag, self.topic, pixels, header)
        elif pixels.dtype == np.float32:
            write_compressed_depth(bag, f"{self.topic}/compressedDepth", pixels, header)
        else:
            write_compressed(bag, f"{self.topic}/compressed", pixels, header)


_Plan: TypeAlias = tuple[_Stream, _Stream]


def _check_target(path: Path) -> None:
    check_new(path)
    if path.suffix not in _SUFFIXES:
        raise RecordingError(
            f"{path}: expected a name ending in .bag, .mcap or .db3, or a folder name without "
            f"a suffix, got {path.suffix}"
        )


def _plan(source: Source, *, rectify: bool, compress: bool) -> _Plan:
    info = source.info
    # Depth that is moved to the colour camera is seen by the rectified one.
    is_rectifying = info.depth_view is not None or (
        rectify and not info.calibrations[0].is_rectified
    )
    prepares = make_preparers(info) if is_rectifying else (None, None)
    is_rectified = is_rectifying or info.calibrations[0].is_rectified
    if info.sensor == "rgbd":
        topics = (
            f"/camera/rgb/{'image_rect_color' if is_rectified else 'image_color'}",
            "/camera/depth/image",
        )
        frame_ids = (info.frame_id or "camera_color_optical_frame",) * 2
        raws = info.calibrations * 2
        compressed = (compress, compress and _is_in_millimetres(source))
    else:
        name = "image_rect" if is_rectified else "image_raw"
        topics = (f"/stereo/left/{name}", f"/stereo/right/{name}")
        frame_ids = (info.frame_id or "camera_left_optical", "camera_right_optical")
        raws = info.calibrations
        compressed = (compress, compress)
    calibrations = [_rectified(raw) if is_rectifying else raw for raw in raws]
    first, second = (
        _Stream(
            topic=topic,
            frame_id=frame_id,
            calibration=calibration,
            prepare=prepare,
            is_compressed=is_compressed,
        )
        for topic, frame_id, calibration, prepare, is_compressed in zip(
            topics, frame_ids, calibrations, prepares, compressed, strict=True
        )
    )
    return first, second


def _rectified(raw: Calibration) -> Calibration:
    return Calibration(
        width=raw.width,
        height=raw.height,
        K=raw.P[:, :3].copy(),
        D=np.zeros(5),
        R=np.eye(3),
        P=raw.P,
        is_rectified=True,
    )


def _is_in_millimetres(source: Source) -> bool:
    """Tell whether the first depth image that can be read is of whole millimetres."""
    for image in source.images():
        if image.stream == 1:
            try:
                return is_in_counts(image.load(), MILLIMETRES)
            except RecordingError:
                continue
    return False


def _write(
    bag: BagWriter, source: Source, plan: _Plan, *, path: Path, progress: _Progress | None
) -> Conversion:
    poses = _stamped_poses(source)
    n_poses, n_images, skipped = len(poses), 0, []
    for image in source.images():
        _write_poses(bag, poses, until_ns=image.stamp_ns)
        stream = plan[image.stream]
        try:
            pixels = _pixels(image, stream)
        except RecordingError as error:
            skipped.append(f"{stream.topic} at {image.stamp_ns} ns: {error}")
            continue
        header = Header(image.stamp_ns, stream.frame_id)
        write_camera_info(bag, stream.info_topic, stream.calibration, header)
        stream.write(bag, pixels, header)
        n_images += 1
        if progress is not None:
            progress(n_images)
    _write_poses(bag, poses)
    return Conversion(path=path, n_images=n_images, n_poses=n_poses, skipped=tuple(skipped))


def _stamped_poses(source: Source) -> deque[tuple[int, FloatArray]]:
    truth = source.ground_truth()
    if truth is None:
        return deque()
    return deque(zip(truth.stamps_ns.tolist(), truth.T_world_cam, strict=True))


def _write_poses(
    bag: BagWriter, poses: deque[tuple[int, FloatArray]], until_ns: int | None = None
) -> None:
    """Write, and take away, the poses up to a stamp; all of them without one."""
    while poses and (until_ns is None or poses[0][0] <= until_ns):
        write_truth(bag, *poses.popleft())


def _pixels(image: StampedImage, stream: _Stream) -> NDArray[Any]:
    pixels = image.load()
    return pixels if stream.prepare is None else stream.prepare(pixels)
