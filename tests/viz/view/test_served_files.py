"""The page serves its own files, and nothing else of the machine."""

import socket
from pathlib import Path
from urllib.parse import quote

import pytest
import viser

from gvo.viz.view.server import ViewServer

SECRET = "only for who may read it"


def ask(view: ViewServer, request: bytes) -> bytes:
    """Send bytes as they are, which no library for the net would; return all that comes back."""
    with socket.create_connection(("127.0.0.1", view.viser.get_port()), timeout=10) as connection:
        connection.sendall(request)
        parts = []
        while part := connection.recv(65536):
            parts.append(part)
    return b"".join(parts)


def get(view: ViewServer, path: bytes, *, method: bytes = b"GET", host: str | None = None) -> bytes:
    name = (f"127.0.0.1:{view.viser.get_port()}" if host is None else host).encode()
    head = b"%s %s HTTP/1.1\r\nHost: %s\r\nConnection: close\r\n\r\n" % (method, path, name)
    return ask(view, head)


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/") else 0


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.txt"
    path.write_text(SECRET, encoding="utf-8")
    return path


def test_the_page_itself_is_served(view: ViewServer) -> None:
    answer = get(view, b"/")
    assert status(answer) == 200
    assert b"<html" in answer.lower()


@pytest.mark.parametrize(
    ("hosts", "code"),
    [
        (("example.org", "example.org:8080", "10.0.0.1", "", "[", "a@127"), 403),
        (("localhost", "127.0.0.1:9", "[::1]:80", "LOCALHOST:8080"), 200),
    ],
)
def test_the_page_is_served_by_names_of_this_machine_alone(
    view: ViewServer, hosts: tuple[str, ...], code: int
) -> None:
    for host in hosts:
        answer = get(view, b"/", host=host)
        assert status(answer) == code, host
        assert (b"<html" in answer.lower()) == (code == 200)


def test_a_path_that_is_too_long_is_refused(view: ViewServer) -> None:
    for n in (251, 7000):
        assert status(get(view, b"/" + b"a" * (n - 1))) == 414
        assert status(get(view, b"/?" + b"a" * n)) == 200


def test_no_path_leads_out_of_the_page(view: ViewServer, secret: Path) -> None:
    root = Path(viser.__file__).parent / "client" / "build"
    assert root.is_dir()
    absolute = str(secret)
    climbing = "/" + "../" * 30 + absolute.lstrip("/")
    from_root = "/" + "../" * len(root.resolve().parts) + absolute.lstrip("/")
    paths = [
        absolute,
        "/" + absolute,
        "//" + absolute,
        "file://" + absolute,
        climbing,
        from_root,
        climbing.lstrip("/"),
        "/assets/" + climbing,
        climbing.replace("..", "%2e%2e"),
        climbing.replace("..", "%252e%252e"),
        climbing.replace("../", "..%2f"),
        climbing.replace("../", "..%5c"),
        climbing.replace("../", "..\\"),
        climbing.replace("../", "....//"),
        climbing.replace("../", "..;/"),
        climbing.replace("..", ".%00."),
        climbing + "%00.html",
        "/index.html/" + climbing,
        "/?file=" + quote(absolute),
        "/" + quote(absolute, safe=""),
        "/~root/.profile",
    ]
    for path in paths:
        answer = get(view, path.encode())
        assert SECRET.encode() not in answer, path
    # None of them but the one that asks for the page itself, by any name, was answered.
    found = [path for path in paths if status(get(view, path.encode())) == 200]
    assert found == ["/?file=" + quote(absolute)]


def test_folders_and_the_files_around_the_page_are_not_served(view: ViewServer) -> None:
    for path in (b"/assets", b"/assets/", b"/../", b"/../package.json", b"/../../__init__.py"):
        assert status(get(view, path)) == 404, path


def test_nothing_is_taken_and_nonsense_does_not_end_it(view: ViewServer) -> None:
    for method in (b"PUT", b"POST", b"DELETE", b"TRACE", b"CONNECT"):
        assert status(get(view, b"/index.html", method=method)) != 200
    long = b"GET " + b"a" * 70000
    for request in (b"\r\n\r\n", b"\x00\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", long):
        ask(view, request)
    assert status(get(view, b"/")) == 200
