"""A network inside the process, for tests: what is published can be read, bags are played."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from gvo.config import Parameters
from gvo.io.bag.reader import BagMessage, BagReader
from gvo.io.bag.topics import Topic
from gvo.live.transport import Service, decode


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

    def announce(self, topics: Iterable[Topic]) -> None:
        self.announced += [Topic(name=t.name, type=t.type, n_messages=1) for t in topics]

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
