"""The page is served to this machine alone, serves its own files alone, and ends cleanly."""

import socket
import threading
from pathlib import Path
from urllib.parse import quote

import pytest

from gvo.errors import ConfigurationError
from gvo.viz.view import serve
from gvo.viz.view.page import Page
from gvo.viz.view.server import find_port, is_own_page
from tests.conftest import assert_open_to_this_machine_alone
from tests.viz.view.fakes import FakePlayer, as_player

SECRET = "only for who may read it"


def ask(page: Page, request: bytes) -> bytes:
    """Send bytes as they are, which no library for the net would; return the first that come."""
    port = page.server.get_port()
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(request)
        answer = b""
        while b"\r\n\r\n" not in answer and (part := connection.recv(65536)):
            answer += part
        return answer


def status(page: Page, path: str = "/", method: str = "GET", **headers: str) -> int:
    host = f"127.0.0.1:{page.server.get_port()}"
    given = {"Host": host, "Connection": "close"} | {
        name.replace("_", "-"): value for name, value in headers.items()
    }
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in given.items())]
    answer = ask(page, "\r\n".join([*lines, "", ""]).encode())
    return int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/") else 0


def test_the_page_listens_on_loopback_alone_and_opens_no_tunnel(page: Page) -> None:
    assert page.url.startswith("http://127.0.0.1:")
    assert_open_to_this_machine_alone(page.server.get_port())
    assert page.server.request_share_url() is None


def test_a_taken_port_is_told_nothing_is_printed_and_closing_frees_all(
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = set(threading.enumerate())
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        with serve(as_player(FakePlayer()), port=port) as page:
            other = page.server.get_port()
            assert other > port
            assert page.note == f"port {port} of 127.0.0.1 is taken: serving on {other}"
            assert not page.wait(0.0)
    assert page.wait(0.0)
    page.close()
    assert capfd.readouterr() == ("", "")
    assert find_port("127.0.0.1", other) == other
    left = [thread for thread in set(threading.enumerate()) - before if thread.is_alive()]
    assert [thread for thread in left if "ThreadPool" not in thread.name] == []


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"--host 192\.0\.2\.1: no address of this"):
        serve(as_player(FakePlayer()), host="192.0.2.1")


def test_the_page_itself_can_steer_and_another_page_in_the_browser_cannot(page: Page) -> None:
    port = page.server.get_port()
    here = f"127.0.0.1:{port}"
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    for origin, host, code in (
        ("http://example.org", here, 403),
        (f"http://localhost:{port + 1}", f"localhost:{port}", 403),
        # A name of the net that leads to this machine.
        (f"http://example.org:{port}", f"example.org:{port}", 403),
        (f"http://{here}", here, 101),
        ("http://localhost:9999", "localhost:9999", 101),  # forwarded
    ):
        assert status(page, Host=host, Origin=origin, **upgrade) == code, origin
    assert status(page, Host=here, **upgrade) == 101
    assert is_own_page("http://robot:8080", "robot:8080", is_local=False)
    assert not is_own_page("http://example.org", "robot:8080", is_local=False)


def test_the_page_is_served_by_names_of_this_machine_alone(page: Page) -> None:
    for host in ("example.org", "example.org:8080", "10.0.0.1", "", "[", "a@127"):
        assert status(page, Host=host) == 403, host
    for host in ("localhost", "127.0.0.1:9", "[::1]:80", "LOCALHOST:8080"):
        assert status(page, Host=host) == 200, host


def test_no_path_leads_out_of_the_page(page: Page, tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text(SECRET, encoding="utf-8")
    absolute = str(secret)
    climbing = "/" + "../" * 30 + absolute.lstrip("/")
    for path in (
        absolute,
        "//" + absolute,
        "file://" + absolute,
        climbing,
        climbing.lstrip("/"),
        "/assets/" + climbing,
        climbing.replace("..", "%2e%2e"),
        climbing.replace("..", "%252e%252e"),
        climbing.replace("../", "..%2f"),
        climbing.replace("../", "..\\"),
        climbing.replace("../", "....//"),
        climbing.replace("..", ".%00."),
        "/index.html/" + climbing,
        "/" + quote(absolute, safe=""),
        "/assets/",
        "/../package.json",
    ):
        assert status(page, path) != 200, path
    for n in (251, 7000):
        assert status(page, "/" + "a" * (n - 1)) == 414
        assert status(page, "/?" + "a" * n) == 200


def test_nothing_is_taken_and_nonsense_does_not_end_it(page: Page) -> None:
    for method in ("PUT", "POST", "DELETE", "CONNECT"):
        assert status(page, "/index.html", method) != 200
    long = b"GET " + b"a" * 70000
    for request in (b"\r\n\r\n", b"\x00\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", long):
        ask(page, request)
    assert status(page) == 200
