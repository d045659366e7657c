"""The view moves with the camera, whatever browsers say of it and however late."""

import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gvo.types import FloatArray
from gvo.viz.view.panels import ViewPoint
from tests.viz.view.fakes import pose_of


class FakeServer:
    """Browsers whose views are as they said last."""

    def __init__(self) -> None:
        box = SimpleNamespace(value=True)
        self.gui = SimpleNamespace(add_checkbox=lambda *args, **options: box)
        self.initial_camera = SimpleNamespace()
        self.clients: dict[int, Any] = {}
        self.catch_up: Any = None

    def on_client_connect(self, callback: Any) -> None:
        self.catch_up = callback

    def get_clients(self) -> dict[int, Any]:
        return self.clients

    def connect(self, number: int) -> Any:
        # as it stands before it has heard of any view
        camera = SimpleNamespace(position=np.full(3, 3.0), look_at=np.zeros(3))
        self.clients[number] = client = SimpleNamespace(client_id=number, camera=camera)
        self.catch_up(client)
        return client


@pytest.fixture
def server() -> FakeServer:
    return FakeServer()


@pytest.fixture
def view(server: FakeServer) -> ViewPoint:
    point = ViewPoint(cast(Any, server))
    point.look_along(pose_of(0), 5.0)
    return point


def seen(client: Any, index: int) -> tuple[FloatArray, FloatArray]:
    """Return from where the camera at a frame is seen, and what is looked at."""
    place = pose_of(index)[:3, 3]
    return client.camera.position - place, client.camera.look_at - place


def test_a_browser_that_tells_late_is_not_left_behind(server: FakeServer, view: ViewPoint) -> None:
    client = server.connect(0)
    start = seen(client, 0)
    for index in range(1, 30):
        was = client.camera.position, client.camera.look_at
        view.show_pose(pose_of(index))
        if index % 3 == 0:  # what it sent before it was moved arrives after that
            client.camera.position, client.camera.look_at = was
    view.show_pose(pose_of(30))
    np.testing.assert_allclose(seen(client, 30), start, atol=1e-9)


def test_a_view_that_was_turned_stays_turned(server: FakeServer, view: ViewPoint) -> None:
    client = server.connect(0)
    view.show_pose(pose_of(1))
    client.camera.position = client.camera.look_at + np.array([7.0, -1.0, 0.0])
    for index in (2, 3):
        view.show_pose(pose_of(index))
    np.testing.assert_allclose(client.camera.position - client.camera.look_at, [7.0, -1.0, 0.0])


def test_a_view_that_was_shifted_at_rest_stays_shifted(
    server: FakeServer, view: ViewPoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = server.connect(0)
    view.show_pose(pose_of(1))
    aside = np.array([2.0, 0.0, 0.0])
    client.camera.position = client.camera.position + aside
    client.camera.look_at = client.camera.look_at + aside
    shifted = seen(client, 1)
    later_s = time.monotonic() + 10.0
    monkeypatch.setattr(time, "monotonic", lambda: later_s)
    for index in (2, 3):
        view.show_pose(pose_of(index))
    np.testing.assert_allclose(seen(client, 3), shifted)


def test_who_comes_later_sees_what_the_others_see_and_what_does_not_follow_stays(
    server: FakeServer, view: ViewPoint
) -> None:
    first = server.connect(0)
    for index in range(1, 8):
        view.show_pose(pose_of(index))
    np.testing.assert_allclose(seen(server.connect(1), 7), seen(first, 7))
    position = first.camera.position
    view.follow = cast(Any, SimpleNamespace(value=False))
    view.show_pose(pose_of(9))
    np.testing.assert_array_equal(first.camera.position, position)
