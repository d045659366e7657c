"""A long house front whose windows repeat exactly, seen from the side window of a tram.

Matches that are one window off agree with one another perfectly. What tells them from right ones
is the little in front of the house that does not repeat: ground, trunks, posts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from gvo.geometry.se3 import exp, make_transform
from gvo.sources.atlas import Texture
from gvo.sources.scene import Rectangle, Scene, make_scene
from gvo.sources.worlds import painting as paint
from gvo.sources.worlds.building import box, plain, slab, wall
from gvo.sources.worlds.motion import CAMERA_HEIGHT_M, R_MAP_LEVEL
from gvo.sources.worlds.street import DAYLIGHT
from gvo.sources.worlds.street_textures import street_textures
from gvo.types import FloatArray

PERIOD_M = 2.0
_FRONT_M = 8.0
_ENDS_M = (-60.0, 460.0)
_SPEED_M_S = 11.0
_ACCELERATION_M_S2 = 3.0


def ride(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a tram that starts and rides at about 11 m/s.

    At 10 Hz it moves by more than half a window from frame to frame: whoever looks for the
    nearest equal window sees it ride backwards.

    Parameters
    ----------
    stamps_s : ndarray of float64, shape (n,)
        Seconds since the start.
    """
    t = stamps_s
    rising_s = np.minimum(t, _SPEED_M_S / _ACCELERATION_M_S2)
    x = 0.5 * _ACCELERATION_M_S2 * rising_s**2 + _SPEED_M_S * (t - rising_s)
    pace = rising_s * _ACCELERATION_M_S2 / _SPEED_M_S
    sway = pace * np.stack([0.03 * np.sin(2.1 * t), 0.01 * np.sin(5.3 * t + 1)])
    position = np.column_stack([x, sway[0], CAMERA_HEIGHT_M + sway[1]])
    zeros = np.zeros_like(t)
    tilts = [0.004 * np.sin(3.7 * t), 0.006 * np.sin(1.9 * t), 0.004 * np.sin(4.3 * t)]
    tilt = exp(np.stack([*(pace * each for each in tilts), zeros, zeros, zeros], axis=-1))
    level = make_transform(np.broadcast_to(R_MAP_LEVEL, (len(t), 3, 3)), position)
    return np.asarray(level @ tilt)


@lru_cache(maxsize=2)
def facade(seed: int) -> Scene:
    """Build the house front, the street before it, and what stands there."""
    first, last = _ENDS_M
    front = wall(
        np.array([first, _FRONT_M]), np.array([last, _FRONT_M]), (0.0, 16.0), plain("windows")
    )
    ends = np.array([first, 0.0]), np.array([last, 0.0])
    aside = np.array([0.0, 1.0])
    rectangles = [
        front,
        slab(ends[0], ends[1], 12.0, 0.0, plain("asphalt")),
        slab(ends[0] + 7.0 * aside, ends[1] + 7.0 * aside, 2.0, 0.1, plain("pavement")),
        wall(ends[0] + 6.0 * aside, ends[1] + 6.0 * aside, (0.0, 0.1), plain("kerb")),
        *_things(np.random.default_rng([seed, 5])),
    ]
    windows = _window(np.random.default_rng([seed, 6]))
    return make_scene(rectangles, street_textures(seed) | {"windows": windows}, DAYLIGHT)


def _things(rng: np.random.Generator) -> Iterator[Rectangle]:
    """Yield trunks and posts along the kerb, at no regular distance."""
    x = _ENDS_M[0]
    while x < _ENDS_M[1]:
        foot = np.array([x, float(rng.uniform(6.3, 6.7))])
        is_tree = rng.random() < 0.6
        width = float(rng.uniform(0.25, 0.5)) if is_tree else 0.14
        bark = replace(
            plain("bark" if is_tree else "metal"),
            offset_m=(float(rng.uniform(0.0, 2.0)), float(rng.uniform(0.0, 2.0))),
        )
        yield from box(foot, float(rng.uniform(-0.3, 0.3)), (width, width, 6.0), bark)[:4]
        x += float(rng.uniform(4.0, 9.0))


def _window(rng: np.random.Generator) -> Texture:
    """Paint one window in its part of the front; every other one is the same."""
    canvas = 150 + 9 * paint.bricks(rng, 10, 32) + 5 * paint.noise(rng, exponent=0.9)
    paint.fill(canvas, (0.24, 0.2, 0.52, 0.5), 228)
    paint.fill(canvas, (0.27, 0.22, 0.46, 0.46), paint.gradient(90, 35))
    for _ in range(9):
        u, v = rng.uniform(0.3, 0.66), rng.uniform(0.3, 0.62)
        paint.fill(canvas, (u, v, *rng.uniform(0.01, 0.05, 2)), float(rng.uniform(60, 220)))
    for x in (0.27, 0.49, 0.715):
        paint.fill(canvas, (x, 0.22, 0.015, 0.46), 235)
    paint.fill(canvas, (0.27, 0.38, 0.46, 0.012), 235)
    paint.fill(canvas, (0.2, 0.7, 0.6, 0.03), 205)
    paint.fill(canvas, (0.2, 0.73, 0.6, 0.012), 60)
    return paint.finish(canvas, (PERIOD_M, 3.2))
