"""Where the two streams of a recording go in a bag: topics, frames, calibrations, forms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.outputs.bag_messages import BagWriter, FramePose, Header, write_image
from gvo.outputs.compressed_messages import write_compressed, write_compressed_depth
from gvo.outputs.conversion import (
    BODY_FRAME,
    LeftOut,
    choose_preparers,
    ideal_calibration,
    pose_on_body,
    readable_images,
)
from gvo.outputs.depth_counts import exact_counts
from gvo.sources.frames import ImagePreparer
from gvo.sources.pixels import MILLIMETRES
from gvo.sources.recording import RecordingInfo, Source
from gvo.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
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
            write_image(bag, self.topic, pixels, header)
        elif pixels.dtype == np.float32:
            write_compressed_depth(bag, f"{self.topic}/compressedDepth", pixels, header)
        else:
            write_compressed(bag, f"{self.topic}/compressed", pixels, header)


BagStreams: TypeAlias = tuple[BagStream, BagStream]


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
    is_raw = not info.calibrations[0].is_rectified
    # Depth that is moved to the colour camera is seen by the rectified one.
    is_rectifying = is_raw and (rectify or info.depth_view is not None)
    prepares = choose_preparers(info, is_rectifying=is_rectifying)
    is_rectified = is_rectifying or not is_raw
    if info.sensor == "rgbd":
        topics = (
            f"/camera/rgb/{'image_rect_color' if is_rectified else 'image_color'}",
            "/camera/depth/image",
        )
        raws = info.calibrations * 2
        compressed = (compress, compress and _is_in_millimetres(source))
    else:
        name = "image_rect" if is_rectified else "image_raw"
        topics = (f"/stereo/left/{name}", f"/stereo/right/{name}")
        raws = info.calibrations
        compressed = (compress, compress)
    first, second = (
        BagStream(
            topic=topic,
            frame_id=frame_id,
            calibration=ideal_calibration(raw) if is_rectified else raw,
            prepare=prepare,
            is_compressed=is_compressed,
        )
        for topic, frame_id, raw, prepare, is_compressed in zip(
            topics, _frame_ids(info), raws, prepares, compressed, strict=True
        )
    )
    return first, second


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
    T_body_cam = pose_on_body(source)
    if T_body_cam is not None and first != BODY_FRAME:
        yield FramePose(stamp_ns, BODY_FRAME, first, T_body_cam)
    if source.info.sensor == "stereo":
        yield FramePose(stamp_ns, first, second, _pose_of_right(source.info))


def _frame_ids(info: RecordingInfo) -> tuple[str, str]:
    if info.sensor == "rgbd":
        return (info.frame_id or "camera_color_optical_frame",) * 2
    left, right = info.frame_id or "camera_left_optical", "camera_right_optical"
    return left, right if left != right else f"{left}_right"


def _pose_of_right(info: RecordingInfo) -> FloatArray:
    left, right = info.calibrations
    baseline = float(left.P[0, 3] - right.P[0, 3]) / float(left.P[0, 0])
    return se3.make_transform(np.eye(3), np.array([baseline, 0.0, 0.0]))


def _is_in_millimetres(source: Source) -> bool:
    """Tell whether the first depth image that can be read is of whole millimetres."""
    for image in readable_images(source, LeftOut()):
        if image.stream == 1:
            try:
                return exact_counts(image.load(), MILLIMETRES) is not None
            except RecordingError:
                continue
    return False
