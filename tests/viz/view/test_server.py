"""The page is served to this machine, and ends cleanly."""

import socket
import sys
import threading
from http.client import HTTPConnection

import pytest

from gvo.errors import ConfigurationError
from gvo.viz.view import serve
from gvo.viz.view.server import ViewServer, find_port, is_own_page, open_server
from tests.conftest import assert_open_to_this_machine_alone
from tests.viz.view.fakes import FakePlayer, as_player


def test_the_page_listens_on_loopback_alone(view: ViewServer) -> None:
    assert view.url.startswith("http://127.0.0.1:")
    assert_open_to_this_machine_alone(int(view.url.rpartition(":")[2]))


def test_closing_frees_the_port_and_ends_its_threads() -> None:
    before = set(threading.enumerate())
    closed = []
    with open_server("127.0.0.1", 0, title="gvo") as view:
        port = view.viser.get_port()
        view.on_close(lambda: closed.append(True))
        assert not view.wait(0.0)
    assert view.wait(0.0)
    view.close()
    assert closed == [True]
    assert find_port("127.0.0.1", port) == port
    left = [thread for thread in set(threading.enumerate()) - before if thread.is_alive()]
    assert [thread for thread in left if "ThreadPool" not in thread.name] == []


def test_a_taken_port_is_told_with_the_one_that_serves_and_nothing_is_printed(
    capfd: pytest.CaptureFixture[str], view: ViewServer
) -> None:
    assert view.note == ""
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        with open_server("127.0.0.1", port, title="gvo") as moved:
            other = moved.viser.get_port()
            assert other > port
            assert moved.note == f"port {port} of 127.0.0.1 is taken: serving on {other}"
    assert capfd.readouterr() == ("", "")


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"--host 192\.0\.2\.1: no address of this"):
        find_port("192.0.2.1", 8080)


def answer(port: int, origin: str | None, host: str) -> int:
    """What the server answers who wants to steer the page."""
    headers = {
        "Host": host,
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        **({} if origin is None else {"Origin": origin}),
    }
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_the_page_itself_can_steer_and_another_page_in_the_browser_cannot(
    view: ViewServer,
) -> None:
    port = view.viser.get_port()
    here = f"127.0.0.1:{port}"
    for origin, host, status in (
        ("http://example.org", here, 403),
        (f"http://localhost:{port + 1}", f"localhost:{port}", 403),
        # A name of the net that leads to this machine.
        (f"http://example.org:{port}", f"example.org:{port}", 403),
        (f"http://{here}", here, 101),
        (None, here, 101),
        ("http://localhost:9999", "localhost:9999", 101),  # forwarded
    ):
        assert answer(port, origin, host) == status, origin


def test_other_names_of_the_machine_serve_the_network() -> None:
    assert is_own_page("http://robot:8080", "robot:8080", is_local=False)
    assert not is_own_page("http://example.org", "robot:8080", is_local=False)


def test_no_client_gets_a_tunnel_to_a_public_address(view: ViewServer) -> None:
    assert view.viser.request_share_url() is None


def test_without_viser_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigurationError, match=r"pip install \S+\[view\]'"):
        serve(as_player(FakePlayer()))
