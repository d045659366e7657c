"""Write recordings as bags."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from gvo.errors import RecordingError, write_faults
from gvo.geometry.camera import Calibration
from gvo.io.convert import bag_messages, common
from gvo.io.convert.bag_messages import BagWriter, FramePose, Header
from gvo.io.frames import ImagePreparer
from gvo.io.images import MILLIMETRES, exact_counts
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.types import FloatArray

_SUFFIXES = (".bag", ".mcap", ".db3", "")
_Progress: TypeAlias = Callable[[int], None]
BagStreams: TypeAlias = tuple["BagStream", "BagStream"]


def write_bag(
    source: Source,
    path: str | Path,
    *,
    rectify: bool = False,
    compress: bool = False,
    progress: _Progress | None = None,
) -> common.Conversion:
    """Write a recording as a bag.

    The frames read back from it are those of the source, bit by bit. A stereo pair becomes
    `/stereo/left/image_rect` and `/stereo/right/image_rect`, or `image_raw` where the source is
    not rectified; an RGB-D camera becomes `/camera/rgb/image_rect_color`, or `image_color`, and
    `/camera/depth/image` in metres (32FC1, NaN = unknown). Each image has a `CameraInfo` of its
    stamp beside it. The ground truth is written to `/tf`: `world` to `ground_truth`, the pose
    of the rectified camera. `/tf_static` holds the right camera in the left one, and both in
    `body` where the recording says where they sit there; the frames are those of the rectified
    cameras, also beside raw images. Where a recording cannot be read on, what was read is kept,
    and the reason is in `skipped`.

    Parameters
    ----------
    source, rectify, progress
        As of `gvo.io.convert.convert.convert`.
    path : str or Path
        `.bag`: ROS 1. `.mcap` or `.db3`: a single file of ROS 2. No suffix: a ROS 2 bag folder.
    compress : bool
        Write images as PNG, topics `.../compressed`; and depth, where the first image is of
        whole millimetres, as `.../compressedDepth`. Other depth stays as it is.

    Returns
    -------
    Conversion

    Raises
    ------
    RecordingError
        When the path exists, has another suffix or cannot be written, a stamp does not fit, or
        no image can be read.
    """
    path = Path(path)
    common.check_new(path)
    if path.suffix not in _SUFFIXES:
        raise RecordingError(
            f"{path}: expected a name ending in .bag, .mcap or .db3, or a folder name without "
            f"a suffix, got {path.suffix}; give --layout for the folder of a data set"
        )
    writer = _Writer(source, plan_streams(source, rectify=rectify, compress=compress))
    with (
        write_faults(RecordingError, path, WriterError1, WriterError2),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as folder,
    ):
        with BagWriter(Path(folder) / path.name, keeps_order=True) as bag:
            writer.write(bag, progress)
        bag.result.rename(path)
    return common.Conversion(
        path=path,
        n_images=sum(writer.n_images),
        n_poses=writer.n_poses,
        skipped=writer.left_out.lines(),
    )


class _Writer:
    """Writes images and poses in the order of their stamps."""

    def __init__(self, source: Source, streams: BagStreams) -> None:
        self._source, self._streams = source, streams
        self.left_out = common.LeftOut()
        truth = common.true_poses(source, self.left_out)
        self._poses: deque[tuple[int, FloatArray]] = deque()
        if truth is not None:
            self._poses.extend(zip(truth.stamps_ns.tolist(), truth.T_world_frame, strict=True))
        self.n_images = [0, 0]
        self.n_poses = len(self._poses)

    def write(self, bag: BagWriter, progress: _Progress | None) -> None:
        is_first = True
        for image in common.readable_images(self._source, self.left_out):
            if is_first:
                self._write_static(bag, image.stamp_ns)
                is_first = False
            self._write_poses(bag, until_ns=image.stamp_ns)
            self.n_images[image.stream] += self._write_image(bag, image)
            if progress is not None:
                progress(sum(self.n_images))
        common.check_images((self.n_images[0], self.n_images[1]), self._source, self.left_out)
        self._write_poses(bag)

    def _write_static(self, bag: BagWriter, stamp_ns: int) -> None:
        # Whoever plays the bag knows the cameras before the first image or pose comes.
        stamp_ns = min([stamp_ns, *(first_ns for first_ns, _ in list(self._poses)[:1])])
        first, second = self._streams
        poses = static_poses(self._source, (first.frame_id, second.frame_id), stamp_ns)
        bag_messages.write_transforms(bag, "/tf_static", poses, is_latched=True)

    def _write_poses(self, bag: BagWriter, until_ns: int | None = None) -> None:
        """Write, and take away, the poses up to a stamp; all of them without one."""
        while self._poses and (until_ns is None or self._poses[0][0] <= until_ns):
            bag_messages.write_truth(bag, *self._poses.popleft())

    def _write_image(self, bag: BagWriter, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read."""
        stream = self._streams[image.stream]
        pixels = common.load_image(image, stream.prepare, stream.topic, self.left_out)
        if pixels is None:
            return False
        header = Header(image.stamp_ns, stream.frame_id)
        bag_messages.write_camera_info(bag, stream.info_topic, stream.calibration, header)
        stream.write(bag, pixels, header)
        return True


