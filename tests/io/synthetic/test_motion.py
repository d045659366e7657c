"""How the cameras of the worlds move, and what they may run into."""

from typing import Any

import numpy as np
import pytest

from gvo.geometry.se3 import invert, rotation_angle
from gvo.io.synthetic.world import WORLDS
from gvo.io.synthetic.worlds.street import block_rectangles
from gvo.types import FloatArray


def moved(name: Any, seed: int, n_frames: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return true poses, and how far each is from the next: degrees and metres."""
    world = WORLDS[name]
    T_map_cam = world.motion(seed)(np.arange(n_frames) / world.rate_hz)
    T = invert(T_map_cam[0]) @ T_map_cam
    steps = invert(T[:-1]) @ T[1:]
    return T, np.rad2deg(rotation_angle(steps)), np.linalg.norm(steps[:, :3, 3], axis=1)


@pytest.mark.parametrize(
    ("name", "rate", "speed", "turn"), [("driving", 10, 12.0, 30.0), ("handheld", 30, 0.6, 60.0)]
)
def test_poses_are_rigid_and_move_smoothly(name: str, rate: int, speed: float, turn: float) -> None:
    T, turns, lengths = moved(name, 0, 900)
    np.testing.assert_allclose(T[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T[:, :3, :3] @ T[:, :3, :3].mT, [np.eye(3)] * 900, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(T), 1.0, atol=1e-12)
    assert 0.4 * speed < rate * lengths.max() < speed
    assert 0.4 * turn < rate * turns.max() < turn
    assert np.abs(np.diff(T[:, :3, 3], n=2, axis=0)).max() < 0.25 * lengths.max()


def visits(T: FloatArray, later: slice, earlier: slice) -> tuple[FloatArray, FloatArray]:
    """Return how far the nearest earlier pose is from each later one: metres and degrees."""
    relative = invert(T[earlier])[np.newaxis] @ T[later][:, np.newaxis]
    distances = np.linalg.norm(relative[..., :3, 3], axis=-1)
    nearest = distances.argmin(axis=1)
    rows = np.arange(len(nearest))
    return distances[rows, nearest], np.rad2deg(rotation_angle(relative[rows, nearest]))


@pytest.mark.parametrize("seed", range(2))
def test_the_block_comes_back_in_its_lane_then_in_the_other_one(seed: int) -> None:
    T, turns, lengths = moved("block", seed, 600)
    assert 550.0 < lengths.sum() < 590.0
    assert 0.25 < lengths.min() < lengths.max() < 1.3
    assert turns.max() < 6.0
    distances, angles = visits(T, slice(376, 440), slice(0, 80))
    assert lengths[376:440].sum() > 60.0
    assert distances.max() < 1.2
    assert angles.max() < 6.0
    distances, angles = visits(T, slice(572, 600), slice(380, 450))
    assert lengths[572:600].sum() > 25.0
    assert 2.0 < distances.min() < distances.max() < 5.0
    assert angles.min() > 165.0


@pytest.mark.parametrize("seed", range(2))
def test_the_drone_comes_to_rest_for_three_seconds_between_flights(seed: int) -> None:
    T, turns, lengths = moved("hovering", seed, 450)
    positions = T[:, :3, 3]
    for start in (0, 150, 300):
        resting = slice(start + 61, start + 150)
        spread = np.linalg.norm(positions[resting] - positions[resting].mean(axis=0), axis=1)
        assert 0.0005 < spread.max() < 0.005
        assert np.rad2deg(rotation_angle(invert(T[start + 61]) @ T[resting])).max() < 0.7
        assert 0.05 < np.linalg.norm(positions[start + 62] - positions[start]) < 2.0
    assert lengths.max() < 0.06  # no jumps
    assert turns.max() < 2.5


def test_the_car_runs_into_nothing() -> None:
    driven = WORLDS["block"].motion(0)(np.arange(600) / 10.0)[:, :2, 3]
    for each in block_rectangles(0):
        corner, s, t = (np.asarray(v, dtype=float) for v in (each.corner, each.edge_s, each.edge_t))
        corners = np.array([corner, corner + s, corner + t, corner + s + t])
        if corners[:, 2].min() < 1.6 and corners[:, 2].max() > 0.2 and np.ptp(corners) < 100.0:
            assert np.linalg.norm(corners[:, np.newaxis, :2] - driven, axis=-1).min() > 1.2
