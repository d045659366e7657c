"""What the street is covered with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gvo.sources.atlas import Texture
from gvo.sources.worlds import house_textures as houses
from gvo.sources.worlds import painting as paint

CAR_LENGTH_M = 4.4
CAR_HEIGHT_M = 1.5
CAR_PROFILE = (  # (along, up) in metres from the rear bumper; the upper outline of a car
    (0.0, 0.45), (0.08, 0.95), (0.55, 1.0), (1.15, 1.46), (2.45, 1.5), (3.3, 0.98), (4.3, 0.8),
    (4.4, 0.45),
)  # fmt: skip


def street_textures(seed: int) -> dict[str, Texture]:
    """Paint the textures of the street; the same seed gives the same bytes."""
    painters = {
        "asphalt": _asphalt,
        "pavement": _pavement,
        "kerb": _kerb,
        "grass": _grass,
        "brick": houses.brick_house,
        "plaster": houses.plaster_house,
        "stone": houses.stone_house,
        "panel": houses.panel_house,
        "shop": houses.shop,
        "doors": houses.doors,
        "wall": _garden_wall,
        "tiles": _roof_tiles,
        "leaves": _leaves,
        "bark": _bark,
        "metal": _metal,
        "paint": _white_paint,
        "car": _car_side,
        "body": _car_body,
        "front": _car_front,
        "glass": _car_glass,
        "gable": houses.gable,
        "sign": _sign,
        "sky": _sky,
    }
    return {
        name: painter(np.random.default_rng([seed, 1, k]))
        for k, (name, painter) in enumerate(painters.items())
    }


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


def _garden_wall(rng: np.random.Generator) -> Texture:
    canvas = 122 + 18 * paint.bricks(rng, 16, 32, joint=3) + 9 * paint.noise(rng, exponent=1.0)
    return paint.finish(canvas, (4.0, 2.4))


def _roof_tiles(rng: np.random.Generator) -> Texture:
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


def _white_paint(rng: np.random.Generator) -> Texture:
    worn = np.minimum(0, paint.noise(rng, exponent=0.9) + 0.9)
    canvas = 205 + 5 * paint.noise(rng, exponent=0.4) + 40 * worn
    return paint.finish(canvas, (4.0, 4.0))


def _car_points(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(x / CAR_LENGTH_M, 1.0 - y / CAR_HEIGHT_M) for x, y in points]


def _car_side(rng: np.random.Generator) -> Texture:
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


def _car_body(rng: np.random.Generator) -> Texture:
    canvas = 165 + 6 * paint.noise(rng, exponent=1.6)
    paint.frame(canvas, (0.03, 0.03, 0.94, 0.94), 90, 0.012)
    return paint.finish(canvas, (2.0, 2.0))


def _car_front(rng: np.random.Generator) -> Texture:
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


def _car_glass(rng: np.random.Generator) -> Texture:
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
