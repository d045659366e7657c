"""Worlds that deceive: traffic, facade, mirror, blank wall, rooms that look the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from scipy.interpolate import PchipInterpolator

from gvo.geometry.se3 import exp, make_transform
from gvo.io.synthetic import textures as paint
from gvo.io.synthetic.scene import Rectangle, Scene, make_scene
from gvo.io.synthetic.textures import Texture
from gvo.io.synthetic.worlds import motion
from gvo.io.synthetic.worlds.building import box, fronted, plain, slab, stretched, wall
from gvo.io.synthetic.worlds.room import LAMP, room_rectangles, room_textures
from gvo.io.synthetic.worlds.street import DAYLIGHT, street_rectangles
from gvo.io.synthetic.worlds.street_textures import street_textures
from gvo.types import FloatArray
from tests.worlds.moving import MirrorScene, MovingScene

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
PERIOD_M = 2.0
_FRONT_M = 8.0
_ENDS_M = (-60.0, 460.0)
_FACADE_SPEED_M_S = 11.0
_ACCELERATION_M_S2 = 3.0
# The mirror: width and height, and where its middle is; metres.
_MIRROR_M = (1.9, 1.5)
_MIDDLE_M = np.array([0.0, 1.25, 1.3])
_SWING_RAD = np.radians(5.0)
_SWING_S = 4.0
# The time from turning away to being turned to the blank wall, and how long it is looked at.
_AWAY_S = (2.0, 2.0)
_BLANK_S = 2.5
# Rooms along a corridor: how many, their distance, the corridor's axis; door and wall in metres.
_N_ROOMS = 3
_APART_M = 5.0
_AISLE_M = -3.1
_DOOR_M = (1.1, 2.1)
_WALL_M = 0.12
# A walk from one room to the same place in the next: seconds, x, y, heading in degrees.
_WALK = np.array(
    [
        [0.0, 0.0, -0.9, 0.0], [1.5, 0.15, -0.7, 18.0], [3.5, -0.1, -0.8, -22.0],
        [6.0, 0.0, -1.4, -140.0], [7.2, 0.0, -2.1, -170.0], [8.6, 0.35, -2.7, -140.0],
        [9.6, 1.1, -2.8, -125.0], [12.2, 4.3, -2.8, -112.0], [13.3, 4.9, -2.75, -62.0],
        [14.4, 5.0, -2.1, -8.0], [15.2, 5.0, -1.5, 0.0],
    ]
)  # fmt: skip
_WALK_S = 16.0


def traffic_drive(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a car that brakes, stands for 7 s and drives on."""
    t = stamps_s
    left_s = np.maximum(_HALT_S - t, 0.0)
    gone_s = np.maximum(t - _START_S, 0.0)
    s = _HALT_M - 0.5 * _BRAKE_M_S2 * left_s**2
    # Up to its speed, then on with it.
    rising_s = np.minimum(gone_s, _SPEED_M_S / _START_M_S2)
    s = s + 0.5 * _START_M_S2 * rising_s**2 + _SPEED_M_S * (gone_s - rising_s)
    speeds = _BRAKE_M_S2 * left_s + _START_M_S2 * rising_s
    return motion.drive_along(t, s, shake=np.minimum(speeds / _SPEED_M_S, 1.0))


def bus_path(elapsed_s: float, *, speed: float = 1.0) -> FloatArray:
    """Return T_map_body of the bus: it comes from the left, halts at 5.5 s, pulls off at 6.5 s."""
    coming_s = max(5.5 - elapsed_s, 0.0)
    gone_s = max(elapsed_s - 6.5, 0.0)
    x = (-0.5 * 2.6 * coming_s**2 + 0.5 * 1.2 * gone_s**2) * speed
    return np.asarray(make_transform(np.eye(3), np.array([x, _CROSSING_M, 0.0])))


@lru_cache(maxsize=2)
def traffic(seed: int, speed: float = 1.0) -> MovingScene:
    """Build the street with a gap for the crossing, and a bus so many times as fast."""
    still = [*filter(_leaves_way, street_rectangles(seed))]
    textures = street_textures(seed) | {"bus": _bus_side(np.random.default_rng([seed, 4]))}
    return MovingScene(
        scene=make_scene([*still, *_bus()], textures, DAYLIGHT),
        n_still=len(still),
        path=partial(bus_path, speed=speed),
    )


def _leaves_way(rectangle: Rectangle) -> bool:
    """Tell whether the bus does not run into a rectangle, or it is ground or sky."""
    corner, s, t = np.array([rectangle.corner, rectangle.edge_s, rectangle.edge_t], dtype=float)
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


