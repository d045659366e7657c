"""What the houses of the street are covered with."""

from __future__ import annotations

import numpy as np

from gvo.sources.atlas import Texture
from gvo.sources.worlds import painting as paint
from gvo.sources.worlds.painting import Box, Canvas

STOREY_M = 3.2
HOUSES = ("brick", "plaster", "stone", "panel")
SHOPS = ("shop", "doors")


def _window(canvas: Canvas, rng: np.random.Generator, box: Box, frame_grey: float) -> None:
    """Paint a window with frame, bars, sill, what is reflected in it, and perhaps a blind."""
    x, y, w, h = box
    t = 0.006
    paint.fill(canvas, (x - t, y - t, w + 2 * t, h + 2 * t), frame_grey)
    sky = paint.gradient(float(rng.uniform(80, 120)), float(rng.uniform(20, 60)))
    paint.fill(canvas, box, np.roll(sky, round(y * len(sky)), axis=0))
    kind = rng.integers(0, 4)
    if kind == 0:
        paint.fill(canvas, (x, y, w, h * rng.uniform(0.2, 0.8)), float(rng.uniform(120, 200)))
    elif kind == 1:
        paint.fill(canvas, (x, y, 0.22 * w, h), 170)
        paint.fill(canvas, (x + 0.78 * w, y, 0.22 * w, h), 175)
    elif kind == 2:
        slope = rng.uniform(0.3, 0.6) * w
        points = [(x + 0.2 * w, y), (x + 0.2 * w + slope, y), (x + slope, y + h), (x, y + h)]
        paint.polygon(canvas, points, 128)
    paint.frame(canvas, box, frame_grey, 0.005)
    paint.fill(canvas, (x + 0.5 * w - 0.003, y, 0.006, h), frame_grey)
    paint.fill(canvas, (x, y + 0.35 * h, w, 0.005), frame_grey)
    paint.fill(canvas, (x - 0.012, y + h + t, w + 0.024, 0.01), 205)
    paint.fill(canvas, (x - 0.012, y + h + t + 0.01, w + 0.024, 0.005), 60)


def _house(
    canvas: Canvas, rng: np.random.Generator, window: tuple[float, float], frame_grey: float
) -> Texture:
    """Add four columns and three storeys of windows, (width, height) in shares of a cell."""
    for row in range(3):
        for column in range(4):
            w, h = window[0] / 4, window[1] / 3
            box = ((column + 0.5) / 4 - 0.5 * w, (row + 0.42) / 3 - 0.5 * h, w, h)
            _window(canvas, rng, box, frame_grey)
    return paint.finish(canvas, (12.0, 3 * STOREY_M))


def brick_house(rng: np.random.Generator) -> Texture:
    """Paint bricks and white windows."""
    canvas = 104 + 13 * paint.bricks(rng, 48, 120) + 7 * paint.noise(rng, exponent=1.2)
    for row in range(3):
        for column in range(4):
            paint.fill(canvas, ((column + 0.24) / 4, (row + 0.1) / 3, 0.13, 0.018), 168)
    return _house(canvas, rng, (0.42, 0.56), 225)


def plaster_house(rng: np.random.Generator) -> Texture:
    """Paint plaster with shutters and stains."""
    canvas = 186 + 5 * paint.noise(rng, exponent=1.4) + 5 * paint.noise(rng, exponent=0.3)
    for row in range(3):
        for column in range(4):
            for x in (0.12, 0.72):  # shutters
                box = ((column + x) / 4, (row + 0.12) / 3, 0.04, 0.2)
                paint.fill(canvas, box, 96)
                for k in range(9):
                    paint.fill(canvas, (box[0], box[1] + 0.022 * k, 0.04, 0.005), 60)
        paint.fill(canvas, (0, (row + 0.94) / 3, 1, 0.012), 150)
    for _ in range(10):  # where the rain ran down
        x, y = rng.uniform(0, 1, 2)
        steps = rng.normal((0.0, 0.006), 0.002, (30, 2))
        paint.polyline(canvas, np.array([x, y]) + np.cumsum(steps, axis=0), 158, 3)
    return _house(canvas, rng, (0.36, 0.58), 235)


