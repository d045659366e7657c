"""A furnished room."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from gvo.io.synthetic import textures as paint
from gvo.io.synthetic.scene import Light, Rectangle, Scene, make_scene
from gvo.io.synthetic.textures import Canvas, Texture
from gvo.io.synthetic.worlds.building import box, fronted, ground_axes, plain, slab, stretched, wall
from gvo.types import FloatArray

_WORDS = (
    "ODOMETRY", "ATLAS", "THE RIVER", "EPIPOLAR", "ALGEBRA", "VOYAGE", "OPTICS", "MAPS",
    "NORTH", "GEODESY", "HARBOUR", "LIGHT", "STARS", "BRIDGES", "CLOCKS", "ISLANDS",
)  # fmt: skip
_DIAMOND = ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))
_HALF_M = 2.0
_HEIGHT_M = 2.5
LAMP = Light(direction=(0.25, -0.5, 0.8), ambient=0.72, direct=0.38)
_NORTH, _EAST, _WEST = 0.0, -0.5 * np.pi, 0.5 * np.pi


@lru_cache(maxsize=2)
def room(seed: int) -> Scene:
    """Furnish the room; the same seed gives the same bytes."""
    return make_scene(room_rectangles(), room_textures(seed), LAMP)


def room_rectangles() -> list[Rectangle]:
    """Return all that is in the room, in the map, with textures of `room_textures`."""
    return [
        *_shell(),
        *_north_side(),
        *_desk(np.array([0.62, 1.55])),
        *_sofa(np.array([-1.52, 0.3])),
        *_chair(np.array([0.55, 0.85]), 0.35),
        *_cartons(np.array([1.6, 0.55])),
        *_coffee_table(np.array([-0.55, 0.75]), 0.2),
        *_potted_plant(np.array([1.72, 1.66])),
    ]


def _at(x: float, y: float) -> FloatArray:
    return np.array([x, y])


def _shell() -> Iterator[Rectangle]:
    """Yield floor, carpet, ceiling, walls and skirting boards."""
    h = _HALF_M
    yield slab(_at(0, -h), _at(0, h), 2 * h, 0.0, plain("planks"))
    yield slab(_at(-0.3, -0.5), _at(-0.3, 1.35), 2.3, 0.012, stretched("carpet"))
    yield Rectangle(
        corner=(-h, -h, _HEIGHT_M), edge_s=(2 * h, 0, 0), edge_t=(0, 2 * h, 0), texture="plaster"
    )
    corners = [_at(-h, h), _at(h, h), _at(h, -h), _at(-h, -h)]
    for k, corner in enumerate(corners):
        following = corners[(k + 1) % 4]
        paper = replace(plain("wallpaper"), offset_m=(0.37 * k, 0.0))
        yield wall(corner, following, (0.0, _HEIGHT_M), paper)
        angle = _NORTH - 0.5 * np.pi * k
        inset, _ = ground_axes(angle)
        middle = 0.5 * (corner + following) - 0.01 * inset
        yield from box(middle, angle, (0.02, 2 * h, 0.09), plain("wood"))


def _picture(
    center: FloatArray, angle: float, size: tuple[float, float], height: float, name: str
) -> Iterator[Rectangle]:
    """Yield a picture on a wall that is looked at in a direction."""
    yield from fronted(box(center, angle, (0.02, *size), plain("wood"), bottom=height), name)


def _north_side() -> Iterator[Rectangle]:
    """Yield the bookcase, the window with its curtains, and pictures on three walls."""
    yield from fronted(box(_at(-1.15, 1.82), _NORTH, (0.34, 1.2, 1.95), plain("wood")), "books")
    yield from _one_carton(_at(-1.4, 1.8), 0.1, 0.32, 1.95)
    window = replace(stretched("window"), is_lit=False, gain=1.05)
    yield wall(_at(0.0, 1.99), _at(1.3, 1.99), (1.05, 2.15), window)
    for x in (-0.2, 1.28):
        yield wall(_at(x, 1.94), _at(x + 0.3, 1.94), (0.8, 2.25), plain("curtain"))
    yield from box(_at(0.65, 1.93), _NORTH, (0.03, 1.95, 0.03), plain("wood"), bottom=2.25)
    yield from _picture(_at(-0.36, 1.98), _NORTH, (0.26, 0.34), 1.45, "abstract")
    yield from _picture(_at(1.98, 0.9), _EAST, (0.7, 1.0), 1.1, "chart")
    yield from _picture(_at(1.98, -0.3), _EAST, (0.9, 0.6), 1.3, "landscape")
    yield from _picture(_at(-1.98, 0.4), _WEST, (1.0, 0.7), 1.25, "landscape")
    yield from _picture(_at(-1.98, 1.35), _WEST, (0.5, 0.65), 1.35, "abstract")


def _table(
    center: FloatArray, angle: float, size: tuple[float, float, float], leg: float
) -> Iterator[Rectangle]:
    """Yield a top on four legs; the size is along the heading, across it, upwards."""
    length, width, height = size
    yield from box(center, angle, (length, width, 0.035), plain("wood"), bottom=height - 0.035)
    forward, right = ground_axes(angle)
    for a in (-1, 1):
        for b in (-1, 1):
            foot = center + a * (0.5 * length - leg) * forward + b * (0.5 * width - leg) * right
            yield from box(foot, angle, (leg, leg, height - 0.036), plain("wood"))[:4]


def _desk(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a desk with a monitor, a keyboard, paper, books and a mug."""
    top = 0.74
    yield from _table(center, _NORTH, (0.7, 1.5, top), 0.06)
    at, size = center + _at(-0.05, 0.15), (0.03, 0.6, 0.36)
    screen = box(at, 0.12, size, plain("fabric"), bottom=top + 0.12)
    yield from fronted(screen, "screen", is_lit=False)
    yield from box(center + _at(-0.05, 0.19), 0.12, (0.04, 0.08, 0.13), plain("fabric"), bottom=top)
    keys = stretched("keyboard")
    size = (0.15, 0.45, 0.02)
    yield from box(center + _at(-0.1, -0.18), 0.08, size, plain("fabric"), bottom=top, top=keys)
    for x, y, angle in ((0.42, -0.12, -0.3), (0.55, 0.02, 0.5), (-0.55, -0.1, 0.15)):
        forward, _ = ground_axes(angle)
        start = center + _at(x, y) - 0.15 * forward
        yield slab(start, start + 0.3 * forward, 0.21, top + 0.002, stretched("page"))
    for k in range(4):
        at, size, bottom = center + _at(0.55, 0.2), (0.17, 0.24 - 0.02 * k, 0.035), top + 0.035 * k
        yield from box(at, 0.2 * k - 0.3, size, stretched("cushion"), bottom=bottom)
    mug = stretched("abstract")
    yield from box(center + _at(0.32, -0.2), 0.4, (0.08, 0.08, 0.1), mug, bottom=top)


