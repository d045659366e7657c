"""A world that can be rendered, and the five worlds that gvo comes with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol, TypeAlias

from gvo.geometry.camera import PinholeCamera
from gvo.io.synthetic.rendering import SampleArray, StillScene
from gvo.io.synthetic.scene import Scene
from gvo.io.synthetic.worlds import motion, room, street
from gvo.types import DepthArray, FloatArray

WorldName: TypeAlias = Literal["driving", "handheld", "turning", "hovering", "block"]
# Seconds since the start, shape (n,), to T_map_cam, shape (n, 4, 4).
Motion: TypeAlias = Callable[[FloatArray], FloatArray]


class Scenery(Protocol):
    """What stands in a world.

    `elapsed_s` is the time since the start in seconds. `T_map_cam` maps camera coordinates to the
    map (metres): shape (4, 4), or (height, 4, 4) with a pose for each row of the image.
    """

    def image(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> SampleArray:
        """Render grey values 0 to 255 without noise, float32, shape (height, width)."""

    def depth(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> DepthArray:
        """Render metres along the optical axis, float32, shape (height, width); NaN: nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """A scene, a motion through it, and the camera that moves.

    Parameters
    ----------
    name : str
        Becomes part of the recording's name.
    scene : callable
        Returns the `Scenery` of a seed.
    motion : callable
        Returns the motion of a seed: a function from seconds since the start, shape (n,), to
        T_map_cam, shape (n, 4, 4), metres.
    camera : PinholeCamera
        The left or colour camera at full scale.
    baseline_m : float
        From the left to the right camera, metres.
    rate_hz : int
        Frames per second.
    max_depth_m : float
        Range of the depth sensor, metres.
    """

    name: str
    scene: Callable[[int], Scenery]
    motion: Callable[[int], Motion]
    camera: PinholeCamera
    baseline_m: float
    rate_hz: int
    max_depth_m: float


by_car = partial(
    World,
    camera=PinholeCamera(
        fx=707.0912, fy=707.0912, cx=601.8873, cy=183.1104, width=1226, height=370
    ),
    baseline_m=0.53715,
    rate_hz=10,
    max_depth_m=80.0,
)
"""A world seen by the cameras of a KITTI car."""

by_hand = partial(
    World,
    camera=PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480),
    baseline_m=0.11,
    rate_hz=30,
    max_depth_m=8.0,
)
"""A world seen by a camera like a Kinect."""


def still(build: Callable[[int], Scene]) -> Callable[[int], Scenery]:
    """Return the scenery of a scene in which nothing moves."""
    return lambda seed: StillScene(build(seed))


def same(move: Motion) -> Callable[[int], Motion]:
    """Return the same motion for all seeds."""
    return lambda _: move


def seeded(move: Callable[[int, FloatArray], FloatArray]) -> Callable[[int], Motion]:
    """Return the motion of each seed."""
    return lambda seed: partial(move, seed)


_ROOM, _STREET, _BLOCK = still(room.room), still(street.street), still(street.block)
WORLDS: dict[str, World] = {
    world.name: world
    for world in (
        by_car(name="driving", scene=_STREET, motion=same(motion.drive)),
        by_hand(name="handheld", scene=_ROOM, motion=same(motion.look_around)),
        by_hand(name="turning", scene=_ROOM, motion=seeded(motion.turn_fast)),
        by_hand(name="hovering", scene=_ROOM, motion=seeded(motion.hover)),
        by_car(name="block", scene=_BLOCK, motion=seeded(motion.drive_block)),
    )
}
