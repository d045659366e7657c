"""Recordings written as bags."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.convert import bag_messages
from gvo.io.convert.bag_messages import BagWriter, FramePose, Header, ImuSample
from gvo.io.convert.plan import BODY_FRAME, Form, plan_images, pose_of_right, pose_on_body
from gvo.io.images import MILLIMETRES, exact_counts
from gvo.io.poses.truth import TRUTH_FRAMES
from gvo.io.recording import RecordingInfo, Source, StampedImage

IMU_FRAME = "imu"
"""Name in tf of the axes in which an IMU measures."""

BagStreams: TypeAlias = tuple["BagStream", "BagStream"]


class BagStream(NamedTuple):
    """Where one stream of a recording goes.

    Parameters
    ----------
    topic : str
        Of its images, without the suffix of a transport.
    frame_id : str
        Of images and `CameraInfo`: the optical frame of the rectified camera.
    calibration : Calibration
        Of the images as they are written.
    """

    topic: str
    frame_id: str
    calibration: Calibration

    @property
    def info_topic(self) -> str:
        """Of its `CameraInfo`."""
        return f"{self.topic.rpartition('/')[0]}/camera_info"


class BagForm(Form):
    """A bag, whose frames are those of the recording, bit by bit.

    A stereo pair becomes `/stereo/left/image_rect` and `/stereo/right/image_rect`, or `image_raw`
    where it is not rectified; an RGB-D camera becomes `/camera/rgb/image_rect_color`, or
    `image_color`, and `/camera/depth/image` in metres (32FC1, NaN = unknown). Each image has a
    `CameraInfo` of its stamp beside it. The ground truth is written to `/tf`: `world` to
    `ground_truth`, the pose of the rectified camera. `/tf_static` holds the right camera in the
    left one, and both in `body` where the recording says where they sit there; the frames are
    those of the rectified cameras, also beside raw images. An IMU becomes `/imu`, and its place
    the frame `imu`.
    """

    def __init__(self, path: Path, source: Source, **options: Any) -> None:  # noqa: ANN401
        super().__init__(path, source, **options)
        self._streams = plan_streams(self.source, rectify=self.rectify)
        self.names = tuple(f"{stream.topic} images" for stream in self._streams)
        is_depth_compressed = self.info.sensor == "stereo" or _is_in_millimetres(self.source)
        self._is_compressed = (self.compress, self.compress and is_depth_compressed)
        # What has stamps of its own: true poses and samples of the IMU.
        self._beside = merge(self._poses(), self._samples(), key=attrgetter("stamp_ns"))
        self._next = next(self._beside, None)
        self._is_empty = True
        self._bag = BagWriter(path, keeps_order=True)
        self.path = self._bag.result

    def __enter__(self) -> BagForm:
        self._bag.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        """Complete the bag."""
        self._bag.__exit__(*exception)

    def images(self) -> Iterator[StampedImage]:
        """Yield all images."""
        return self.recorded()

    def write(self, image: StampedImage, pixels: NDArray[Any]) -> None:
        """Write what comes before an image, and the image beside its calibration."""
        if self._is_empty:
            self._write_static(image.stamp_ns)
            self._is_empty = False
        self._write_beside(image.stamp_ns)
        stream, is_compressed = self._streams[image.stream], self._is_compressed[image.stream]
        header = Header(image.stamp_ns, stream.frame_id)
        bag_messages.write_camera_info(self._bag, stream.info_topic, stream.calibration, header)
        if not is_compressed:
            bag_messages.write_image(self._bag, stream.topic, pixels, header)
        elif pixels.dtype == np.float32:
            topic = f"{stream.topic}/compressedDepth"
            bag_messages.write_compressed_depth(self._bag, topic, pixels, header)
        else:
            topic = f"{stream.topic}/compressed"
            bag_messages.write_compressed(self._bag, topic, pixels, header)

    def _write_static(self, stamp_ns: int) -> None:
        # Whoever plays the bag knows the cameras before the first image or pose comes.
        stamp_ns = stamp_ns if self._next is None else min(stamp_ns, self._next.stamp_ns)
        first, second = self._streams
        poses = static_poses(self.source, (first.frame_id, second.frame_id), stamp_ns)
        bag_messages.write_transforms(self._bag, "/tf_static", poses, is_latched=True)

    def _poses(self) -> Iterator[FramePose | ImuSample]:
        if self.truth is not None:
            rows = zip(self.truth.stamps_ns.tolist(), self.truth.T_world_frame, strict=True)
            yield from (FramePose(stamp_ns, *TRUTH_FRAMES, T) for stamp_ns, T in rows)

    def _samples(self) -> Iterator[FramePose | ImuSample]:
        for part in self.imu_samples():
            yield from map(ImuSample, part.stamps_ns.tolist(), part.gyro, part.acceleration)

    def _write_beside(self, until_ns: float = np.inf) -> None:
        while self._next is not None and self._next.stamp_ns <= until_ns:
            if isinstance(self._next, FramePose):
                bag_messages.write_transforms(self._bag, "/tf", [self._next])
                self.n_poses += 1
            else:
                bag_messages.write_imu(self._bag, "/imu", self._next, IMU_FRAME)
            self._next = next(self._beside, None)

    def finish(self) -> None:
        """Write what comes after the last image."""
        self._write_beside()


def plan_streams(source: Source, *, rectify: bool) -> BagStreams:
    """Decide where the streams of a recording go.

    Parameters
    ----------
    source : Source
        The recording.
    rectify : bool
        Write raw images rectified and grey.
    """
    info = source.info
    calibrations, _ = plan_images(info, rectify=rectify)
    is_rectified = calibrations[0].is_rectified
    if info.sensor == "rgbd":
        name = "image_rect_color" if is_rectified else "image_color"
        topics = (f"/camera/rgb/{name}", "/camera/depth/image")
        calibrations *= 2
    else:
        name = "image_rect" if is_rectified else "image_raw"
        topics = (f"/stereo/left/{name}", f"/stereo/right/{name}")
    first, second = map(BagStream, topics, _frame_ids(info), calibrations)
    return first, second


def _frame_ids(info: RecordingInfo) -> tuple[str, str]:
    if info.sensor == "rgbd":
        return (info.frame_id or "camera_color_optical_frame",) * 2
    left, right = info.frame_id or "camera_left_optical", "camera_right_optical"
    return left, right if left != right else f"{left}_right"


def _is_in_millimetres(source: Source) -> bool:
    """Tell whether the first depth image that can be read is of whole millimetres."""
    with suppress(RecordingError):  # the recording breaks off
        for image in source.images():
            if image.stream == 1:
                with suppress(RecordingError):
                    return exact_counts(image.load(), MILLIMETRES) is not None
    return False


def static_poses(source: Source, frame_ids: tuple[str, str], stamp_ns: int) -> Iterator[FramePose]:
    """Yield T_body_cam and T_camera_imu where the recording knows them, and T_left_right of a pair.

    Parameters
    ----------
    source : Source
        The recording.
    frame_ids : tuple of two str
        Of both streams: the optical frames of the rectified cameras.
    stamp_ns : int
        Nanoseconds.
    """
    first, second = frame_ids
    T_body_cam = pose_on_body(source)
    if T_body_cam is not None and first != BODY_FRAME:
        yield FramePose(stamp_ns, BODY_FRAME, first, T_body_cam)
    if source.info.sensor == "stereo":
        yield FramePose(stamp_ns, first, second, pose_of_right(source.info))
    imu = source.info.imu
    if imu is not None and imu.imu.T_camera_imu is not None:
        yield FramePose(stamp_ns, first, IMU_FRAME, imu.imu.T_camera_imu)