def _sofa(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a sofa with its back to the west wall."""
    cloth = plain("fabric")
    yield from box(center, _WEST, (0.85, 1.7, 0.42), cloth)
    yield from box(center - _at(0.3, 0.0), _WEST, (0.22, 1.7, 0.42), cloth, bottom=0.42)
    for y in (-0.78, 0.78):
        yield from box(center + _at(0.0, y), _WEST, (0.85, 0.16, 0.2), cloth, bottom=0.42)
    for y, angle in ((-0.42, 0.25), (0.38, -0.2)):
        size = (0.14, 0.42, 0.4)
        cushion = stretched("cushion")
        yield from box(center + _at(-0.08, y), _WEST + angle, size, cushion, bottom=0.42)


def _chair(center: FloatArray, angle: float) -> Iterator[Rectangle]:
    """Yield a chair in front of the desk."""
    yield from _table(center, angle, (0.42, 0.42, 0.46), 0.04)
    forward, right = ground_axes(angle)
    back = center - 0.19 * forward
    for bottom in (0.58, 0.74, 0.9):
        yield from box(back, angle, (0.03, 0.42, 0.09), plain("wood"), bottom=bottom)
    for side in (-0.19, 0.19):
        post = back + side * right
        yield from box(post, angle, (0.035, 0.035, 0.56), plain("wood"), bottom=0.46)


def _one_carton(
    center: FloatArray, angle: float, size: float, bottom: float
) -> Iterator[Rectangle]:
    sizes = (size, 1.15 * size, 0.8 * size)
    yield from box(center, angle, sizes, stretched("carton"), bottom=bottom)


def _cartons(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a pile of cartons."""
    yield from _one_carton(center, 0.2, 0.55, 0.0)
    yield from _one_carton(center + _at(0.03, 0.02), -0.3, 0.42, 0.44)
    yield from _one_carton(center + _at(-0.1, -0.65), 0.6, 0.45, 0.0)


def _coffee_table(center: FloatArray, angle: float) -> Iterator[Rectangle]:
    """Yield a low table with magazines and a box on it."""
    yield from _table(center, angle, (0.5, 0.85, 0.4), 0.05)
    for x, turn in ((-0.25, 0.5), (0.02, -0.2)):
        forward, _ = ground_axes(angle + turn)
        start = center + _at(x, -0.12)
        yield slab(start, start + 0.28 * forward, 0.2, 0.403, stretched("page"))
    size = (0.16, 0.22, 0.12)
    yield from box(center + _at(0.25, 0.05), 0.7, size, stretched("chart"), bottom=0.4)


def _potted_plant(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a plant in a pot, its leaves on crossing cards."""
    yield from box(center, 0.4, (0.28, 0.28, 0.3), plain("cushion"))
    for k in range(3):
        _, across = ground_axes(np.pi * k / 3)
        ends = center - 0.25 * across, center + 0.25 * across
        leaves = replace(stretched("plant"), is_two_sided=True, is_lit=False, gain=0.85 + 0.1 * k)
        yield wall(*ends, (0.2, 1.1), leaves)


def _grain(rng: np.random.Generator) -> Canvas:
    """Return noise drawn out along the columns, like the grain of wood."""
    fine = paint.noise(rng, exponent=0.7)
    bands = np.resize(np.repeat(fine[:, ::2], 2, axis=1), fine.shape)
    long = np.repeat(fine[: len(fine) // 16], 16, axis=0)
    return np.asarray(0.3 * bands + 0.9 * long, dtype=np.float32)


def _planks(rng: np.random.Generator) -> Texture:
    tones = np.ascontiguousarray(paint.bricks(rng, 4, 16, joint=3).T)
    canvas = 132 + 12 * tones + 9 * _grain(rng) + 4 * paint.noise(rng, exponent=0.5)
    for x, y in rng.uniform(0, 1, (30, 2)):  # knots
        paint.disc(canvas, (x, y), (0.004, 0.008), float(rng.uniform(60, 90)))
    return paint.finish(canvas, (2.0, 2.0))


def _carpet(rng: np.random.Generator) -> Texture:
    canvas = 92 + 10 * paint.noise(rng, exponent=0.2) + 6 * paint.noise(rng, exponent=1.0)
    weave = paint.noise(rng, exponent=0.2)
    for inset, grey in ((0.03, 190), (0.05, 60), (0.09, 165), (0.1, 84)):
        box = (inset, inset, 1 - 2 * inset, 1 - 2 * inset)
        paint.fill(canvas, box, grey + 8 * weave)
    for row in range(6):
        for column in range(8):
            center = (0.17 + 0.094 * column, 0.18 + 0.128 * row)
            r = 0.04 if (row + column) % 2 else 0.03
            diamond = [(center[0] + r * x, center[1] + 1.3 * r * y) for x, y in _DIAMOND]
            paint.polygon(canvas, diamond, 190 if (row + column) % 2 else 140)
            inner = [(center[0] + 0.5 * r * x, center[1] + 0.6 * r * y) for x, y in _DIAMOND]
            paint.polygon(canvas, inner, float(rng.uniform(40, 110)))
    return paint.finish(canvas + 6 * weave, (2.0, 2.0))


def _wallpaper(rng: np.random.Generator) -> Texture:
    canvas = 176 + 4 * paint.noise(rng, exponent=1.2) + 4 * paint.noise(rng, exponent=0.3)
    for column in range(8):
        paint.fill(canvas, (column / 8, 0, 0.008, 1), 158)
        for row in range(8):
            x, y = (column + 0.5) / 8, (row + 0.25 + 0.5 * (column % 2)) / 8
            for dx, dy in _DIAMOND:
                petal = (x + 0.02 * dx, (y + 0.02 * dy) % 1.0)
                paint.disc(canvas, petal, (0.012, 0.012), float(rng.uniform(120, 150)))
            paint.disc(canvas, (x, y), (0.009, 0.009), 205)
    return paint.finish(canvas, (1.6, 1.6))


def _plaster(rng: np.random.Generator) -> Texture:
    canvas = 205 + 4 * paint.noise(rng, exponent=1.0) + 3 * paint.noise(rng, exponent=0.3)
    for x, y in rng.uniform(0, 1, (6, 2)):
        paint.disc(canvas, (x, y), (0.02, 0.02), 170)
    return paint.finish(canvas, (2.0, 2.0))


def _wood(rng: np.random.Generator) -> Texture:
    canvas = 118 + 15 * _grain(rng) + 6 * paint.noise(rng, exponent=1.2)
    return paint.finish(canvas, (1.0, 1.0))


def _books(rng: np.random.Generator) -> Texture:
    """Paint five shelves of books, stretched over the front of a bookcase."""
    canvas = paint.gradient(26, 34) + 2 * paint.noise(rng)
    for shelf in range(5):
        floor, x = (shelf + 1) / 5 - 0.016, 0.03
        while x < 0.93:
            w, h = float(rng.uniform(0.018, 0.045)), float(rng.uniform(0.115, 0.168))
            _book(canvas, rng, (x, floor - h, w, h))
            x += w + (0.05 if rng.random() < 0.06 else 0.002)
        paint.fill(canvas, (0, floor, 1, 0.02), 150)
    paint.frame(canvas, (0, 0, 1, 1), 140, 0.02)
    return paint.finish(canvas, (1.2, 2.0))


def _book(canvas: Canvas, rng: np.random.Generator, box: paint.Box) -> None:
    x, y, w, h = box
    grey = float(rng.uniform(45, 215))
    ink = grey - 90 if grey > 130 else grey + 110
    paint.fill(canvas, box, grey)
    paint.fill(canvas, (x, y, 0.003, h), grey - 25)
    for v in (0.08, 0.86):
        paint.fill(canvas, (x, y + v * h, w, 0.06 * h), ink)
    length = float(rng.uniform(0.3, 0.75))
    for v in np.arange(0.22, length, float(rng.uniform(0.05, 0.1))):  # letters down the spine
        width = float(rng.uniform(0.3, 0.6)) * w
        paint.fill(canvas, (x + 0.5 * (w - width), y + v * h, width, 0.04 * h), ink)


def _landscape(rng: np.random.Generator) -> Texture:
    """Paint a photograph of hills and a house, framed."""
    canvas = paint.gradient(225, 150) + 8 * paint.noise(rng, exponent=1.8)
    for k, grey in enumerate((150, 120, 88)):
        profile = 0.42 + 0.13 * k + 0.05 * paint.noise(rng, exponent=1.7)[0]
        rows = np.linspace(0, 1, paint.N_TEXELS)[:, np.newaxis]
        tone = grey + 14 * paint.noise(rng, exponent=0.8)
        canvas = np.where(rows > profile, tone, canvas).astype(np.float32)
    paint.fill(canvas, (0.55, 0.58, 0.16, 0.14), 205)
    paint.polygon(canvas, [(0.53, 0.58), (0.63, 0.48), (0.73, 0.58)], 60)
    paint.fill(canvas, (0.58, 0.62, 0.03, 0.04), 40)
    paint.fill(canvas, (0.65, 0.64, 0.03, 0.08), 70)
    paint.frame(canvas, (0, 0, 1, 1), 40, 0.03)
    paint.frame(canvas, (0.03, 0.03, 0.94, 0.94), 235, 0.04)
    return paint.finish(canvas, (1.0, 0.7))


def _abstract(rng: np.random.Generator) -> Texture:
    canvas = 200 + 5 * paint.noise(rng, exponent=0.8)
    for _ in range(26):
        x, y, w, h = *rng.uniform(0.06, 0.8, 2), *rng.uniform(0.04, 0.22, 2)
        grey = float(rng.uniform(30, 240))
        if rng.random() < 0.5:
            paint.fill(canvas, (x, y, min(w, 0.92 - x), min(h, 0.92 - y)), grey)
        else:
            paint.disc(canvas, (x + 0.03, y + 0.03), (0.3 * w, 0.3 * w), grey)
    paint.frame(canvas, (0, 0, 1, 1), 60, 0.03)
    return paint.finish(canvas + 3 * paint.noise(rng, exponent=0.3), (0.7, 0.9))


def _chart(rng: np.random.Generator) -> Texture:
    """Paint a poster with a title, a plot and lines of text."""
    canvas = 228 + 2 * paint.noise(rng, exponent=0.5)
    paint.fill(canvas, (0, 0, 1, 0.16), 70)
    paint.write(canvas, "VISUAL ODOMETRY", (0.06, 0.05, 0.88, 0.08), 240)
    paint.frame(canvas, (0.08, 0.21, 0.84, 0.36), 60, 0.006)
    for k in range(1, 8):
        paint.fill(canvas, (0.08 + 0.105 * k, 0.21, 0.002, 0.36), 170)
        paint.fill(canvas, (0.08, 0.21 + 0.045 * k, 0.84, 0.002), 170)
    for grey in (30, 110):
        y = 0.4 + 0.03 * np.cumsum(rng.standard_normal(60)) / 2
        points = np.column_stack([np.linspace(0.09, 0.91, 60), np.clip(y, 0.23, 0.55)])
        paint.polyline(canvas, points, grey, 5)
    _text(canvas, rng, (0.08, 0.62, 0.84, 0.34), 11)
    return paint.finish(canvas, (0.7, 1.0))


def _text(canvas: Canvas, rng: np.random.Generator, box: paint.Box, n_lines: int) -> None:
    x, y, w, h = box
    step = h / n_lines
    for line in range(n_lines):
        for k in range(3):
            word = str(rng.choice(_WORDS))
            cell = (x + k * w / 3, y + line * step, 0.28 * w, 0.55 * step)
            paint.write(canvas, word, cell, 40)


def _window(rng: np.random.Generator) -> Texture:
    """Paint a window with trees and a roof outside."""
    canvas = paint.gradient(242, 205) + 6 * paint.noise(rng, exponent=1.7)
    paint.polygon(canvas, [(0.5, 0.62), (0.72, 0.4), (0.95, 0.62), (0.95, 1), (0.5, 1)], 125)
    leaves = 95 + 38 * paint.noise(rng, exponent=0.9)
    for center, r in (((0.2, 0.6), 0.2), ((0.35, 0.78), 0.2), ((0.85, 0.85), 0.17)):
        shape = paint.blank(0)
        paint.disc(shape, center, (r, r), 1)
        canvas = np.where(shape > 0, leaves, canvas).astype(np.float32)
    for x in (0.0, 0.485):
        paint.frame(canvas, (x, 0, 0.515, 1), 235, 0.03)
        paint.frame(canvas, (x + 0.03, 0.03, 0.455, 0.94), 120, 0.006)
    return paint.finish(canvas, (1.4, 1.1))


def _curtain(rng: np.random.Generator) -> Texture:
    x = np.arange(paint.N_TEXELS) / paint.N_TEXELS
    folds = 26 * np.sin(2 * np.pi * 6 * x) + 9 * np.sin(2 * np.pi * 14 * x + 1)
    canvas = (150 + folds).astype(np.float32) + 7 * paint.noise(rng, exponent=0.4)
    for x_dot, y_dot in rng.uniform(0, 1, (90, 2)):
        paint.disc(canvas, (x_dot, y_dot), (0.012, 0.008), 95)
    return paint.finish(canvas, (0.8, 1.6))


def _fabric(rng: np.random.Generator) -> Texture:
    checks = paint.bricks(rng, 32, 32, joint=2, shift=0.0)
    canvas = 104 + 7 * checks + 9 * paint.noise(rng, exponent=0.3)
    return paint.finish(canvas + 7 * paint.noise(rng, exponent=1.3), (1.0, 1.0))


def _cushion(rng: np.random.Generator) -> Texture:
    canvas = 190 + 6 * paint.noise(rng, exponent=0.4)
    for k in range(0, 10, 2):
        paint.fill(canvas, (0, k / 10, 1, 0.1), 80 + 6 * paint.noise(rng, exponent=0.4))
    for k in range(9):
        paint.disc(canvas, (0.1 + 0.1 * k, 0.5), (0.03, 0.03), 230)
    return paint.finish(canvas, (0.45, 0.45))


def _carton(rng: np.random.Generator) -> Texture:
    canvas = 138 + 6 * paint.noise(rng, exponent=1.0) + 4 * paint.noise(rng, exponent=0.2)
    paint.fill(canvas, (0.44, 0, 0.12, 1), 172)
    paint.fill(canvas, (0.06, 0.52, 0.32, 0.36), 225)
    _text(canvas, rng, (0.08, 0.56, 0.28, 0.2), 4)
    for k in range(18):  # a bar code
        if rng.random() < 0.6:
            paint.fill(canvas, (0.09 + 0.014 * k, 0.79, 0.008, 0.07), 20)
    paint.write(canvas, "FRAGILE", (0.6, 0.2, 0.34, 0.12), 50)
    paint.polygon(canvas, [(0.68, 0.62), (0.76, 0.5), (0.84, 0.62)], 50)
    paint.fill(canvas, (0.74, 0.62, 0.04, 0.16), 50)
    paint.frame(canvas, (0, 0, 1, 1), 105, 0.008)
    return paint.finish(canvas, (0.5, 0.4))


def _screen(rng: np.random.Generator) -> Texture:
    canvas = paint.blank(38) + 1.5 * paint.noise(rng, exponent=0.5)
    for line in range(22):
        x, y = 0.05 + 0.03 * float(rng.integers(0, 4)), 0.08 + 0.038 * line
        for _ in range(int(rng.integers(1, 7))):
            w = float(rng.uniform(0.02, 0.1))
            paint.fill(canvas, (x, y, w, 0.018), float(rng.uniform(110, 220)))
            x += w + 0.015
    paint.fill(canvas, (0.66, 0.1, 0.3, 0.4), 210)
    paint.polyline(canvas, rng.uniform([0.68, 0.14], [0.94, 0.48], (9, 2)), 60, 4)
    paint.frame(canvas, (0, 0, 1, 1), 18, 0.03)
    return paint.finish(canvas, (0.6, 0.36))


def _keyboard(rng: np.random.Generator) -> Texture:
    canvas = paint.blank(40) + 2 * paint.noise(rng)
    for row in range(5):
        for column in range(15):
            key = (0.02 + 0.064 * column, 0.06 + 0.18 * row, 0.054, 0.14)
            paint.fill(canvas, key, 92)
            paint.fill(canvas, (key[0] + 0.012, key[1] + 0.02, 0.014, 0.05), 220)
    return paint.finish(canvas, (0.45, 0.15))


def _page(rng: np.random.Generator) -> Texture:
    canvas = 232 + 2 * paint.noise(rng, exponent=0.6)
    paint.write(canvas, str(rng.choice(_WORDS)), (0.08, 0.06, 0.6, 0.1), 30)
    paint.fill(canvas, (0.08, 0.2, 0.5, 0.26), 110 + 30 * paint.noise(rng, exponent=1.2))
    _text(canvas, rng, (0.08, 0.5, 0.84, 0.44), 9)
    paint.frame(canvas, (0, 0, 1, 1), 150, 0.01)
    return paint.finish(canvas, (0.21, 0.3))


def _plant(rng: np.random.Generator) -> Texture:
    """Paint long leaves that hang over, stretched over a card."""
    canvas = 100 + 24 * paint.noise(rng, exponent=0.8)
    shape = paint.blank(0)
    for _ in range(46):
        angle, reach = rng.normal(0.0, 0.75), rng.uniform(0.35, 0.62)
        u = np.linspace(0, 1, 24)[:, np.newaxis]
        bend = np.array([np.sin(angle), -np.cos(angle)]) * u + [0.0, 0.45] * u**2
        path = np.clip(np.array([0.5, 0.75]) + reach * bend, 0.03, 0.97)
        paint.polyline(shape, path, 1, 22)
        paint.polyline(canvas, path, float(rng.uniform(60, 160)), 18)
        paint.polyline(canvas, path, float(rng.uniform(150, 200)), 3)
    return paint.finish(canvas, (0.8, 0.8), mask=paint.opaque(shape))


# In the order of their seeds.
_PAINTERS = (
    *(_planks, _carpet, _wallpaper, _plaster, _wood, _books, _landscape, _abstract, _chart),
    *(_window, _curtain, _fabric, _cushion, _carton, _screen, _keyboard, _page, _plant),
)


def room_textures(seed: int) -> dict[str, Texture]:
    """Paint the textures of the room; the same seed gives the same bytes."""
    return paint.painted(_PAINTERS, seed, 3)
