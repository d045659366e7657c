"""Write recordings as bags of ROS 1 or ROS 2, without loss."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import WriterError as WriterError2

from gvo.errors import RecordingError
from gvo.outputs.bag_messages import (
    BagWriter,
    Header,
    write_camera_info,
    write_transforms,
    write_truth,
)
from gvo.outputs.bag_streams import BagStreams, plan_streams, static_poses
from gvo.outputs.conversion import (
    Conversion,
    LeftOut,
    check_images,
    check_new,
    readable_images,
    true_poses,
)
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
    of the rectified camera. `/tf_static` holds the right camera in the left one, and both in
    `body` where the recording says where they sit there; the frames are those of the rectified
    cameras, also beside raw images. Where a recording cannot be read on, what was read is kept,
    and the reason is in `skipped`.

    Parameters
    ----------
    source : Source
        The recording.
    path : str or Path
        `.bag`: ROS 1. `.mcap` or `.db3`: a single file of ROS 2. No suffix: a ROS 2 bag folder.
    rectify : bool
        Write raw images rectified and grey, as the frames hold them.
    compress : bool
        Write images as PNG, topics `.../compressed`; and depth, where the first image is of
        whole millimetres, as `.../compressedDepth`. Other depth stays as it is.
    progress : callable, optional
        Called with the number of images written so far.

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
    _check_target(path)
    writer = _Writer(source, plan_streams(source, rectify=rectify, compress=compress))
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".convert-") as folder:
            with BagWriter(Path(folder) / path.name, keeps_order=True) as bag:
                writer.write(bag, progress)
            bag.result.rename(path)
    except (OSError, WriterError1, WriterError2) as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    return Conversion(
        path=path,
        n_images=sum(writer.n_images),
        n_poses=writer.n_poses,
        skipped=writer.left_out.lines(),
    )


def _check_target(path: Path) -> None:
    check_new(path)
    if path.suffix not in _SUFFIXES:
        raise RecordingError(
            f"{path}: expected a name ending in .bag, .mcap or .db3, or a folder name without "
            f"a suffix, got {path.suffix}; give --layout for the folder of a data set"
        )


class _Writer:
    """Writes images and poses in the order of their stamps."""

    def __init__(self, source: Source, streams: BagStreams) -> None:
        self._source = source
        self._streams = streams
        self.left_out = LeftOut()
        truth = true_poses(source, self.left_out)
        self._poses: deque[tuple[int, FloatArray]] = deque()
        if truth is not None:
            self._poses.extend(zip(truth.stamps_ns.tolist(), truth.T_world_cam, strict=True))
        self.n_images = [0, 0]
        self.n_poses = len(self._poses)

    def write(self, bag: BagWriter, progress: _Progress | None) -> None:
        is_first = True
        for image in readable_images(self._source, self.left_out):
            if is_first:
                self._write_static(bag, image.stamp_ns)
                is_first = False
            self._write_poses(bag, until_ns=image.stamp_ns)
            self.n_images[image.stream] += self._write_image(bag, image)
            if progress is not None:
                progress(sum(self.n_images))
        check_images((self.n_images[0], self.n_images[1]), self._source, self.left_out)
        self._write_poses(bag)

    def _write_static(self, bag: BagWriter, stamp_ns: int) -> None:
        # Whoever plays the bag knows the cameras before the first image or pose comes.
        stamp_ns = min([stamp_ns, *(first_ns for first_ns, _ in list(self._poses)[:1])])
        first, second = self._streams
        poses = static_poses(self._source, (first.frame_id, second.frame_id), stamp_ns)
        write_transforms(bag, "/tf_static", poses, is_latched=True)

    def _write_poses(self, bag: BagWriter, until_ns: int | None = None) -> None:
        """Write, and take away, the poses up to a stamp; all of them without one."""
        while self._poses and (until_ns is None or self._poses[0][0] <= until_ns):
            write_truth(bag, *self._poses.popleft())

    def _write_image(self, bag: BagWriter, image: StampedImage) -> bool:
        """Write an image; False, with a note, where it cannot be read."""
        stream = self._streams[image.stream]
        try:
            pixels = image.load()
            if stream.prepare is not None:
                pixels = stream.prepare(pixels)
        except RecordingError as error:
            self.left_out.add_image(stream.topic, image.stamp_ns, str(error))
            return False
        header = Header(image.stamp_ns, stream.frame_id)
        write_camera_info(bag, stream.info_topic, stream.calibration, header)
        stream.write(bag, pixels, header)
        return True
