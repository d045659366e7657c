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
from gvo.sources.frames import ImagePreparer
from gvo.sources.recording import Source, StampedImage
from gvo.types import FloatArray

_SUFFIXES = (".bag", ".mcap", ".db3", "")
_Progress: TypeAlias = Callable[[int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion wrote.

    Parameters
    ----------
    path : Path
        The new bag.
    n_images : int
        Images written, of both streams.
    n_poses : int
        Poses of the ground truth written.
    skipped : tuple of str
        One line for each image that could not be read and was left out.
    """

    path: Path
    n_images: int
    n_poses: int
    skipped: tuple[str, ...]


def convert(
    source: Source, path: str | Path, *, rectify: bool = False, progress: _Progress | None = None
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
    progress : callable, optional
        Called with the number of images written so far.

    Raises
    ------
    RecordingError
        When the path exists, has another suffix or cannot be written, or a stamp does not fit.
    """
    path = Path(path)
    _check_target(path)
    plan = _plan(source, rectify=rectify)
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

    @property
    def info_topic(self) -> str:
        return f"{self.topic.rpartition('/')[0]}/camera_info"


_Plan: TypeAlias = tuple[_Stream, _Stream]


def _check_target(path: Path) -> None:
    if path.exists():
        raise RecordingError(f"{path}: exists already; give another path or remove it")
    if path.suffix not in _SUFFIXES:
        raise RecordingError(
            f"{path}: expected a name ending in .bag, .mcap or .db3, or a folder name without "
            f"a suffix, got {path.suffix}"
        )
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: cannot be written: {path.parent} is no folder")


def _plan(source: Source, *, rectify: bool) -> _Plan:
    info = source.info
    if info.sensor == "rgbd":
        (color,) = info.calibrations
        is_rectified = color.is_rectified or rectify
        name = "image_rect_color" if is_rectified else "image_color"
        frame_id = "camera_color_optical_frame"
        return (
            _stream(f"/camera/rgb/{name}", frame_id, color, rectify=rectify),
            _stream("/camera/depth/image", frame_id, color, rectify=rectify, is_depth=True),
        )
    left, right = info.calibrations
    name = "image_rect" if left.is_rectified or rectify else "image_raw"
    return (
        _stream(f"/stereo/left/{name}", "camera_left_optical", left, rectify=rectify),
        _stream(f"/stereo/right/{name}", "camera_right_optical", right, rectify=rectify),
    )


def _stream(
    topic: str, frame_id: str, raw: Calibration, *, rectify: bool, is_depth: bool = False
) -> _Stream:
    if raw.is_rectified or not rectify:
        return _Stream(topic=topic, frame_id=frame_id, calibration=raw, prepare=None)
    rectified = Calibration(
        width=raw.width,
        height=raw.height,
        K=raw.P[:, :3].copy(),
        D=np.zeros(5),
        R=np.eye(3),
        P=raw.P,
        is_rectified=True,
    )
    prepare = ImagePreparer(raw, is_depth=is_depth)
    return _Stream(topic=topic, frame_id=frame_id, calibration=rectified, prepare=prepare)


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
        write_image(bag, stream.topic, pixels, header)
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
