"""The cameras of a bag, as their first `CameraInfo` describe them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, islice, pairwise
from typing import Any, TypeAlias

import numpy as np

from gvo.errors import CalibrationError, RecordingError
from gvo.io.bag.file import BagFile
from gvo.io.bag.messages import (
    bare,
    camera_fields,
    decode_compressed,
    decode_compressed_depth,
    stamp_of,
)
from gvo.io.bag.reader import BagMessage, BagReader, MessageReader
from gvo.io.bag.topics import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPE,
    IMAGE_TYPES,
    CameraTopics,
    Topic,
    camera_info_topics,
    describe_topics,
    find_topic,
)
from gvo.io.calibration.camera_info import CameraFields

# Written by a run for viewers, beside the poses.
_OF_RUN = "/gvo/"
# Pieces of one recording follow each other but for what a recorder writes late.
_MAX_OVERLAP_S = 1.0
_MAX_GAP_S = 5.0
# `CameraInfo` that are compared of each, of all topics.
_N_FIRST = 20
# The header of a serialised message begins with what changes: of ROS 1 the number, the stamp.
_N_STAMP_BYTES = 12
_Numbers: TypeAlias = tuple[object, ...]
_FLOAT_TYPE = "std_msgs/msg/Float32"
# Beside the stream of depth of a bag that librealsense wrote: metres per count.
_REALSENSE_DEPTH = re.compile(r"(/device_\d+/sensor_\d+)/[^/]+/image/data")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagCamera:
    """A camera of a bag and what its first `CameraInfo` says."""

    image: Topic
    info_name: str
    fields: CameraFields
    stamp_ns: int
    notes: tuple[str, ...] = ()


def read_bag_cameras(
    reader: MessageReader, topics: CameraTopics, where: str, names: Sequence[str] = ()
) -> tuple[BagCamera, BagCamera | None]:
    """Read the first `CameraInfo` of both image topics; None where depth has none.

    Their topics are those of the names, as far as these go.

    Raises
    ------
    CalibrationError
        When a `CameraInfo` is missing.
    """
    cameras = []
    infos = [t for t in reader.topics if t.type == CAMERA_INFO_TYPE and t.n_messages > 0]
    for n, image in enumerate((topics.first, topics.second)):
        name = "".join(names[n : n + 1])
        info = find_topic(name, infos) if name else _find_info(reader, image, infos)
        content = None if info is None else _first_messages(reader, {info.name}).get(info.name)
        if info is not None and content is not None:
            cameras.append(_bag_camera(reader, image, (info.name, content), where))
        elif name or n == 0 or topics.sensor == "stereo":
            held = describe_topics(infos) or "none"
            raise CalibrationError(
                f"{where}: no CameraInfo for {image.name}{' on ' * bool(name)}{name}, it holds "
                f"{held}; give {'--camera-info TOPIC or ' * bool(infos)}--calibration FILE"
            )
    return cameras[0], cameras[1] if len(cameras) > 1 else None


def _find_info(reader: MessageReader, image: Topic, infos: Sequence[Topic]) -> Topic | None:
    """Return the topic of an image's `CameraInfo`: by place and name, if size and frame allow it.

    If they do not, it is one elsewhere with the size and the frame of the images.
    """
    frame_id, size = "", (0, 0)
    with suppress(CalibrationError, RecordingError):  # as of a network, before the first image
        frame_id, size = image_frame(reader, image), image_size(reader, image)
    best, found, of_name = 0, None, None
    for by_name, topic in camera_info_topics(image, infos):
        its_size, its_frame = _stated(reader, topic)
        is_other_size = size != its_size and 0 not in (*size, *its_size)
        is_other = is_other_size or (frame_id != its_frame and "" not in (frame_id, its_frame))
        is_its_own = size == its_size and frame_id == its_frame != ""
        rank = 2 * is_its_own if by_name[0] else 1 if is_other else 3
        if rank > best:
            best, found, of_name = rank, topic, by_name
        elif rank == best == 2 and by_name == of_name:
            found = None  # nothing tells which
        if best == 3:
            break
    return found


def _stated(reader: MessageReader, info: Topic) -> tuple[tuple[int, int], str]:
    """Return the size and the frame that a `CameraInfo` states; zeros and "" where it does not."""
    with suppress(CalibrationError, RecordingError):
        content = _first_messages(reader, {info.name}).get(info.name)
        if content is not None:
            fields = camera_fields(content, info.name)
            return fields.recorded_size(), fields.frame_id
    return (0, 0), ""


class CameraInfoWatch:
    """Counts the `CameraInfo` that differ from the first of their topic, which is the one used."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self._first: dict[str, _Numbers] = {}
        self._last: dict[str, tuple[bytes, bool]] = {}

    def take(self, message: BagMessage) -> None:
        """Compare the next message."""
        name, content = message.topic.name, message.data[_N_STAMP_BYTES:]
        last = self._last.get(name)
        if last is None or last[0] != content:
            numbers = _numbers_of(message)
            if numbers is None:
                return
            last = content, self._first.setdefault(name, numbers) != numbers
            self._last[name] = last
        if last[1]:
            self.counts[name] = self.counts.get(name, 0) + 1


