"""A player that computes nothing, and views of a camera that drives ahead."""

from __future__ import annotations

import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from gvo.config import Config
from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, FrameLink, FrameResult, IntArray
from gvo.viz.view.history import FrameView
from tests.results import estimate_at
from tests.results import result_of as made_up

PERIOD_NS = 100_000_000
CAMERA = PinholeCamera(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0)


def pose_of(index: int) -> FloatArray:
    """A metre ahead per frame."""
    T = np.eye(4)
    T[2, 3] = float(index)
    return T


def stamps_of(n: int) -> IntArray:
    return PERIOD_NS * np.arange(n, dtype=np.int64)


def result_of(index: int) -> FrameResult:
    """What a frame gives: a link to the frame before and a refused one to the first."""
    stamp_ns = PERIOD_NS * index
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 4e-4, 9e-4]) * (index + 1)
    estimate = estimate_at(stamp_ns, pose_of(index), covariance=covariance)
    links = (
        FrameLink(reference_ns=stamp_ns - PERIOD_NS, kind="step", chi2=6.0, is_accepted=True),
        FrameLink(reference_ns=0, kind="keyframe", chi2=None, is_accepted=False),
    )
    return made_up(
        estimate,
        n_keypoints=200,
        n_points=150,
        n_matches=100 + index,
        n_inliers=90 + index,
        n_links=1,
        links=links if index else (),
        keyframes_ns=(0,),
        stage_ms={"extract": 4.0, "window": 1.5},
    )


def frame_view_of(index: int, *, is_faulty: bool = False) -> FrameView:
    """What the page is given of a frame."""
    picture = np.full((120, 160, 3), index, dtype=np.uint8)
    points = np.random.default_rng(index).uniform(1.0, 9.0, (50, 3)).astype(np.float32)
    known = {int(stamp): pose_of(i) for i, stamp in enumerate(stamps_of(index + 1))}
    return FrameView(
        index=index,
        stamp_ns=PERIOD_NS * index,
        result=None if is_faulty else result_of(index),
        reason="truncated image" if is_faulty else "",
        image=picture,
        overlay=picture,
        cloud=(points, np.zeros((50, 3), dtype=np.uint8)),
        T_world_frame=pose_of(index),
        window_poses=known,
        window_covariances={stamp: np.eye(6) * 1e-4 for stamp in known},
    )


def cells(numbers: str) -> dict[str, str]:
    """The numbers as a browser would find them."""
    return dict(re.findall(r'data-gvo="([^"]+)">([^<]*)<', numbers))


class FakeHistory:
    def __init__(self) -> None:
        self.n = 0

    def path(self, name: str) -> tuple[IntArray, FloatArray]:
        stamps_ns, positions = stamps_of(self.n), self._positions()
        paths = {
            "raw": (stamps_ns, positions + np.array([0.1, 0.0, 0.0])),
            "causal": (stamps_ns, positions),
            "smoothed": (stamps_ns[:-1], positions[:-1]),
        }
        return paths[name]

    def loop_lines(self) -> FloatArray:
        return self._positions()[[0, -1]][np.newaxis]

    def accumulated_cloud(self) -> tuple[Any, Any]:
        return self._positions().astype(np.float32), np.zeros((self.n, 3), dtype=np.uint8)

    def _positions(self) -> FloatArray:
        return np.array([pose_of(index)[:3, 3] for index in range(self.n)]).reshape(-1, 3)


def _noted(name: str) -> Callable[..., None]:
    return lambda player, *arguments: player.calls.append((name, *arguments))


class FakePlayer:
    """Writes down what it is asked for."""

    n_frames = 40
    first_index = 0

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.config = Config()
        self.source = SimpleNamespace(info=SimpleNamespace(name="drive", camera=CAMERA))
        self.history = FakeHistory()
        self.frame_view: FrameView | None = None
        self.is_playing = self.is_busy = self.is_finished = False
        self.fault = ""
        self.callbacks: list[Callable[[FrameView], None]] = []

    def show(self, view: FrameView, *, fault: str = "") -> None:
        self.frame_view = view
        self.fault = fault
        self.history.n = view.index + 1
        for callback in self.callbacks:
            callback(view)

    @property
    def index(self) -> int:
        return self.history.n - 1

    @property
    def n_done(self) -> int:
        return self.history.n

    def subscribe(self, callback: Callable[[FrameView], None]) -> Callable[[], None]:
        self.callbacks.append(callback)
        return lambda: self.callbacks.remove(callback)

    def reconfigure(self, config: Config) -> None:
        self.calls.append(("reconfigure",))
        self.config = config

    set_speed, seek = _noted("speed"), _noted("seek")
    play, pause, step, restart = map(_noted, ("play", "pause", "step", "restart"))
