"""The cameras of a bag, as their first `CameraInfo` describe them."""

from __future__ import annotations

import re
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gvo.errors import CalibrationError, RecordingError
from gvo.io.bag.messages import (
    camera_fields,
    decode_compressed,
    decode_compressed_depth,
    stamp_of,
)
from gvo.io.bag.reader import BagReader
from gvo.io.bag.topics import (
    IMAGE_TYPE,
    CameraTopics,
    Topic,
    camera_info_names,
    find_camera_info,
)
from gvo.io.calibration.camera_info import CameraFields
from gvo.io.poses.tf_paths import bare

_FLOAT_TYPE = "std_msgs/msg/Float32"
# Beside the stream of depth of a bag that librealsense wrote: metres per count.
_REALSENSE_DEPTH = re.compile(r"(/device_\d+/sensor_\d+)/[^/]+/image/data")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagCamera:
    """A camera of a bag and what its first `CameraInfo` says.

    Parameters
    ----------
    image : Topic
        Its images.
    info_name : str
        Its topic of `CameraInfo`.
    fields : CameraFields
        Of the first message.
    stamp_ns : int
        Of the first message, nanoseconds.
    notes : tuple of str
        What was assumed, a line each.
    """

    image: Topic
    info_name: str
    fields: CameraFields
    stamp_ns: int
    notes: tuple[str, ...] = ()


def read_bag_cameras(
    reader: BagReader, topics: CameraTopics, where: str
) -> tuple[BagCamera, BagCamera | None]:
    """Read the first `CameraInfo` of both image topics.

    Parameters
    ----------
    reader : BagReader
        The bag.
    topics : CameraTopics
        The image topics.
    where : str
        The bag, for messages.

    Returns
    -------
    first : BagCamera
        Left or colour.
    second : BagCamera or None
        Right or depth; None where depth has no `CameraInfo`.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    CalibrationError
        When a `CameraInfo` is missing.
    """
    is_depth = topics.sensor == "rgbd"
    names = [find_camera_info(image, reader.topics) for image in (topics.first, topics.second)]
    messages = _first_messages(reader, {name for name in names if name is not None})
    cameras = []
    for image, name in zip((topics.first, topics.second), names, strict=True):
        is_needed = image is topics.first or not is_depth
        if is_needed and name is None:
            raise CalibrationError(
                f"{where}: no CameraInfo for {image.name}: expected "
                f"/{camera_info_names(image)[0]}; give --calibration FILE"
            )
        if is_needed and name not in messages:
            raise CalibrationError(f"{where}: {name} yields no message; give --calibration FILE")
        if name is not None and name in messages:
            cameras.append(_bag_camera(reader, (image, name), messages[name], where))
    return cameras[0], cameras[1] if len(cameras) > 1 else None


def camera_info_changes(reader: BagReader, names: Collection[str]) -> dict[str, int]:
    """Count the `CameraInfo` that differ from the first of their topic, which is the one used.

    Parameters
    ----------
    reader : BagReader
        The bag; all messages of the topics are read.
    names : collection of str
        Topics of `CameraInfo`.

    Returns
    -------
    dict
        Number of messages by topic, for those topics that have any.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    """
    first: dict[str, tuple[object, ...]] = {}
    counts: dict[str, int] = {}
    for message in reader.messages(names):
        name = message.topic.name
        try:
            numbers = _comparable(camera_fields(message.decode(), name))
        except RecordingError:
            continue
        if first.setdefault(name, numbers) != numbers:
            counts[name] = counts.get(name, 0) + 1
    return counts


def image_frame(reader: BagReader, image: Topic) -> str:
    """Return the frame that the first image of a topic names; empty where none does."""
    message = _first_messages(reader, {image.name}).get(image.name)
    return "" if message is None else bare(str(message.header.frame_id))


def recorded_depth_scale(reader: BagReader, depth: Topic) -> float | None:
    """Return the counts per metre that librealsense recorded beside a stream of depth."""
    stream = _REALSENSE_DEPTH.fullmatch(depth.name)
    name = "" if stream is None else f"{stream[1]}/option/Depth Units/value"
    if not any(topic.name == name and topic.type == _FLOAT_TYPE for topic in reader.topics):
        return None
    metres = float(getattr(_first_messages(reader, {name}).get(name), "data", 0.0))
    # It is a float of 32 bits: 0.001 would give 999.99995.
    return round(1.0 / metres, 3) if np.isfinite(metres) and metres > 0 else None


def _first_messages(reader: BagReader, names: Collection[str]) -> dict[str, Any]:
    """Return the first message of each topic that can be decoded, one that is calibrated first.

    A driver may send `CameraInfo` of zeros until it has read its calibration.
    """
    found: dict[str, Any] = {}
    uncalibrated: dict[str, Any] = {}
    for message in reader.messages(names):
        if message.topic.name not in found:
            with suppress(RecordingError):
                content = message.decode()
                if _is_calibrated(content):
                    found[message.topic.name] = content
                else:
                    uncalibrated.setdefault(message.topic.name, content)
        if len(found) == len(names):
            break
    return uncalibrated | found


def _is_calibrated(message: Any) -> bool:  # noqa: ANN401 - of any type
    matrices = [getattr(message, name, None) for name in ("K", "k", "P", "p")]
    numbers = [matrix for matrix in matrices if matrix is not None]
    return not numbers or any(np.any(matrix) for matrix in numbers)


def _bag_camera(
    reader: BagReader,
    source: tuple[Topic, str],
    message: Any,  # noqa: ANN401 - ROS 1 or 2
    where: str,
) -> BagCamera:
    image, name = source
    fields = camera_fields(message, f"{where}: {name}")
    notes: tuple[str, ...] = ()
    if 0 in fields.recorded_size():
        width, height = _image_size(reader, image, where)
        binning_x, binning_y = fields.binning_factors
        fields = replace(
            fields,
            width=width * binning_x + fields.roi.x_offset,
            height=height * binning_y + fields.roi.y_offset,
            roi=replace(fields.roi, width=0, height=0),
        )
        notes = (f"calibration: {name} leaves the size 0: {width}x{height} px as {image.name}",)
    return BagCamera(
        image=image,
        info_name=name,
        fields=fields,
        stamp_ns=stamp_of(message.header),
        notes=notes,
    )


def _image_size(reader: BagReader, image: Topic, where: str) -> tuple[int, int]:
    """Return width and height of the first image that can be read."""
    for message in reader.messages([image.name]):
        with suppress(RecordingError):
            content = message.decode()
            if image.type == IMAGE_TYPE:
                return int(content.width), int(content.height)
            if "compressedDepth" in content.format:
                height, width = decode_compressed_depth(content, 1.0, image.name).shape
            else:
                height, width = decode_compressed(content, image.name).shape[:2]
            return width, height
    raise CalibrationError(
        f"{where}: the CameraInfo of {image.name} leaves width and height 0, and none of its "
        "images can be read; give --calibration FILE"
    )


def _comparable(fields: CameraFields) -> tuple[object, ...]:
    matrices = (np.asarray(getattr(fields, name)).tobytes() for name in "KDRP")
    return (fields.width, fields.height, fields.model, fields.binning, fields.roi, *matrices)
