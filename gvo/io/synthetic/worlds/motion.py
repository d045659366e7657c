"""How the camera moves: a drive around a block, a hand that looks around or turns fast, a drone.

Map axes: z up; a camera looks along its z axis, x to the right, y down.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from gvo.geometry.se3 import exp, make_transform
from gvo.types import FloatArray

CAMERA_HEIGHT_M = 1.65
STRAIGHT_M = 50.0
TURN_M = 50.0
LAP_M = 4 * (STRAIGHT_M + TURN_M)
_START_M = 30.0
# Where the drive around the block turns back, and its line there: along and right, metres.
TURN_BACK_M = 525.0
_TURN_BACK = np.array(
    [
        [-12.0, 0.1], [-8.0, 0.7], [-4.0, 1.9], [0.0, 2.75], [3.0, 2.2], [4.9, 0.2],
        [5.2, -2.2], [3.9, -4.7], [1.3, -6.0], [-2.0, -6.1], [-6.0, -5.0], [-10.0, -3.9],
        [-14.0, -3.5],
    ]
)  # fmt: skip
_LEG_S, _HOVER_S = 2.0, 3.0
_N_PLACES = 8
R_MAP_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def heading(s: FloatArray | float) -> FloatArray:
    """Return the heading of the road at arc lengths in metres; radians, left is positive."""
    corner, along = np.divmod(np.asarray(s), STRAIGHT_M + TURN_M)
    x = np.clip((along - STRAIGHT_M) / TURN_M, 0.0, 1.0)
    return np.asarray(0.5 * np.pi * (corner + x * x * (3.0 - 2.0 * x)))


def curvature(s: FloatArray | float) -> FloatArray:
    """Return the derivative of the heading, 1/m."""
    x = np.clip((np.asarray(s) % (STRAIGHT_M + TURN_M) - STRAIGHT_M) / TURN_M, 0.0, 1.0)
    return np.asarray(3.0 * np.pi * x * (1.0 - x) / TURN_M)


@lru_cache(maxsize=1)
def _lap() -> CubicSpline:
    s = np.linspace(0.0, LAP_M, 4001)
    middle = heading(0.5 * (s[1:] + s[:-1]))
    ends = heading(s)
    step = s[1] - s[0]

    def integrate(values: FloatArray, middles: FloatArray) -> FloatArray:
        simpson = step / 6.0 * (values[:-1] + 4.0 * middles + values[1:])
        return np.concatenate([[0.0], np.cumsum(simpson)])

    x = integrate(-np.sin(ends), -np.sin(middle))
    y = integrate(np.cos(ends), np.cos(middle))
    return CubicSpline(s, np.stack([x, y], axis=1))


def road_point(s: FloatArray | float, right: FloatArray | float = 0.0) -> FloatArray:
    """Return points beside the driven line."""
    psi = heading(s)
    aside = np.stack([np.cos(psi), np.sin(psi)], axis=-1)
    return np.asarray(_lap()(s % LAP_M) + aside * np.asarray(right)[..., np.newaxis])


def drive(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a car at 5 to 11 m/s on a slightly uneven road."""
    t = stamps_s
    # The integral of 8.2 + 2 sin(0.6 t) + 0.8 sin(1.7 t + 1) m/s.
    s = _START_M + 8.2 * t - 2 / 0.6 * (np.cos(0.6 * t) - 1)
    s -= 0.8 / 1.7 * (np.cos(1.7 * t + 1) - np.cos(1.0))
    return drive_along(t, s)


def drive_along(
    stamps_s: FloatArray, s: FloatArray, *, shake: FloatArray | float = 1.0
) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a car on a slightly uneven road."""
    return _by_car(stamps_s, road_point(s), heading(s), shake)


def drive_block(seed: int, stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam (n, 4, 4) of a car: a lap and more of the same road, then back."""
    line, way = _block_line(seed)
    driven = way(np.minimum(stamps_s, way.x[-1]))
    along = line(driven, 1)
    return _by_car(stamps_s, line(driven), np.arctan2(-along[:, 0], along[:, 1]))


@lru_cache(maxsize=4)
def _block_line(seed: int) -> tuple[CubicSpline, CubicSpline]:
    """Return the driven line by its length in metres, and that length by seconds."""
    rates = np.random.default_rng([seed, 9]).uniform(0.8, 1.2, 3)
    there, back = np.arange(_START_M, TURN_BACK_M - 17.0, 5.0), np.arange(0.0, 65.0, 5.0)
    weave = 0.35 * np.sin(rates[0] * there / 17.0) + 0.15 * np.sin(rates[1] * there / 5.0)
    table = np.vstack(
        [
            np.column_stack([there, weave]),
            np.add(_TURN_BACK, [TURN_BACK_M, 0.0]),
            np.column_stack([TURN_BACK_M - 17.0 - back, -3.4 + 0.25 * np.sin(back / 13.0)]),
        ]
    )
    points = road_point(table[:, 0], table[:, 1])
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    line = CubicSpline(lengths, points)
    fine = np.linspace(0.0, lengths[-1], 4001)
    from_turn = fine - lengths[len(there) + 6]
    speeds = 10.8 + 1.4 * np.sin(rates[2] * fine / 14.0)
    speeds *= 1.0 - 0.73 * np.exp(-((from_turn / 19.0) ** 4))
    steps = np.diff(fine) * 0.5 * (1.0 / speeds[1:] + 1.0 / speeds[:-1])
    return line, CubicSpline(np.append(0.0, np.cumsum(steps)), fine)


