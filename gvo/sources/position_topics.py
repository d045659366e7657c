"""Topics of a bag that hold positions without rotations: GNSS fixes and measured points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry.geodesy import local_enu
from gvo.sources.bag_reader import BagReader
from gvo.sources.edges import InputFaults
from gvo.sources.messages import stamp_of
from gvo.sources.tf_paths import bare
from gvo.sources.topics import Topic
from gvo.types import FloatArray, IntArray

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
"""Latitude, longitude and height of an antenna."""
POSITION_TYPES = (FIX_TYPE, "geometry_msgs/msg/PointStamped")
"""Message types that hold a position of a stamp."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Positions:
    """The positions of one topic.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Strictly increasing, nanoseconds.
    positions : ndarray of float64, shape (n, 3)
        In the parent frame, metres.
    parent_frame : str
        Empty where the messages name none.
    child_frame : str
        Of the point that was measured; empty where the messages name none.
    origin : str
        Of the parent frame, where it was chosen here: the first fix, in words.
    """

    stamps_ns: IntArray
    positions: FloatArray
    parent_frame: str
    child_frame: str
    origin: str = ""


def read_positions(reader: BagReader, topic: Topic, faults: InputFaults) -> Positions:
    """Read the positions of a topic.

    Those of `NavSatFix` are east, north and up of the first fix. A status below zero, or a
    number that is no place on Earth, is no fix.

    Parameters
    ----------
    reader : BagReader
    topic : Topic
        Of one of `POSITION_TYPES`.
    faults : InputFaults
        Notes messages that hold no position.

    Raises
    ------
    RecordingError
        When the bag cannot be read on, or no message holds a position.
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
            raise RecordingError(f"{topic.name} at {stamp_of(message.header)} ns: no point")
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
