"""What moves and what is reflected in rendered recordings, against geometry done by hand."""

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.io.synthetic.moving_scene import reflect
from gvo.io.synthetic.recording import SensorNoise, SyntheticRecording
from gvo.io.synthetic.rendering import render_depth
from gvo.io.synthetic.worlds.deceptive import PERIOD_M, bus_path, facade, mirror_room, ride, traffic

CAMERA = PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
# Looks along y of the map, z is up.
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def looking_north(x: float, y: float, z: float = 1.3) -> np.ndarray:
    return se3.make_transform(LEVEL, np.array([x, y, z]))


@pytest.mark.parametrize(
    ("world", "sensor"),
    [
        ("traffic", "rgbd"),
        ("facade", "stereo"),
        ("mirror", "stereo"),
        ("mirror", "rgbd"),
        ("wall", "rgbd"),
    ],
)
def test_frames_depend_neither_on_one_another_nor_on_the_length(world, sensor) -> None:  # type: ignore[no-untyped-def]
    long = list(SyntheticRecording(world, sensor, n_frames=60, scale=0.1).images())
    short = list(SyntheticRecording(world, sensor, n_frames=51, scale=0.1).images())
    for stream in (1, 0):
        np.testing.assert_array_equal(long[100 + stream].load(), short[100 + stream].load())


def test_the_bus_stands_where_its_path_says() -> None:
    moving = traffic(0)
    for elapsed_s in (5.0, 6.0, 7.5):
        depth = moving.render_depth(
            elapsed_s, looking_north(0.0, 36.0, 1.65), CAMERA, is_reflected=False
        )
        near_side = bus_path(elapsed_s)[1, 3] - 2.55 / 2
        assert depth[60, 80] == pytest.approx(near_side - 36.0, abs=1e-4)
    depth = moving.render_depth(0.0, looking_north(0.0, 36.0, 1.65), CAMERA, is_reflected=False)
    assert depth[60, 80] > 20.0


def test_the_bus_fills_most_of_the_view_while_it_stands() -> None:
    with_bus = SyntheticRecording("traffic", n_frames=61, scale=0.2).render_depth(60)
    assert 0.55 < np.mean(np.abs(with_bus - np.median(with_bus)) < 0.5) < 0.8


def test_a_still_mirror_shows_the_room_behind_it() -> None:
    moving = mirror_room(0)
    T_map_cam = looking_north(0.3, -0.2)
    glass = moving.render_depth(0.0, T_map_cam, CAMERA, is_reflected=False)
    seen = moving.render_depth(0.0, T_map_cam, CAMERA, is_reflected=True)
    assert glass[60, 80] == pytest.approx(1.25 + 0.2, abs=1e-4)
    # To the mirror, and from it to the wall at y = -2 behind the camera.
    assert seen[60, 80] == pytest.approx(1.45 + 3.25, abs=1e-4)


def test_the_reflection_is_what_a_camera_behind_the_glass_would_see() -> None:
    """A camera mirrored in the glass sees the room, its image turned over left and right."""
    moving = mirror_room(0)
    scene = moving.at(1.7)
    assert moving.mirror is not None
    T_map_cam = looking_north(0.2, -0.3)
    seen = moving.render_depth(1.7, T_map_cam, CAMERA, is_reflected=True)
    normal = np.cross(scene.axes_s[moving.mirror], scene.axes_t[moving.mirror])
    H = np.eye(3) - 2.0 * np.outer(normal, normal)
    point = scene.origins[moving.mirror]
    flip = np.diag([-1.0, 1.0, 1.0])
    T_map_twin = se3.make_transform(
        H @ T_map_cam[:3, :3] @ flip, H @ (T_map_cam[:3, 3] - point) + point
    )
    twin = render_depth(scene, T_map_twin, CAMERA, beyond=(point, -normal))[:, ::-1]
    glass = moving.render_depth(1.7, T_map_cam, CAMERA, is_reflected=False)
    is_glass = np.abs(seen - glass) > 0.05
    assert is_glass.mean() > 0.3
    assert np.quantile(np.abs(seen - twin)[is_glass], 0.98) < 1e-3


def test_reflecting_twice_gives_the_scene_again() -> None:
    scene = mirror_room(0).at(0.0)
    mirror = mirror_room(0).mirror
    assert mirror is not None
    virtual, (point, normal) = reflect(scene, mirror)
    assert np.all((virtual.origins - point) @ normal > -4.0)
    assert len(virtual.origins) < len(scene.origins)


def test_the_front_of_the_house_repeats_exactly() -> None:
    scene = facade(0)
    texels = scene.texels_per_m[0, 0] * PERIOD_M
    assert texels == pytest.approx(scene.atlas.size)


def test_the_tram_moves_by_more_than_half_a_window_per_frame() -> None:
    positions = ride(np.arange(40, 90) / 10.0)[:, :3, 3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).min() > 0.5 * PERIOD_M


def test_the_blank_wall_fills_the_view() -> None:
    recording = SyntheticRecording("wall", n_frames=191, scale=0.1, noise=SensorNoise.none())
    images = list(recording.images())
    for index in (113, 150, 190):
        assert np.ptp(images[2 * index].load()[1:-1, 1:-1]) <= 3
    assert np.ptp(images[0].load()) > 60
