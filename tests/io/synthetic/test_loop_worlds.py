"""The worlds with places seen again, and with places that only look the same."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import invert, make_transform, rotation_angle
from gvo.io.synthetic.rendering import render_depth
from gvo.io.synthetic.scene import Light, Rectangle, Scene, make_scene
from gvo.io.synthetic.textures import blank, finish
from gvo.io.synthetic.worlds.deceptive import rooms_rectangles, walk
from gvo.io.synthetic.worlds.motion import drive_block, road_point
from gvo.io.synthetic.worlds.street import TWIN_M, block_rectangles
from gvo.types import FloatArray

CAMERA = PinholeCamera(fx=40.0, fy=40.0, cx=31.5, cy=15.5, width=64, height=32)
TENTHS_S = np.arange(600) / 10.0


def visits(T: FloatArray, later: slice, earlier: slice) -> tuple[FloatArray, FloatArray]:
    """Return how far the nearest earlier pose is from each later one: metres and degrees."""
    relative = invert(T[earlier])[np.newaxis] @ T[later][:, np.newaxis]
    distances = np.linalg.norm(relative[..., :3, 3], axis=-1)
    nearest = distances.argmin(axis=1)
    rows = np.arange(len(nearest))
    return distances[rows, nearest], np.rad2deg(rotation_angle(relative[rows, nearest]))


@pytest.mark.parametrize("seed", range(10))
def test_the_drive_comes_back_in_its_lane_then_in_the_other_one(seed: int) -> None:
    T = drive_block(seed, TENTHS_S)
    steps = invert(T[:-1]) @ T[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    assert 550.0 < lengths.sum() < 590.0
    assert 0.25 < lengths.min() < lengths.max() < 1.3
    assert np.rad2deg(rotation_angle(steps)).max() < 6.0
    distances, angles = visits(T, slice(376, 440), slice(0, 80))
    assert lengths[376:440].sum() > 60.0
    assert distances.max() < 1.2
    assert angles.max() < 6.0
    distances, angles = visits(T, slice(572, 600), slice(380, 450))
    assert lengths[572:600].sum() > 25.0
    assert 2.0 < distances.min() < distances.max() < 5.0
    assert angles.min() > 165.0


@pytest.mark.parametrize("seed", range(3))
def test_the_car_runs_into_nothing(seed: int) -> None:
    driven = drive_block(seed, TENTHS_S)[:, :2, 3]
    for each in block_rectangles(seed):
        corner, s, t = (np.asarray(v, dtype=float) for v in (each.corner, each.edge_s, each.edge_t))
        corners = np.array([corner, corner + s, corner + t, corner + s + t])
        if corners[:, 2].min() < 1.6 and corners[:, 2].max() > 0.2 and np.ptp(corners) < 100.0:
            assert np.linalg.norm(corners[:, np.newaxis, :2] - driven, axis=-1).min() > 1.2


def middles(rectangles: list[Rectangle]) -> FloatArray:
    """Return the middles of what stands upright and higher than cars, but for the sky."""
    arrays = np.array([[r.corner, r.edge_s, r.edge_t] for r in rectangles], dtype=np.float64)
    is_upright = (arrays[:, 2, 2] < -0.2) & (np.abs(arrays[:, 1]).max(axis=1) < 100.0)
    points = (arrays[:, 0] + 0.5 * (arrays[:, 1] + arrays[:, 2]))[is_upright]
    return np.asarray(points[points[:, 2] > 1.6])


def share_found(points: FloatArray, among: FloatArray) -> float:
    return float(np.mean(cKDTree(among).query(points)[0] < 0.01))


def test_the_twin_street_is_built_as_the_first_side_of_the_block_and_no_other_is() -> None:
    built = middles(block_rectangles(1))
    half_turn = np.diag([-1.0, -1.0, 1.0])
    offset = np.append(road_point(0.0) + road_point(TWIN_M), 0.0)
    shares = []
    for s in (0.0, 20.0, 40.0, 110.0, 130.0, 150.0):
        along = np.linspace(s, s + 20.0, 41)
        near = cKDTree(road_point(along)).query(built[:, :2])[0] < 14.0
        shares.append(share_found(built[near] @ half_turn + offset, built))
    assert min(shares[:3]) > 0.6
    assert max(shares[3:]) < 0.2
    assert (
        np.linalg.norm(road_point(np.arange(75.0)) - road_point(TWIN_M + 25.0), axis=1).min() > 80
    )


def test_another_seed_builds_another_block() -> None:
    first, second = (middles(block_rectangles(seed)) for seed in (1, 2))
    assert share_found(first, second) < 0.2


@pytest.fixture(scope="module")
def rooms() -> Scene:
    """The rooms without their textures."""
    rectangles = rooms_rectangles()
    grey = finish(blank(100), (1.0, 1.0))
    return make_scene(rectangles, {each.texture: grey for each in rectangles}, Light())


def test_the_rooms_look_the_same_and_are_five_metres_apart(rooms: Scene) -> None:
    for index in (0, 40, 100):
        T = walk(3, np.array([index / 30.0, index / 30.0]))
        T[1, 0, 3] += 5.0
        first, second = (render_depth(rooms, pose, CAMERA) for pose in T)
        np.testing.assert_allclose(first, second, rtol=1e-5)
    places = walk(0, np.array([1.0, 17.0, 33.0]))[:, :3, 3]
    np.testing.assert_allclose(np.diff(places, axis=0), [[5.0, 0.0, 0.0]] * 2, atol=0.06)


@pytest.mark.parametrize("seed", range(3))
def test_the_hand_walks_through_doors_and_not_through_walls(rooms: Scene, seed: int) -> None:
    T = walk(seed, np.arange(360) / 10.0)
    steps = invert(T[:-1]) @ T[1:]
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.15
    assert np.rad2deg(rotation_angle(steps)).max() < 9.0
    ways = np.diff(T[:, :3, 3], axis=0)
    for pose, way in zip(T[:-1:5], ways[::5], strict=True):
        assert render_depth(rooms, pose, CAMERA).min() > 0.3
        # What lies ahead of each step is farther than the step.
        right = np.cross(way, [0.0, 0.0, 1.0])
        if (length := np.linalg.norm(right)) > 1e-3:
            forward = np.cross([0.0, 0.0, 1.0], right / length)
            R = np.column_stack([right / length, [0.0, 0.0, -1.0], forward])
            assert render_depth(rooms, make_transform(R, pose[:3, 3]), CAMERA)[16, 32] > 0.2
