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
    CameraTopics,
    Topic,
    TopicChoice,
    describe_topics,
)
from gvo.io.calibration.files import CalibrationPaths
from gvo.io.poses.tf import TF_TYPES, TfBuffer, read_tf
from gvo.io.recording import StampedImage
from gvo.io.sync import MAX_WAITING_BYTES
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
_Found = TypeVar("_Found")


class NetworkReader:
    """Reads the topics of a network as `BagReader` reads those of a bag.

    It receives `CameraInfo` and transforms from the first `refresh` on, images from `begin` on.

    Parameters
    ----------
    transport : Transport

    Attributes
    ----------
    topics : list of Topic
        Those that others announce.
    n_dropped : int
        Images that were given up because too many waited to be paired.
    on_small : callable
        Gets each `CameraInfo` and transform when it comes.
    """

    damage = ""

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.topics: list[Topic] = []
        self.notes: list[str] = []
        self.n_dropped = 0
        self.on_small: Callable[[BagMessage], None] = lambda _: None
        self._kept: dict[str, deque[BagMessage]] = {}
        self._images: deque[BagMessage] = deque()
        self._changed = threading.Condition()
        self._is_closed = False

    def refresh(self) -> bool:
        """List the topics again; tell whether they are still the same."""
        before = self.topics
        topics = [each for each in self.transport.topics() if not each.name.startswith(_OWN)]
        self.topics = sorted(topics, key=lambda topic: topic.name)
        for topic in self.topics:
            if topic.type in _SMALL and topic.name not in self._kept:
                self._subscribe(topic)
        return self.topics == before

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
            If nothing came on a topic that is not tf.
        """
        types = {topic.name: topic.type for topic in self.topics}
        for name in names:
            if not self._kept.get(name) and types.get(name) not in TF_TYPES:
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
        self._kept[topic.name] = deque(maxlen=1 if is_image else _N_KEPT)
        channel = Channel(topic.name, topic.type, self.transport.is_ros1)
        take = partial(self._take, channel, is_image=is_image)
        self.transport.subscribe(topic.name, topic.type, take)

    def _take(self, topic: Channel, data: bytes, stamp_ns: int, *, is_image: bool) -> None:
        message = BagMessage(topic, stamp_ns, data)
        kept = self._kept[topic.name]
        with self._changed:
            if not is_image:
                kept.append(message)
                self.on_small(message)
                return
            if not kept:
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
    topics, calibration, config
        As of `BagSource`.

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
    ) -> None:
        is_steady = reader.refresh()
        if not is_steady:
            held = describe_topics([each for each in reader.topics if each.type in IMAGE_TYPES])
            raise RecordingError(f"{reader.transport.name}: image topics: {held or 'none'}")
        self._network = reader
        self._name = reader.transport.name
        self._open(reader, reader.transport.name, topics, calibration, config)

    def images(self) -> Iterator[StampedImage]:
        """Yield images as they arrive, until `close`.

        Raises
        ------
        RecordingError
            At the end, if a topic has been silent for three seconds then.
        """
        stamps = ImageStamps()
        came_s: dict[str, float] = {}
        for message in self._network.messages(self._info_names):
            self._watch.take(message)
        self._network.on_small = self._watch_info
        for message in self._network.images():
            name = message.topic.name
            if name in self.image_topics:
                came_s[name] = time.monotonic()
                yield self._stamped(message, self.image_topics.index(name), stamps)
        for name, last_s in came_s.items():
            if (silent_s := time.monotonic() - last_s) > SILENT_S:
                raise RecordingError(f"{name}: no images in the last {silent_s:.0f} s")

    def _watch_info(self, message: BagMessage) -> None:
        """Compare a `CameraInfo` with the one that is used; say so once where it differs."""
        if message.topic.name in self._info_names:
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
