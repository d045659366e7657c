"""Another configuration of the window while it runs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, Status

STEP_NS = 100_000_000
COVARIANCE = np.diag([1e-5, 2e-5, 1e-5, 1e-4, 2e-4, 1e-4])
GAUSSIAN = WindowConfig(kernel="none", gate=None)


def edge_to(reference: int, n_steps: int, rng: np.random.Generator) -> Edge:
    """Return a noisy edge from a frame to one a few steps later, on a bend."""
    step = se3.exp(np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.3]))
    T = np.linalg.matrix_power(step, n_steps) @ se3.exp(0.01 * rng.normal(size=6))
    return Edge(reference_id=reference, T_reference_frame=T, covariance=COVARIANCE)


def edges_of(frame: int, rng: np.random.Generator) -> list[Edge]:
    return [edge_to(frame - n, n, rng) for n in (1, 2) if frame - n >= 0]


def run(
    changes: dict[int, WindowConfig], start: WindowConfig, n: int
) -> tuple[SlidingWindow, list[Estimate]]:
    """Add n poses; before some of them the configuration changes."""
    rng = np.random.default_rng(0)
    window = SlidingWindow(start)
    causal = []
    for frame in range(n):
        if frame in changes:
            window.reconfigure(changes[frame])
        edges = [edge for edge in edges_of(frame, rng) if edge.reference_id in window]
        causal.append(window.add_pose(frame, frame * STEP_NS, edges))
    return window, causal


def stacked(estimates: list[Estimate]) -> FloatArray:
    ordered = sorted(estimates, key=lambda estimate: estimate.stamp_ns)
    return np.stack([estimate.T_world_cam for estimate in ordered])


def test_a_smaller_window_lets_poses_leave_with_the_next_update() -> None:
    window, _ = run({12: GAUSSIAN.model_copy(update={"size": 3})}, WindowConfig(size=10), 12)
    window.pop_finished()
    window.reconfigure(WindowConfig(size=3))
    assert len(window) == 10
    window.add_pose(12, 12 * STEP_NS, [edge_to(11, 1, np.random.default_rng(1))])
    assert [estimate.frame_id for estimate in window.pop_finished()] == list(range(2, 10))
    assert list(window.poses()) == [10, 11, 12]


def test_a_size_that_changes_leaves_a_gaussian_graph_at_the_same_optimum() -> None:
    """Each edge is there with either size, so marginals and whole graph must agree."""
    wide = GAUSSIAN.model_copy(update={"size": 20})
    sizes = {8: wide.model_copy(update={"size": 4}), 11: wide.model_copy(update={"size": 15})}
    changed, _ = run(sizes, wide, 18)
    untouched, _ = run({}, wide, 18)
    for frame in (15, 16, 17):
        np.testing.assert_allclose(changed.pose(frame), untouched.pose(frame), atol=2e-4)
        expected = untouched.covariance(frame)
        np.testing.assert_allclose(changed.covariance(frame), expected, rtol=0.02, atol=1e-7)


def test_a_window_that_keeps_all_can_begin_to_slide_and_stop_again() -> None:
    whole, sliding = GAUSSIAN.model_copy(update={"size": None}), GAUSSIAN
    window, _ = run({60: sliding, 80: whole}, whole, 100)
    finished = window.pop_finished()
    assert len(window) > 20  # none left after the second change
    finished += window.finish()
    assert window.polish is None
    assert sorted(estimate.frame_id for estimate in finished) == list(range(100))  # type: ignore[type-var]
    reference, _ = run({}, whole, 100)
    expected = stacked(reference.finish())
    np.testing.assert_allclose(stacked(finished)[-1], expected[-1], atol=0.02)


def test_many_poses_leave_a_few_at_a_time() -> None:
    window, _ = run({}, GAUSSIAN.model_copy(update={"size": None}), 80)
    window.reconfigure(GAUSSIAN)
    sizes, rng = [], np.random.default_rng(3)
    for frame in range(80, 84):
        window.add_pose(frame, frame * STEP_NS, edges_of(frame, rng))
        sizes.append(len(window))
    assert sizes == [49, 18, 5, 5]


def test_an_edge_keeps_the_kernel_that_it_went_in_with() -> None:
    window, _ = run({}, WindowConfig(kernel="none", gate=None, size=10), 4)
    rng = np.random.default_rng(5)
    window.reconfigure(WindowConfig(kernel="cauchy", kernel_threshold=0.5, gate=None, size=10))
    window.add_pose(4, 4 * STEP_NS, [edge_to(3, 1, rng), edge_to(2, 2, rng)])
    weights = {(edge.reference_id, edge.frame_id): edge.weight for edge in window.graph()}
    assert all(weight == 1.0 for (_, frame), weight in weights.items() if frame != 4)
    assert weights[3, 4] < 1.0
    assert weights[2, 4] < 1.0


def test_the_gate_is_that_of_the_present() -> None:
    window, _ = run({}, WindowConfig(gate=None, size=10), 6)
    rng = np.random.default_rng(7)
    wrong = replace(edge_to(3, 3, rng), T_reference_frame=se3.exp(np.full(6, 1.0)))
    good = [edge_to(5, 1, rng), edge_to(4, 2, rng)]
    assert not window.add_pose(6, 6 * STEP_NS, [*good, wrong]).rejected
    window.reconfigure(WindowConfig(gate=10.0, size=10))
    good = [edge_to(6, 1, rng), edge_to(5, 2, rng)]
    wrong = replace(wrong, reference_id=4)
    assert [r.reference_id for r in window.add_pose(7, 7 * STEP_NS, [*good, wrong]).rejected] == [4]


def test_coasting_goes_on_over_a_change_and_is_lost_by_the_new_limit() -> None:
    window, _ = run({}, WindowConfig(), 5)
    statuses = []
    for frame in range(5, 11):
        if frame == 8:
            window.reconfigure(WindowConfig(lost_after_s=0.35, coasting_sigma_m_per_s=300.0))
        estimate = window.add_pose(frame, frame * STEP_NS, [])
        statuses.append((estimate.status, estimate.covariance[5, 5] > 100.0))
    assert [status for status, _ in statuses] == [Status.COASTING] * 3 + [Status.LOST] * 3
    assert [is_unsure for _, is_unsure in statuses] == [False] * 3 + [True] * 3


def test_another_type_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be a gvo\.WindowConfig, got dict"):
        SlidingWindow().reconfigure({"size": 3})  # type: ignore[arg-type]


configurations = st.builds(
    WindowConfig,
    size=st.none() | st.integers(2, 30),
    kernel=st.sampled_from(["none", "huber", "cauchy", "geman_mcclure", "dcs"]),
    kernel_threshold=st.none() | st.floats(0.1, 20.0),
    gate=st.none() | st.floats(0.5, 20.0),
    lost_after_s=st.floats(0.1, 5.0),
    coasting_sigma_m_per_s=st.floats(0.01, 100.0),
)


@given(
    changes=st.dictionaries(st.integers(0, 39), configurations, max_size=8),
    kept=st.sets(st.integers(0, 39)),
    gaps=st.sets(st.integers(1, 39), max_size=10),
)
@settings(max_examples=15, deadline=None)
def test_each_pose_is_finished_exactly_once_over_any_changes(
    changes: dict[int, WindowConfig], kept: set[int], gaps: set[int]
) -> None:
    rng = np.random.default_rng(0)
    window = SlidingWindow()
    finished = []
    for frame in range(40):
        if frame in changes:
            window.reconfigure(changes[frame])
        window.add_pose(frame, frame * STEP_NS, [] if frame in gaps else edges_of(frame, rng))
        if frame in kept and frame in window:
            window.keep(frame)
        if frame % 7 == 6:
            for kept_id in window.kept()[:2]:
                window.release(kept_id)
        finished += window.pop_finished()
    finished += window.finish()
    assert sorted(estimate.stamp_ns for estimate in finished) == [n * STEP_NS for n in range(40)]
    assert all(
        np.isfinite(e.T_world_cam).all() and np.isfinite(e.covariance).all() for e in finished
    )