def ride(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a tram that starts and rides at about 11 m/s.

    At 10 Hz it moves by more than half a window from frame to frame: whoever looks for the
    nearest equal window sees it ride backwards.
    """
    t = stamps_s
    rising_s = np.minimum(t, _FACADE_SPEED_M_S / _ACCELERATION_M_S2)
    x = 0.5 * _ACCELERATION_M_S2 * rising_s**2 + _FACADE_SPEED_M_S * (t - rising_s)
    pace = rising_s * _ACCELERATION_M_S2 / _FACADE_SPEED_M_S
    sway = pace * np.stack([0.03 * np.sin(2.1 * t), 0.01 * np.sin(5.3 * t + 1)])
    position = np.column_stack([x, sway[0], motion.CAMERA_HEIGHT_M + sway[1]])
    tilts = [0.004 * np.sin(3.7 * t), 0.006 * np.sin(1.9 * t), 0.004 * np.sin(4.3 * t)]
    return motion.level_and_turned(position, np.column_stack([pace * each for each in tilts]))


@lru_cache(maxsize=2)
def facade(seed: int) -> Scene:
    """Build the house front, the street before it, and what stands there."""
    first, last = _ENDS_M
    ends = np.array([first, 0.0]), np.array([last, 0.0])
    aside = np.array([0.0, 1.0])
    rectangles = [
        wall(ends[0] + _FRONT_M * aside, ends[1] + _FRONT_M * aside, (0.0, 16.0), plain("windows")),
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


@lru_cache(maxsize=2)
def mirror_room(seed: int, is_dusty: bool) -> MirrorScene:
    """Build the room with a standing mirror that swings about its upright axis."""
    still = room_rectangles()
    width, height = _MIRROR_M
    half = 0.5 * width
    glass = wall(np.array([-half, 0.0]), np.array([half, 0.0]), (0.0, height), stretched("black"))
    frame = [
        *box(np.array([0.0, 0.03]), 0.0, (0.04, width + 0.1, 0.06), plain("wood"), bottom=-0.06),
        *box(np.array([0.0, 0.03]), 0.0, (0.04, width + 0.1, 0.06), plain("wood"), bottom=height),
        *box(np.array([-half - 0.03, 0.03]), 0.0, (0.04, 0.06, height), plain("wood")),
        *box(np.array([half + 0.03, 0.03]), 0.0, (0.04, 0.06, height), plain("wood")),
    ]
    textures = room_textures(seed) | {"black": paint.finish(paint.blank(0), (1.0, 1.0))}
    scene = make_scene([*still, glass, *frame], textures, LAMP)
    moving = MovingScene(scene=scene, n_still=len(still), path=_swing)
    return MirrorScene(moving=moving, is_dusty=is_dusty)


def _swing(elapsed_s: float) -> FloatArray:
    """Return T_map_body of the mirror; it begins to swing gently after a second."""
    t = max(elapsed_s - 1.0, 0.0)
    angle = _SWING_RAD * min(0.5 * t, 1.0) * np.sin(2.0 * np.pi * t / _SWING_S)
    R = exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))[:3, :3]
    return make_transform(R, _MIDDLE_M - [0.0, 0.0, 0.5 * _MIRROR_M[1]])


@lru_cache(maxsize=2)
def blank_room(seed: int) -> Scene:
    """Build the room with a wall of one grey behind the camera, from floor to ceiling."""
    blank: Texture = paint.finish(paint.blank(190), (1.0, 1.0))
    board = wall(np.array([2.0, -1.97]), np.array([-2.0, -1.97]), (0.0, 2.5), stretched("blank"))
    return make_scene([*room_rectangles(), board], room_textures(seed) | {"blank": blank}, LAMP)


def turn_away(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a hand that turns to the wall behind it, and back."""
    start, duration = _AWAY_S
    away = _smooth((stamps_s - start) / duration)
    back = _smooth((stamps_s - start - duration - _BLANK_S) / duration)
    zeros = np.zeros_like(stamps_s)
    yaw = motion.turned(np.column_stack([zeros, zeros, -np.pi * (away - back)]))
    T_map_cam = motion.look_around(stamps_s)
    T_map_cam[:, :3, :3] = yaw[:, :3, :3] @ T_map_cam[:, :3, :3]
    return T_map_cam


def _smooth(share: FloatArray) -> FloatArray:
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


@lru_cache(maxsize=2)
def rooms(seed: int) -> Scene:
    """Build three rooms furnished alike, their doors on one corridor."""
    return make_scene(rooms_rectangles(), room_textures(seed), LAMP)


def rooms_rectangles() -> list[Rectangle]:
    """Return all that is in the rooms and the corridor, with textures of `room_textures`."""
    shift = np.array([_APART_M, 0.0, 0.0])
    alike = [*filter(_leaves_door, room_rectangles()), *_front(), *_aisle()]
    rectangles = [
        replace(each, corner=np.asarray(each.corner) + k * shift)
        for k in range(_N_ROOMS)
        for each in alike
    ]
    far = 0.5 * _APART_M + np.array([-_APART_M, (_N_ROOMS - 1) * _APART_M])
    half = -2.0 - _AISLE_M
    for x, aside in ((far[0], half), (far[1], -half)):
        ends = np.array([x, _AISLE_M - aside]), np.array([x, _AISLE_M + aside])
        rectangles.append(wall(*ends, (0.0, 2.5), plain("wallpaper")))
    return rectangles


def _leaves_door(rectangle: Rectangle) -> bool:
    """Tell whether a rectangle of the room is not part of its southern wall."""
    y = np.array([rectangle.corner, rectangle.edge_s, rectangle.edge_t], dtype=np.float64)[:, 1]
    return bool(y[0] + max(y[1], 0.0) + max(y[2], 0.0) > -1.9)


def _front() -> Iterator[Rectangle]:
    """Yield the wall between a room and the corridor, its door and the door's frame."""
    width, height = _DOOR_M
    paper, wood = plain("wallpaper"), plain("wood")
    middle = -2.0 - 0.5 * _WALL_M
    beside = 0.5 * (_APART_M - width)
    for sign in (-1.0, 1.0):
        center = np.array([sign * 0.5 * (width + beside), middle])
        yield from box(center, 0.0, (_WALL_M, beside, 2.5), paper)[:4]
        post = np.array([sign * 0.5 * width, middle])
        yield from box(post, 0.0, (_WALL_M + 0.06, 0.1, height), wood)[:4]
    size = (_WALL_M, width, 2.5 - height)
    yield from box(np.array([0.0, middle]), 0.0, size, paper, bottom=height)[::2]
    corner = (-0.5 * width, -2.0 - _WALL_M, height)
    yield replace(wood, corner=corner, edge_s=(width, 0, 0), edge_t=(0, _WALL_M, 0))
    yield from box(np.array([-0.58, -1.52]), -0.05, (0.95, 0.04, 2.05), wood)


def _aisle() -> Iterator[Rectangle]:
    """Yield the part of the corridor before a room: floor, ceiling, wall, a picture, a carton."""
    half, near, far = 0.5 * _APART_M, -2.0, 2.0 * _AISLE_M + 2.0
    ends = np.array([-half, _AISLE_M]), np.array([half, _AISLE_M])
    yield slab(*ends, near - far, 0.0, plain("planks"))
    edges = (2 * half, 0, 0), (0, near - far, 0)
    yield Rectangle(corner=(-half, far, 2.5), edge_s=edges[0], edge_t=edges[1], texture="plaster")
    south = np.array([half, far]), np.array([-half, far])
    yield wall(*south, (0.0, 2.5), plain("wallpaper"))
    yield wall(*south, (0.0, 0.09), plain("wood"))
    for x, name, width in ((0.3, "landscape", 0.9), (-1.6, "chart", 0.5), (1.9, "abstract", 0.5)):
        center, size = np.array([x, far + 0.015]), (0.03, width, 0.65)
        yield from fronted(box(center, np.pi, size, plain("wood"), bottom=1.2), name)
    yield from box(np.array([-1.7, far + 0.2]), 0.2, (0.3, 0.4, 0.35), stretched("carton"))


def walk(seed: int, stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a camera carried in the hand from room to room.

    It looks around in a room for 4 s, leaves by the door, and is in the next one 16 s later.
    """
    onwards = np.array([_WALK_S, _APART_M, 0.0, 0.0])
    knots = np.vstack([_WALK + k * onwards for k in range(_N_ROOMS)])[
        : 3 - len(_WALK)
    ]  # in the last room it stays
    t = np.minimum(stamps_s, knots[-1, 0])
    x, y, heading = PchipInterpolator(knots[:, 0], knots[:, 1:])(t).T
    rng = np.random.default_rng([seed, 13])
    rates, phases = rng.uniform(1.5, 5.0, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    sway = np.sin(rates * stamps_s[:, np.newaxis] + phases)
    position = np.column_stack([x, y, np.full_like(x, 1.4)]) + 0.012 * sway[:, :3]
    tilt = motion.turned(0.025 * sway[:, 3:] - [0.1, 0.0, 0.0])
    yaw = motion.turned(np.column_stack([np.zeros((len(x), 2)), np.radians(heading)]))
    level = make_transform(yaw[:, :3, :3] @ motion.R_MAP_LEVEL, position)
    return np.asarray(level @ tilt)
