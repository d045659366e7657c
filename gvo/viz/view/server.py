"""The web server of the page: where it binds, and whom it answers."""

from __future__ import annotations

import contextlib
import errno
import html
import io
import ipaddress
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as websockets_server

from gvo.errors import ConfigurationError

N_PORTS = 20
"""How many ports are tried, from the one asked for."""

_VISER_TITLE = b"<title>Viser</title>"
_MAX_PATH = 250  # bytes; the names of the page's files are shorter, no file's name is longer


class LocalServer(viser.ViserServer):
    """A server that stays on this machine: it opens no tunnel to a public address."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse, whichever client asks."""
        return None


def open_server(host: str, port: int, *, title: str) -> viser.ViserServer:
    """Bind and listen, or raise `ConfigurationError`."""
    free = find_port(host, port)
    with silence(), _answering(is_local=_is_loopback(host), title=title):
        server = LocalServer(host=host, port=free, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


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
def _answering(*, is_local: bool, title: str) -> Iterator[None]:
    """Make a server that starts inside refuse other pages, and name its own; viser does not."""
    serve = websockets_server.serve
    named = f"<title>{html.escape(title)}</title>".encode()

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:  # noqa: ANN401
        def check(connection: Any, request: Any) -> Any:  # noqa: ANN401 - as websockets has it
            origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
            if not is_own_page(origin, host, is_local=is_local):
                return connection.respond(403, "gvo: not from another page\n")
            if len(request.path.partition("?")[0]) > _MAX_PATH:
                return connection.respond(414, "gvo: no file of the page has so long a name\n")
            request.headers.pop("Accept-Encoding", None)
            response = process_request(connection, request)
            if response is not None and _VISER_TITLE in response.body:
                response.body = response.body.replace(_VISER_TITLE, named, 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            return response

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


def silence() -> contextlib.AbstractContextManager[object]:
    """Swallow what viser prints."""
    return contextlib.redirect_stdout(io.StringIO())
