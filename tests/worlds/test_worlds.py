"""The worlds that deceive, against geometry done by hand."""

from typing import Any

import numpy as np
import pytest

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import make_transform
from gvo.io.synthetic import Light, StillScene, make_scene
from gvo.io.synthetic.rendering import render_depth
from gvo.io.synthetic.textures import blank, finish
from gvo.types import FloatArray
from tests.worlds import rendered
from tests.worlds.deceptive import (
    PERIOD_M,
    bus_path,
    facade,
    mirror_room,
    ride,
    rooms_rectangles,
    traffic,
    walk,
)
from tests.worlds.moving import look_beyond

CAMERA = PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
WIDE = PinholeCamera(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
# Looks along y of the map, z is up.
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def looking_north(x: float, y: float, z: float = 1.3) -> FloatArray:
    return make_transform(LEVEL, np.array([x, y, z]))


@pytest.mark.parametrize(
    ("kind", "sensor"),
    [("traffic", "rgbd"), ("facade", "stereo"), ("mirror", "stereo"), ("rooms", "rgbd")],
)
def test_frames_depend_neither_on_one_another_nor_on_the_length(kind: str, sensor: Any) -> None:
    long = list(rendered(kind, sensor, n_frames=60, scale=0.1).images())
    short = list(rendered(kind, sensor, n_frames=51, scale=0.1).images())
    for stream in (1, 0):
        np.testing.assert_array_equal(long[100 + stream].load(), short[100 + stream].load())


def test_the_bus_stands_where_its_path_says() -> None:
    scene, here = traffic(0), looking_north(0.0, 36.0, 1.65)
    for elapsed_s in (5.0, 6.0, 7.5):
        near_side = bus_path(elapsed_s)[1, 3] - 2.55 / 2
        ahead = scene.depth(elapsed_s, here, CAMERA)[60, 80]
        assert ahead == pytest.approx(near_side - 36.0, abs=1e-4)
    assert scene.depth(0.0, here, CAMERA)[60, 80] > 20.0
    with_bus = rendered("traffic", n_frames=61, scale=0.2).render_depth(60)
    assert 0.55 < np.mean(np.abs(with_bus - np.median(with_bus)) < 0.5) < 0.8


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


def test_the_tram_moves_by_more_than_half_a_window_per_frame() -> None:
    positions = ride(np.arange(40, 90) / 10.0)[:, :3, 3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).min() > 0.5 * PERIOD_M
    scene = facade(0).atlas.size, facade(0).texels_per_m[0, 0]
    assert scene[1] * PERIOD_M == pytest.approx(scene[0])


@pytest.fixture(scope="module")
def rooms() -> StillScene:
    """The rooms without their textures."""
    rectangles, grey = rooms_rectangles(), finish(blank(100), (1.0, 1.0))
    return StillScene(make_scene(rectangles, {r.texture: grey for r in rectangles}, Light()))


def test_the_rooms_look_the_same_and_are_five_metres_apart(rooms: StillScene) -> None:
    for index in (0, 40, 100):
        T = walk(3, np.array([index / 30.0, index / 30.0]))
        T[1, 0, 3] += 5.0
        first, second = (rooms.depth(0.0, pose, WIDE) for pose in T)
        np.testing.assert_allclose(first, second, rtol=1e-5)
    places = walk(0, np.array([1.0, 17.0, 33.0]))[:, :3, 3]
    np.testing.assert_allclose(np.diff(places, axis=0), [[5.0, 0.0, 0.0]] * 2, atol=0.06)
