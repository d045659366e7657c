"""The room with a large mirror that swings, and the room with a wall of one grey."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from gvo.geometry.se3 import exp, make_transform
from gvo.sources.atlas import Texture
from gvo.sources.scene import make_scene
from gvo.sources.stage import Stage
from gvo.sources.worlds import painting as paint
from gvo.sources.worlds.building import box, plain, stretched, wall
from gvo.sources.worlds.motion import look_around
from gvo.sources.worlds.room import LAMP, room_rectangles
from gvo.sources.worlds.room_textures import room_textures
from gvo.types import FloatArray

# The mirror: width and height, and where its middle is; metres.
_MIRROR_M = (1.9, 1.5)
_MIDDLE_M = np.array([0.0, 1.25, 1.3])
_SWING_RAD = np.radians(5.0)
_SWING_S = 4.0
# The time from turning away to being turned to the blank wall, and how long it is looked at.
_AWAY_S = (2.0, 2.0)
_BLANK_S = 2.5


@lru_cache(maxsize=2)
def mirror_room(seed: int) -> Stage:
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
    return Stage(
        scene=make_scene([*still, glass, *frame], textures, LAMP),
        n_still=len(still),
        path=_swing,
        mirror=len(still),
    )


def _swing(elapsed_s: float) -> FloatArray:
    """Return T_map_body of the mirror; it begins to swing gently after a second."""
    t = max(elapsed_s - 1.0, 0.0)
    angle = _SWING_RAD * min(0.5 * t, 1.0) * np.sin(2.0 * np.pi * t / _SWING_S)
    R = exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))[:3, :3]
    return make_transform(R, _MIDDLE_M - [0.0, 0.0, 0.5 * _MIRROR_M[1]])


@lru_cache(maxsize=2)
def blank_room(seed: int) -> Stage:
    """Build the room with a wall of one grey behind the camera, from floor to ceiling."""
    blank: Texture = paint.finish(paint.blank(190), (1.0, 1.0))
    board = wall(np.array([2.0, -1.97]), np.array([-2.0, -1.97]), (0.0, 2.5), stretched("blank"))
    return Stage(
        scene=make_scene([*room_rectangles(), board], room_textures(seed) | {"blank": blank}, LAMP)
    )


def turn_away(stamps_s: FloatArray) -> FloatArray:
    """Return T_map_cam, shape (n, 4, 4), of a hand that turns to the wall behind it, and back.

    Parameters
    ----------
    stamps_s : ndarray of float64, shape (n,)
        Seconds since the start; the wall fills the view from 3.8 s to 7.0 s.
    """
    start, duration = _AWAY_S
    away = _smooth((stamps_s - start) / duration)
    back = _smooth((stamps_s - start - duration - _BLANK_S) / duration)
    zeros = np.zeros_like(stamps_s)
    angles = -np.pi * (away - back)
    yaw = exp(np.stack([zeros, zeros, angles, zeros, zeros, zeros], axis=-1))
    T_map_cam = look_around(stamps_s)
    T_map_cam[:, :3, :3] = yaw[:, :3, :3] @ T_map_cam[:, :3, :3]
    return T_map_cam


def _smooth(share: FloatArray) -> FloatArray:
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))
