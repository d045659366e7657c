"""Topics of poses and of positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.geometry.geodesy import local_enu
from gvo.io.bag.messages import bare, stamp_of, transform_of
from gvo.io.bag.reader import BagReader, MessageReader
from gvo.io.bag.topics import Topic, asked_topic, describe_topics
from gvo.io.edges.events import InputFaults
from gvo.io.edges.pose_streams import PoseStream
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

_Value = TypeVar("_Value")

_TRANSFORM_TYPE = "geometry_msgs/msg/TransformStamped"
_COVARIANCE_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")

POSE_TYPES = (*_COVARIANCE_TYPES, "geometry_msgs/msg/PoseStamped", _TRANSFORM_TYPE)
"""Message types that hold a pose of a stamp; the last two without a covariance."""
FIX_TYPE = "sensor_msgs/msg/NavSatFix"
"""Latitude, longitude and height of an antenna."""
POSITION_TYPES = (FIX_TYPE, "geometry_msgs/msg/PointStamped")
"""Message types that hold a position of a stamp."""


def read_streams(path: Path, names: Sequence[str], faults: InputFaults) -> list[PoseStream]:
    """Read a bag's topics of poses; without names, the only one there is."""
    reader = BagReader(path)
    topics = find_topics(reader, names, str(path))
    streams = [_read_stream(reader, topic, faults) for topic in topics]
    decision = "; ".join([*reader.notes, streams[0].decision])
    return [replace(streams[0], decision=decision), *streams[1:]]


def _read_stream(reader: BagReader, topic: Topic, faults: InputFaults) -> PoseStream:
    poses: list[PoseMessage] = []
    broken_off = ""
    try:
        for pose in pose_messages(reader, topic, faults):
            if poses and pose.stamp_ns <= poses[-1].stamp_ns:
                first = f"{pose.stamp_ns} ns after {poses[-1].stamp_ns} ns in {topic.name}"
                faults.add("poses have a stamp that does not advance and were skipped", first)
                continue
            poses.append(pose)
    except RecordingError as error:
        broken_off = str(error)
    unknown = np.full((6, 6), np.nan)
    covariances = [unknown if one.covariance is None else one.covariance for one in poses]
    return PoseStream(
        name=topic.name,
        poses=Trajectory(
            stamps_ns=np.array([pose.stamp_ns for pose in poses], dtype=np.int64),
            T_world_frame=np.reshape([pose.T_parent_child for pose in poses], (-1, 4, 4)),
            stamps_from="topic",
        ),
        covariances=np.reshape(covariances, (-1, 6, 6)),
        decision=f"{topic.name}: {topic.type}, {topic.n_messages} messages",
        broken_off=broken_off,
    )


def find_topics(
    reader: MessageReader, names: Sequence[str], where: str, *, types: Sequence[str] = POSE_TYPES
) -> list[Topic]:
    """Find the topics that were asked for; without names the only one there is."""
    found = [topic for topic in reader.topics if topic.type in types and topic.n_messages]
    if names:
        return [asked_topic(name, found, where, "pose") for name in names]
    if len(found) == 1:
        return found
    if not found:
        raise RecordingError(f"{where}: holds no poses; expected a topic of {', '.join(types)}")
    raise RecordingError(
        f"{where}: holds more than one topic of poses; choose by --topic NAME, repeated to fuse "
        f"several: {describe_topics(found)}"
    )


class PoseMessage(NamedTuple):
    """A pose of a topic: T_parent_child (4, 4) in metres; its covariance (6, 6), if stated."""

    stamp_ns: int
    T_parent_child: FloatArray
    covariance: FloatArray | None
    child_frame: str


def pose_messages(
    reader: MessageReader, topic: Topic, faults: InputFaults
) -> Iterator[PoseMessage]:
    """Yield the poses of a topic in the order of recording.

    Messages that hold none, or are of other frames than the first, are skipped and counted.
    """
    first: tuple[str, str] | None = None
    for header, pose in _values(reader, topic, _pose, "pose", faults):
        frames = pose.child_frame, bare(header.frame_id)
        first = first or frames
        if frames == first:
            yield pose
        else:
            reason = "{} in {} in place of {} in {}".format(*frames, *first)
            faults.add("messages are of other frames and were skipped", reason)


