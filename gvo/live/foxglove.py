"""A live view in Foxglove: a WebSocket server of the Foxglove SDK, beside any input.

It needs foxglove-sdk (the extra `foxglove`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from typing import Any

from gvo.config import Config, Parameters, values_by_name
from gvo.errors import ConfigurationError, missing_extra
from gvo.io.bag.reader import typestore
from gvo.live.transport import Publisher, Service

try:
    import foxglove
    from foxglove.websocket import Capability, ChannelView, Client, ServerListener, WebSocketServer
except ImportError as error:
    raise missing_extra("--foxglove needs foxglove-sdk", "foxglove") from error

DEFAULT_PORT = 8765
"""The port that Foxglove proposes."""

_ENCODING, _SCHEMA_ENCODING = "cdr", "ros2msg"
# Messages that may wait for a client; then the oldest are dropped.
_N_WAITING = 256
# CDR has a byte for a message without fields; not all clients send it.
_N_BYTES_EMPTY = 5
_PATIENCE_S = 2.0
_NULL = "null"
_STATUS = "parameters"


class Foxglove:
    """A WebSocket server for Foxglove: topics, parameters and services of a run.

    Parameters
    ----------
    host : str
        Address to listen on; with 0.0.0.0 everyone on the network can see and control the run.
    port : int
        0 takes a free port.

    Raises
    ------
    ConfigurationError
        If the port is taken, or the address does not belong to this machine.
    """

    is_ros1 = False

    def __init__(self, *, host: str = "127.0.0.1", port: int = DEFAULT_PORT) -> None:
        # Errors of clients are sent to them, not printed.
        logging.getLogger("foxglove").addHandler(logging.NullHandler())
        self._host = host
        self._context = foxglove.Context()
        self._listener = _Listener()
        try:
            self._server = foxglove.start_server(
                name="gvo",
                host=host,
                port=port,
                capabilities=[Capability.Parameters, Capability.Services],
                supported_encodings=[_ENCODING],
                server_listener=self._listener,
                context=self._context,
                message_backlog_size=_N_WAITING,
            )
        except (RuntimeError, OverflowError) as error:
            reason = str(error).rpartition("port: ")[2]
            raise ConfigurationError(
                f"--foxglove: cannot listen on {host}:{port}: {reason}; give another port, 0 for "
                "any, and an address of this machine"
            ) from error
        self._listener.server = self._server
        self._is_closed = False

    @property
    def url(self) -> str:
        """Address to be opened in Foxglove on this machine."""
        host = "localhost" if self._host in ("0.0.0.0", "::") else self._host  # noqa: S104
        return f"ws://{f'[{host}]' if ':' in host else host}:{self._server.port}"

    def advertise(self, topic: str, type_: str, *, is_latched: bool = False) -> Publisher:
        """Open a channel for CDR messages with a schema of ROS 2."""
        schema = _schema(type_, type_)
        channel = foxglove.Channel(
            topic, schema=schema, message_encoding=_ENCODING, context=self._context
        )
        publisher = _Channel(channel, is_latched=is_latched)
        self._listener.channels[channel.id()] = publisher
        return publisher

    def serve(self, service: Service) -> None:
        """Answer the calls of a service; the client gets an error for a damaged request."""
        type_ = service.type
        type_.register(is_ros1=False)
        request, response = (
            foxglove.MessageSchema(encoding=_ENCODING, schema=_schema(f"{type_.name}{end}", name))
            for end, name in (("_Request", type_.request_type), ("_Response", type_.response_type))
        )

        def answer(call: foxglove.ServiceRequest) -> bytes:
            return service.call(call.payload.ljust(_N_BYTES_EMPTY, b"\0"), is_ros1=False)

        schema = foxglove.ServiceSchema(type_.name, request=request, response=response)
        self._server.add_services([foxglove.Service(service.name, schema=schema, handler=answer)])

    def offer(self, parameters: Parameters) -> None:
        """Let clients see and set parameters; one that is None appears as the text null."""
        self._listener.parameters = parameters

    def close(self) -> None:
        """Disconnect the clients and listen no more; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        # `stop` waits for ever for clients that connected and sent nothing.
        stopping = threading.Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(_PATIENCE_S)
        for publisher in self._listener.channels.values():
            publisher.channel.close()


class _Channel:
    """A publisher of one channel."""

    def __init__(self, channel: foxglove.Channel, *, is_latched: bool) -> None:
        self.channel, self._is_latched = channel, is_latched
        self._last: tuple[bytes, int] | None = None

    @property
    def is_heard(self) -> bool:
        return self.channel.has_sinks()

    def publish(self, data: bytes, stamp_ns: int) -> None:
        if self._is_latched:
            self._last = data, stamp_ns
        self.channel.log(data, log_time=stamp_ns)

    def repeat(self) -> None:
        """Send the last message of a latched channel again, for a new subscriber."""
        if self._last is not None:
            data, stamp_ns = self._last
            # Not by `publish`, which would overwrite what another thread publishes meanwhile.
            self.channel.log(data, log_time=stamp_ns)


class _Listener(ServerListener):
    """Answers requests of clients, in threads of the server."""

    server: WebSocketServer
    parameters: Parameters | None = None

    def __init__(self) -> None:
        self.channels: dict[int, _Channel] = {}

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        if channel.id in self.channels:
            self.channels[channel.id].repeat()

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[foxglove.Parameter]:
        return [] if self.parameters is None else _values(self.parameters.config, param_names)

    def on_set_parameters(
        self, client: Client, parameters: list[foxglove.Parameter], request_id: str | None = None
    ) -> list[foxglove.Parameter]:
        """Set all of them or none; return their values."""
        if self.parameters is None:
            return []
        try:
            self.parameters.set({each.name: _value(each) for each in parameters})
        except ConfigurationError as error:
            self.server.publish_status(str(error), foxglove.StatusLevel.Warning, _STATUS)
        else:
            self.server.remove_status([_STATUS])
        return _values(self.parameters.config, [each.name for each in parameters])


def _schema(name: str, type_: str) -> foxglove.Schema:
    definition, _ = typestore(is_ros1=False).generate_msgdef(type_, ros_version=2)
    return foxglove.Schema(name=name, encoding=_SCHEMA_ENCODING, data=definition.encode())


def _values(config: Config, names: Sequence[str]) -> list[foxglove.Parameter]:
    """Return the parameters of these names, or all if there are no names."""
    values = values_by_name(config)
    known = {name: _NULL if value is None else value for name, value in values.items()}
    chosen = [name for name in names if name in known] or ([] if names else known)
    return [foxglove.Parameter(name, value=known[name]) for name in chosen]


def _value(parameter: foxglove.Parameter) -> Any:  # noqa: ANN401 - whatever a client sends
    value = parameter.get_value()
    return None if value == _NULL else value
