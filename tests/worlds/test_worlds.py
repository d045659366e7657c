"""The worlds that deceive, against geometry done by hand."""

import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import make_transform
from gvo.io.synthetic.rendering import render_depth
from gvo.types import FloatArray
from tests.worlds.deceptive import (
    mirror_room,
)
from tests.worlds.moving import look_beyond

CAMERA = PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
# Looks along y of the map, z is up.
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def looking_north(x: float, y: float, z: float = 1.3) -> FloatArray:
    return make_transform(LEVEL, np.array([x, y, z]))


def test_the_reflection_is_what_a_camera_behind_the_glass_would_see() -> None:
    """A camera mirrored in the glass sees the room, its image turned over left and right."""
    world = mirror_room(0, False)
    scene, mirror = world.moving.at(1.7), world.moving.n_still
    here = looking_north(0.2, -0.3)
    seen, glass = (mirror_room(0, dusty).depth(1.7, here, CAMERA) for dusty in (False, True))
    normal = np.cross(scene.axes_s[mirror], scene.axes_t[mirror])
    H, point = np.eye(3) - 2.0 * np.outer(normal, normal), scene.origins[mirror]
    R = H @ here[:3, :3] @ np.diag([-1.0, 1.0, 1.0])
    twin = make_transform(R, H @ (here[:3, 3] - point) + point)
    expected = render_depth(look_beyond((point, -normal), scene, twin, CAMERA))[:, ::-1]
    is_glass = np.abs(seen - glass) > 0.05
    assert is_glass.mean() > 0.3
    assert np.quantile(np.abs(seen - expected)[is_glass], 0.98) < 1e-3