def _values(
    reader: MessageReader,
    topic: Topic,
    value_of: Callable[[Any, Topic], _Value],
    name: str,
    faults: InputFaults,
) -> Iterator[tuple[Any, _Value]]:
    """Yield header and value of each message of a topic; skip and count what holds none."""
    n_messages = 0
    for message in reader.messages([topic.name]):
        if message.topic.type != topic.type:
            continue
        n_messages += 1
        try:
            content = message.decode()
            value = value_of(content, topic)
        except RecordingError as error:
            faults.add(f"messages hold no {name} and were skipped", str(error))
        else:
            yield content.header, value
    if n_messages == 0:
        raise RecordingError(
            f"{topic.name} announces {topic.n_messages} messages but yields none; record or "
            "convert the bag anew"
        )


def _pose(message: Any, topic: Topic) -> PoseMessage:  # noqa: ANN401 - made at run time
    stamp_ns = stamp_of(message.header)
    T = transform_of(*_parts(message, topic.type))
    if isinstance(T, Failure):
        raise RecordingError(f"{topic.name} at {stamp_ns} ns: not a pose: {T.reason}")
    has_covariance = topic.type in _COVARIANCE_TYPES
    covariance = _covariance(message.pose.covariance, T[:3, :3]) if has_covariance else None
    return PoseMessage(stamp_ns, T, covariance, bare(getattr(message, "child_frame_id", "")))


def _parts(message: Any, type_: str) -> tuple[Any, Any]:  # noqa: ANN401 - made at run time
    if type_ == _TRANSFORM_TYPE:
        return message.transform.translation, message.transform.rotation
    pose = message.pose.pose if type_ in _COVARIANCE_TYPES else message.pose
    return pose.position, pose.orientation


def _covariance(numbers: FloatArray, R: FloatArray) -> FloatArray | None:
    """Return the covariance of 36 numbers; None where they say that it is not known."""
    covariance_ros = np.asarray(numbers, dtype=np.float64).reshape(6, 6)
    if not np.isfinite(covariance_ros).all() or covariance_ros[0, 0] < 0.0:
        return None
    covariance = se3.covariance_from_ros(covariance_ros, R)
    return np.asarray(0.5 * (covariance + covariance.T))


class Positions(NamedTuple):
    """Positions of a named frame; `origin` says in words what they are relative to, if chosen."""

    trajectory: Trajectory
    child_frame: str
    origin: str = ""


def read_positions(reader: MessageReader, topic: Topic, faults: InputFaults) -> Positions:
    """Read the positions of a topic; skip and count what holds none.

    Those of `NavSatFix` are east, north and up of the first fix. Messages with a status
    below zero or an impossible place are skipped.
    """
    rows: dict[int, FloatArray] = {}
    frame = ""
    for header, numbers in _values(reader, topic, _numbers, "position", faults):
        if not rows:  # the first one's counts: neither fixes nor points change theirs
            frame = bare(header.frame_id)
        rows[stamp_of(header)] = numbers
    if not rows:
        reason = "; ".join(faults.warnings())
        raise RecordingError(f"{topic.name}: holds no position: {reason}")
    stamps_ns = np.array(sorted(rows), dtype=np.int64)
    places = np.stack([rows[int(stamp_ns)] for stamp_ns in stamps_ns])
    if topic.type != FIX_TYPE:
        return Positions(Trajectory.of_positions(stamps_ns, places, stamps_from="topic"), "")
    latitude, longitude, height = places[0]
    return Positions(
        Trajectory.of_positions(stamps_ns, local_enu(*places.T), stamps_from="topic"),
        frame,
        f"east, north, up of {latitude:.7f} deg, {longitude:.7f} deg, {height:.2f} m",
    )


def _numbers(message: Any, topic: Topic) -> FloatArray:  # noqa: ANN401 - made at run time
    if topic.type != FIX_TYPE:
        point = np.array([getattr(message.point, axis) for axis in "xyz"], dtype=np.float64)
        if not np.all(np.isfinite(point)):
            raise RecordingError(f"{topic.name} at {stamp_of(message.header)} ns: not a point")
        return point
    fix = np.array([message.latitude, message.longitude, message.altitude], dtype=np.float64)
    is_place = np.all(np.isfinite(fix)) and abs(fix[0]) <= 90.0 and abs(fix[1]) <= 360.0
    if message.status.status < 0 or not is_place:
        raise RecordingError(
            f"{topic.name} at {stamp_of(message.header)} ns: no fix (status "
            f"{message.status.status}, latitude {fix[0]:g}, longitude {fix[1]:g}, "
            f"altitude {fix[2]:g})"
        )
    return fix
