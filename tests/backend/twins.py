"""A window that meets one fault, beside a twin that never saw it.

A window is driven with good poses, meets one fault, and is driven on. Where nothing of the
fault may stay, every later estimate equals that of the twin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, PosePrior, PositionPrior, Prior
from tests.backend.walks import STEP_NS, number

N = 29  # eight good poses, the one with the fault, twenty good ones


FAULTY = 8  # the window of five holds 3 to 7 when it comes


NEWEST = FAULTY - 1


CONFIG = WindowConfig(size=5)


Act = Callable[[SlidingWindow], object]


def stamp_of(frame: int) -> int:
    return 1_000 + frame * STEP_NS


@cache
def true_poses() -> tuple[FloatArray, ...]:
    rng = np.random.default_rng(5)
    poses = [np.eye(4)]
    for _ in range(N - 1):
        twist = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.3]) + 0.02 * rng.normal(size=6)
        poses.append(poses[-1] @ se3.exp(twist))
    return tuple(poses)


@cache
def good_edges() -> tuple[tuple[Edge, ...], ...]:
    """Return for each pose edges to the three before it."""
    rng = np.random.default_rng(6)
    poses = true_poses()
    edges: list[tuple[Edge, ...]] = []
    for frame in range(N):
        measured = []
        for reference in range(max(frame - 3, 0), frame):
            mixing = np.eye(6) + 0.2 * rng.normal(size=(6, 6))
            covariance = 1e-6 * mixing @ mixing.T
            noise = se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
            T = se3.normalize(np.linalg.inv(poses[reference]) @ poses[frame] @ noise)
            measured.append(
                Edge(reference_id=reference, T_reference_frame=T, covariance=covariance)
            )
        edges.append(tuple(measured))
    return tuple(edges)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A window's whole life: what it answered to the fault and what it gave."""

    answer: object
    causal: list[Estimate]
    finished: list[Estimate]
    window: SlidingWindow


def run(
    act: Act | None = None,
    *,
    edges: Sequence[Edge] | None = None,
    prior: Prior | None = None,
    first_prior: Prior | None = None,
    config: WindowConfig = CONFIG,
) -> Run:
    """Drive a window; before pose 8 it meets `act`, with pose 8 come `edges` and `prior`."""
    window = SlidingWindow(config)
    causal: list[Estimate] = []
    finished: list[Estimate] = []
    answer: object = None
    for frame, frame_edges in enumerate(good_edges()):
        frame_prior = first_prior if frame == 0 else None
        if frame == FAULTY:
            answer = act(window) if act else None
            frame_edges = tuple(frame_edges if edges is None else edges)
            frame_prior = prior
        causal.append(window.add_pose(frame, stamp_of(frame), frame_edges, frame_prior))
        finished += window.pop_finished()
        # Where not even a pose alone goes in, it is handed over at once.
        assert (window.newest == frame) != any(e.frame_id == frame for e in finished)
    return Run(answer=answer, causal=causal, finished=finished + window.finish(), window=window)


@cache
def plain_twin() -> Run:
    return run()


@cache
def twin_without_edges() -> Run:
    return run(edges=())


def assert_sound(estimate: Estimate) -> None:
    assert se3.transform_fault(estimate.T_world_frame, tolerance=1e-6) == ""
    assert se3.covariance_fault(estimate.covariance) == ""


def assert_complete(found: Run, n: int = N) -> None:
    """Check that each pose came out once, sound, under its own stamp."""
    assert sorted(number(e.frame_id) for e in found.finished) == list(range(n))
    for estimate in [*found.causal, *found.finished]:
        assert_sound(estimate)
        assert estimate.stamp_ns == stamp_of(number(estimate.frame_id))


def assert_as_twin(found: Run, twin: Run) -> None:
    assert_complete(found)
    for ours, theirs in ((found.causal, twin.causal), (found.finished, twin.finished)):
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            assert (one.frame_id, one.stamp_ns) == (other.frame_id, other.stamp_ns)
            assert one.status == other.status
            np.testing.assert_allclose(one.T_world_frame, other.T_world_frame, rtol=0, atol=1e-9)
            scale = np.abs(other.covariance).max()
            np.testing.assert_allclose(
                one.covariance / scale, other.covariance / scale, rtol=0, atol=1e-9
            )


# Faults of a measured transform and of a covariance, made of good ones.
Fault = Callable[[FloatArray], FloatArray]


def with_entry(row: int, column: int, value: float) -> Fault:
    def change(matrix: FloatArray) -> FloatArray:
        changed = matrix.copy()
        changed[row, column] = value
        return changed

    return change


POSE_PRIOR = PosePrior(T_world_frame=true_poses()[NEWEST], covariance=1e-4 * np.eye(6))


POSITION_PRIOR = PositionPrior(
    position_world=true_poses()[NEWEST][:3, 3], covariance=1e-4 * np.eye(3)
)
