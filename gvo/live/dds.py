"""ROS 2 without a ROS installation: its topics and services over CycloneDDS.

The topic `/a/b` of ROS 2 is `rt/a/b` in DDS, its type is `package::msg::dds_::Name_`, and its bytes
are CDR as in a bag. CycloneDDS needs a class for each type, which other participants compare with
theirs: they are made from the definitions in rosbags. The bytes pass through unchanged.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

from rosbags.interfaces import Nodetype

from gvo._text import cut
from gvo.config import Parameters
from gvo.errors import ConfigurationError, GvoError, missing_extra
from gvo.io.bag.reader import typestore
from gvo.io.bag.topics import IMAGE_TYPES, Topic
from gvo.live.transport import OnMessage, Service, decode

try:
    from cyclonedds import builtin, core, domain, pub, sub, topic, util
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.qos import Policy, Qos
except ImportError as error:
    raise missing_extra("gvo live ros2 needs CycloneDDS", "dds") from error

ImageQos: TypeAlias = Literal["sensor", "reliable", "system"]
Receive: TypeAlias = Callable[[Any], None]

_LOGGER = logging.getLogger(__name__)
# Discovery by multicast and by the first ports of this machine, for nodes with either setting.
_LOOPBACK = """<General><AllowMulticast>spdp</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>"""
_SETTINGS = """<CycloneDDS><Domain>{}
<Internal><MaxSampleSize>268435456B</MaxSampleSize></Internal></Domain></CycloneDDS>"""
_MAX_DOMAIN = 232
_N_IMAGES, _N_OTHERS = 10, 100
_N_PUBLICATIONS = 10_000
_CLOCK = Topic(name="/clock", type="rosgraph_msgs/msg/Clock", n_messages=1)
_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")
# A request has the encoding, then client and number, then its fields; answers repeat the second.
_CODING, _ASKED = slice(0, 4), slice(4, 20)
_ANSWERED_WITHIN_S = 2.0

_BASES: Final = {"bool": bool, "string": str, "byte": types.uint8, "char": types.uint8}


class Dds:
    """The DDS network of ROS 2, within this machine by default.

    The domain is `ROS_DOMAIN_ID`. `ROS_LOCALHOST_ONLY=0`, `ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET`
    or the settings in `CYCLONEDDS_URI` open it to other machines.

    Parameters
    ----------
    qos : {"sensor", "reliable", "system"}
        How to receive images: best effort, as is usual for sensors; reliably; or as all writers
        offer. Other messages are always received as their writers offer.

    Raises
    ------
    ConfigurationError
        If the domain cannot be joined.
    """

    is_ros1 = False
    name = "ROS 2"

    def __init__(self, *, qos: ImageQos = "sensor") -> None:
        self._qos = qos
        self._domain, self._participant = _join()
        self._publications = builtin.BuiltinDataReader(
            self._participant, builtin.BuiltinTopicDcpsPublication
        )
        self._readings: list[_Reading] = []
        self._clock_ns: int | None = None
        self._has_clock = False

    def topics(self) -> Sequence[Topic]:
        """Return the topics that others write."""
        found = {
            endpoint.topic_name.removeprefix("rt"): _TYPE.fullmatch(endpoint.type_name)
            for endpoint in self._writers()
            if endpoint.topic_name.startswith("rt/")
        }
        topics = [
            Topic(name=name, type=f"{match[1]}/msg/{match[2]}", n_messages=1)
            for name, match in sorted(found.items())
            if match is not None
        ]
        if _CLOCK in topics and not self._has_clock:
            self._has_clock = True
            self.subscribe(_CLOCK.name, _CLOCK.type, self._set_clock)
        return topics

    def subscribe(self, topic: str, type_: str, callback: OnMessage) -> None:
        """Receive the messages of a topic; see `Transport`."""
        is_image = type_ in IMAGE_TYPES
        offers = [each.qos for each in self._writers() if each.topic_name == f"rt{topic}"]
        is_reliable, is_held = (
            bool(offers) and all(offer[policy] not in (None, least) for offer in offers)
            for policy, least in (
                (Policy.Reliability, Policy.Reliability.BestEffort),
                (Policy.Durability, Policy.Durability.Volatile),
            )
        )
        if is_image and self._qos != "system":
            is_reliable = self._qos == "reliable"
        n_kept = _N_IMAGES if is_image else _N_OTHERS
        qos = _qos(n_kept, is_reliable=is_reliable, is_held=is_held)
        reader = sub.DataReader(self._participant, self._topic(f"rt{topic}", type_), qos)
        self._read(reader, lambda sample: callback(sample.payload, self._now_ns()))

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> DdsPublisher:
        """Open a topic for writing; see `Sink`."""
        qos = _qos(1 if is_latched else _N_OTHERS, is_held=is_latched)
        made = self._topic(f"rt{topic}", type_)
        return DdsPublisher(pub.DataWriter(self._participant, made, qos))

    def serve(self, service: Service) -> None:
        """Answer requests in the format of `rmw_cyclonedds`."""
        type_, qos = service.type, _qos(_N_OTHERS)
        request = self._topic(f"rq{service.name}Request", type_.request_type, kind="srv")
        answer = self._topic(f"rr{service.name}Reply", type_.response_type, kind="srv")
        reader = sub.DataReader(self._participant, request, qos)
        writer = pub.DataWriter(self._participant, answer, qos)
        self._read(reader, partial(_answer, service, reader, writer))

    def offer(self, parameters: Parameters) -> None:
        """Do nothing: parameters are changed on the page or in Foxglove."""

    def close(self) -> None:
        """Leave the network."""
        for reading in self._readings:
            reading.close()
        self._domain.__del__()  # with all that belongs to it; a second time nothing

    def _topic(self, name: str, type_: str, kind: str = "msg") -> topic.Topic[Any]:
        return topic.Topic(self._participant, name, message_class(type_, kind))

    def _read(self, reader: sub.DataReader[Any], receive: Receive) -> None:
        self._readings.append(_Reading(self._participant, reader, receive))

    def _writers(self) -> list[builtin.DcpsEndpoint]:
        """Return the writers of others."""
        own = self._participant.guid
        return [
            endpoint
            for endpoint in self._publications.read(_N_PUBLICATIONS)
            if endpoint.sample_info.instance_state == core.InstanceState.Alive
            and endpoint.participant_key != own
        ]

    def _now_ns(self) -> int:
        return time.time_ns() if self._clock_ns is None else self._clock_ns

    def _set_clock(self, data: bytes, _: int) -> None:
        with suppress(GvoError):
            clock = decode(data, _CLOCK.type, is_ros1=False).clock
            self._clock_ns = clock.sec * 1_000_000_000 + clock.nanosec


class DdsPublisher:
    """A topic that messages are written to."""

    def __init__(self, writer: pub.DataWriter[Any]) -> None:
        self._writer = writer

    def publish(self, data: bytes, stamp_ns: int) -> None:
        """Send a message; readers that are too far behind miss it."""
        with suppress(core.DDSException):
            self._writer.write(_of_bytes(self._writer.data_type, data))

    @property
    def is_heard(self) -> bool:
        """Whether anybody listens."""
        return bool(self._writer.matched_sub)


class _Reading:
    """A thread that takes the messages of a reader."""

    def __init__(
        self, participant: domain.DomainParticipant, reader: sub.DataReader[Any], receive: Receive
    ) -> None:
        self._reader, self._receive = reader, receive
        self._end = core.GuardCondition(participant)
        self._waitset = core.WaitSet(participant)
        state = core.ViewState.Any | core.SampleState.NotRead | core.InstanceState.Any
        for condition in (self._end, core.ReadCondition(reader, state)):
            self._waitset.attach(condition)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Receive nothing more."""
        if self._thread.is_alive():
            self._end.set(True)
            self._thread.join()

    def _run(self) -> None:
        while not self._end.read():
            for sample in self._reader.take(_N_OTHERS):
                if sample.sample_info.valid_data:
                    self._receive(sample)
            self._waitset.wait(util.duration(infinite=True))


