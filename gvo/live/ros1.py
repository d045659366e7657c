"""ROS 1 by rospy: topics, services, and parameters as dynamic_reconfigure has them.

Messages stay bytes: rospy gets classes that have the name and MD5 sum of a type and pass bytes
through, so that neither message packages nor cv_bridge are needed.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import signal
import socket
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from http.client import HTTPException
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from itertools import chain
from typing import Any, Final
from urllib.parse import urlsplit

from rosbags.typesys.msg import denormalize_msgtype, normalize_msgtype

from gvo.config import Config, Parameter, Parameters, list_parameters
from gvo.errors import ConfigurationError, GvoError, RecordingError
from gvo.io.bag.reader import serialize, typestore
from gvo.io.bag.topics import Topic
from gvo.live.transport import OnMessage, Service, ServiceType

_LOGGER = logging.getLogger(__name__)
# Where Debian and Ubuntu install rospy. Appended to the path, so that it shadows no package.
_DEBIAN = "/usr/lib/python3/dist-packages"
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_MASTER_TIMEOUT_S = 5.0
_FLUSH_TIMEOUT_S = 2.0
_N_QUEUED = 100
_READ_BYTES = 1 << 20


class Ros1:
    """A node of ROS 1.

    rospy allows one node per process, and none after `close`. A node that exists is used.

    Parameters
    ----------
    arguments : sequence of str
        `from:=to` of topics and services, `__name:=name` of the node, `_parameter:=value`.

    Raises
    ------
    ConfigurationError
        If rospy is not installed, or no master answers.
    """

    name = "ROS 1"
    is_ros1 = True

    def __init__(self, arguments: Sequence[str] = ()) -> None:
        self._rospy = rospy = _import_rospy()
        self._publishers: list[Any] = []
        self._is_closed = False
        uri = _find_master()
        if rospy.core.is_initialized():
            return
        if (
            not {"ROS_IP", "ROS_HOSTNAME"} & os.environ.keys()
            and urlsplit(uri).hostname in _LOOPBACK
        ):
            os.environ["ROS_IP"] = "127.0.0.1"  # else it listens on all networks
        rospy.core.configure_logging = lambda *_: None  # takes over all of Python's logging
        try:
            rospy.init_node("gvo", argv=["gvo", *arguments], disable_signals=True)
        except (rospy.ROSException, ValueError) as error:
            raise ConfigurationError(f"ROS 1: {error}") from error
        rospy.core.add_preshutdown_hook(self._end)

    def topics(self) -> list[Topic]:
        """Return the topics that other nodes announce."""
        try:
            master = self._rospy.get_master()
            _, _, (published, _, _) = master.getSystemState()
            _, _, types = master.getTopicTypes()
        except (OSError, xmlrpc.client.Error, HTTPException) as error:
            raise RecordingError(f"ROS 1: the master does not answer any more: {error}") from error
        others = {name for name, nodes in published if set(nodes) - {self._rospy.get_name()}}
        return [
            Topic(name=name, type=normalize_msgtype(type_), n_messages=1)
            for name, type_ in types
            if name in others
        ]

    def subscribe(self, topic: str, type_: str, callback: OnMessage) -> None:
        """Receive the messages of a topic, see `Transport`."""

        def receive(message: Any) -> None:  # noqa: ANN401 - of a class made at run time
            callback(message.data, self._rospy.get_rostime().to_nsec())

        self._rospy.Subscriber(
            topic, _message_class(type_), receive, buff_size=_READ_BYTES, tcp_nodelay=True
        )

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> _Publisher:
        """Open a topic for writing; `~name` is in the node's namespace."""
        message_class = _message_class(type_)
        publisher = self._rospy.Publisher(
            topic, message_class, latch=is_latched, queue_size=_N_QUEUED
        )
        self._publishers.append(publisher)
        return _Publisher(publisher, message_class, is_latched=is_latched)

    def serve(self, service: Service) -> None:
        """Answer the calls of a service; `~name` is in the node's namespace."""
        service_class = _service_class(service.type)

        def answer(request: Any) -> Any:  # noqa: ANN401 - of classes made at run time
            try:
                return service_class._response_class(service.call(request.data, is_ros1=True))
            except GvoError as error:
                raise self._rospy.ServiceException(str(error)) from error

        self._rospy.Service(service.name, service_class, answer)

    def offer(self, parameters: Parameters) -> None:
        """Let rqt_reconfigure and dynparam change the parameters."""
        _Reconfigure(self, parameters, warn=self._rospy.logwarn)

    def close(self) -> None:
        """Send what is queued, and leave."""
        end_s = time.monotonic() + _FLUSH_TIMEOUT_S
        while time.monotonic() < end_s and any(map(_has_queued, self._publishers)):
            time.sleep(0.01)
        self._is_closed = True
        self._rospy.signal_shutdown("closed")

    def _end(self, reason: str) -> None:
        """End the program as Ctrl-C does when the master ends the node (rosnode kill)."""
        if not self._is_closed:
            _LOGGER.warning("ROS 1: the master ends the node: %s", reason)
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


