"""A furnished room of 4 x 4 x 2.5 m, its middle at the origin, the floor at height 0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from gvo.sources.scene import Light, Rectangle, Scene, make_scene
from gvo.sources.worlds.building import box, ground_axes, plain, slab, stretched, wall
from gvo.sources.worlds.room_textures import room_textures
from gvo.types import FloatArray

_HALF_M = 2.0
_HEIGHT_M = 2.5
LAMP = Light(direction=(0.25, -0.5, 0.8), ambient=0.72, direct=0.38)
_NORTH, _EAST, _WEST = 0.0, -0.5 * np.pi, 0.5 * np.pi


@lru_cache(maxsize=2)
def room(seed: int) -> Scene:
    """Furnish the room; the same seed gives the same bytes.

    Returns
    -------
    Scene
        Some 250 rectangles, map axes with z up.
    """
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
        *_plant(np.array([1.72, 1.66])),
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
    first, *others = box(center, angle, (0.02, *size), plain("wood"), bottom=height)
    yield replace(first, texture=name, is_stretched=True)
    yield from others


def _north_side() -> Iterator[Rectangle]:
    """Yield the bookcase, the window with its curtains, and pictures on three walls."""
    front, *others = box(_at(-1.15, 1.82), _NORTH, (0.34, 1.2, 1.95), plain("wood"))
    yield replace(front, texture="books", is_stretched=True)
    yield from others
    yield from _carton(_at(-1.4, 1.8), 0.1, 0.32, 1.95)
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
    below = (center, angle, (length, width), height - 0.036)
    forward, right = ground_axes(angle)
    for a in (-1, 1):
        for b in (-1, 1):
            foot = center + a * (0.5 * length - leg) * forward + b * (0.5 * width - leg) * right
            yield from box(foot, angle, (leg, leg, below[3]), plain("wood"))[:4]


def _desk(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a desk with a monitor, a keyboard, paper, books and a mug."""
    top = 0.74
    yield from _table(center, _NORTH, (0.7, 1.5, top), 0.06)
    screen, *others = box(
        center + _at(-0.05, 0.15), 0.12, (0.03, 0.6, 0.36), plain("fabric"), bottom=top + 0.12
    )
    yield replace(screen, texture="screen", is_stretched=True, is_lit=False)
    yield from others
    yield from box(center + _at(-0.05, 0.19), 0.12, (0.04, 0.08, 0.13), plain("fabric"), bottom=top)
    keys = stretched("keyboard")
    size = (0.15, 0.45, 0.02)
    yield from box(center + _at(-0.1, -0.18), 0.08, size, plain("fabric"), bottom=top, top=keys)
    for x, y, angle in ((0.42, -0.12, -0.3), (0.55, 0.02, 0.5), (-0.55, -0.1, 0.15)):
        forward, _ = ground_axes(angle)
        start = center + _at(x, y) - 0.15 * forward
        yield slab(start, start + 0.3 * forward, 0.21, top + 0.002, stretched("page"))
    for k in range(4):
        size = (0.17, 0.24 - 0.02 * k, 0.035)
        yield from box(
            center + _at(0.55, 0.2),
            0.2 * k - 0.3,
            size,
            stretched("cushion"),
            bottom=top + 0.035 * k,
        )
    yield from box(
        center + _at(0.32, -0.2), 0.4, (0.08, 0.08, 0.1), stretched("abstract"), bottom=top
    )


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
    forward, _ = ground_axes(angle)
    back = center - 0.19 * forward
    for bottom in (0.58, 0.74, 0.9):
        yield from box(back, angle, (0.03, 0.42, 0.09), plain("wood"), bottom=bottom)
    _, right = ground_axes(angle)
    for side in (-0.19, 0.19):
        post = back + side * right
        yield from box(post, angle, (0.035, 0.035, 0.56), plain("wood"), bottom=0.46)


def _carton(center: FloatArray, angle: float, size: float, bottom: float) -> Iterator[Rectangle]:
    yield from box(
        center, angle, (size, 1.15 * size, 0.8 * size), stretched("carton"), bottom=bottom
    )


def _cartons(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a pile of cartons."""
    yield from _carton(center, 0.2, 0.55, 0.0)
    yield from _carton(center + _at(0.03, 0.02), -0.3, 0.42, 0.44)
    yield from _carton(center + _at(-0.1, -0.65), 0.6, 0.45, 0.0)


def _coffee_table(center: FloatArray, angle: float) -> Iterator[Rectangle]:
    """Yield a low table with magazines and a box on it."""
    yield from _table(center, angle, (0.5, 0.85, 0.4), 0.05)
    for x, turn in ((-0.25, 0.5), (0.02, -0.2)):
        forward, _ = ground_axes(angle + turn)
        start = center + _at(x, -0.12)
        yield slab(start, start + 0.28 * forward, 0.2, 0.403, stretched("page"))
    yield from box(
        center + _at(0.25, 0.05), 0.7, (0.16, 0.22, 0.12), stretched("chart"), bottom=0.4
    )


def _plant(center: FloatArray) -> Iterator[Rectangle]:
    """Yield a plant in a pot, its leaves on crossing cards."""
    yield from box(center, 0.4, (0.28, 0.28, 0.3), plain("cushion"))
    for k in range(3):
        _, across = ground_axes(np.pi * k / 3)
        ends = center - 0.25 * across, center + 0.25 * across
        leaves = replace(stretched("plant"), is_two_sided=True, is_lit=False, gain=0.85 + 0.1 * k)
        yield wall(*ends, (0.2, 1.1), leaves)
