"""Topics of a bag that hold poses: odometry, stamped poses and transforms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.sources.bag_reader import BagReader
from gvo.sources.edges import InputFaults
from gvo.sources.messages import stamp_of, transform_of
from gvo.sources.pose_streams import PoseSample
from gvo.sources.tf_paths import bare
from gvo.sources.topics import Topic, describe_topics, find_topic
from gvo.trajectory.trajectory import StampsFrom
from gvo.types import Failure, FloatArray

_TRANSFORM_TYPE = "geometry_msgs/msg/TransformStamped"
_COVARIANCE_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")

POSE_TYPES = (*_COVARIANCE_TYPES, "geometry_msgs/msg/PoseStamped", _TRANSFORM_TYPE)
"""Message types that hold a pose of a stamp; the last two without a covariance."""


class TopicStream:
    """The poses of one topic of a bag.

    Parameters
    ----------
    reader : BagReader
    topic : Topic
        Of one of `POSE_TYPES`.

    Attributes
    ----------
    parent_frame, child_frame : str
        As the first pose names them, without a leading slash: T_parent_child is the pose. Empty
        before it is read; the child also where the type names none.
    """

    def __init__(self, reader: BagReader, topic: Topic) -> None:
        self._reader = reader
        self._topic = topic
        self.name = topic.name
        self.decisions = [f"{topic.name}: {topic.type}, {topic.n_messages} messages"]
        self.n_poses = topic.n_messages
        self.stamps_from: StampsFrom = "topic"
        self.parent_frame = ""
        self.child_frame = ""
        self._has_frames = False

    def samples(self, faults: InputFaults) -> Iterator[PoseSample]:
        """Yield the poses in the order of recording; skip and count what holds none.

        Raises
        ------
        RecordingError
            When the bag cannot be read on.
        """
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
        """Tell whether a message is of the frames that the first one is of."""
        names = (message.header.frame_id, getattr(message, "child_frame_id", ""))
        parent, child = map(bare, names)
        if not self._has_frames:
            self.parent_frame, self.child_frame, self._has_frames = parent, child, True
        is_same = (parent, child) == (self.parent_frame, self.child_frame)
        if not is_same:
            reason = f"{child} in {parent} in place of {self.child_frame} in {self.parent_frame}"
            faults.add("messages are of other frames and were skipped", reason)
        return is_same


def find_topics(
    reader: BagReader, names: Sequence[str], where: str, *, types: Sequence[str] = POSE_TYPES
) -> list[Topic]:
    """Find the topics of poses that were asked for, or the only one there is.

    Parameters
    ----------
    reader : BagReader
    names : sequence of str
        With or without the leading slash; empty: the only topic of poses is taken.
    where : str
        The bag, for messages.
    types : sequence of str
        Of the messages.

    Returns
    -------
    list of Topic
        In the order of the names.

    Raises
    ------
    RecordingError
        When a name is unknown, or none is given and there is not exactly one topic of poses.
    """
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


def _sample(message: Any, topic: Topic) -> PoseSample:  # noqa: ANN401 - made at run time
    stamp_ns = stamp_of(message.header)
    has_covariance = topic.type in _COVARIANCE_TYPES
    position, orientation = _parts(message, topic.type)
    T = transform_of(position, orientation)
    if isinstance(T, Failure):
        raise RecordingError(f"{topic.name} at {stamp_ns} ns: the pose is no transform: {T.reason}")
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


def open_streams(path: Path, names: Sequence[str]) -> list[TopicStream]:
    """Return the streams of a bag.

    Parameters
    ----------
    path : Path
        `.bag`, `.mcap` or `.db3` file, or a ROS 2 bag folder.
    names : sequence of str
        Topics; empty: the only one there is.

    Raises
    ------
    RecordingError
        When the bag cannot be read or does not hold the topics.
    """
    reader = BagReader(path)
    streams = [TopicStream(reader, topic) for topic in find_topics(reader, names, str(path))]
    streams[0].decisions[:0] = reader.notes
    return streams