def _by_car(
    stamps_s: FloatArray, ground: FloatArray, psi: FloatArray, shake: FloatArray | float = 1.0
) -> FloatArray:
    """Return the poses of a car on the road at points (n, 2), with headings (n,)."""
    t = stamps_s
    zeros, ones = np.zeros_like(psi), np.ones_like(psi)
    right = np.stack([np.cos(psi), np.sin(psi), zeros], axis=-1)
    forward = np.stack([-np.sin(psi), np.cos(psi), zeros], axis=-1)
    R = np.stack([right, np.stack([zeros, zeros, -ones], axis=-1), forward], axis=-1)
    bounce = shake * (0.012 * np.sin(8.1 * t) + 0.008 * np.sin(12.7 * t + 2))
    position = np.column_stack([ground, CAMERA_HEIGHT_M + bounce])
    pitch = shake * (0.004 * np.sin(7.3 * t + 1) + 0.003 * np.sin(2.1 * t))
    roll = shake * (0.004 * np.sin(5.9 * t) + 0.004 * np.sin(1.3 * t + 0.5))
    tilt = turned(np.column_stack([pitch, zeros, roll]))
    return np.asarray(make_transform(R, position) @ tilt)


def look_around(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a camera held in the hand."""
    t = stamps_s[:, np.newaxis]
    amplitudes = np.array([0.22, 0.14, 0.12, 0.05, 0.05, 0.03])  # m
    rates = np.array([0.9, 0.75, 1.1, 2.3, 2.0, 2.6])  # rad/s
    waves = amplitudes * np.sin(rates * t + [0.0, 0.7, 1.9, 0.3, 2.2, 1.1])
    position = np.array([0.0, -0.75, 1.35]) + waves[:, :3] + waves[:, 3:]
    tilts = np.array([0.20, 0.48, 0.13, 0.03, 0.05, 0.03])  # rad about x, y, z of the camera
    rates = np.array([1.1, 0.9, 1.3, 3.1, 2.7, 2.3])
    turns = tilts * np.sin(rates * t + [0.4, 0.0, 1.2, 2.0, 0.9, 0.1])
    return level_and_turned(position, turns[:, :3] + turns[:, 3:] + [-0.12, 0.0, 0.0])


def turn_fast(seed: int, stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a hand that turns the camera to and fro."""
    t = stamps_s[:, np.newaxis]
    rng = np.random.default_rng([seed, 7])
    rates = np.array([1.3, 1.0, 1.6, 2.6, 1.9, 2.3]) * rng.uniform(0.9, 1.1, 6)  # rad/s
    waves = np.sin(rates * t + rng.uniform(0.0, 2.0 * np.pi, 6))
    position = np.array([0.0, -0.75, 1.35]) + np.array([0.06, 0.05, 0.04]) * waves[:, :3]
    turns = np.array([0.25, 0.5, 0.36]) * waves[:, 3:] + [-0.12, 0.0, 0.0]
    return level_and_turned(position, turns)


def hover(seed: int, stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam (n, 4, 4) of a drone that flies for 2 s and hovers for 3 s, in turn."""
    rng = np.random.default_rng([seed, 8])
    reach = np.array([0.6, 0.4, 0.25, 0.12, 0.4])  # m; rad of pitch and yaw
    places = reach * rng.uniform(-1.0, 1.0, (_N_PLACES, 5))
    leg, on_leg_s = np.divmod(stamps_s, _LEG_S + _HOVER_S)
    x = np.minimum(on_leg_s / _LEG_S, 1.0)[:, np.newaxis]
    k = leg.astype(np.int64)
    start, end = places[k % _N_PLACES], places[(k + 1) % _N_PLACES]
    flown = start + x**3 * (10.0 - 15.0 * x + 6.0 * x * x) * (end - start)
    rates = rng.uniform(6.0, 25.0, (2, 6))  # rad/s
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    waves = np.sin(rates * stamps_s[:, np.newaxis, np.newaxis] + phases).sum(axis=1)
    jitter = 0.001 * waves  # m, rad
    position = np.array([0.0, -0.75, 1.35]) + flown[:, :3] + jitter[:, :3]
    turns = np.column_stack([flown[:, 3:] - [0.12, 0.0], np.zeros(len(flown))]) + jitter[:, 3:]
    return level_and_turned(position, turns)


def level_and_turned(position: FloatArray, turns: FloatArray) -> FloatArray:
    """Return the poses of level cameras at positions (n, 3), then turned by vectors (n, 3)."""
    level = make_transform(np.broadcast_to(R_MAP_LEVEL, (len(turns), 3, 3)), position)
    return np.asarray(level @ turned(turns))


def turned(turns: FloatArray) -> FloatArray:
    """Return the transforms (n, 4, 4) of rotation vectors (n, 3)."""
    return exp(np.column_stack([turns, np.zeros_like(turns)]))