class _Publisher:
    def __init__(self, publisher: Any, message_class: Any, *, is_latched: bool) -> None:  # noqa: ANN401
        self._publisher, self._message_class = publisher, message_class
        self._is_latched = is_latched

    def publish(self, data: bytes, stamp_ns: int) -> None:
        """Send a message; for a slow node the oldest that waits is dropped."""
        self._publisher.publish(self._message_class(data))

    @property
    def is_heard(self) -> bool:
        """Whether anybody listens; always true for a latched topic."""
        return self._is_latched or self._publisher.get_num_connections() > 0


def _has_queued(publisher: Any) -> bool:  # noqa: ANN401
    connections = publisher.impl.connections if publisher.impl else ()
    return any(getattr(connection, "_queue", ()) for connection in connections)


def _import_rospy() -> Any:  # noqa: ANN401 - has no types
    if find_spec("rospy") is None:
        sys.path.append(_DEBIAN)
    logger_class = logging.getLoggerClass()
    try:
        rospy = import_module("rospy")
    except ImportError as error:
        raise ConfigurationError(
            f"ROS 1: {error}; install rospy (Debian, Ubuntu: apt-get install python3-rospy), or "
            "source the setup.bash of ROS"
        ) from error
    finally:
        logging.setLoggerClass(logger_class)  # rospy has its own for all
    return rospy


def _find_master() -> str:
    """Return the address of the master; without one rospy would wait for ever."""
    rosgraph = import_module("rosgraph")
    uri = str(rosgraph.get_master_uri())
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_MASTER_TIMEOUT_S)
    try:
        rosgraph.Master("/gvo").getPid()
    except (OSError, ValueError, rosgraph.MasterException, xmlrpc.client.Error) as error:
        raise ConfigurationError(
            f"ROS 1: no master answers at {uri}: {error}; start roscore, or set ROS_MASTER_URI"
        ) from error
    finally:
        socket.setdefaulttimeout(before)
    return uri


class _Bytes:
    """A message that stays serialised."""

    def __init__(self, data: bytes = b"") -> None:
        self.data = data

    def serialize(self, buffer: BytesIO) -> None:
        buffer.write(self.data)

    def deserialize(self, data: bytes) -> _Bytes:
        self.data = data
        return self


@cache
def _message_class(type_: str, name: str | None = None) -> Any:  # noqa: ANN401 - made here
    definition, md5sum = typestore(is_ros1=True).generate_msgdef(type_)
    fields = {
        "_type": name or denormalize_msgtype(type_),
        "_md5sum": md5sum,
        "_full_text": definition,
        "_has_header": False,  # rospy would number it
    }
    return type("Message", (_Bytes, import_module("genpy").Message), fields)


def _service_class(service: ServiceType) -> Any:  # noqa: ANN401 - made here
    service.register(is_ros1=True)
    name = service.name.replace("/srv/", "/")
    text = _hashed(service.request) + _hashed(service.response)
    fields = {
        "_type": name,
        "_md5sum": hashlib.md5(text.encode(), usedforsecurity=False).hexdigest(),
        "_request_class": _message_class(service.request_type, f"{name}Request"),
        "_response_class": _message_class(service.response_type, f"{name}Response"),
    }
    return type("Service", (), fields)


def _hashed(definition: str) -> str:
    """Return the text that the MD5 sum of a service is of: sums in place of message names."""
    lines = []
    for type_, field in (line.split() for line in definition.splitlines()):
        is_message = "/" in type_
        md5sum = _message_class(normalize_msgtype(type_))._md5sum if is_message else type_
        lines.append(f"{md5sum} {field}")
    return "\n".join(lines)


_PACKAGE = "dynamic_reconfigure/msg"
_RECONFIGURE: Final = ServiceType(
    name="dynamic_reconfigure/srv/Reconfigure",
    request="dynamic_reconfigure/Config config",
    response="dynamic_reconfigure/Config config",
)
_TYPES: Final = {bool: "bool", int: "int", float: "double", str: "str"}
# Type of each kind of parameter, and the bounds that are shown if it has none of its own.
_KINDS: Final[dict[str, tuple[Any, Any, Any]]] = {
    "switch": (bool, False, True),
    "choice": (str, "", ""),
    "integer": (int, -(2**31), 2**31 - 1),
    "number": (float, -math.inf, math.inf),
}
_NULL = "null"


