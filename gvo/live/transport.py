"""What `gvo live` needs of a network of topics, of services and of parameters.

Messages are bytes: rosbags serialises them, so that no message packages of ROS are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

from rosbags.typesys import get_types_from_msg

from gvo.config import Parameters
from gvo.io.bag.reader import BagMessage, serialize, typestore
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.topics import Topic
from gvo.io.convert.bag_messages import MessageWriter

OnMessage: TypeAlias = Callable[[bytes, int], None]
"""Gets the bytes of a message, and the time when it came, nanoseconds."""


class Publisher(Protocol):
    """A topic that messages are written to."""

    def publish(self, data: bytes, stamp_ns: int) -> None:
        """Send a message. Any thread may call it."""

    @property
    def is_heard(self) -> bool:
        """Whether anybody listens; clouds and pictures are not made otherwise."""


class Sink(Protocol):
    """A network or viewer that gets messages, calls services and changes parameters.

    Attributes
    ----------
    is_ros1 : bool
        Messages are serialised as in ROS 1, else as CDR.
    """

    is_ros1: bool

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> Publisher:
        """Open a topic for writing.

        Parameters
        ----------
        topic : str
            With its leading slash.
        type_ : str
            `package/msg/Name`.
        is_latched : bool
            Subscribers that come late get the last message.
        """

    def serve(self, service: Service) -> None:
        """Answer the calls of a service, in a thread of the transport."""

    def offer(self, parameters: Parameters) -> None:
        """Let others see and change the parameters, if the network has a way to do so."""

    def close(self) -> None:
        """Leave the network: send and receive nothing any more."""


class Transport(Sink, Protocol):
    """A network that also has topics of cameras.

    Attributes
    ----------
    name : str
        For messages.
    """

    name: str

    def topics(self) -> Sequence[Topic]:
        """Return the topics of others; `n_messages` is 1, the true number being unknown."""

    def subscribe(self, topic: str, type_: str, callback: OnMessage) -> None:
        """Receive the messages of a topic, also latched ones.

        Parameters
        ----------
        topic, type_ : str
            As `topics` has them.
        callback : callable
            Gets the bytes of a message and the time of the network's clock, nanoseconds, which
            may be simulated. Called in a thread of the transport.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceType:
    """A service type as in ROS 2.

    Parameters
    ----------
    name : str
        `package/srv/Name`.
    request, response : str
        The parts of a `.srv` file above and below its line of dashes.
    """

    name: str
    request: str
    response: str

    @property
    def request_type(self) -> str:
        """Name of the request's message type."""
        return f"{self.name.replace('/srv/', '/msg/')}_Request"

    @property
    def response_type(self) -> str:
        """Name of the answer's message type."""
        return f"{self.name.replace('/srv/', '/msg/')}_Response"

    def register(self, *, is_ros1: bool) -> None:
        """Register both message types with rosbags."""
        store = typestore(is_ros1=is_ros1)
        for type_, text in (self.request_type, self.request), (self.response_type, self.response):
            if type_ not in store.fielddefs:
                store.register(get_types_from_msg(text, type_))


TRIGGER: Final = ServiceType(
    name="std_srvs/srv/Trigger", request="", response="bool success\nstring message"
)
SET_POSE: Final = ServiceType(
    name="robot_localization/srv/SetPose",
    request="geometry_msgs/PoseWithCovarianceStamped pose",
    response="",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """A service and the function that answers it.

    Parameters
    ----------
    name : str
        With its leading slash.
    type : ServiceType
    answer : callable
        Gets the message of a request and returns the fields of the answer, in any thread.
    """

    name: str
    type: ServiceType
    answer: Callable[[Any], Mapping[str, Any]]

    def call(self, request: bytes, *, is_ros1: bool) -> bytes:
        """Answer a request; both are bytes.

        Raises
        ------
        RecordingError
            If the request cannot be decoded.
        """
        self.type.register(is_ros1=is_ros1)
        message = decode(request, self.type.request_type, is_ros1=is_ros1)
        type_ = self.type.response_type
        response = typestore(is_ros1=is_ros1).types[type_](**self.answer(message))
        return serialize(response, type_, is_ros1=is_ros1)


def decode(data: bytes, type_: str, *, is_ros1: bool) -> Any:  # noqa: ANN401 - made at run time
    """Decode a message that came from a network.

    Raises
    ------
    RecordingError
        If the bytes are not a message of the type.
    """
    return BagMessage(Channel(type_, type_, is_ros1), 0, data).decode()


class NetworkWriter(MessageWriter):
    """Writes messages into a network.

    Parameters
    ----------
    sink : Sink
    name : str
        For messages.
    left_out : collection of str
        Topics that are not written.
    """

    def __init__(self, sink: Sink, name: str, left_out: Collection[str] = ()) -> None:
        super().__init__(name, is_ros1=sink.is_ros1)
        self._sink, self._left_out = sink, left_out
        self._publishers: dict[str, Publisher] = {}

    def announce(self, topics: Mapping[str, str]) -> None:
        """Open topics, by name and type, so that others find them before the first message."""
        for topic, type_ in topics.items():
            self._publisher(topic, type_, is_latched=topic == "/tf_static")

    def is_wanted(self, topic: str) -> bool:
        """Tell whether anybody listens; also true if the topic is not open yet."""
        publisher = self._publishers.get(topic)
        return publisher is None or publisher.is_heard

    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        """Send a message."""
        if topic not in self._left_out:
            data = self.serialize(message, type_)
            self._publisher(topic, type_, is_latched=is_latched).publish(data, stamp_ns)

    def _publisher(self, topic: str, type_: str, *, is_latched: bool) -> Publisher:
        if topic not in self._publishers:
            self._publishers[topic] = self._sink.advertise(topic, type_, is_latched=is_latched)
        return self._publishers[topic]
