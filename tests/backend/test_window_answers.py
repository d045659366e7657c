"""What the window answers at its borders: beside its measurements, not by them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import pytest

from gvo.backend.gating import WindowCounter
from gvo.backend.isam2 import PoseGraph
from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PositionPrior, Rejected, Status

STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))
FAR = np.array([[0.0, 0.0, 0.0], [0.0, -1e12, 0.0]])


def edge(reference_id: FrameId, T: FloatArray, sigma: float = 0.01) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def power(n: int) -> FloatArray:
    return se3.normalize(np.linalg.matrix_power(STEP, n))


def walk(config: WindowConfig, n: int) -> SlidingWindow:
    """Return a window that was given n poses, each seen from the one before."""
    window = SlidingWindow(config)
    for frame in range(n):
        edges = [edge(frame - 1, STEP)] if frame else []
        window.add_pose(frame, frame * STEP_NS, edges)
    return window


# A first position.


@pytest.mark.parametrize("sigma_m", [1.0, 3e3])
def test_a_first_position_is_believed_but_for_what_is_unknown_of_it(sigma_m: float) -> None:
    # A radian about each axis, and ten kilometres beside what the prior knows.
    place = np.array([400.0, -500.0, 600.0])
    prior = PositionPrior(position_world=place, covariance=sigma_m**2 * np.eye(3))
    first = SlidingWindow(WindowConfig(size=5)).add_pose("a", 0, [], prior)
    np.testing.assert_allclose(first.T_world_cam, se3.make_transform(np.eye(3), place), atol=1e-9)
    variance = 1.0 / (1.0 / sigma_m**2 + 1e-8)
    np.testing.assert_allclose(np.diag(first.covariance), np.repeat([1.0, variance], 3), rtol=1e-6)


# Names.


@pytest.mark.parametrize(
    "ask",
    [
        lambda window: window.add_edge([1], edge(0, STEP)),
        lambda window: window.add_prior([1], PositionPrior(
            position_world=np.zeros(3), covariance=np.eye(3)
        )),
        lambda window: window.pose({}),
        lambda window: window.keep([1]),
    ],
)  # fmt: skip
def test_a_name_that_cannot_be_one_is_told_as_such(ask: Any) -> None:
    with pytest.raises(ValueError, match="a frame_id must be hashable"):
        ask(walk(WindowConfig(), 2))


# Poses that went to infinity.


@pytest.mark.parametrize("is_moved", [True, False])
def test_others_are_looked_at_where_a_new_pose_moved_them(is_moved: bool) -> None:
    window = walk(WindowConfig(size=9, kernel="none"), 5)
    before = window.poses()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseGraph, "positions", lambda _: FAR)
        patch.setattr(PoseGraph, "iterate", lambda *_, **__: is_moved)
        estimate = window.add_pose(5, 5 * STEP_NS, [edge(4, STEP)])
    np.testing.assert_allclose(estimate.T_world_cam, power(5), atol=1e-6)
    assert (window.counts.n_restored > 0) is is_moved
    assert window.counts.n_edges == (4 if is_moved else 5)
    for frame_id, T in before.items():
        np.testing.assert_allclose(window.pose(frame_id), T, atol=1e-9)


def test_a_whole_graph_is_too_large_to_be_looked_at() -> None:
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseGraph, "positions", lambda _: FAR)
        window.add_pose(5, 5 * STEP_NS, [edge(4, STEP)])
        assert isinstance(window.add_edge(5, edge(0, power(5))), Estimate)
    assert window.counts.n_restored == 0


@pytest.mark.parametrize("value", [1e12, np.nan, np.inf])
def test_an_estimate_that_is_nowhere_is_the_causal_one(value: float) -> None:
    window = walk(WindowConfig(size=5), 4)
    expected = window.estimate(2)
    nowhere = np.eye(4)
    nowhere[1, 3] = value
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseGraph, "pose", lambda *_: nowhere)
        found = window.estimate(2)
        finished = window.finish()
    for each in (found, finished[2]):
        np.testing.assert_allclose(each.T_world_cam, expected.T_world_cam, atol=1e-6)
        assert np.isfinite(each.covariance).all()
        assert each.status is Status.OK


@contextmanager
def failing_updates(*calls: int) -> Iterator[list[int]]:
    """Let updates of ISAM2 fail at these calls."""
    original = gtsam.ISAM2.update
    seen: list[int] = []

    def update(self: Any, *arguments: Any) -> Any:
        seen.append(len(seen))
        if seen[-1] in calls:
            raise RuntimeError("Indeterminant linear system detected\nand more lines")
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, "update", update)
        yield seen


def test_a_late_edge_is_tried_once_more_with_a_hardened_graph_and_no_more() -> None:
    loop = edge(0, power(4))
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    # The update, that of making the hardened graph, and the update again.
    with failing_updates(0, 2) as seen:
        answer = window.add_edge(4, loop)
    assert isinstance(answer, Rejected)
    assert (answer.frame_id, answer.reference_id, answer.stamp_ns) == (4, 0, 4 * STEP_NS)
    assert "GTSAM gave up on the update" in answer.reason
    assert len(seen) == 3
    counts = window.counts
    assert (counts.n_restored, counts.n_rejected, counts.n_gated, counts.n_edges) == (2, 1, 0, 4)
    # Now it is hardened: one try is all.
    with failing_updates(0) as seen:
        assert isinstance(window.add_edge(4, loop), Rejected)
    assert (len(seen), window.counts.n_restored) == (1, 3)
    assert isinstance(window.add_edge(4, loop), Estimate)
    assert [each.frame_id for each in window.finish()] == list(range(5))


def test_a_late_edge_is_refused_where_not_even_the_hardened_graph_can_be_made() -> None:
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    with failing_updates(0, 1) as seen:
        answer = window.add_edge(4, edge(0, power(4)))
    assert isinstance(answer, Rejected)
    assert "GTSAM gave up on the update" in answer.reason
    assert len(seen) == 2
    assert [each.frame_id for each in window.finish()] == list(range(5))


def test_a_sliding_window_tries_a_late_edge_once() -> None:
    window = walk(WindowConfig(size=9, kernel="none"), 5)
    with failing_updates(0) as seen:
        assert isinstance(window.add_edge(4, edge(0, power(4))), Rejected)
    assert (len(seen), window.counts.n_restored) == (1, 1)


def test_late_measurements_are_listed_with_the_others() -> None:
    window = walk(WindowConfig(size=9, kernel="none"), 4)
    place = PositionPrior(position_world=power(2)[:3, 3] + 0.3, covariance=0.09 * np.eye(3))
    assert isinstance(window.add_prior(2, place), Estimate)
    assert isinstance(window.add_edge(3, edge(0, power(3))), Estimate)
    ends = [(each.reference_id, each.frame_id) for each in window.graph()]
    assert ends == [(0, 1), (1, 2), (None, 2), (2, 3), (0, 3)]


# What is counted.


def test_a_refusal_is_gated_only_where_it_is_called_so() -> None:
    counter = WindowCounter()
    first = Rejected(frame_id="a", stamp_ns=7, reason="one", reference_id="b")
    second = Rejected(frame_id="c", stamp_ns=None, reason="two")
    assert (str(first), str(second)) == ("edge 'b' -> 'a' at 7 ns: one", "prior 'c': two")
    counter.add_rejected(first)
    counter.add_rejected(second, is_gated=True)
    counter.add(n_poses=2, n_edges=3)
    counter.add(n_poses=1)
    counts = counter.counts
    assert (counts.n_poses, counts.n_edges, counts.n_rejected, counts.n_gated) == (3, 3, 2, 1)
    assert counts.first_rejected == str(first)
    assert (counts.n_priors, counts.n_coasting, counts.n_restored, counts.n_rebuilt) == (0,) * 4


def test_a_window_is_printed_in_one_line() -> None:
    window = SlidingWindow(WindowConfig(size=3))
    assert str(window) == "SlidingWindow: 0 of 0 poses, 0 edges accepted, 0 rejected"
    for frame in range(5):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)] if frame else [])
    window.keep(3)
    assert isinstance(window.add_edge(4, edge("nobody", STEP)), Rejected)
    assert str(window) == (
        "SlidingWindow: 3 of 5 poses (newest 4, 1 kept), 4 edges accepted, 1 rejected"
    )
