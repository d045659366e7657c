"""A lap around a block of houses: road, pavements, parked cars, trees, sky.

Everything stands at an arc length and at a distance to the right of the driven line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from gvo.io.synthetic.scene import Light, Rectangle, Scene, make_scene
from gvo.io.synthetic.worlds.building import box, ground_axes, plain, slab, stretched, wall
from gvo.io.synthetic.worlds.motion import (
    LAP_M,
    STRAIGHT_M,
    TURN_BACK_M,
    TURN_M,
    curvature,
    heading,
    road_point,
)
from gvo.io.synthetic.worlds.street_textures import (
    CAR_HEIGHT_M,
    CAR_LENGTH_M,
    CAR_PROFILE,
    HOUSES,
    SHOPS,
    STOREY_M,
    street_textures,
)
from gvo.types import FloatArray

_KERBS = (-7.2, 4.2)  # to the right of the driven line, metres
_PARKING = (-6.2, 3.15)
_HOUSES = (-10.2, 7.6)
_KERB_M = 0.12
_SKY_M = 420.0
DAYLIGHT = Light(direction=(0.5, -0.45, 0.8), ambient=0.82, direct=0.5, haze_m=800.0, haze_grey=205)
# Rows of houses around the block, the first of which is built twice; where nobody may park.
_ROWS = ((-10.0, 75.0), (75.0, 190.0), (275.0, 390.0))
TWIN_M = 0.5 * LAP_M
_FREE = (TURN_BACK_M % LAP_M - 14.0, TURN_BACK_M % LAP_M + 9.0)
_OVERCAST = Light(direction=(0.0, 0.0, 1.0), ambient=0.95, direct=0.15, haze_m=600.0, haze_grey=205)


@lru_cache(maxsize=2)
def street(seed: int) -> Scene:
    """Build the street; the same seed gives the same bytes."""
    return make_scene(street_rectangles(seed), street_textures(seed), DAYLIGHT)


def street_rectangles(seed: int) -> list[Rectangle]:
    """Return all that stands along the street, in the map, with textures of `street_textures`."""
    rectangles = [*_backdrop(), *_road(), *_markings()]
    for side in (0, 1):
        rng = np.random.default_rng([seed, 2, side])
        rectangles += _houses(rng, side)
        rectangles += _parked_cars(rng, side)
        rectangles += _trees_and_posts(rng, side)
    return rectangles


@lru_cache(maxsize=2)
def block(seed: int) -> Scene:
    """Build the street for a drive around the block, with a twin of its first side."""
    return make_scene(block_rectangles(seed), street_textures(seed), _OVERCAST)


def block_rectangles(seed: int) -> list[Rectangle]:
    """Return all that stands around the block, in the map, with textures of `street_textures`."""
    rectangles = [*_backdrop(), *_road(), *_markings()]
    for side in (0, 1):
        for row, (start, end) in enumerate(_ROWS):
            for at in (0.0, TWIN_M) if row == 0 else (0.0,):
                rng = np.random.default_rng([seed, 10, side, row])
                age = np.random.default_rng([seed, 11, side, row, int(at)])
                houses = _houses(rng, side, (start + at, end + at))
                rectangles += (replace(r, gain=r.gain * age.uniform(0.97, 1.03)) for r in houses)
                rectangles += _trees_and_posts(rng, side, (start + at, end + at))
        rectangles += _parked_cars(np.random.default_rng([seed, 12, side]), side, _FREE)
    return rectangles


def _angle(s: float) -> float:
    return float(heading(s))


def _backdrop() -> Iterator[Rectangle]:
    """Yield meadows to the horizon, and four screens of sky around them."""
    center = 0.5 * (road_point(0.0, 0.0) + road_point(0.5 * LAP_M, 0.0))
    end = np.array([0.0, _SKY_M])
    yield slab(center - end, center + end, 2 * _SKY_M, -0.05, plain("grass"))
    sky = replace(plain("sky"), is_lit=False)
    corners = center + _SKY_M * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    for k in range(4):
        yield wall(corners[k], corners[(k + 1) % 4], (-2.0, 298.0), sky)


def _segments() -> Iterator[tuple[float, float]]:
    """Yield where segments of the road start and end: long ones on straights, short in bends."""
    for corner in range(4):
        start = corner * (STRAIGHT_M + TURN_M)
        bend = start + STRAIGHT_M
        yield from pairwise(np.linspace(start, bend, 5).tolist())
        yield from pairwise(np.linspace(bend, bend + TURN_M, 11).tolist())


def _road() -> Iterator[Rectangle]:
    """Yield the surface, kerbs and pavements in straight segments."""
    left, right = _KERBS
    for k, (s, e) in enumerate(_segments()):
        lift = 0.002 * (k % 2)  # neighbours overlap in bends
        middle = 0.5 * (left + right)
        start, end = road_point(s - 0.6, middle), road_point(e + 0.6, middle)
        surface = replace(plain("asphalt"), offset_m=(0.0, -e % 8.0))
        yield slab(start, end, right - left + 1.0, lift, surface)
        yield from _pavement(s, e, left, _KERB_M + lift)
        yield from _pavement(s, e, right, _KERB_M + lift)


def _pavement(s: float, e: float, kerb: float, height: float) -> Iterator[Rectangle]:
    """Yield slabs and kerb stones along a kerb at a distance to the right of the driven line."""
    sign = float(np.sign(kerb))
    walk = kerb + 2.5 * sign
    tile = replace(plain("pavement"), offset_m=(0.0, -e % 4.0))
    yield slab(road_point(s - 0.5, walk), road_point(e + 0.5, walk), 5.0, height, tile)
    ends = road_point(s, kerb), road_point(e, kerb)
    yield wall(*(ends if sign < 0 else ends[::-1]), (0.0, height), plain("kerb"))
    stone = kerb + 0.1 * sign
    yield slab(road_point(s, stone), road_point(e, stone), 0.22, height + 0.004, plain("kerb"))


def _markings() -> Iterator[Rectangle]:
    """Yield dashes along the middle, a line at the parking lane, crossings."""
    height, white = 0.006, replace(plain("paint"), is_lit=False)
    for s in np.arange(0.0, LAP_M, 8.0):
        dash = replace(white, offset_m=(float(s) % 3.7, float(s) % 2.9))
        yield slab(road_point(s, -1.7), road_point(s + 3.5, -1.7), 0.14, height, dash)
    for s in np.arange(0.0, LAP_M, 4.0):
        for right in (2.0, -5.0):
            line = replace(white, offset_m=(float(s) % 3.1, right), gain=0.9)
            yield slab(road_point(s, right), road_point(s + 2.6, right), 0.1, height, line)
    for s in (44.0, 118.0, 146.0, 244.0, 318.0):
        for k in range(10):
            right = _KERBS[0] + 1.1 + 1.1 * k
            bar = replace(white, offset_m=(0.7 * k, 0.3 * k))
            yield slab(road_point(s, right), road_point(s + 3.0, right), 0.55, height + 0.003, bar)


def _houses(
    rng: np.random.Generator, side: int, ends: tuple[float, float] = (0.0, LAP_M)
) -> Iterator[Rectangle]:
    """Yield a row of houses with a gap now and then."""
    sign = 1.0 if side else -1.0
    s, end = ends
    while s < end:
        width = float(rng.choice([9.0, 12.0, 15.0]))
        set_back = _HOUSES[side] + sign * float(rng.uniform(0.0, 1.6))
        # On the inside of a bend the same arc length has less room.
        stretch = max(0.45, 1.0 + float(curvature(s + 0.5 * width)) * set_back)
        if rng.random() < 0.22:
            gap = float(rng.uniform(5.0, 9.0))
            yield from _garden(rng, s + 0.5 * gap / stretch, set_back + 3.0 * sign, gap)
            s += gap / stretch
            continue
        yield from _house(rng, s + 0.5 * width / stretch, set_back, width)
        s += width / stretch


def _house(
    rng: np.random.Generator, s: float, set_back: float, width: float
) -> Iterator[Rectangle]:
    """Yield a house with its front at a distance to the right of the driven line."""
    depth = 10.0
    angle = _angle(s) - 0.5 * np.pi * np.sign(set_back)  # of who enters
    inwards, _ = ground_axes(angle)
    center = road_point(s, set_back) + 0.5 * depth * inwards
    eaves = STOREY_M * int(rng.integers(2, 5))
    tone = float(rng.uniform(0.82, 1.12))
    offset = (3.0 * int(rng.integers(0, 4)), STOREY_M * int(rng.integers(0, 3)))
    style = replace(plain(str(rng.choice(HOUSES))), offset_m=offset, gain=tone)
    front, *_ = box(center, angle, (depth, width, STOREY_M), plain(str(rng.choice(SHOPS))))
    yield replace(front, offset_m=(offset[0], 0.0), gain=tone)
    side = replace(plain("wall"), gain=tone)
    yield from box(center, angle, (depth, width, STOREY_M), side)[1:4:2]
    size = (depth, width, eaves - STOREY_M)
    yield from box(center, angle, size, style, bottom=STOREY_M)[:4]
    yield from _roof(center, angle, (depth, width, eaves), tone)


def _roof(
    center: FloatArray, angle: float, size: tuple[float, float, float], tone: float
) -> Iterator[Rectangle]:
    """Yield the slope over the front, the gables, a cornice and a chimney."""
    depth, width, eaves = size
    rise = 0.45 * depth
    inwards, right = ground_axes(angle)
    corner = center - 0.5 * width * right
    slope = np.append(-(0.5 * depth + 0.4) * inwards, -rise * (1.0 + 0.8 / depth))
    yield replace(
        plain("tiles"),
        corner=np.append(corner, eaves + rise),
        edge_s=np.append(width * right, 0.0),
        edge_t=slope,
        gain=tone,
    )
    gable = replace(stretched("gable"), gain=tone)
    yield from box(center, angle, (depth, width, rise), gable, bottom=eaves)[1:4:2]
    cornice = center - (0.5 * depth + 0.05) * inwards
    yield from box(cornice, angle, (0.3, width, 0.3), plain("kerb"), bottom=eaves - 0.3)[:4]
    chimney = center - 1.2 * inwards + 0.3 * width * right
    yield from box(chimney, angle, (0.7, 0.9, 2.0), plain("wall"), bottom=eaves + rise - 1.6)


def _garden(rng: np.random.Generator, s: float, set_back: float, gap: float) -> Iterator[Rectangle]:
    """Yield the wall that closes a gap between houses, and a tree behind it."""
    angle = _angle(s) - 0.5 * np.pi * np.sign(set_back)
    inwards, _ = ground_axes(angle)
    center = road_point(s, set_back)
    yield from box(center, angle, (0.3, gap + 6.0, 2.0), plain("wall"), top=plain("kerb"))
    yield from _tree(rng, center + 4.0 * inwards, 7.5)


def _tree(rng: np.random.Generator, foot: FloatArray, height: float) -> Iterator[Rectangle]:
    """Yield a trunk, and a crown of crossing cards."""
    width = 0.72 * height
    angle = float(rng.uniform(0.0, np.pi))
    yield from box(foot, angle, (0.26, 0.26, 0.42 * height), plain("bark"))[:4]
    tone = float(rng.uniform(0.8, 1.1))
    for k in range(4):
        _, across = ground_axes(angle + 0.25 * np.pi * k)
        middle = foot + rng.normal(0.0, 0.15, 2)
        ends = middle - 0.5 * width * across, middle + 0.5 * width * across
        crown = replace(stretched("leaves"), is_two_sided=True, is_lit=False)
        yield wall(*ends, (0.3 * height, height), replace(crown, gain=tone * (0.86 + 0.06 * k)))


def _trees_and_posts(
    rng: np.random.Generator, side: int, ends: tuple[float, float] = (0.0, LAP_M)
) -> Iterator[Rectangle]:
    """Yield what stands on the pavement near the kerb."""
    sign = 1.0 if side else -1.0
    s = ends[0] + float(rng.uniform(4.0, 10.0))
    while s < ends[1]:
        foot = road_point(s, _KERBS[side] + sign * float(rng.uniform(0.5, 0.8)))
        if rng.random() < 0.55:
            yield from _tree(rng, foot, float(rng.uniform(5.0, 7.0)))
        else:
            yield from _post(foot, _angle(s))
        s += float(rng.uniform(8.0, 17.0))


def _post(foot: FloatArray, angle: float) -> Iterator[Rectangle]:
    """Yield a lamp post with a traffic sign."""
    forward, right = ground_axes(angle)
    yield from box(foot, angle, (0.14, 0.14, 6.0), plain("metal"))[:4]
    yield from box(foot, angle, (0.5, 0.3, 0.15), plain("metal"), bottom=6.0)
    ends = foot - 0.1 * forward - 0.33 * right, foot - 0.1 * forward + 0.33 * right
    yield wall(*ends, (2.2, 2.86), replace(stretched("sign"), is_lit=False))


def _parked_cars(
    rng: np.random.Generator, side: int, free: tuple[float, float] = (LAP_M, LAP_M)
) -> Iterator[Rectangle]:
    """Yield cars at the kerb, with free places between them, and none between two arc lengths."""
    s = float(rng.uniform(3.0, 8.0))
    while s < LAP_M - 6.0:
        # Whoever parks on the left came the other way.
        angle = _angle(s) + (0.0 if side else np.pi)
        place = road_point(s, _PARKING[side] + float(rng.normal(0.0, 0.1)))
        tone = float(rng.choice([0.45, 0.7, 0.95, 1.25]))
        if not free[0] < s < free[1]:
            yield from _car(place, angle, tone)
        s += float(rng.choice([5.6, 6.2, 9.0, 14.0, 21.0]))


def _car(center: FloatArray, angle: float, tone: float) -> Iterator[Rectangle]:
    """Yield a car: two cut-out sides, and strips over its outline from the rear to the front."""
    width = 1.72
    forward, right = ground_axes(angle)
    rear = center - 0.5 * CAR_LENGTH_M * forward
    front = rear + CAR_LENGTH_M * forward
    aside = 0.5 * width * right
    flank = replace(stretched("car"), gain=tone)
    yield wall(rear + aside, front + aside, (0.0, CAR_HEIGHT_M), flank)
    mirrored = wall(rear - aside, front - aside, (0.0, CAR_HEIGHT_M), flank)
    yield replace(mirrored, is_two_sided=True)
    outline = [(0.0, 0.22), *CAR_PROFILE, (CAR_LENGTH_M, 0.22)]
    names = ["front", "front", "body", "glass", "body", "glass", "body", "front", "front"]
    for name, (x0, z0), (x1, z1) in zip(names, outline[:-1], outline[1:], strict=True):
        strip = stretched(name) if name != "body" else plain(name)
        start, end = np.append(rear + x0 * forward, z0), np.append(rear + x1 * forward, z1)
        yield replace(
            strip,
            corner=end - np.append(aside, 0.0),
            edge_s=np.append(2.0 * aside, 0.0),
            edge_t=start - end,
            gain=tone if name != "glass" else 1.0,
        )
    shadow = replace(plain("asphalt"), gain=0.42, is_lit=False)
    yield slab(rear - 0.2 * forward, front + 0.2 * forward, width + 0.3, 0.012, shadow)
