"""A camera whose images are topics of a network."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Final, TypeVar

from gvo.config import Config
from gvo.errors import CalibrationError, RecordingError
from gvo.io.bag.reader import BagMessage
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.source import CAMERA_CHANGED, BagSource, ImageStamps
from gvo.io.bag.topics import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPES,
    IMU_TYPE,
    CameraTopics,
    Topic,
    TopicChoice,
    describe_topics,
    find_topic,
)
from gvo.io.calibration.files import CalibrationPaths
from gvo.io.calibration.forms import ImuFacts
from gvo.io.poses.tf import TF_TYPES, TfBuffer, read_tf
from gvo.io.recording import StampedImage
from gvo.io.sync import MAX_WAITING_BYTES
from gvo.live.imu import N_WAITING, ImuQueue
from gvo.live.publishing import SILENT_S
from gvo.live.transport import Transport

_SMALL = (CAMERA_INFO_TYPE, *TF_TYPES)
_LOGGER = logging.getLogger(__name__)
_OWN = "/gvo/"
# Messages kept of each CameraInfo and tf topic, to read the calibration and the mount from.
_N_KEPT: Final = 100
# Images that may wait to be paired, besides their memory. Pairing is quick; pairs have a queue of
# their own.
_N_WAITING: Final = 300
_PAUSE_S = 0.2
_SAID_AFTER = 5
# For so long after topics appear an IMU, its place and an image to compare its clock with are
# waited for.
_IMU_WITHIN_S = 1.0
_Found = TypeVar("_Found")


class NetworkReader:
    """Reads the topics of a network as `BagReader` reads those of a bag.

    It receives `CameraInfo`, transforms and IMUs from the first `refresh` on, images from `begin`
    on.

    Parameters
    ----------
    transport : Transport

    Attributes
    ----------
    topics : list of Topic
        Those that others announce.
    n_dropped : int
        Images that were given up because too many waited to be paired.
    """

    damage = ""

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.topics: list[Topic] = []
        self.notes: list[str] = []
        self.n_dropped = 0
        self._on_small: Callable[[BagMessage], None] = lambda _: None
        self._kept: dict[str, deque[BagMessage]] = {}
        self._images: deque[BagMessage] = deque()
        self._changed = threading.Condition()
        self._is_closed = False
        self._appeared_s = 0.0

    def refresh(self, *, with_imu: bool = False) -> bool:
        """List the topics again; tell whether they are still the same."""
        before = self.topics
        topics = [each for each in self.transport.topics() if not each.name.startswith(_OWN)]
        self.topics = sorted(topics, key=lambda topic: topic.name)
        for topic in self.topics:
            is_small = topic.type in _SMALL or (with_imu and topic.type == IMU_TYPE)
            if is_small and topic.name not in self._kept:
                self._subscribe(topic)
        if self.topics != before:
            self._appeared_s = time.monotonic()
        return self.topics == before

    def follow(self, names: Collection[str], take: Callable[[BagMessage], None]) -> None:
        """Give `take` the messages of some topics received so far, then all but images."""
        with self._changed:
            for message in self.messages(names):
                take(message)
            self._on_small = take

    def await_imu(self, asked: str | None) -> None:
        """Refuse while nothing came of the IMU asked for; at first while any topic is silent.

        Raises
        ------
        RecordingError
            With what to wait for.
        """
        imus = [topic for topic in self.topics if topic.type == IMU_TYPE]
        chosen = None if asked is None else find_topic(asked, imus)
        names = [] if chosen is None else [chosen.name]
        if imus and time.monotonic() - self._appeared_s < _IMU_WITHIN_S:
            names = [*self._kept]
        for name in names:
            if not self._kept[name]:
                raise RecordingError(f"{self.transport.name}: nothing came on {name}")

    def begin(self, topics: CameraTopics) -> None:
        """Receive the images of a camera."""
        for topic in (topics.first, topics.second):
            if topic.name not in self._kept:
                self._subscribe(topic)

    def messages(self, names: Collection[str]) -> Iterator[BagMessage]:
        """Yield messages received so far: up to a hundred of each topic, one of image topics.

        Raises
        ------
        RecordingError
            If nothing came on a topic that is neither tf nor of an IMU.
        """
        types = {topic.name: topic.type for topic in self.topics}
        for name in names:
            if not self._kept.get(name) and types.get(name) not in (*TF_TYPES, IMU_TYPE):
                raise RecordingError(f"{self.transport.name}: nothing came on {name}")
        with self._changed:
            kept = [message for name in names for message in self._kept[name]]
        yield from sorted(kept, key=lambda message: message.log_time_ns)

    def images(self) -> Iterator[BagMessage]:
        """Yield images as they arrive, until `close`."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._images or self._is_closed)
                if not self._images:
                    break
                message = self._images.popleft()
            yield message
        if self.n_dropped:
            _LOGGER.warning("%d images were dropped before they were paired", self.n_dropped)

    def close(self) -> None:
        """End the images after those received so far."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _subscribe(self, topic: Topic) -> None:
        is_image = topic.type in IMAGE_TYPES
        n_kept = N_WAITING if topic.type == IMU_TYPE else 1 if is_image else _N_KEPT
        self._kept[topic.name] = deque(maxlen=n_kept)
        channel = Channel(topic.name, topic.type, self.transport.is_ros1)
        take = partial(self._take, channel, is_image=is_image)
        self.transport.subscribe(topic.name, topic.type, take)

    def _take(self, topic: Channel, data: bytes, stamp_ns: int, *, is_image: bool) -> None:
        message = BagMessage(topic, stamp_ns, data)
        kept = self._kept[topic.name]
        # Before a simulated clock first ticks, that of an IMU cannot be compared with a camera's.
        is_timed = stamp_ns > 0 or topic.type not in (IMU_TYPE, *IMAGE_TYPES)
        with self._changed:
            if not is_image:
                if is_timed:
                    kept.append(message)
                    self._on_small(message)
                return
            if is_timed and not kept:
                kept.append(message)
            self._images.append(message)
            n_bytes = sum(len(each.data) for each in self._images)
            if len(self._images) > _N_WAITING or n_bytes > MAX_WAITING_BYTES:
                self._images.popleft()
                if self.n_dropped == 0:
                    _LOGGER.warning("images are dropped: %d wait to be paired", len(self._images))
                self.n_dropped += 1
            self._changed.notify_all()


class TopicSource(BagSource):
    """A stereo or RGB-D camera in a network, found by its topics as in a bag.

    Parameters
    ----------
    reader : NetworkReader
    topics, calibration, config, imu
        As of `BagSource`.

    Attributes
    ----------
    imu_queue : ImuQueue or None
        What comes of the IMU.

    Raises
    ------
    RecordingError, CalibrationError
        While the images or the calibration are still missing; see `wait_for`.
    """

    def __init__(
        self,
        reader: NetworkReader,
        *,
        topics: TopicChoice | None = None,
        calibration: CalibrationPaths = None,
        config: Config | None = None,
        imu: ImuFacts | None = None,
    ) -> None:
        is_steady = reader.refresh(with_imu=imu is not None)
        if not is_steady:
            held = describe_topics([each for each in reader.topics if each.type in IMAGE_TYPES])
            raise RecordingError(f"{reader.transport.name}: image topics: {held or 'none'}")
        self._network = reader
        self._name = reader.transport.name
        found = self._open(reader, reader.transport.name, topics, calibration, config)
        self.imu_queue: ImuQueue | None = None
        names = self._info_names
        if imu is not None:
            reader.await_imu(topics.imu if topics else None)
            chosen = self._add_imu(topics, found, {**imu, **found.imu})
            if chosen is not None:
                self.imu_queue = ImuQueue(chosen, self._stamp_of)
                names = names | chosen.names
        reader.follow(names, self._take_small)

    def images(self) -> Iterator[StampedImage]:
        """Yield images as they arrive, until `close`.

        Raises
        ------
        RecordingError
            At the end, if a topic has been silent for three seconds then.
        """
        stamps = ImageStamps()
        came_s: dict[str, float] = {}
        for message in self._network.images():
            name = message.topic.name
            if name in self.image_topics:
                came_s[name] = time.monotonic()
                yield self._stamped(message, self.image_topics.index(name), stamps)
        for name, last_s in came_s.items():
            if (silent_s := time.monotonic() - last_s) > SILENT_S:
                raise RecordingError(f"{name}: no images in the last {silent_s:.0f} s")

    def _take_small(self, message: BagMessage) -> None:
        """Compare a `CameraInfo` with the one that is used; keep samples of the IMU."""
        if self.imu_queue is not None and message.topic.name in self.imu_queue.names:
            self.imu_queue.put(message)
        elif message.topic.name in self._info_names:
            was_same = not self.camera_info_changes
            self._watch.take(message)
            if was_same and self.camera_info_changes:
                _LOGGER.warning("%s changes on the way: %s", message.topic.name, CAMERA_CHANGED)

    def transforms(self, frames: Collection[str] | None = None) -> TfBuffer:
        """Return all transforms received so far."""
        return read_tf(self._network)

    def close(self) -> None:
        """End the images."""
        self._network.close()

    def _choose_topics(self, choice: TopicChoice) -> CameraTopics:
        topics = super()._choose_topics(choice)
        self._network.begin(topics)
        return topics


def wait_for(
    make: Callable[[], _Found], say: Callable[[str], None], is_ended: threading.Event
) -> _Found | None:
    """Call `make` again and again until it succeeds.

    Parameters
    ----------
    make : callable
        Raises a `RecordingError` or `CalibrationError` that says what is missing.
    say : callable
        Gets a line that says what is missing, after a second and when it changes.
    is_ended : threading.Event
        Set it to give up.

    Returns
    -------
    object or None
        What `make` returned; None after giving up.
    """
    said, n_tries = "", 0
    while not is_ended.is_set():
        try:
            return make()
        except (RecordingError, CalibrationError) as error:
            missing = str(error)
        n_tries += 1
        if n_tries >= _SAID_AFTER and missing != said:
            say(f"waiting: {missing}")
            said = missing
        is_ended.wait(_PAUSE_S)
    return None
