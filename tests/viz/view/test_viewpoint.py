"""The view moves with the camera, whatever browsers say of it and however late."""

import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gvo.types import FloatArray
from gvo.viz.view.viewpoint import ViewPoint
from tests.viz.view.fakes import pose_of


class FakeServer:
    """Browsers whose views are as they said last."""

    def __init__(self) -> None:
        self.box = SimpleNamespace(value=True)
        self.gui = SimpleNamespace(add_checkbox=lambda *args, **options: self.box)
        self.initial_camera = SimpleNamespace()
        self.clients: dict[int, Any] = {}
        self.on_connect: Any = None

    def on_client_connect(self, callback: Any) -> None:
        self.on_connect = callback

    def get_clients(self) -> dict[int, Any]:
        return self.clients

    def connect(self, number: int) -> Any:
        # as it stands before it has heard of any view
        camera = SimpleNamespace(position=np.full(3, 3.0), look_at=np.zeros(3))
        self.clients[number] = client = SimpleNamespace(client_id=number, camera=camera)
        self.on_connect(client)
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
    np.testing.assert_allclose(seen(server.connect(1), 30), start, atol=1e-9)
    server.box.value = False  # it does not follow any more
    view.show_pose(pose_of(31))
    np.testing.assert_allclose(seen(client, 30), start, atol=1e-9)


def test_a_view_that_was_turned_or_shifted_at_rest_stays_so(
    server: FakeServer, view: ViewPoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = server.connect(0)
    view.show_pose(pose_of(1))
    client.camera.position = client.camera.look_at + np.array([7.0, -1.0, 0.0])
    view.show_pose(pose_of(2))
    np.testing.assert_allclose(client.camera.position - client.camera.look_at, [7.0, -1.0, 0.0])
    aside = np.array([2.0, 0.0, 0.0])
    client.camera.position = client.camera.position + aside
    client.camera.look_at = client.camera.look_at + aside
    shifted = seen(client, 2)
    later_s = time.monotonic() + 10.0
    monkeypatch.setattr(time, "monotonic", lambda: later_s)
    for index in (3, 4):
        view.show_pose(pose_of(index))
    np.testing.assert_allclose(seen(client, 4), shifted)