def stone_house(rng: np.random.Generator) -> Texture:
    """Paint ashlar with framed windows."""
    canvas = 152 + 9 * paint.bricks(rng, 16, 24, joint=3) + 7 * paint.noise(rng, exponent=0.9)
    for row in range(3):
        paint.fill(canvas, (0, row / 3, 1, 0.016), 200)
        paint.fill(canvas, (0, row / 3 + 0.016, 1, 0.006), 84)
        for column in range(4):
            box = ((column + 0.2) / 4, (row + 0.1) / 3, 0.15, 0.235)
            paint.frame(canvas, box, 196, 0.014)
    return _house(canvas, rng, (0.46, 0.6), 70)


def panel_house(rng: np.random.Generator) -> Texture:
    """Paint concrete panels with wide windows."""
    canvas = 128 + 12 * paint.bricks(rng, 8, 6, joint=4, shift=0.0)
    canvas += 5 * paint.noise(rng, exponent=0.6)
    for row in range(3):
        paint.fill(canvas, (0, (row + 0.8) / 3, 1, 0.05), 88)
        for k in range(40):
            paint.fill(canvas, (k / 40, (row + 0.8) / 3, 0.004, 0.05), 150)
    return _house(canvas, rng, (0.74, 0.5), 50)


def _ground_floor(rng: np.random.Generator, grey: float) -> Canvas:
    canvas = grey + 8 * paint.bricks(rng, 24, 8, joint=4) + 6 * paint.noise(rng, exponent=0.9)
    paint.fill(canvas, (0, 0, 1, 0.03), 190)
    paint.fill(canvas, (0, 0.03, 1, 0.015), 60)
    paint.fill(canvas, (0, 0.92, 1, 0.08), 70)
    return canvas


def shop(rng: np.random.Generator) -> Texture:
    """Paint three shops, a ground floor."""
    canvas = _ground_floor(rng, 120)
    for k, name in enumerate(("BAKERY", "BOOKS & MAPS", "CAMERA")):
        x = k / 3 + 0.02
        paint.fill(canvas, (x, 0.08, 0.29, 0.14), float(rng.uniform(30, 80)))
        paint.write(canvas, name, (x + 0.02, 0.11, 0.25, 0.08), 230)
        paint.fill(canvas, (x, 0.26, 0.2, 0.56), paint.gradient(90, 20))
        for _ in range(24):
            u, v, w, h = *rng.uniform(0, 1, 2), *rng.uniform(0.01, 0.04, 2)
            box = (x + 0.01 + 0.15 * u, 0.4 + 0.36 * v, w, h)
            paint.fill(canvas, box, float(rng.uniform(60, 230)))
        for stripe in range(8):
            box = (x + 0.025 * stripe, 0.24, 0.0125, 0.08)
            paint.fill(canvas, box, 220)
        paint.frame(canvas, (x, 0.26, 0.2, 0.56), 210, 0.008)
        _door(canvas, (x + 0.215, 0.3, 0.07, 0.62), 60)
    return paint.finish(canvas, (12.0, STOREY_M))


def _door(canvas: Canvas, box: Box, grey: float) -> None:
    x, y, w, h = box
    paint.fill(canvas, (x - 0.006, y - 0.012, w + 0.012, h + 0.012), 200)
    paint.fill(canvas, box, grey)
    for k in range(3):
        panel = (x + 0.15 * w, y + (0.06 + 0.31 * k) * h, 0.7 * w, 0.25 * h)
        paint.frame(canvas, panel, grey + 45, 0.004)
    paint.disc(canvas, (x + 0.9 * w, y + 0.55 * h), (0.003, 0.012), 220)


def doors(rng: np.random.Generator) -> Texture:
    """Paint doors and windows, a ground floor."""
    canvas = _ground_floor(rng, 140)
    for k in range(4):
        _window(canvas, rng, (k / 4 + 0.03, 0.28, 0.09, 0.34), 230)
        _door(canvas, (k / 4 + 0.16, 0.26, 0.06, 0.66), float(rng.uniform(30, 90)))
        paint.write(canvas, str(2 * k + 11), (k / 4 + 0.18, 0.16, 0.02, 0.06), 30)
    return paint.finish(canvas, (12.0, STOREY_M))


def gable(rng: np.random.Generator) -> Texture:
    """Paint a triangle of bricks, stretched over the end of a roof."""
    canvas = 112 + 13 * paint.bricks(rng, 40, 56) + 7 * paint.noise(rng, exponent=1.2)
    _window(canvas, rng, (0.44, 0.5, 0.12, 0.26), 225)
    shape = paint.blank(0)
    paint.polygon(shape, [(0, 1), (0.5, 0), (1, 1)], 1)
    return paint.finish(canvas, (10.0, 4.5), mask=paint.opaque(shape))
