"""A network inside the process, for tests: what is published can be read, bags are played."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gvo
from gvo.config import Parameters
from gvo.io.bag.messages import stamp_of
from gvo.io.bag.reader import BagMessage, BagReader, serialize, typestore
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.topics import Topic, TopicChoice
from gvo.io.calibration.forms import ImuFacts
from gvo.live.odometry import LiveOdometry, LiveRun
from gvo.live.topics import NetworkReader, TopicSource, wait_for
from gvo.live.transport import Service, decode

NO_REPORT = gvo.RunOutputs(report=False)
SECOND_NS = 10**9
ODOMETRY = "/gvo/odom/odometry"


class Outlet:
    """A topic that a node writes to."""

    def __init__(self, network: Network, topic: str, type_: str) -> None:
        self._network, self._topic, self._type = network, topic, type_

    @property
    def is_heard(self) -> bool:
        return self._topic not in self._network.unheard

    def publish(self, data: bytes, stamp_ns: int) -> None:
        message = decode(data, self._type, is_ros1=self._network.is_ros1)
        with self._network.changed:
            self._network.sent[self._topic].append((stamp_ns, message))
            self._network.changed.notify_all()


class Network:
    """Topics, services and parameters in one process."""

    name = "network"

    def __init__(self, *, is_ros1: bool = False) -> None:
        self.is_ros1 = is_ros1
        self.announced: list[Topic] = []
        self.unheard: set[str] = set()
        self.sent: dict[str, list[tuple[int, Any]]] = defaultdict(list)
        self.opened: dict[str, tuple[str, bool]] = {}
        self.services: dict[str, Service] = {}
        self.parameters: Parameters | None = None
        self.changed = threading.Condition()
        self.is_closed = False
        self._callbacks: dict[str, Callable[[bytes, int], None]] = {}

    def topics(self) -> Sequence[Topic]:
        return [*self.announced]

    def subscribe(self, topic: str, type_: str, callback: Callable[[bytes, int], None]) -> None:
        assert Topic(name=topic, type=type_, n_messages=1) in self.announced
        with self.changed:
            assert topic not in self._callbacks, "subscribed twice"
            self._callbacks[topic] = callback
            self.changed.notify_all()

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> Outlet:
        assert topic not in self.opened, "announced twice"
        self.opened[topic] = (type_, is_latched)
        return Outlet(self, topic, type_)

    def serve(self, service: Service) -> None:
        self.services[service.name] = service

    def offer(self, parameters: Parameters) -> None:
        self.parameters = parameters

    def close(self) -> None:
        self.is_closed = True

    def announce(self, topics: Iterable[Topic | Channel]) -> None:
        self.announced += [Topic(name=t.name, type=t.type, n_messages=1) for t in topics]

    def is_heard(self, topic: str) -> bool:
        return topic in self._callbacks

    def send(self, message: BagMessage) -> None:
        name = message.topic.name
        with self.changed:
            assert self.changed.wait_for(lambda: name in self._callbacks, timeout=60)
        self._callbacks[name](message.data, message.log_time_ns)

    def wait_for(self, topic: str, n: int) -> list[tuple[int, Any]]:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.sent[topic]) >= n, timeout=60)
            return [*self.sent[topic]]


def recorded(bag: Path) -> list[BagMessage]:
    """Return the messages of a bag, those that do not move first."""
    reader = BagReader(bag)
    messages = [*reader.messages({topic.name for topic in reader.topics})]
    return sorted(messages, key=lambda message: message.topic.name != "/tf_static")


class Play:
    """Odometry over a bag, or some messages, that are played in a network.

    The script sends messages in a thread of its own; at its end the images end.
    """

    def __init__(
        self,
        played: Path | Sequence[BagMessage],
        script: Callable[[Play], None] | None = None,
        *,
        choice: TopicChoice | None = None,
        imu: ImuFacts | None = None,
        **options: Any,
    ) -> None:
        found = recorded(played) if isinstance(played, Path) else played
        self.messages = [each for each in found if each.topic.name != "/tf"]
        self.said: list[str] = []
        self.network = Network(is_ros1=self.messages[0].topic.is_ros1)
        self.network.announce({each.topic.name: each.topic for each in self.messages}.values())
        self.reader = NetworkReader(self.network)
        self._script = script or Play.send_all
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()
        make = partial(TopicSource, self.reader, topics=choice, imu=imu or {})
        source = wait_for(make, self.said.append, threading.Event())
        assert source is not None
        self.source = source
        options = {"max_waiting": 1000, "say": self.said.append, **options}
        self.live = LiveOdometry(source, sinks=[self.network], **options)

    def _play(self) -> None:
        try:
            self._script(self)
        finally:
            self.reader.close()

    def send_all(self) -> None:
        self.send(0, len(self.messages))

    def send(self, start: int, end: int) -> None:
        for message in self.messages[start:end]:
            self.network.send(message)

    def run(self, out: Path, outputs: gvo.RunOutputs = NO_REPORT) -> list[LiveRun]:
        runs = self.live.run(out, outputs=outputs)
        self.wait()
        return runs

    def wait(self) -> None:
        """Wait for the end of the script."""
        self._thread.join(timeout=60)
        assert not self._thread.is_alive()

    def sent(self, topic: str) -> list[Any]:
        return [message for _, message in self.network.sent[topic]]

    def call(self, name: str, **fields: Any) -> Any:
        """Call a service as a client does, by bytes."""
        service, is_ros1 = self.network.services[name], self.network.is_ros1
        service.type.register(is_ros1=is_ros1)
        store = typestore(is_ros1=is_ros1)
        type_ = service.type.request_type
        request = serialize(store.types[type_](**fields), type_, is_ros1=is_ros1)
        answer = service.call(request, is_ros1=is_ros1)
        return decode(answer, service.type.response_type, is_ros1=is_ros1)


def shifted(message: BagMessage, by_ns: int) -> BagMessage:
    """Return a message of a time by so much later."""
    content = message.decode()
    if hasattr(content, "header"):
        stamp = content.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_of(content.header) + by_ns, SECOND_NS)
    data = serialize(content, message.topic.type, is_ros1=message.topic.is_ros1)
    return BagMessage(message.topic, message.log_time_ns + by_ns, data)
