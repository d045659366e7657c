"""What a window answers where GTSAM fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, PosePrior, PositionPrior, Rejected, Status
from tests.backend.twins import (
    FAULTY,
    NEWEST,
    POSE_PRIOR,
    POSITION_PRIOR,
    N,
    Run,
    assert_as_twin,
    assert_complete,
    assert_sound,
    good_edges,
    plain_twin,
    run,
    stamp_of,
    twin_without_edges,
)
from tests.backend.walks import STEP, STEP_NS, edge, failing, go_on, messages, number, power, walk

# The update, and the same again with a graph that is solved by QR; the call in between makes it.
TWICE = [0, 2]


# Faults of GTSAM itself, which validation keeps from it.


def as_transform(row: int, column: int, value: float) -> Callable[[Edge], Edge]:
    def change(edge: Edge) -> Edge:
        T = edge.T_reference_frame.copy()
        T[row, column] = value
        return replace(edge, T_reference_frame=T)

    return change


DEADLY: dict[str, Callable[[Edge], Edge]] = {
    "NaN in the rotation": as_transform(0, 0, np.nan),
    "NaN in the translation": as_transform(0, 3, np.nan),
    "infinity": as_transform(1, 3, np.inf),
    "a covariance of NaN": lambda edge: replace(edge, covariance=np.full((6, 6), np.nan)),
    "a zero covariance": lambda edge: replace(edge, covariance=np.zeros((6, 6))),
}


@pytest.fixture
def unguarded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gvo.backend.window.find_faults", lambda edges: [""] * len(edges))
    monkeypatch.setattr("gvo.backend.window.prior_fault", lambda _: "")


@pytest.mark.usefixtures("unguarded")
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
@pytest.mark.parametrize("fault", DEADLY)
@pytest.mark.parametrize("size", [5, None])
def test_what_kills_the_graph_of_gtsam_is_undone(fault: str, size: int | None) -> None:
    config = WindowConfig(size=size, gate=None)

    def act(window: SlidingWindow) -> None:
        bad = DEADLY[fault](good_edges()[NEWEST][0])
        place = replace(POSE_PRIOR, T_world_frame=bad.T_reference_frame, covariance=bad.covariance)
        for answer in (window.add_edge(NEWEST, bad), window.add_prior(NEWEST, place)):
            assert isinstance(answer, Rejected)
            assert "GTSAM gave up on the update" in answer.reason

    found = run(act, config=config)
    assert_as_twin(found, run(config=config))
    assert (found.window.counts.n_restored, found.window.counts.n_rebuilt) == (2, 0)
    bad = DEADLY[fault](good_edges()[FAULTY][0])
    found = run(edges=[bad], config=config)
    assert [each.reference_id for each in found.causal[FAULTY].rejected] == [bad.reference_id]
    assert_as_twin(found, run(edges=(), config=config))
    assert (found.window.counts.n_restored, found.window.counts.n_rebuilt) == (1, 0)


# Failures at chosen calls.


def run_failing(
    name: str, calls: Sequence[int] | range, error: type[Exception] = RuntimeError
) -> tuple[Run, list[int]]:
    """Drive a window while GTSAM fails at these calls since pose 8."""
    calls_seen: list[list[int]] = []
    with ExitStack() as stack:
        found = run(lambda _: calls_seen.append(stack.enter_context(failing(name, calls, error))))
    return found, [call for call in calls_seen[0] if call in calls]


@pytest.mark.parametrize("error", [RuntimeError, IndexError])
def test_one_failing_update_is_undone_and_its_pose_coasts(
    error: type[Exception], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="gvo"):
        found, failed = run_failing("update", TWICE, error)
    assert failed == TWICE
    assert found.causal[FAULTY].status == Status.COASTING
    assert_as_twin(found, twin_without_edges())
    assert (found.window.counts.n_restored, found.window.counts.n_rebuilt) == (1, 0)
    (line,) = messages(caplog)
    assert repr(FAULTY) in line
    assert "\n" not in line


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(calls=st.sets(st.integers(0, 60), min_size=1))
def test_nothing_is_lost_wherever_updates_fail(calls: set[int]) -> None:
    with failing("update", calls) as seen:
        found = run()
    assert_complete(found)
    if not calls & {*seen}:
        assert_as_twin(found, plain_twin())


@pytest.mark.parametrize("name", ["marginalizeLeaves", "marginalCovariance"])
@pytest.mark.parametrize("n_failures", [1, 2, 3, 10])
def test_nothing_is_lost_when_other_steps_of_gtsam_fail(name: str, n_failures: int) -> None:
    found, failed = run_failing(name, range(n_failures))
    assert failed
    assert_complete(found)
    # The first one takes a graph solved by QR only.
    assert (found.window.counts.n_restored > 0) is (n_failures > 1)


@pytest.mark.parametrize("size", [5, None])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_interrupts_an_update_is_passed_on_and_leaves_the_window_as_it_was(
    error: type[BaseException], size: int | None
) -> None:
    def act(window: SlidingWindow) -> None:
        for _ in range(2):
            with failing("marginalCovariance", error=error), pytest.raises(error):
                window.add_pose(FAULTY, stamp_of(FAULTY), good_edges()[FAULTY])
            with failing("update", error=error), pytest.raises(error):
                window.add_prior(NEWEST, POSITION_PRIOR)

    config = WindowConfig(size=size)
    assert_as_twin(run(act, config=config), run(config=config))


def test_a_batch_optimization_that_fails_leaves_the_estimates_as_they_were(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failed = []

    def give_up(*_: Any) -> None:
        failed.append(True)
        raise RuntimeError("Indeterminant linear system detected\nand more lines")

    window = SlidingWindow(WindowConfig(size=None))
    for frame, frame_edges in enumerate(good_edges()):
        window.add_pose(frame, stamp_of(frame), frame_edges)
    before = window.poses()
    for name in ("optimize", "optimizeSafely", "iterate"):
        monkeypatch.setattr(gtsam.LevenbergMarquardtOptimizer, name, give_up)
    with caplog.at_level(logging.WARNING, logger="gvo"):
        finished = window.finish()
    assert failed
    assert [e.frame_id for e in finished] == list(range(N))
    for estimate in finished:
        assert_sound(estimate)
        np.testing.assert_allclose(
            estimate.T_world_frame, before[number(estimate.frame_id)], atol=1e-9
        )
    assert messages(caplog)


# Poses that diverge.


FAR = np.array([[0.0, 0.0, 0.0], [0.0, -1e12, 0.0]])


def closing_a_turn() -> tuple[SlidingWindow, Edge]:
    """Return a window, and an edge that moves its poses so far that others are looked at."""
    window = walk(WindowConfig(size=9, kernel="none", gate=None), 5, sigma=0.1)
    turn = se3.exp(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    return window, edge(0, se3.normalize(power(4) @ turn), 0.01)


def test_an_edge_that_sends_another_pose_away_is_refused_and_leaves_no_trace() -> None:
    window, loop = closing_a_turn()
    before = window.poses()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.utilities, "extractPose3", lambda _: FAR)
        answer = window.add_edge(4, loop)
    assert isinstance(answer, Rejected)
    assert "diverged to 1e+12 m" in answer.reason
    assert (window.counts.n_restored, window.counts.n_edges) == (1, 4)
    for frame_id, T in window.poses().items():
        np.testing.assert_allclose(T, before[frame_id], atol=1e-9)
    assert isinstance(window.add_edge(4, loop), Estimate)


@pytest.mark.parametrize("value", [1e12, np.nan, np.inf])
def test_an_estimate_that_is_nowhere_is_the_causal_one(value: float) -> None:
    window = walk(WindowConfig(size=5), 4)
    expected = window.estimate(2)
    nowhere = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, value, 0.0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, "calculateEstimatePose3", lambda *_: nowhere)
        found = window.estimate(2)
        finished = window.finish()
    for each in (found, finished[2]):
        np.testing.assert_allclose(each.T_world_frame, expected.T_world_frame, atol=1e-6)
        assert np.isfinite(each.covariance).all()
        assert each.status is Status.OK


# Late measurements.


@pytest.mark.parametrize("size", [None, 9])
@pytest.mark.parametrize(
    "calls",
    [TWICE, [0, 1, 2], [0, 1, 2, 3]],
    ids=["QR fails too", "no graph for QR can be made", "nor one to go back to"],
)
def test_a_late_edge_is_tried_once_more_by_qr_and_no_more(
    size: int | None, calls: list[int]
) -> None:
    loop = edge(0, power(4))
    window = walk(WindowConfig(size=size, kernel="none"), 5)
    with failing("update", calls) as seen:
        answer = window.add_edge(4, loop)
    assert isinstance(answer, Rejected)
    assert (answer.frame_id, answer.reference_id, answer.stamp_ns) == (4, 0, 4 * STEP_NS)
    assert "GTSAM gave up on the update" in answer.reason
    counts = window.counts
    assert (len(seen), counts.n_restored) == (4, 1)
    assert (counts.n_rejected, counts.n_gated, counts.n_edges) == (1, 0, 4)
    with failing("update", [0]):  # now it is solved by QR: one try is all
        assert isinstance(window.add_edge(4, loop), Rejected)
    assert window.counts.n_restored == 2
    assert isinstance(window.add_edge(4, loop), Estimate)
    assert [each.frame_id for each in window.finish()] == list(range(5))


# What is given up.


PLACE = PosePrior(T_world_frame=STEP, covariance=1e-4 * np.eye(6))


def test_an_update_that_fails_takes_all_measurements_of_its_pose_along() -> None:
    window = walk(WindowConfig(size=9), 5)
    place = PositionPrior(position_world=power(5)[:3, 3], covariance=np.eye(3))
    with failing("update", TWICE):
        found = window.add_pose(
            5, 5 * STEP_NS, [edge(4, STEP), edge(3, power(2))], place, status=Status.OK
        )
    assert [each.reference_id for each in found.rejected] == [4, 3, None]
    assert {each.reason for each in found.rejected} == {"GTSAM gave up on the update"}
    assert found.status is Status.COASTING
    np.testing.assert_allclose(found.T_world_frame, power(5), atol=1e-6)
    counts = window.counts
    assert (counts.n_edges, counts.n_priors, counts.n_rejected) == (4, 0, 3)
    assert (counts.n_gated, counts.n_coasting, counts.n_poses) == (0, 1, 6)
    assert (counts.n_restored, counts.n_rebuilt) == (1, 0)
    assert window.edges(5) == ()
    assert [each.frame_id for each in window.graph()] == [1, 2, 3, 4]


def test_where_not_even_a_pose_alone_goes_in_the_window_begins_anew(
    caplog: pytest.LogCaptureFixture,
) -> None:
    window = walk(WindowConfig(size=9), 5)
    before = [window.estimate(frame) for frame in range(5)]
    with caplog.at_level(logging.WARNING, logger="gvo"), failing("update", [0, 2, 4]):
        found = window.add_pose(5, 5 * STEP_NS, [edge(4, STEP)])
    assert len(messages(caplog)) == 2
    assert (window.counts.n_restored, window.counts.n_rebuilt) == (2, 1)
    assert (len(window), window.newest, window.graph()) == (0, None, [])
    np.testing.assert_allclose(found.T_world_frame, power(5), atol=1e-6)  # as the motion leads
    finished = window.pop_finished()
    assert [each.frame_id for each in finished] == list(range(6))
    for one, other in zip(finished, before, strict=False):
        np.testing.assert_allclose(one.T_world_frame, other.T_world_frame, atol=1e-9)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-12)
    # Nothing it could refer to is there any more: the motion goes on, less and less sure.
    again = window.add_pose(6, 6 * STEP_NS, [edge(5, STEP)])
    assert [each.reference_id for each in again.rejected] == [5]
    assert again.covariance[5, 5] > found.covariance[5, 5]
    for each in [again, *go_on(window, 7, 9)]:
        np.testing.assert_allclose(each.T_world_frame, power(number(each.frame_id)), atol=1e-6)
    assert [each.frame_id for each in window.finish()] == [6, 7, 8]


def test_the_first_pose_that_fails_is_the_origin_no_more_but_stays_where_it_is() -> None:
    window = SlidingWindow(WindowConfig(size=9))
    with failing("update", TWICE):
        first = window.add_pose("a", 0, [], PLACE)
    assert [each.reference_id for each in first.rejected] == [None]
    np.testing.assert_allclose(first.T_world_frame, np.eye(4), atol=1e-12)
    assert (window.counts.n_priors, window.counts.n_rejected) == (0, 1)
    assert first.status is Status.OK
    second = window.add_pose("b", STEP_NS, [edge("a", STEP)])
    np.testing.assert_allclose(second.T_world_frame, STEP, atol=1e-9)


def test_a_first_pose_that_gtsam_never_takes_is_handed_over_where_the_world_begins() -> None:
    window = SlidingWindow(WindowConfig(size=5))
    with failing("update"):
        first = window.add_pose("a", 0, [])
        second = window.add_pose("b", STEP_NS, [])
    assert len(window) == 0
    for estimate in (first, second):
        np.testing.assert_array_equal(estimate.T_world_frame, np.eye(4))
    assert np.linalg.eigvalsh(first.covariance)[0] > 0.0
    assert second.covariance[5, 5] > first.covariance[5, 5]
    # The window itself is whole: the next pose that GTSAM takes begins it.
    third = window.add_pose("c", 2 * STEP_NS, [])
    assert list(window.poses()) == ["c"]
    assert [each.frame_id for each in window.finish()] == ["a", "b", "c"]
    assert third.stamp_ns == 2 * STEP_NS


def test_without_a_covariance_the_causal_pose_stands(caplog: pytest.LogCaptureFixture) -> None:
    window = walk(WindowConfig(size=5, kernel="none", gate=None), 4)
    causal = window.add_pose(4, 4 * STEP_NS, [edge(3, STEP), edge("nobody", STEP)])
    assert len(causal.rejected) == 1
    turned = edge(0, se3.normalize(STEP @ STEP @ STEP @ STEP @ STEP), 1e-3)
    assert isinstance(window.add_edge(4, turned), Estimate)
    assert not np.allclose(window.pose(4), causal.T_world_frame, atol=1e-4)
    with caplog.at_level(logging.WARNING, logger="gvo"), failing("marginalCovariance"):
        found = window.estimate(4)
    np.testing.assert_array_equal(found.T_world_frame, causal.T_world_frame)
    np.testing.assert_array_equal(found.covariance, causal.covariance)
    assert (found.frame_id, found.stamp_ns, found.status) == (4, 4 * STEP_NS, causal.status)
    assert found.rejected == ()  # told once, with the pose
    (line,) = messages(caplog)
    assert "4 at 400000000 ns" in line
    assert "\n" not in line


def test_where_the_joint_covariance_is_lost_two_poses_share_nothing() -> None:
    window = walk(WindowConfig(size=6, kernel="none"), 6)
    first, last = (window.estimate(frame) for frame in (2, 5))
    with failing("jointMarginalCovariance"):
        found = window.relative_pose(2, 5)
    H_first, H_last = np.zeros((6, 6), order="F"), np.zeros((6, 6), order="F")
    between = gtsam.Pose3(first.T_world_frame).between(
        gtsam.Pose3(last.T_world_frame), H_first, H_last
    )
    expected = H_first @ first.covariance @ H_first.T + H_last @ last.covariance @ H_last.T
    np.testing.assert_allclose(found.T_reference_frame, between.matrix(), atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-12)
    shared = window.relative_pose(2, 5)
    np.testing.assert_allclose(shared.T_reference_frame, found.T_reference_frame, atol=1e-12)
    assert np.linalg.eigvalsh(found.covariance - shared.covariance)[0] > 0.0
    assert not window.relative_pose(4, 4).covariance.any()


def test_a_whole_window_that_cannot_slide_at_once_goes_on_anyway() -> None:
    window = walk(WindowConfig(size=None), 6)
    before = window.poses()
    window.reconfigure(WindowConfig(size=3))
    for frame_id, T in window.poses().items():
        np.testing.assert_allclose(T, before[frame_id], atol=1e-9)
    with failing("update", [0, 1]):
        go_on(window, 6, 7)
    go_on(window, 7, 12)
    assert len(window) == 3
    finished = window.finish()
    assert [each.frame_id for each in finished] == list(range(12))
    for frame, each in enumerate(finished):
        expected = np.linalg.matrix_power(STEP, frame)
        np.testing.assert_allclose(each.T_world_frame, expected, atol=1e-6)


def test_where_cholesky_gives_up_the_batch_is_solved_by_qr() -> None:
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    place = PositionPrior(position_world=window.pose(4)[:3, 3] + 0.1, covariance=1e-4 * np.eye(3))
    assert isinstance(window.add_prior(4, place), Estimate)
    original: Any = gtsam.LevenbergMarquardtOptimizer
    solvers = []

    class Picky(original):  # type: ignore[misc]
        def __init__(self, factors: Any, values: Any, parameters: Any) -> None:
            super().__init__(factors, values, parameters)
            self.solver = parameters.getLinearSolverType()
            solvers.append(self.solver)

        def iterate(self) -> Any:
            if self.solver == "MULTIFRONTAL_CHOLESKY":
                raise RuntimeError("Indeterminant linear system detected")
            return super().iterate()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam, "LevenbergMarquardtOptimizer", Picky)
        finished = window.finish()
    assert solvers == ["MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR"]
    assert window.batch_result is not None
    assert window.batch_result.error_after < window.batch_result.error_before
    assert window.batch_result.n_iterations > 0
    assert [each.frame_id for each in finished] == list(range(5))
