"""Recordings that deceive: no frame is called `ok` where the registration is grossly wrong."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain
from typing import Any

import numpy as np
import pytest

from gvo import Config, FrameResult, Odometry, SyntheticRecording, frames
from gvo.geometry import se3
from gvo.types import FloatArray, RgbdFrame, Status, StereoFrame
from tests.make.recordings import Held, hold
from tests.worlds import KINDS
from tests.worlds.deceptive import traffic

pytestmark = pytest.mark.acceptance

TIED = (Status.OK, Status.RESUMED)


@dataclass
class Tracked:
    """What the odometry said of each frame, and the truth."""

    results: list[FrameResult]
    T_world_frame: FloatArray

    def errors_m(self) -> FloatArray:
        estimates = np.array([result.causal.T_world_frame[:3, 3] for result in self.results])
        return np.asarray(np.linalg.norm(estimates - self.T_world_frame[:, :3, 3], axis=1))

    def wrong_steps(self) -> Iterator[int]:
        """Yield frames registered 0.1 m or 0.5 degrees off, and 5 sigma of what was stated."""
        for n in range(1, len(self.results)):
            result, before = self.results[n], self.results[n - 1]
            if result.registration is None:
                continue
            T_true = se3.invert(self.T_world_frame[n - 1]) @ self.T_world_frame[n]
            T_raw = se3.invert(before.raw.T_world_frame) @ result.raw.T_world_frame
            x = se3.log(se3.invert(T_true) @ T_raw)
            is_far = np.linalg.norm(x[3:]) > 0.1 or np.linalg.norm(x[:3]) > np.radians(0.5)
            sigmas = np.sqrt(x @ np.linalg.solve(result.registration.covariance, x))
            if is_far and sigmas > 5.0:
                yield n


@cache
def rendered(
    world: Any, sensor: Any, n_frames: int, scale: float, *, seed: int = 0, speed: float = 1.0
) -> Held:
    """Return a recording whose images are rendered once, with a bus so many times as fast."""
    if world == "traffic":
        world = replace(KINDS[world], scene=partial(traffic, speed=speed))
    else:
        world = KINDS[world]
    return hold(SyntheticRecording(world, sensor, n_frames=n_frames, scale=scale, seed=seed))


def track(held: Held, part: slice = slice(None), *, kind: str = "klt") -> Tracked:
    config = Config.model_validate({"runtime": {"threads": 1}, "frontend": {"kind": kind}})
    odometry = Odometry(held.info.camera, config)
    pairs = list(zip(held.stream(0), held.stream(1), strict=True))[part]
    results = []
    for frame in frames(replace(held, items=[*chain(*pairs)]), config):
        assert isinstance(frame, StereoFrame | RgbdFrame)
        results.append(odometry.track(frame))
    assert held.truth is not None
    return Tracked(results, held.truth.T_world_frame[part])


@pytest.mark.parametrize(
    ("kind", "speed", "seed"),
    [("klt", 0.5, 1), ("descriptor", 2.0, 0)],
)
def test_a_bus_that_fills_the_view_does_not_carry_the_camera_along(
    kind: str, speed: float, seed: int
) -> None:
    tracked = track(rendered("traffic", "stereo", 95, 0.4, seed=seed, speed=speed), kind=kind)
    assert not list(tracked.wrong_steps())
    assert tracked.errors_m().max() < 0.3


def test_a_front_that_repeats_exactly_is_not_followed_by_a_window_off() -> None:
    tracked = track(rendered("facade", "stereo", 45, 0.4))
    assert not list(tracked.wrong_steps())
    travelled = np.linalg.norm(tracked.T_world_frame[-1, :3, 3])
    assert tracked.errors_m()[-1] < 0.03 * travelled


def test_before_a_blank_wall_no_pose_is_called_ok_until_the_room_is_back() -> None:
    tracked = track(rendered("wall", "rgbd", 250, 0.3), slice(80, None))
    assert not list(tracked.wrong_steps())
    blank = tracked.results[36:128]
    assert not any(result.status in TIED for result in blank)
    assert any(result.status is Status.LOST for result in blank)
    spreads = [np.trace(result.causal.covariance[3:, 3:]) for result in blank]
    assert spreads[-1] > 4.0 * spreads[0]
    assert tracked.results[-1].status in TIED


def test_a_swinging_mirror_misleads_by_no_more_than_what_it_shows_moves() -> None:
    tracked = track(rendered("mirror", "stereo", 60, 0.3))
    assert not list(tracked.wrong_steps())
    assert tracked.errors_m().max() < 0.3
