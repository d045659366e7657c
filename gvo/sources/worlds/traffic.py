"""A car that stops at a crossing, and a long bus that passes close before it.

The bus fills two thirds of the image for seconds: it comes, halts before the camera and pulls
off again, so that most of what is seen agrees on a motion that is not the camera's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from gvo.geometry.se3 import make_transform
from gvo.sources.atlas import Texture
from gvo.sources.scene import Rectangle, make_scene
from gvo.sources.stage import Stage
from gvo.sources.worlds import painting as paint
from gvo.sources.worlds.building import box, plain, stretched
from gvo.sources.worlds.motion import drive_along
from gvo.sources.worlds.street import DAYLIGHT, street_rectangles
from gvo.sources.worlds.street_textures import street_textures
from gvo.types import FloatArray

_BUS_M = (18.0, 2.55, 3.0)  # length, width, height
_BOTTOM_M = 0.3
# Where the car halts and where the bus crosses its road, along it; metres.
_HALT_M = 36.0
_CROSSING_M = _HALT_M + 10.3
_SPEED_M_S = 8.0
_BRAKE_M_S2 = 3.2
_HALT_S = 2.5
_START_S = 9.5
_START_M_S2 = 1.8


def traffic_drive(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a car that brakes, stands for 7 s and drives on.

    Parameters
    ----------
    stamps_s : ndarray of float64, shape (n,)
        Seconds since the start.
    """
    t = stamps_s
    left_s = np.maximum(_HALT_S - t, 0.0)
    gone_s = np.maximum(t - _START_S, 0.0)
    s = _HALT_M - 0.5 * _BRAKE_M_S2 * left_s**2
    # Up to its speed, then on with it.
    rising_s = np.minimum(gone_s, _SPEED_M_S / _START_M_S2)
    s = s + 0.5 * _START_M_S2 * rising_s**2 + _SPEED_M_S * (gone_s - rising_s)
    speeds = _BRAKE_M_S2 * left_s + _START_M_S2 * rising_s
    return drive_along(t, s, shake=np.minimum(speeds / _SPEED_M_S, 1.0))


def bus_path(elapsed_s: float) -> FloatArray:
    """Return T_map_body of the bus: it comes from the left, halts at 5.5 s, pulls off at 6.5 s."""
    coming_s = max(5.5 - elapsed_s, 0.0)
    gone_s = max(elapsed_s - 6.5, 0.0)
    x = -0.5 * 2.6 * coming_s**2 + 0.5 * 1.2 * gone_s**2
    return np.asarray(make_transform(np.eye(3), np.array([x, _CROSSING_M, 0.0])))


@lru_cache(maxsize=2)
def traffic(seed: int) -> Stage:
    """Build the street with a gap for the crossing, and the bus."""
    still = [*filter(_leaves_way, street_rectangles(seed))]
    textures = street_textures(seed) | {"bus": _bus_side(np.random.default_rng([seed, 4]))}
    return Stage(
        scene=make_scene([*still, *_bus()], textures, DAYLIGHT),
        n_still=len(still),
        path=bus_path,
    )


def _leaves_way(rectangle: Rectangle) -> bool:
    """Tell whether the bus does not run into a rectangle, or it is ground or sky."""
    corner, s, t = (
        np.asarray(v, dtype=np.float64)
        for v in (rectangle.corner, rectangle.edge_s, rectangle.edge_t)
    )
    corners = np.array([corner, corner + s, corner + t, corner + s + t])
    low, high = corners.min(axis=0), corners.max(axis=0)
    is_beside = high[1] < _CROSSING_M - 2.5 or low[1] > _CROSSING_M + 2.5
    return bool(is_beside or high[2] < _BOTTOM_M or (high - low).max() > 200.0)


def _bus() -> Sequence[Rectangle]:
    """Return a bus that stands along x, its middle at the origin."""
    length, width, height = _BUS_M
    size = (width, length, height)
    return box(np.zeros(2), 0.0, size, stretched("bus"), bottom=_BOTTOM_M, top=plain("body")) + box(
        np.zeros(2), 0.0, (width - 0.3, length - 1.0, _BOTTOM_M), replace(plain("metal"), gain=0.3)
    )


def _bus_side(rng: np.random.Generator) -> Texture:
    """Paint a row of windows with passengers, advertisements, doors and wheels."""
    canvas = paint.gradient(196, 150) + 4 * paint.noise(rng, exponent=1.0)
    for k in range(14):
        x = 0.02 + k * 0.069
        paint.fill(canvas, (x, 0.12, 0.062, 0.36), float(rng.uniform(35, 70)))
        for _ in range(5):
            u, v = x + rng.uniform(0.006, 0.05), rng.uniform(0.2, 0.42)
            paint.disc(canvas, (u, v), (0.006, 0.035), float(rng.uniform(60, 200)))
        if k % 4 == 1:
            paint.fill(canvas, (x, 0.12, 0.062, 0.78), 45)
            paint.frame(canvas, (x, 0.12, 0.031, 0.78), 170, 0.004)
    for k, words in enumerate(("CITY LINES", "SEE THE SEA", "FRESH BREAD", "NIGHT MAPS")):
        x = 0.095 + 0.245 * k
        paint.fill(canvas, (x + 0.06, 0.55, 0.13, 0.2), float(rng.uniform(60, 120)))
        paint.write(canvas, words, (x + 0.065, 0.59, 0.12, 0.12), 235)
    for _ in range(160):  # dirt and dents
        x, y = rng.uniform(0.0, 0.99), rng.uniform(0.5, 0.95)
        paint.fill(canvas, (x, y, *rng.uniform(0.002, 0.008, 2)), float(rng.uniform(60, 230)))
    for x in (0.12, 0.55, 0.86):
        paint.disc(canvas, (x, 0.95), (0.028, 0.15), 30)
        paint.disc(canvas, (x, 0.95), (0.014, 0.08), 150)
    return paint.finish(canvas, (_BUS_M[0], _BUS_M[2]))
