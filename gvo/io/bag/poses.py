"""Topics of poses and of positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.geometry.geodesy import local_enu
from gvo.io.bag.messages import bare, stamp_of, transform_of
from gvo.io.bag.reader import BagReader, MessageReader
from gvo.io.bag.topics import Topic, describe_topics, find_topic
from gvo.io.edges.events import InputFaults
from gvo.io.edges.pose_streams import PoseSample
from gvo.trajectory.trajectory import StampsFrom
from gvo.types import Failure, FloatArray, IntArray

_TRANSFORM_TYPE = "geometry_msgs/msg/TransformStamped"
_COVARIANCE_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")

POSE_TYPES = (*_COVARIANCE_TYPES, "geometry_msgs/msg/PoseStamped", _TRANSFORM_TYPE)
"""Message types that hold a pose of a stamp; the last two without a covariance."""
FIX_TYPE = "sensor_msgs/msg/NavSatFix"
"""Latitude, longitude and height of an antenna."""
POSITION_TYPES = (FIX_TYPE, "geometry_msgs/msg/PointStamped")
"""Message types that hold a position of a stamp."""


def open_streams(path: Path, names: Sequence[str]) -> list[TopicStream]:
    """Return the streams of a bag's topics of poses; without names, of the only one there is."""
    reader = BagReader(path)
    streams = [TopicStream(reader, topic) for topic in find_topics(reader, names, str(path))]
    streams[0].decisions[:0] = reader.notes
    return streams


def find_topics(
    reader: MessageReader, names: Sequence[str], where: str, *, types: Sequence[str] = POSE_TYPES
) -> list[Topic]:
    """Find the topics that were asked for; without names the only one there is."""
    found = [topic for topic in reader.topics if topic.type in types and topic.n_messages]
    if names:
        return [_find(name, found, where) for name in names]
    if len(found) == 1:
        return found
    if not found:
        raise RecordingError(f"{where}: holds no poses; expected a topic of {', '.join(types)}")
    raise RecordingError(
        f"{where}: holds more than one topic of poses; choose by --topic NAME, repeated to fuse "
        f"several: {describe_topics(found)}"
    )


def _find(name: str, topics: Sequence[Topic], where: str) -> Topic:
    topic = find_topic(name, topics)
    if topic is None:
        held = describe_topics(topics) or "none"
        raise RecordingError(f"{where}: has no poses on topic {name}; topics of poses: {held}")
    return topic


class TopicStream:
    """The poses of one topic of a bag.

    Attributes
    ----------
    parent_frame, child_frame : str
        As the first pose names them, without a leading slash: T_parent_child is the pose. Empty
        before it is read; the child also where the type names none.
    """

    def __init__(self, reader: MessageReader, topic: Topic) -> None:
        self._reader, self._topic = reader, topic
        self.name = topic.name
        self.decisions = [f"{topic.name}: {topic.type}, {topic.n_messages} messages"]
        self.n_poses = topic.n_messages
        self.stamps_from: StampsFrom = "topic"
        self.parent_frame = ""
        self.child_frame = ""
        self._has_frames = False

    def samples(self, faults: InputFaults) -> Iterator[PoseSample]:
        """Yield the poses in the order of recording; skip and count what holds none."""
        n_messages = 0
        for message in self._reader.messages([self._topic.name]):
            if message.topic.type != self._topic.type:
                continue
            n_messages += 1
            try:
                content = message.decode()
                sample = _sample(content, self._topic)
            except RecordingError as error:
                faults.add("messages hold no pose and were skipped", str(error))
                continue
            if self._is_of_the_frames(content, faults):
                yield sample
        if n_messages == 0:
            raise RecordingError(
                f"{self._topic.name} announces {self._topic.n_messages} messages but yields "
                "none; record or convert the bag anew"
            )

    def _is_of_the_frames(self, message: Any, faults: InputFaults) -> bool:  # noqa: ANN401
        names = (message.header.frame_id, getattr(message, "child_frame_id", ""))
        parent, child = map(bare, names)
        if not self._has_frames:
            self.parent_frame, self.child_frame, self._has_frames = parent, child, True
        is_same = (parent, child) == (self.parent_frame, self.child_frame)
        if not is_same:
            reason = f"{child} in {parent} in place of {self.child_frame} in {self.parent_frame}"
            faults.add("messages are of other frames and were skipped", reason)
        return is_same


def _sample(message: Any, topic: Topic) -> PoseSample:  # noqa: ANN401 - made at run time
    stamp_ns = stamp_of(message.header)
    has_covariance = topic.type in _COVARIANCE_TYPES
    position, orientation = _parts(message, topic.type)
    T = transform_of(position, orientation)
    if isinstance(T, Failure):
        raise RecordingError(f"{topic.name} at {stamp_ns} ns: not a pose: {T.reason}")
    return PoseSample(
        stamp_ns=stamp_ns,
        T_world_frame=T,
        covariance=_covariance(message.pose.covariance, T[:3, :3]) if has_covariance else None,
    )


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Positions:
    """The positions of one topic.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Strictly increasing, nanoseconds.
    positions : ndarray of float64, shape (n, 3)
        In the parent frame, metres.
    parent_frame, child_frame : str
        Empty where the messages name none.
    origin : str
        Of the parent frame, where it was chosen here: the first fix, in words.
    """

    stamps_ns: IntArray
    positions: FloatArray
    parent_frame: str
    child_frame: str
    origin: str = ""


def read_positions(reader: MessageReader, topic: Topic, faults: InputFaults) -> Positions:
    """Read the positions of a topic; skip and count what holds none.

    Those of `NavSatFix` are east, north and up of the first fix. Messages with a status
    below zero or an impossible place are skipped.
    """
    rows: dict[int, FloatArray] = {}
    frame: str | None = None
    for message in reader.messages([topic.name]):
        if message.topic.type != topic.type:
            continue
        try:
            content = message.decode()
            rows[stamp_of(content.header)] = _numbers(content, topic)
        except RecordingError as error:
            faults.add("messages hold no position and were skipped", str(error))
            continue
        if frame is None:  # the first one's counts: neither fixes nor points change theirs
            frame = bare(content.header.frame_id)
    if frame is None:
        reason = "; ".join(faults.warnings()) or f"none of {topic.n_messages} messages is there"
        raise RecordingError(f"{topic.name}: holds no position: {reason}")
    stamps_ns = np.array(sorted(rows), dtype=np.int64)
    numbers = np.stack([rows[int(stamp_ns)] for stamp_ns in stamps_ns])
    if topic.type != FIX_TYPE:
        return Positions(stamps_ns=stamps_ns, positions=numbers, parent_frame=frame, child_frame="")
    latitude, longitude, height = numbers[0]
    return Positions(
        stamps_ns=stamps_ns,
        positions=local_enu(*numbers.T),
        parent_frame="",
        child_frame=frame,
        origin=f"east, north, up of {latitude:.7f} deg, {longitude:.7f} deg, {height:.2f} m",
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