@cache
def message_class(type_: str, kind: str = "msg") -> type[Any]:
    """Return the class of `package/msg/Name`; for a service type, that of its header alone."""
    package, _, name = type_.split("/")
    fields = {"guid": types.uint64, "sequence": types.int64}
    if kind == "msg":
        definitions = typestore(is_ros1=False).fielddefs[type_][1]
        fields = {key: _field(definition) for key, definition in definitions}
    full = f"{package}::{kind}::dds_::{name}_"
    made: Any = make_idl_struct(name, full, fields, dataclassify=False)
    made.serialize = lambda sample, **_: sample.payload
    made.deserialize = made.deserialize_key = classmethod(_of_bytes)
    return made  # type: ignore[no-any-return]


def _of_bytes(class_: type[Any], data: bytes, /, **_: Any) -> Any:  # noqa: ANN401
    """Return a message of a class that passes bytes through."""
    sample = class_()
    sample.payload = data
    return sample


def _field(definition: Any) -> Any:  # noqa: ANN401 - types made at run time
    kind, what = definition
    if kind == Nodetype.NAME:
        return message_class(what)
    element, size = what
    if kind == Nodetype.BASE:
        return _BASES.get(element) or getattr(types, element)
    made: Any = types.array if kind == Nodetype.ARRAY else types.sequence
    return made[(_field(element), size) if size else _field(element)]