def _numbers_of(message: BagMessage) -> _Numbers | None:
    """Return what of a `CameraInfo` can be compared; None where it says nothing."""
    try:
        content = message.decode()
        return _comparable(camera_fields(content, "")) if _is_calibrated(content) else None
    except RecordingError:
        return None


def find_contradiction(reader: BagReader, *, by_camera_info: bool) -> str:
    """Say why files without metadata are not parts of one recording; empty if they may be.

    Of those with images of the same topics one must follow the other, with the same `CameraInfo`.
    Files that were found in a folder, not given together, must also hold the same image topics
    and follow without a gap. A bag that a run wrote is not a part of a recording.
    """
    parts = [(file, _image_names(file)) for file in reader.loose_files]
    for file, _ in parts:
        if any(channel.name.startswith(_OF_RUN) for channel in file.counts):
            return f"{file.path.name} was written by a run"
    parts = sorted([part for part in parts if part[1]], key=lambda part: part[0].start_time_ns)
    for (before, images), (after, others) in combinations(parts, 2):
        overlap_s = 1e-9 * (min(before.end_time_ns, after.end_time_ns) - after.start_time_ns)
        shorter_s = 1e-9 * min(file.end_time_ns - file.start_time_ns for file in (before, after))
        if images & others and overlap_s > min(_MAX_OVERLAP_S, 0.5 * shorter_s):
            return f"{after.path.name} begins {overlap_s:.3g} s before {before.path.name} ends"
    for (before, images), (after, others) in pairwise(parts if reader.is_found else ()):
        if images != others:
            return f"{after.path.name} holds other image topics than {before.path.name}"
        gap_s = 1e-9 * (after.start_time_ns - before.end_time_ns)
        if gap_s > _MAX_GAP_S:
            return f"{after.path.name} begins {gap_s:.3g} s after {before.path.name} ends"
    return _other_camera(reader, [file for file, _ in parts]) if by_camera_info else ""


def _image_names(file: BagFile) -> set[str]:
    return {c.name for c, n in file.counts.items() if n > 0 and c.type in IMAGE_TYPES}


def _other_camera(reader: BagReader, files: Sequence[BagFile]) -> str:
    watch = CameraInfoWatch()
    names = {topic.name for topic in reader.topics if topic.type == CAMERA_INFO_TYPE}
    for file in files:
        for message in islice(reader.messages(names, files=[file]), _N_FIRST):
            watch.take(message)
        for name in watch.counts:
            return f"{name} of {file.path.name} is not that of those before"
    return ""


def image_frame(reader: MessageReader, image: Topic) -> str:
    """Return the frame that the first image of a topic names; empty if none."""
    message = _first_messages(reader, {image.name}).get(image.name)
    return "" if message is None else bare(str(message.header.frame_id))


def recorded_depth_scale(reader: MessageReader, depth: Topic) -> float | None:
    """Return the counts per metre that librealsense recorded beside a stream of depth."""
    stream = _REALSENSE_DEPTH.fullmatch(depth.name)
    name = "" if stream is None else f"{stream[1]}/option/Depth Units/value"
    if not any(topic.name == name and topic.type == _FLOAT_TYPE for topic in reader.topics):
        return None
    metres = float(getattr(_first_messages(reader, {name}).get(name), "data", 0.0))
    # It is a float of 32 bits: 0.001 would give 999.99995.
    return round(1.0 / metres, 3) if np.isfinite(metres) and metres > 0 else None


def _first_messages(reader: MessageReader, names: Collection[str]) -> dict[str, Any]:
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
    reader: MessageReader, image: Topic, named: tuple[str, Any], where: str
) -> BagCamera:
    name, message = named
    fields = camera_fields(message, f"{where}: {name}")
    notes: tuple[str, ...] = ()
    if 0 in fields.recorded_size():
        width, height = image_size(reader, image)
        binning_x, binning_y = fields.binning_factors
        fields = replace(
            fields,
            width=width * binning_x + fields.roi.x_offset,
            height=height * binning_y + fields.roi.y_offset,
            roi=replace(fields.roi, width=0, height=0),
        )
        notes = (f"calibration: {name} leaves the size 0: {width}x{height} px as {image.name}",)
    return BagCamera(
        image=image, info_name=name, fields=fields, stamp_ns=stamp_of(message.header), notes=notes
    )


def image_size(reader: MessageReader, image: Topic) -> tuple[int, int]:
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
        f"{image.name}: its calibration leaves width and height out, and none of its images can "
        "be read; give --calibration FILE with the size"
    )


def _comparable(fields: CameraFields) -> _Numbers:
    matrices = (np.asarray(getattr(fields, name)).tobytes() for name in "KDRP")
    return (fields.width, fields.height, fields.model, fields.binning, fields.roi, *matrices)
