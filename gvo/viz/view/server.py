"""The web server of the page: where it binds, what it says, how it ends."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as websockets_server

from gvo.errors import ConfigurationError

N_PORTS = 20
"""How many ports are tried, from the one asked for."""

_MAX_PATH = 250  # bytes; the names of the page's files are shorter, no file's name is longer


class LocalServer(viser.ViserServer):
    """A server that stays on this machine: it opens no tunnel to a public address."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse, whichever client asks."""
        return None


class ViewServer(AbstractContextManager["ViewServer"]):
    """A page that is being served, until it is closed.

    Attributes
    ----------
    note : str
        One line where another port than the one asked for is used, else empty.
    """

    def __init__(self, server: viser.ViserServer, *, note: str = "") -> None:
        self.viser, self.note = server, note
        self._closing: list[Callable[[], None]] = []
        self._is_closed = threading.Event()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.viser.get_host()
        shown = "localhost" if host in ("0.0.0.0", "::") else host  # noqa: S104 - only shown
        return f"http://{shown}:{self.viser.get_port()}"

    def on_close(self, action: Callable[[], None]) -> None:
        """Call this before the server stops."""
        self._closing.append(action)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the page is closed; return whether it is."""
        return self._is_closed.wait(timeout_s)

    def close(self) -> None:
        """Stop serving; again: nothing."""
        if self._is_closed.is_set():
            return
        try:
            for action in reversed(self._closing):
                action()
        finally:
            with _silence():
                self.viser.stop()
            self._is_closed.set()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()


def open_server(host: str, port: int, *, title: str) -> ViewServer:
    """Bind and listen, or raise `ConfigurationError`."""
    free = find_port(host, port)
    with _silence(), _refusing_strangers(is_local=_is_loopback(host)):
        server = LocalServer(host=host, port=free, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    is_moved = port not in (0, free)
    note = f"port {port} of {host} is taken: serving on {free}" if is_moved else ""
    return ViewServer(server, note=note)


def is_own_page(origin: str | None, host: str, *, is_local: bool) -> bool:
    """Tell whether the origin that a browser names is this page; a local one has local names."""
    try:
        page = urlsplit(f"//{host}" if origin is None else origin)
        name = page.hostname or ""
    except ValueError:  # a bracket without its other one
        return False
    return page.netloc == host and (not is_local or _is_loopback(name))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextlib.contextmanager
def _refusing_strangers(*, is_local: bool) -> Iterator[None]:
    """Make a server that starts inside the context refuse other pages; viser accepts all."""
    serve = websockets_server.serve

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:  # noqa: ANN401
        def check(connection: Any, request: Any) -> Any:  # noqa: ANN401 - as websockets has it
            origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
            if not is_own_page(origin, host, is_local=is_local):
                return connection.respond(403, "gvo: not from another page\n")
            if len(request.path.partition("?")[0]) > _MAX_PATH:
                return connection.respond(414, "gvo: no file of the page has so long a name\n")
            return process_request(connection, request)

        return serve(*args, process_request=check, **options)

    websockets_server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets_server.serve = serve  # type: ignore[misc]


def find_port(host: str, port: int) -> int:
    """Return the first free port from the given one; 0 stands for any."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    last = min(port + N_PORTS, 65536)
    for candidate in range(port, last):
        try:
            socket.create_server((host, candidate), family=family).close()
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise ConfigurationError(
                    f"--host {host}: no address of this machine; 127.0.0.1 is only for this "
                    "machine, 0.0.0.0 for everyone on the network"
                ) from error
        else:
            return candidate
    raise ConfigurationError(
        f"no free port from {port} to {last - 1} on {host}; give another one, --port 0 for any"
    )


def _silence() -> contextlib.AbstractContextManager[object]:
    """Swallow what viser prints."""
    return contextlib.redirect_stdout(io.StringIO())