@dataclass(frozen=True, slots=True, eq=False)
class BagStream:
    """Where one stream goes.

    Parameters
    ----------
    topic : str
        Of its images, without the suffix of a transport.
    frame_id : str
        Of images and `CameraInfo`: the optical frame of the rectified camera.
    calibration : Calibration
        Of the images as they are written.
    prepare : ImagePreparer, optional
        What makes them of those of the recording.
    is_compressed : bool
        Written as PNG.
    """

    topic: str
    frame_id: str
    calibration: Calibration
    prepare: ImagePreparer | None
    is_compressed: bool

    @property
    def info_topic(self) -> str:
        """Of its `CameraInfo`."""
        return f"{self.topic.rpartition('/')[0]}/camera_info"

    def write(self, bag: BagWriter, pixels: NDArray[Any], header: Header) -> None:
        """Write an image, as PNG where that was asked for."""
        if not self.is_compressed:
            bag_messages.write_image(bag, self.topic, pixels, header)
        elif pixels.dtype == np.float32:
            bag_messages.write_compressed_depth(
                bag, f"{self.topic}/compressedDepth", pixels, header
            )
        else:
            bag_messages.write_compressed(bag, f"{self.topic}/compressed", pixels, header)


def plan_streams(source: Source, *, rectify: bool, compress: bool) -> BagStreams:
    """Decide where the streams of a recording go.

    Parameters
    ----------
    source : Source
        The recording; of depth the first image is read where it is to be compressed.
    rectify : bool
        Write raw images rectified and grey.
    compress : bool
        Write images as PNG; depth only where it is in whole millimetres.
    """
    info = source.info
    calibrations, preparers = common.plan_images(info, rectify=rectify)
    is_rectified, is_compressed = calibrations[0].is_rectified, (compress, compress)
    if info.sensor == "rgbd":
        name = "image_rect_color" if is_rectified else "image_color"
        topics = (f"/camera/rgb/{name}", "/camera/depth/image")
        calibrations *= 2
        is_compressed = (compress, compress and _is_in_millimetres(source))
    else:
        name = "image_rect" if is_rectified else "image_raw"
        topics = (f"/stereo/left/{name}", f"/stereo/right/{name}")
    first, second = map(BagStream, topics, _frame_ids(info), calibrations, preparers, is_compressed)
    return first, second


def _frame_ids(info: RecordingInfo) -> tuple[str, str]:
    if info.sensor == "rgbd":
        return (info.frame_id or "camera_color_optical_frame",) * 2
    left, right = info.frame_id or "camera_left_optical", "camera_right_optical"
    return left, right if left != right else f"{left}_right"


def _is_in_millimetres(source: Source) -> bool:
    """Tell whether the first depth image that can be read is of whole millimetres."""
    for image in common.readable_images(source, common.LeftOut()):
        if image.stream == 1:
            try:
                return exact_counts(image.load(), MILLIMETRES) is not None
            except RecordingError:
                continue
    return False


def static_poses(source: Source, frame_ids: tuple[str, str], stamp_ns: int) -> Iterator[FramePose]:
    """Yield how the cameras sit on the body and beside each other.

    Parameters
    ----------
    source : Source
        The recording.
    frame_ids : tuple of two str
        Of both streams: the optical frames of the rectified cameras.
    stamp_ns : int
        Nanoseconds.

    Yields
    ------
    FramePose
        T_body_cam where the recording knows it, T_left_right of a stereo pair.
    """
    first, second = frame_ids
    T_body_cam = common.pose_on_body(source)
    if T_body_cam is not None and first != common.BODY_FRAME:
        yield FramePose(stamp_ns, common.BODY_FRAME, first, T_body_cam)
    if source.info.sensor == "stereo":
        yield FramePose(stamp_ns, first, second, common.pose_of_right(source.info))