class _Reconfigure:
    """A server of dynamic_reconfigure.

    A parameter is named `section__key`, in the group of its section. One that may be null is a
    text.
    """

    def __init__(self, node: Ros1, parameters: Parameters, *, warn: Callable[[str], None]) -> None:
        self._parameters, self._warn = parameters, warn
        every = chain(*list_parameters().values())
        self._known = {f"{one.section}__{one.key}": _shown(one) for one in every}
        self._tell_config = _opened(node, "~parameter_updates", "Config")
        _opened(node, "~parameter_descriptions", "ConfigDescription")(self._description())
        self._tell(parameters.config)
        parameters.follow(self._tell)
        node.serve(Service(name="~set_parameters", type=_RECONFIGURE, answer=self._set))

    def _tell(self, config: Config) -> None:
        self._tell_config(self._state(config))

    def _state(self, config: Config) -> Any:  # noqa: ANN401 - made at run time
        return _config(self._values(config), list_parameters())

    def _set(self, request: Any) -> dict[str, Any]:  # noqa: ANN401 - made at run time
        try:
            self._parameters.set(self._wanted(request.config))
        except ConfigurationError as error:
            _LOGGER.warning("dynamic_reconfigure: %s", error)
            self._warn(str(error))
            self._tell(self._parameters.config)
        return {"config": self._state(self._parameters.config)}

    def _wanted(self, config: Any) -> dict[str, Any]:  # noqa: ANN401 - made at run time
        """Return the values that a request sets, by `section.key`."""
        lists = [getattr(config, f"{type_}s") for type_ in _TYPES.values()]
        given = {item.name.replace("__", "."): item.value for item in chain(*lists)}
        return {name: None if value == _NULL else value for name, value in given.items()}

    def _values(self, config: Config) -> dict[str, Any]:
        values = {}
        for name, one in self._known.items():
            value = getattr(getattr(config, one.section), one.key)
            values[name] = _NULL if value is None else _KINDS[one.kind][0](value)
        return values

    def _description(self) -> Any:  # noqa: ANN401 - made at run time
        lower, upper = {}, {}
        for name, one in self._known.items():
            type_, lowest, highest = _KINDS[one.kind]
            lower[name] = type_(lowest if one.minimum is None else one.minimum)
            upper[name] = type_(highest if one.maximum is None else one.maximum)
        groups = []
        for index, section in enumerate(["Default", *list_parameters()]):
            described = [
                _make(
                    "ParamDescription",
                    name=name,
                    type=_TYPES[_KINDS[one.kind][0]],
                    level=0,
                    description=one.hint,
                    edit_method=_enumeration(one),
                )
                for name, one in self._known.items()
                if one.section == section
            ]
            names = {"name": section, "type": "collapse" if index else ""}
            groups.append(_make("Group", parameters=described, parent=0, id=index, **names))
        bounds = {"min": _config(lower), "max": _config(upper)}
        defaults = _config(self._values(Config()))
        return _make("ConfigDescription", groups=groups, dflt=defaults, **bounds)


def _shown(one: Parameter) -> Parameter:
    """Return what may be null as a text."""
    return replace(one, kind="choice", minimum=None, maximum=None) if one.is_optional else one


def _enumeration(parameter: Parameter) -> str:
    """Return the choices, if any, as dynamic_reconfigure wants them: the repr of a dict."""
    choices = [
        {"name": choice, "value": choice, "type": "str", "description": choice}
        for choice in parameter.choices
    ]
    return repr({"enum": choices, "enum_description": parameter.hint}) if choices else ""


def _config(values: Mapping[str, Any], sections: Iterable[str] = ()) -> Any:  # noqa: ANN401
    """Return a message of values, and of groups where sections are given."""
    lists: dict[str, list[Any]] = {f"{type_}s": [] for type_ in _TYPES.values()}
    for name, value in values.items():
        type_ = _TYPES[type(value)]
        lists[f"{type_}s"].append(_make(f"{type_.capitalize()}Parameter", name=name, value=value))
    groups = [
        _make("GroupState", name=name, state=True, id=index, parent=0)
        for index, name in enumerate(["Default", *sections] if sections else [])
    ]
    return _make("Config", groups=groups, **lists)


def _make(name: str, /, **fields: Any) -> Any:  # noqa: ANN401 - made at run time
    return typestore(is_ros1=True).types[f"{_PACKAGE}/{name}"](**fields)


def _opened(node: Ros1, topic: str, name: str) -> Callable[[object], None]:
    type_ = f"{_PACKAGE}/{name}"
    publisher = node.advertise(topic, type_, is_latched=True)
    return lambda message: publisher.publish(serialize(message, type_, is_ros1=True), 0)