def _join() -> tuple[domain.Domain, domain.DomainParticipant]:
    """Join the domain, by the loopback interface unless the environment asks for more."""
    get = os.environ.get
    number, settings = get("ROS_DOMAIN_ID") or "0", get("CYCLONEDDS_URI")
    if not (number.isdecimal() and int(number) <= _MAX_DOMAIN):
        expected = f"expected a number from 0 to {_MAX_DOMAIN}"
        raise ConfigurationError(f"ROS_DOMAIN_ID: {expected}, got {cut(number, 40)}")
    is_wide = get("ROS_LOCALHOST_ONLY") == "0" or get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "SUBNET"
    before = sockets()
    try:
        joined = domain.Domain(
            int(number), settings or _SETTINGS.format("" if is_wide else _LOOPBACK)
        )
        participant = domain.DomainParticipant(int(number))
    except core.DDSException as error:
        raise ConfigurationError(f"ROS_DOMAIN_ID={number} cannot be joined: {error}") from error
    if not (settings or is_wide):
        _confine(sockets() - before)
    return joined, participant


def sockets() -> set[int]:
    """Return the open sockets of this process, on Linux."""
    return {int(link.name) for link in Path("/proc/self/fd").glob("*") if link.is_socket()}


def _confine(numbers: set[int]) -> None:
    """Bind sockets to the loopback device: CycloneDDS listens on all addresses."""
    for number in numbers:
        with socket.socket(fileno=os.dup(number)) as made, suppress(OSError):
            made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")


def _qos(n_kept: int, *, is_reliable: bool = True, is_held: bool = False) -> Qos:
    reliable = Policy.Reliability.Reliable(util.duration(milliseconds=10))
    return Qos(
        reliable if is_reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if is_held else Policy.Durability.Volatile,
        Policy.History.KeepLast(n_kept),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def _answer(
    service: Service,
    reader: sub.DataReader[Any],
    writer: pub.DataWriter[Any],
    sample: Any,  # noqa: ANN401
) -> None:
    """Answer a request; ignore a damaged one."""
    coding, asked = sample.payload[_CODING], sample.payload[_ASKED]
    try:
        answer = service.call(coding + sample.payload[_ASKED.stop :], is_ros1=False)
    except GvoError as error:
        _LOGGER.warning("%s: a request is ignored: %s", service.name, error)
        return
    client = reader.get_matched_publication_data(sample.sample_info.publication_handle)
    _wait_for_reader(writer, client)
    with suppress(core.DDSException):
        data = answer[_CODING] + asked + answer[_CODING.stop :]
        writer.write(_of_bytes(writer.data_type, data))


def _wait_for_reader(writer: pub.DataWriter[Any], client: builtin.DcpsEndpoint | None) -> None:
    """Wait until DDS knows the client's reader of answers, else the answer would be lost."""
    end_s = time.monotonic() + _ANSWERED_WITHIN_S
    while client is not None and time.monotonic() < end_s:
        readers = map(writer.get_matched_subscription_data, writer.matched_sub)
        if any(each and each.participant_key == client.participant_key for each in readers):
            return
        time.sleep(0.005)
