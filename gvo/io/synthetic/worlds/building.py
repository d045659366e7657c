"""Put rectangles together: walls, floors, boxes. Map axes: z up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gvo.io.synthetic.scene import Rectangle
from gvo.types import FloatArray


def plain(texture: str) -> Rectangle:
    """Return a rectangle of a repeated texture, still to be placed."""
    return Rectangle(corner=(0, 0, 0), edge_s=(1, 0, 0), edge_t=(0, 1, 0), texture=texture)


def stretched(texture: str) -> Rectangle:
    """Return a rectangle that one period of a texture covers, still to be placed."""
    return replace(plain(texture), is_stretched=True)


def wall(
    left: FloatArray, right: FloatArray, heights: tuple[float, float], texture: Rectangle
) -> Rectangle:
    """Stand a rectangle on the ground."""
    bottom, top = heights
    along, down = np.append(right - left, 0.0), (0.0, 0.0, bottom - top)
    return replace(texture, corner=np.append(left, top), edge_s=along, edge_t=down)


def slab(
    start: FloatArray, end: FloatArray, width: float, height: float, texture: Rectangle
) -> Rectangle:
    """Lay a rectangle flat, seen from above; `start` to `end` is its middle line."""
    along = end - start
    aside = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    corner = np.append(end - 0.5 * width * aside, height)
    return replace(
        texture, corner=corner, edge_s=np.append(width * aside, 0.0), edge_t=np.append(-along, 0.0)
    )


def ground_axes(angle: float) -> tuple[FloatArray, FloatArray]:
    """Return the directions forward and right, x and y, of a heading; 0 is along y."""
    forward = np.array([-np.sin(angle), np.cos(angle)])
    return forward, np.array([forward[1], -forward[0]])


def box(
    center: FloatArray,
    angle: float,
    size: tuple[float, float, float],
    texture: Rectangle,
    *,
    bottom: float = 0.0,
    top: Rectangle | None = None,
) -> list[Rectangle]:
    """Return four walls and the top of a box; the wall facing backwards comes first."""
    length, width, height = size
    forward, right = ground_axes(angle)
    f, r = 0.5 * length * forward, 0.5 * width * right
    corners = [center - f - r, center - f + r, center + f + r, center + f - r]
    heights = (bottom, bottom + height)
    sides = [wall(corners[k], corners[(k + 1) % 4], heights, texture) for k in range(4)]
    return [*sides, slab(center - f, center + f, width, bottom + height, top or texture)]


def fronted(body: list[Rectangle], texture: str, *, is_lit: bool = True) -> list[Rectangle]:
    """Return a box with a texture stretched over the wall that comes first."""
    front, *others = body
    return [replace(front, texture=texture, is_stretched=True, is_lit=is_lit), *others]
