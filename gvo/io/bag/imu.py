"""The IMU of a bag or network: a topic of `sensor_msgs/Imu`, or one of its gyro and one beside."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from difflib import SequenceMatcher
from itertools import islice
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from gvo.errors import RecordingError
from gvo.geometry.imu import HOLE_S, ImuSamples, are_in_order
from gvo.io.bag.messages import bare
from gvo.io.bag.reader import BagMessage, MessageReader
from gvo.io.bag.topics import IMU_TYPE, Topic, asked_topic, find_topic, n_common_parts
from gvo.types import BoolArray, Failure, FloatArray, IntArray

StampOf: TypeAlias = Callable[[BagMessage], int | None]
"""Returns the stamp of a message, nanoseconds; None where it holds none."""

_GYRO, _ACCELERATION = "angular_velocity", "linear_acceleration"
# Messages by which is told what a topic measures, and that are read at once.
_N_FIRST, _N_AT_ONCE = 50, 300
# Between accelerations that are farther apart none is made up, nanoseconds.
_HOLE_NS = round(1e9 * HOLE_S)
# Of a gyro that wait for accelerations.
_N_PENDING = 5_000
# By how much the clocks of IMU and camera may differ.
_OTHER_CLOCK_S = 10.0
_LATEST_NS = 2**63 - 1  # in MCAP it may be later
_N_LISTED = 5


class BagImu(NamedTuple):
    """The topics of an IMU.

    Parameters
    ----------
    gyro, acceleration : Topic
        Of one topic for both the same.
    frame_id : str
        Whose axes it measures in; empty where the messages name none.
    clock_ns : int
        By how much the time of recording is later than the stamps.
    why : str
        How it was chosen, as the end of a decision; empty where there is one alone.
    """

    gyro: Topic
    acceleration: Topic
    frame_id: str
    clock_ns: int
    why: str = ""

    @property
    def is_one(self) -> bool:
        """Tell whether one topic holds both."""
        return self.gyro is self.acceleration

    @property
    def names(self) -> set[str]:
        """Names of its topics."""
        return {self.gyro.name, self.acceleration.name}

    def describe(self) -> str:
        """Return its topics, and how it was chosen."""
        topics = [self.gyro] if self.is_one else [self.gyro, self.acceleration]
        counts = " + ".join(str(topic.n_messages) for topic in topics)
        return f"{' + '.join(topic.name for topic in topics)} ({counts} messages){self.why}"


class _Look(NamedTuple):
    """What the first messages of a topic show; a vector is False if zero, None if it is denied."""

    topic: Topic
    frame_id: str
    clock_ns: int
    gyro: bool | None
    acceleration: bool | None


def find_imu(
    reader: MessageReader,
    camera: Topic,
    asked: str | None,
    hint: str,
    where: str,
    *,
    stamp_of: StampOf,
) -> BagImu | Failure:
    """Find the IMU of a camera, or say why there is none: nothing where no topic is of one.

    Parameters
    ----------
    reader : MessageReader
    camera : Topic
        Of the left or colour images.
    asked : str or None
        Topic that the user chose.
    hint : str
        Topic that a calibration names; it counts if it is there.
    where : str
        The bag or network, for messages.
    stamp_of : callable
        Returns the stamp of a message.

    Raises
    ------
    RecordingError
        When the topic asked for is none or cannot be used.
    """
    topics = [topic for topic in reader.topics if topic.type == IMU_TYPE and topic.n_messages]
    wanted = None if asked is None else asked_topic(asked, topics, where, "IMU")
    looks = [look for topic in topics if (look := _look(reader, topic, stamp_of)) is not None]
    found = [imu for look in looks if (imu := _complete(look, looks, wanted)) is not None]
    if wanted is not None:
        found = [imu for imu in found if imu.gyro == wanted]
    imu = _best(found, camera, find_topic(hint, topics))
    names = ", ".join(topic.name for topic in ([wanted] if wanted else topics)[:_N_LISTED])
    what = "both angular velocity and acceleration" if looks else "a message that can be read"
    reason = f"{names} without {what}" if topics else ""
    if found:
        reason = f"--imu chooses one of {', '.join(each.gyro.name for each in found)}"
    if imu is not None:
        first = None
        with suppress(RecordingError):  # in a network no image may have come yet
            first = next(_first(reader, camera, stamp_of), None)
        offset_s = 0.0 if first is None else 1e-9 * (imu.clock_ns - first[0])
        if abs(offset_s) <= _OTHER_CLOCK_S:
            return imu
        reason = f"the clock of {imu.gyro.name} is {offset_s:.3g} s before that of the camera"
    if wanted is not None:
        raise RecordingError(f"{where}: --imu {asked}: {reason}; give another one, or none")
    return Failure(reason=reason)


def _first(reader: MessageReader, topic: Topic, stamp_of: StampOf) -> Iterator[tuple[int, Any]]:
    """Yield by how much the first messages were recorded after their stamps, and them."""
    messages = (each for each in reader.messages([topic.name]) if each.topic.type == topic.type)
    for message in islice(messages, _N_FIRST):
        stamp_ns = stamp_of(message)
        if stamp_ns is not None:
            yield message.log_time_ns - stamp_ns, message


def _look(reader: MessageReader, topic: Topic, stamp_of: StampOf) -> _Look | None:
    """Look at the first messages of a topic; None where none can be read."""
    clocks_ns, contents = [], []
    for clock_ns, message in _first(reader, topic, stamp_of):
        with suppress(RecordingError):
            contents.append(message.decode())
            clocks_ns.append(clock_ns)
    if not contents:
        return None

    def shows(name: str) -> bool | None:
        if getattr(contents[0], f"{name}_covariance")[0] == -1.0:
            return None
        return any(any(_numbers(getattr(content, name))) for content in contents)

    frame_id = bare(str(contents[0].header.frame_id))
    return _Look(topic, frame_id, clocks_ns[0], shows(_GYRO), shows(_ACCELERATION))


def _complete(look: _Look, looks: Sequence[_Look], wanted: Topic | None) -> BagImu | None:
    """Return the IMU whose gyro is a topic; None if it has none, or nothing tells acceleration."""
    partners = [each for each in looks if each.acceleration and not each.gyro]
    is_asked = look.topic == wanted and None not in (look.gyro, look.acceleration)
    if look.gyro and not look.acceleration and partners:
        name = look.topic.name
        likeness = [SequenceMatcher(None, name, each.topic.name).ratio() for each in partners]
        acceleration = partners[int(np.argmax(likeness))].topic
    elif (look.gyro and look.acceleration) or is_asked:  # of zeros at rest, without noise
        acceleration = look.topic
    else:
        return None
    return BagImu(look.topic, acceleration, look.frame_id, look.clock_ns)


def _best(found: Sequence[BagImu], camera: Topic, hint: Topic | None) -> BagImu | None:
    """Return the IMU that a calibration names, else the one whose name is alone the nearest."""
    if len(found) < 2:
        return next(iter(found), None)
    hinted = [imu for imu in found if imu.gyro == hint]
    nearness = [n_common_parts(imu.gyro, camera) for imu in found]
    nearest = [imu for imu, near in zip(found, nearness, strict=True) if near == max(nearness)]
    if len(chosen := hinted or nearest) > 1:
        return None
    why = "as the calibration says" if hinted else "by its name"
    others = ", ".join(imu.gyro.name for imu in found if imu is not chosen[0])
    return chosen[0]._replace(why=f", {why}; --imu takes another of {others}")


def read_samples(
    reader: MessageReader, imu: BagImu, stamp_of: StampOf, start_ns: int
) -> Iterator[ImuSamples]:
    """Yield the samples of an IMU from a stamp on, some at a time."""
    messages, decoder = reader.messages(imu.names), SampleDecoder(imu, stamp_of, start_ns)
    while block := list(islice(messages, _N_AT_ONCE)):
        yield decoder.take(block)


class SampleDecoder:
    """Makes samples of the messages of an IMU; skips what is damaged.

    Of two topics the acceleration is interpolated to the stamps of the gyro.

    Parameters
    ----------
    imu : BagImu
    stamp_of : callable
        Returns the stamp of a message.
    start_ns : int
        What is stamped before is left out, nanoseconds.
    """

    def __init__(self, imu: BagImu, stamp_of: StampOf, start_ns: int) -> None:
        self._imu, self._stamp_of, self._start_ns = imu, stamp_of, start_ns
        self._pairing = _Pairing()

    def take(self, messages: Iterable[BagMessage]) -> ImuSamples:
        """Return the samples that are known with these messages."""
        rows = [row for message in messages if (row := self._row(message)) is not None]
        is_gyro = np.array([name == self._imu.gyro.name for name, _, _ in rows], dtype=np.bool_)
        stamps_ns = np.array([stamp_ns for _, stamp_ns, _ in rows], dtype=np.int64)
        values = np.array([numbers for _, _, numbers in rows]).reshape(-1, 6)
        if not self._imu.is_one:
            return self._pairing.take(is_gyro, stamps_ns, values)
        return ImuSamples(stamps_ns=stamps_ns, gyro=values[:, :3], acceleration=values[:, 3:])

    def _row(self, message: BagMessage) -> tuple[str, int, list[float]] | None:
        """Return topic, stamp, and the six numbers of gyro and acceleration of a message."""
        stamp_ns = self._stamp_of(message)
        if message.topic.type == IMU_TYPE and stamp_ns is not None and stamp_ns >= self._start_ns:
            with suppress(RecordingError):
                content = message.decode()
                vectors = content.angular_velocity, content.linear_acceleration
                numbers = [number for vector in vectors for number in _numbers(vector)]
                return message.topic.name, min(stamp_ns, _LATEST_NS), numbers
        return None


def _numbers(vector: Any) -> tuple[float, float, float]:  # noqa: ANN401 - made at run time
    return vector.x, vector.y, vector.z


class _Pairing:
    """Gives the samples of a gyro accelerations at their stamps, between those before and after."""

    def __init__(self) -> None:
        self._gyro_ns, self._known_ns = np.zeros((2, 0), dtype=np.int64)
        self._gyro, self._known = np.zeros((2, 0, 3))

    def take(self, is_gyro: BoolArray, stamps_ns: IntArray, values: FloatArray) -> ImuSamples:
        """Take samples of both; return those of the gyro that can be told."""
        gyro_ns = np.concatenate([self._gyro_ns, stamps_ns[is_gyro]])
        gyro = np.concatenate([self._gyro, values[is_gyro, :3]])
        known_ns = np.concatenate([self._known_ns, stamps_ns[~is_gyro]])
        known = np.concatenate([self._known, values[~is_gyro, 3:]])
        are_kept = are_in_order(known_ns)
        known_ns, known = known_ns[are_kept], known[are_kept]
        last_ns = known_ns.max(initial=0)
        is_due = gyro_ns <= last_ns
        is_kept = known_ns >= last_ns - _HOLE_NS
        self._gyro_ns, self._gyro = gyro_ns[~is_due][-_N_PENDING:], gyro[~is_due][-_N_PENDING:]
        self._known_ns, self._known = known_ns[is_kept], known[is_kept]
        acceleration, is_known = _interpolated(known_ns, known, gyro_ns[is_due])
        return ImuSamples(
            stamps_ns=gyro_ns[is_due][is_known],
            gyro=gyro[is_due][is_known],
            acceleration=acceleration[is_known],
        )


def _interpolated(
    known_ns: IntArray, known: FloatArray, stamps_ns: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Return values (n, 3) at stamps, none later than all that are known, and where they are."""
    if len(stamps_ns) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.bool_)
    after = np.searchsorted(known_ns, stamps_ns)
    before = np.maximum(after - 1, 0)
    is_known = (known_ns[before] <= stamps_ns) & (known_ns[after] - known_ns[before] <= _HOLE_NS)
    origin_ns = known_ns[0]  # floats hold no stamps
    at = [np.interp(stamps_ns - origin_ns, known_ns - origin_ns, column) for column in known.T]
    return np.stack(at, axis=1), is_known
