"""Where the cameras of a bag stand: by `/tf`, or by the extrinsics that librealsense records."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.sources.bag_cameras import BagCamera
from gvo.sources.bag_reader import BagMessage, BagReader
from gvo.sources.messages import transform_of
from gvo.sources.tf import TfBuffer, read_tf
from gvo.types import Failure, FloatArray

TRANSFORM_TYPE = "geometry_msgs/msg/Transform"

# The topics of one stream of a bag that librealsense wrote.
_REALSENSE_STREAM = re.compile(r"(/device_\d+/sensor_\d+/[^/]+)/image/data")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extrinsics:
    """Where one camera stands as seen from another.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        Maps coordinates of the source to the target camera, metres.
    origin : str
        What told it.
    """

    T_target_source: FloatArray
    origin: str


def find_extrinsics(
    reader: BagReader, target: BagCamera, source: BagCamera
) -> Extrinsics | Failure:
    """Find the transform between two cameras of a bag.

    Parameters
    ----------
    reader : BagReader
        The bag; the topics of transforms are read.
    target, source : BagCamera
        The cameras.

    Returns
    -------
    Extrinsics or Failure
        By the tf between the frames that their `CameraInfo` name; where these are empty, by the
        `tf` topics beside the streams of librealsense, which map their reference to each stream.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    """
    frames = (target.fields.frame_id, source.fields.frame_id)
    if not all(frames):
        return _of_realsense(reader, target, source)
    if frames[0] == frames[1]:
        return Failure(reason=f"both CameraInfo name the frame {frames[0]}")
    buffer = read_tf(reader, frames=frames)
    found = _lookup(buffer, frames, target.stamp_ns)
    if isinstance(found, Failure):
        return found
    return Extrinsics(T_target_source=found, origin=f"tf {frames[0]} -> {frames[1]}")


def _lookup(buffer: TfBuffer, frames: tuple[str, str], stamp_ns: int) -> FloatArray | Failure:
    """Look a mount up at a stamp, or where it is known: `CameraInfo` may come before tf."""
    found = buffer.lookup(*frames, stamp_ns)
    if not isinstance(found, Failure):
        return found
    stamps_ns = buffer.edge_stamps_ns(*frames)
    T, is_known = buffer.lookup_many(*frames, stamps_ns)
    known = np.flatnonzero(is_known)
    if len(known) == 0:
        return found
    return np.asarray(T[known[np.argmin(np.abs(stamps_ns[known] - stamp_ns))]])


def _of_realsense(reader: BagReader, target: BagCamera, source: BagCamera) -> Extrinsics | Failure:
    streams = [_REALSENSE_STREAM.fullmatch(camera.image.name) for camera in (target, source)]
    references = [set() if stream is None else _references(reader, stream[1]) for stream in streams]
    common = sorted(references[0] & references[1])
    if not common:
        return Failure(reason="the CameraInfo name no frame")
    names = [f"{stream[1]}/tf/{common[0]}" for stream in streams if stream is not None]
    T_stream_reference = {}
    for message in reader.messages(names):
        T_stream_reference[message.topic.name] = _transform(message)
    if len(T_stream_reference) != len(set(names)):
        return Failure(reason=f"{names[0]} or {names[1]} yields no message")
    T_target_reference, T_source_reference = (T_stream_reference[name] for name in names)
    T_target_source = T_target_reference @ se3.invert(T_source_reference)
    return Extrinsics(T_target_source=T_target_source, origin=" and ".join(names))


def _references(reader: BagReader, stream: str) -> set[str]:
    start = f"{stream}/tf/"
    return {
        topic.name.removeprefix(start)
        for topic in reader.topics
        if topic.name.startswith(start) and topic.type == TRANSFORM_TYPE
    }


def _transform(message: BagMessage) -> FloatArray:
    content = message.decode()
    T = transform_of(content.translation, content.rotation)
    if isinstance(T, Failure):
        raise RecordingError(
            f"{message.topic.name}: holds no transform: {T.reason}; give --calibration FILE"
        )
    return T
