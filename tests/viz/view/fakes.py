"""A player that computes nothing, and results of a camera that drives ahead."""

import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from gvo.config import Config, DepthConfig
from gvo.geometry.camera import StereoCamera
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    FrameLink,
    FrameResult,
    RelativePose,
    StereoFrame,
)
from gvo.viz.view.newest import Newest
from tests.make.results import estimate_at
from tests.make.results import result_of as made_up

PERIOD_NS = 100_000_000
CAMERA = StereoCamera(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0, baseline=0.1)


def pose_of(index: int) -> FloatArray:
    """A metre ahead per frame."""
    T = np.eye(4)
    T[2, 3] = float(index)
    return T


def result_of(index: int, n_points: int = 50, **changes: Any) -> FrameResult:
    """What a frame gives: a link to the frame before and a refused one to the first."""
    stamp_ns = PERIOD_NS * index
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 4e-4, 9e-4]) * (index + 1)
    estimate = estimate_at(stamp_ns, pose_of(index), covariance=covariance)
    links = (
        FrameLink(reference_ns=stamp_ns - PERIOD_NS, kind="step", chi2=6.0, is_accepted=True),
        FrameLink(reference_ns=0, kind="keyframe", chi2=None, is_accepted=False),
    )
    given = {
        "n_keypoints": 200,
        "n_points": 150,
        "n_matches": 100 + index,
        "n_inliers": 90 + index,
        "n_links": 1,
        "links": links if index else (),
        "keyframes_ns": (0,),
        "stage_ms": {"extract": 4.0, "window": 1.5},
        "registration": registration_of(n_points),
    }
    return made_up(estimate, **given | changes)


def registration_of(n: int) -> RelativePose:
    points = np.random.default_rng(0).uniform(1.0, 9.0, (n, 3))
    return RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        matches=np.zeros((n, 2), dtype=np.int64),
        inliers=np.ones(n, dtype=np.bool_),
        pixels_reference=np.full((n, 2), 7.0),
        pixels_current=np.full((n, 2), 9.0),
        points_current=points,
    )


def frame_of(index: int) -> StereoFrame:
    grey = np.full((CAMERA.height, CAMERA.width), index % 256, dtype=np.uint8)
    return StereoFrame(stamp_ns=PERIOD_NS * index, left=grey, right=grey)


def cells(numbers: str) -> dict[str, str]:
    """The numbers as a browser would find them."""
    return dict(re.findall(r'data-gvo="([^"]+)">([^<]*)<', numbers))


class FakeWindow:
    """Holds the newest poses, half a metre aside of where they came, and counts questions."""

    def __init__(self, n_held: int = 3) -> None:
        self._n_held = n_held
        self.stamps_ns: list[int] = []
        self.n_asked = 0

    def take(self, stamp_ns: int) -> "Any":
        self.stamps_ns = [*self.stamps_ns[1 - self._n_held :], stamp_ns]
        return self

    def __contains__(self, stamp_ns: int) -> bool:
        return stamp_ns in self.stamps_ns

    def estimate(self, stamp_ns: int) -> Estimate:
        self.n_asked += 1
        T = pose_of(stamp_ns // PERIOD_NS)
        T[0, 3] = 0.5
        return Estimate(stamp_ns=stamp_ns, T_world_frame=T, covariance=np.eye(6))


def _noted(name: str) -> Callable[..., None]:
    return lambda player, *arguments: player.calls.append((name, *arguments))


class FakePlayer:
    """Writes down what it is asked for."""

    n_frames = 40

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.config = Config()
        self.source = SimpleNamespace(info=SimpleNamespace(name="drive", camera=CAMERA))
        self.newest = Newest(CAMERA)
        self.window = FakeWindow()
        self.is_playing = self.is_busy = self.is_finished = False
        self.fault = ""

    def show(self, index: int, *, is_faulty: bool = False, **changes: Any) -> None:
        frame: Any = frame_of(index)
        if is_faulty:
            frame = FaultyFrame(stamp_ns=frame.stamp_ns, reason="truncated image")
        result = None if is_faulty else result_of(index, **changes)
        self.newest.add(frame, result, self.window.take(PERIOD_NS * index), DepthConfig())

    def rest_s(self, spent_s: float) -> float:
        return 0.0

    def reconfigure(self, config: Config) -> None:
        self.calls.append(("reconfigure",))
        self.config = config

    set_speed, restart = _noted("speed"), _noted("restart")
    play, pause, step = map(_noted, ("play", "pause", "step"))


def as_player(player: FakePlayer) -> Any:
    return cast(Any, player)
