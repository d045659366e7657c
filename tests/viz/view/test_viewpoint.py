"""The camera stays where browsers look, its heading ahead."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.types import FloatArray
from gvo.viz.view.viewpoint import ViewPoint


class FakeServer:
    """One browser, whose view is as it was set."""

    def __init__(self) -> None:
        self.box = SimpleNamespace(value=True)
        self.gui = SimpleNamespace(add_checkbox=lambda *args, **options: self.box)
        self.initial_camera = SimpleNamespace()
        self.client = SimpleNamespace(camera=SimpleNamespace())

    def get_clients(self) -> dict[int, Any]:
        return {0: self.client}


def view_of(server: FakeServer) -> tuple[ViewPoint, Any]:
    world = SimpleNamespace(wxyz=np.array([1.0, 0.0, 0.0, 0.0]), position=np.zeros(3))
    return ViewPoint(cast(Any, server), cast(Any, world)), world


def shown(world: Any, T_world_frame: FloatArray) -> FloatArray:
    """Return where a browser sees a frame, shape (4, 4)."""
    R = Rotation.from_quat(world.wxyz, scalar_first=True).as_matrix()
    return np.asarray(se3.make_transform(R, world.position) @ T_world_frame)


@pytest.mark.parametrize("turn", [0.0, 0.5, -2.0, np.pi])
def test_the_camera_stays_in_the_middle_and_its_heading_ahead(turn: float) -> None:
    point, world = view_of(FakeServer())
    yaw = se3.exp(np.array([0.0, turn, 0.0, 3.0, -1.0, 4.0]))
    pitch = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    point.show_pose(yaw @ pitch)
    np.testing.assert_allclose(shown(world, yaw @ pitch), pitch, atol=1e-12)
    down = yaw @ se3.exp(np.array([-np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    point.show_pose(down)  # it has no heading: that of before counts
    np.testing.assert_allclose(shown(world, down)[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shown(world, yaw), np.eye(4), atol=1e-12)


def test_a_world_that_does_not_follow_stays() -> None:
    server = FakeServer()
    point, world = view_of(server)
    point.show_pose(np.eye(4))
    server.box.value = False
    point.show_pose(se3.exp(np.ones(6)))
    np.testing.assert_allclose(shown(world, np.eye(4)), np.eye(4))


def test_browsers_look_from_behind_and_above() -> None:
    server = FakeServer()
    view_of(server)[0].look_along(5.0)
    for camera in (server.initial_camera, server.client.camera):
        x, y, z = camera.look_at - camera.position
        assert (x, y > 0.0, z > y) == (0.0, True, True)
        assert camera.near < 1.0 < 100.0 < camera.far
