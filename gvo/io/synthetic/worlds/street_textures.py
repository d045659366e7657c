"""Its textures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gvo.io.synthetic import textures as paint
from gvo.io.synthetic.textures import Box, Canvas, Texture

CAR_LENGTH_M = 4.4
CAR_HEIGHT_M = 1.5
CAR_PROFILE = (  # (along, up) in metres from the rear bumper; the upper outline of a car
    (0.0, 0.45), (0.08, 0.95), (0.55, 1.0), (1.15, 1.46), (2.45, 1.5), (3.3, 0.98), (4.3, 0.8),
    (4.4, 0.45),
)  # fmt: skip
STOREY_M = 3.2
HOUSES = ("brick", "plaster", "stone", "panel")
SHOPS = ("shop", "doors")


def _asphalt(rng: np.random.Generator) -> Texture:
    canvas = 104 + 7 * paint.noise(rng, exponent=1.0) + 9 * paint.noise(rng, exponent=0.2)
    for _ in range(9):  # patches of repairs
        x, y, w, h = *rng.uniform(0, 0.85, 2), *rng.uniform(0.04, 0.15, 2)
        paint.fill(canvas, (x, y, w, h), canvas + rng.uniform(-24, 16))
        paint.frame(canvas, (x, y, w, h), 52, 0.002)
    for _ in range(14):
        paint.crack(canvas, rng, n_steps=int(rng.integers(10, 60)), grey=48)
    x, y = rng.uniform(0.2, 0.7, 2)
    paint.disc(canvas, (x, y), (0.04, 0.04), 58)
    paint.disc(canvas, (x, y), (0.032, 0.032), 84)
    for k in range(5):
        paint.fill(canvas, (x - 0.02, y - 0.02 + 0.01 * k, 0.04, 0.004), 50)
    return paint.finish(canvas, (8.0, 8.0))


def _pavement(rng: np.random.Generator) -> Texture:
    tones = paint.bricks(rng, 8, 8, joint=3, shift=0.0)
    canvas = 138 + 12 * tones + 6 * paint.noise(rng, exponent=0.8)
    canvas += 5 * paint.noise(rng, exponent=0.1)
    for x, y in rng.uniform(0, 1, (40, 2)):
        paint.disc(canvas, (x, y), (0.004, 0.004), float(rng.uniform(70, 110)))
    return paint.finish(canvas, (4.0, 4.0))


def _kerb(rng: np.random.Generator) -> Texture:
    canvas = 158 + 6 * paint.bricks(rng, 4, 2, joint=5, shift=0.0)
    return paint.finish(canvas + 8 * paint.noise(rng, exponent=0.7), (4.0, 4.0))


def _grass(rng: np.random.Generator) -> Texture:
    canvas = 96 + 14 * paint.noise(rng, exponent=0.5) + 14 * paint.noise(rng, exponent=1.2)
    return paint.finish(canvas, (6.0, 6.0))


def _wall(rng: np.random.Generator) -> Texture:
    canvas = 122 + 18 * paint.bricks(rng, 16, 32, joint=3) + 9 * paint.noise(rng, exponent=1.0)
    return paint.finish(canvas, (4.0, 2.4))


def _tiles(rng: np.random.Generator) -> Texture:
    canvas = 88 + 10 * paint.bricks(rng, 24, 24, joint=5) + 8 * paint.noise(rng, exponent=1.0)
    return paint.finish(canvas, (6.0, 6.0))


def _leaves(rng: np.random.Generator) -> Texture:
    """Paint a crown, stretched over a card: leaves with light between them."""
    field = paint.noise(rng, exponent=0.8, largest=0.1)
    canvas = 84 + 26 * field + 26 * paint.noise(rng, exponent=1.3, largest=0.2)
    y, x = np.mgrid[: paint.N_TEXELS, : paint.N_TEXELS] / paint.N_TEXELS - 0.5
    outline = paint.noise(rng, exponent=1.5, largest=0.3)
    density = 1.0 - 5.4 * np.hypot(x, 1.05 * y) ** 2 + 0.2 * outline + 0.08 * field
    canvas += (10 - 80 * y).astype(np.float32)  # lit from above
    return paint.finish(canvas, (6.0, 6.0), mask=np.asarray(density > 0.05))


def _bark(rng: np.random.Generator) -> Texture:
    canvas = 92 + 12 * paint.noise(rng, exponent=0.7) + 16 * paint.bricks(rng, 64, 4, joint=4)
    return paint.finish(canvas, (2.0, 2.0))


def _metal(rng: np.random.Generator) -> Texture:
    canvas = 112 + 6 * paint.noise(rng, exponent=1.0)
    for k in range(8):
        paint.fill(canvas, (0, k / 8, 1, 0.012), 70)
    return paint.finish(canvas, (2.0, 2.0))


def _paint(rng: np.random.Generator) -> Texture:
    worn = np.minimum(0, paint.noise(rng, exponent=0.9) + 0.9)
    canvas = 205 + 5 * paint.noise(rng, exponent=0.4) + 40 * worn
    return paint.finish(canvas, (4.0, 4.0))


def _car_points(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(x / CAR_LENGTH_M, 1.0 - y / CAR_HEIGHT_M) for x, y in points]


def _car(rng: np.random.Generator) -> Texture:
    """Paint a car from its right side, stretched over length and height."""
    shape = paint.blank(0)
    paint.polygon(shape, _car_points([(0.0, 0.22), *CAR_PROFILE, (4.4, 0.22)]), 1)
    canvas = paint.gradient(190, 110) + 3 * paint.noise(rng, exponent=1.5)
    glass = [(0.72, 1.0), (1.2, 1.4), (2.42, 1.43), (3.12, 1.0)]
    paint.polygon(canvas, _car_points(glass), 40)
    paint.polygon(canvas, _car_points([(1.3, 1.38), (1.7, 1.38), (1.4, 1.02), (1.0, 1.02)]), 95)
    for x in (0.75, 1.85, 3.05):  # door gaps and pillars
        paint.polygon(
            canvas, _car_points([(x, 1.42), (x + 0.05, 1.42), (x + 0.03, 0.35), (x, 0.35)]), 45
        )
    paint.polygon(canvas, _car_points([(0.1, 0.7), (4.3, 0.66), (4.3, 0.63), (0.1, 0.67)]), 60)
    paint.polygon(canvas, _car_points([(0.0, 0.35), (4.4, 0.35), (4.4, 0.2), (0.0, 0.2)]), 35)
    for x in (1.6, 2.75):
        paint.polygon(
            canvas, _car_points([(x, 0.9), (x + 0.2, 0.9), (x + 0.2, 0.86), (x, 0.86)]), 230
        )
    for x in (0.85, 3.5):
        (center,) = _car_points([(x, 0.33)])
        for radius, grey in ((0.38, 25), (0.33, 45), (0.21, 190), (0.07, 60)):
            paint.disc(canvas, center, (radius / CAR_LENGTH_M, radius / CAR_HEIGHT_M), grey)
        paint.disc(shape, center, (0.33 / CAR_LENGTH_M, 0.33 / CAR_HEIGHT_M), 1)
    return paint.finish(canvas, (CAR_LENGTH_M, CAR_HEIGHT_M), mask=paint.opaque(shape))


def _body(rng: np.random.Generator) -> Texture:
    canvas = 165 + 6 * paint.noise(rng, exponent=1.6)
    paint.frame(canvas, (0.03, 0.03, 0.94, 0.94), 90, 0.012)
    return paint.finish(canvas, (2.0, 2.0))


def _front(rng: np.random.Generator) -> Texture:
    """Paint lamps, grille and number plate, stretched over a bumper."""
    canvas = paint.gradient(170, 100) + 2 * paint.noise(rng, exponent=1.5)
    for x in (0.05, 0.77):
        paint.fill(canvas, (x, 0.12, 0.18, 0.3), 235)
        paint.frame(canvas, (x, 0.12, 0.18, 0.3), 50, 0.015)
    paint.fill(canvas, (0.28, 0.1, 0.44, 0.3), 45)
    paint.fill(canvas, (0.33, 0.52, 0.34, 0.24), 235)
    paint.write(canvas, "KA 1707", (0.35, 0.56, 0.3, 0.15), 20)
    paint.fill(canvas, (0, 0.86, 1, 0.14), 40)
    return paint.finish(canvas, (2.0, 1.0))


def _glass(rng: np.random.Generator) -> Texture:
    canvas = paint.gradient(110, 40) + 8 * paint.noise(rng, exponent=1.5)
    paint.polygon(canvas, [(0.15, 1), (0.35, 0), (0.55, 0), (0.35, 1)], 135)
    for x in (0.22, 0.62):  # the seats behind it
        paint.fill(canvas, (x, 0.5, 0.16, 0.5), 22)
    paint.frame(canvas, (0, 0, 1, 1), 30, 0.03)
    return paint.finish(canvas, (1.5, 0.7))


def _sign(rng: np.random.Generator) -> Texture:
    canvas = paint.blank(40) + 2 * paint.noise(rng)
    paint.disc(canvas, (0.5, 0.5), (0.44, 0.44), 235)
    paint.write(canvas, "30", (0.22, 0.34, 0.56, 0.32), 20)
    shape = paint.blank(0)
    paint.disc(shape, (0.5, 0.5), (0.49, 0.49), 1)
    return paint.finish(canvas, (1.0, 1.0), mask=paint.opaque(shape))


def _sky(rng: np.random.Generator) -> Texture:
    """Paint sky, clouds and distant hills, stretched over the height of the backdrop."""
    heights = paint.gradient(1.0, 0.0)
    clouds = np.clip(paint.noise(rng, exponent=1.7) + 0.2, 0, 2) * np.clip(3 * heights, 0, 1)
    canvas = 228 - 70 * heights + 34 * clouds
    x = np.arange(paint.N_TEXELS)
    for base, grey, amount in ((0.075, 165, 0.03), (0.05, 140, 0.02), (0.03, 112, 0.012)):
        profile = base + amount * np.cumsum(paint.noise(rng, exponent=0.6)[0]) / 12
        profile -= (profile[-1] - profile[0]) * x / len(x)  # periodic
        tone = grey + 5 * paint.noise(rng, exponent=0.8, largest=0.05)
        canvas = np.where(heights < profile, tone, canvas).astype(np.float32)
    return paint.finish(canvas, (600.0, 300.0))


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


def _brick(rng: np.random.Generator) -> Texture:
    """Paint bricks and white windows."""
    canvas = 104 + 13 * paint.bricks(rng, 48, 120) + 7 * paint.noise(rng, exponent=1.2)
    for row in range(3):
        for column in range(4):
            paint.fill(canvas, ((column + 0.24) / 4, (row + 0.1) / 3, 0.13, 0.018), 168)
    return _house(canvas, rng, (0.42, 0.56), 225)


def _plaster(rng: np.random.Generator) -> Texture:
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


def _stone(rng: np.random.Generator) -> Texture:
    """Paint ashlar with framed windows."""
    canvas = 152 + 9 * paint.bricks(rng, 16, 24, joint=3) + 7 * paint.noise(rng, exponent=0.9)
    for row in range(3):
        paint.fill(canvas, (0, row / 3, 1, 0.016), 200)
        paint.fill(canvas, (0, row / 3 + 0.016, 1, 0.006), 84)
        for column in range(4):
            box = ((column + 0.2) / 4, (row + 0.1) / 3, 0.15, 0.235)
            paint.frame(canvas, box, 196, 0.014)
    return _house(canvas, rng, (0.46, 0.6), 70)


def _panel(rng: np.random.Generator) -> Texture:
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


def _shop(rng: np.random.Generator) -> Texture:
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


def _doors(rng: np.random.Generator) -> Texture:
    """Paint doors and windows, a ground floor."""
    canvas = _ground_floor(rng, 140)
    for k in range(4):
        _window(canvas, rng, (k / 4 + 0.03, 0.28, 0.09, 0.34), 230)
        _door(canvas, (k / 4 + 0.16, 0.26, 0.06, 0.66), float(rng.uniform(30, 90)))
        paint.write(canvas, str(2 * k + 11), (k / 4 + 0.18, 0.16, 0.02, 0.06), 30)
    return paint.finish(canvas, (12.0, STOREY_M))


def _gable(rng: np.random.Generator) -> Texture:
    """Paint a triangle of bricks, stretched over the end of a roof."""
    canvas = 112 + 13 * paint.bricks(rng, 40, 56) + 7 * paint.noise(rng, exponent=1.2)
    _window(canvas, rng, (0.44, 0.5, 0.12, 0.26), 225)
    shape = paint.blank(0)
    paint.polygon(shape, [(0, 1), (0.5, 0), (1, 1)], 1)
    return paint.finish(canvas, (10.0, 4.5), mask=paint.opaque(shape))


# In the order of their seeds.
_PAINTERS = (
    *(_asphalt, _pavement, _kerb, _grass),
    *(_brick, _plaster, _stone, _panel, _shop, _doors),
    *(_wall, _tiles, _leaves, _bark, _metal, _paint),
    *(_car, _body, _front, _glass),
    *(_gable, _sign, _sky),
)


def street_textures(seed: int) -> dict[str, Texture]:
    """Paint the textures of the street; the same seed gives the same bytes."""
    return paint.painted(_PAINTERS, seed, 1)
