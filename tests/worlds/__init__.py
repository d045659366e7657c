"""Worlds that deceive, for tests and benchmarks.

`traffic`: the car halts, and a bus fills two thirds of the image from 3 to 10 s. `facade`: sideways
along a house whose windows repeat exactly, by more than half a window per frame. `mirror`: the room
with a large mirror that swings; stereo sees the virtual room behind the glass, the depth of an
RGB-D camera is that of the glass. `wall`: the hand turns to a wall of one grey, which fills the
image from 3.8 to 7.0 s, and turns back. `rooms`: the hand walks through three rooms furnished
alike, along the corridor between them, in 36 s.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording, World
from gvo.io.synthetic.world import WORLDS, by_car, by_hand, same, seeded, still
from gvo.io.synthetic.worlds import motion
from tests.worlds import deceptive

_MIRROR = partial(by_hand, name="mirror", motion=same(motion.look_around))
_DUSTY_MIRROR = _MIRROR(scene=partial(deceptive.mirror_room, is_dusty=True))
KINDS: dict[str, World] = WORLDS | {
    world.name: world
    for world in (
        by_car(name="traffic", scene=deceptive.traffic, motion=same(deceptive.traffic_drive)),
        by_car(name="facade", scene=still(deceptive.facade), motion=same(deceptive.ride)),
        _MIRROR(scene=partial(deceptive.mirror_room, is_dusty=False)),
        by_hand(name="wall", scene=still(deceptive.blank_room), motion=same(deceptive.turn_away)),
        by_hand(name="rooms", scene=still(deceptive.rooms), motion=seeded(deceptive.walk)),
    )
}
"""All ten worlds by name; the mirror as a stereo camera sees it."""


def rendered(kind: str, sensor: Sensor = "stereo", **options: Any) -> SyntheticRecording:
    """Return a recording of any of the ten worlds."""
    world = _DUSTY_MIRROR if (kind, sensor) == ("mirror", "rgbd") else KINDS[kind]
    return SyntheticRecording(world, sensor, **options)
