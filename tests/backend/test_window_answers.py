"""What a window answers: poses, covariances, statuses, keyframes; and over changes of its size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, PosePrior, PositionPrior, Rejected, Status
from tests.backend.twins import (
    CONFIG,
    FAULTY,
    POSE_PRIOR,
    assert_complete,
    assert_sound,
    good_edges,
    plain_twin,
    run,
)
from tests.backend.walks import STEP, STEP_NS, edge, go_on, power, shifted, walk

# Who is in the window.


def test_the_window_holds_the_recent_and_the_kept_alone() -> None:
    window = SlidingWindow(WindowConfig(size=3))
    for frame in range(12):
        go_on(window, frame, frame + 1)
        if frame in (2, 4):
            window.keep(frame)
        if frame == 8:
            window.release(2)
        assert list(window.poses()) == sorted(
            {i for i in (2, 4) if i <= frame and not (i == 2 and frame > 8)}
            | set(range(max(frame - 2, 0), frame + 1))
        )
    assert len(window) == 4
    assert (4 in window, 3 in window) == (True, False)


@pytest.mark.parametrize(("interval", "n_poses"), [(2, 5), (10, 11), (300, 301), (301, 5)])
def test_the_window_grows_to_the_interval_of_its_fixes(
    interval: int, n_poses: int, caplog: pytest.LogCaptureFixture
) -> None:
    window = SlidingWindow(WindowConfig(size=5))
    for frame in range(2 * interval + 1):
        edges = [edge(frame - 1, STEP)] if frame else []
        place = PositionPrior(position_world=power(frame)[:3, 3], covariance=np.eye(3))
        fix = place if frame % interval == 0 else None
        assert window.add_pose(frame, frame * STEP_NS, edges, fix).rejected == ()
        assert len(window) <= (5 if frame <= interval else n_poses)
    assert len(window) == n_poses
    warnings = [record.getMessage() for record in caplog.records]
    assert [("301 poses apart" in each) for each in warnings] == [True] * (n_poses < interval)


def test_keyframes_are_told_oldest_first_until_they_are_released() -> None:
    window = walk(WindowConfig(size=2), 3)
    window.keep(2)
    window.keep(1)
    assert window.kept() == [1, 2]
    go_on(window, 3, 8)
    assert list(window.poses()) == [1, 2, 6, 7]
    window.release(1)
    assert window.kept() == [2]
    assert 1 in window  # until the next update
    go_on(window, 8, 9)
    assert list(window.poses()) == [2, 7, 8]


def test_a_window_is_printed_in_one_line() -> None:
    window = SlidingWindow(WindowConfig(size=3))
    assert str(window) == "SlidingWindow(0 poses; so far 0 poses, 0 edges accepted, 0 rejected)"
    for frame in range(5):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)] if frame else [])
    window.keep(3)
    assert isinstance(window.add_edge(4, edge("nobody", STEP)), Rejected)
    assert str(window) == (
        "SlidingWindow(3 poses, newest 4, 1 kept; so far 5 poses, 4 edges accepted, 1 rejected)"
    )


# The first pose.


def test_the_first_pose_is_where_it_is_told_and_the_rest_follows() -> None:
    start = se3.exp(np.array([0.3, -0.2, 0.1, 4.0, 5.0, 6.0]))
    window = SlidingWindow()
    first = window.add_pose(
        "a", 0, [], PosePrior(T_world_frame=start, covariance=1e-10 * np.eye(6))
    )
    np.testing.assert_allclose(first.T_world_frame, start, atol=1e-12)
    assert np.sqrt(np.diag(first.covariance)).max() < 1e-4
    step = se3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 1.0]))
    second = window.add_pose("b", 7, [edge("a", step)], status=Status.RESUMED)
    np.testing.assert_allclose(second.T_world_frame, start @ step, atol=1e-9)
    assert (second.stamp_ns, second.frame_id, second.status) == (7, "b", Status.RESUMED)
    assert [e.status for e in window.finish()] == [Status.OK, Status.RESUMED]


@pytest.mark.parametrize("sigma_m", [1.0, 3e3])
def test_a_first_position_is_believed_but_for_what_is_unknown_of_it(sigma_m: float) -> None:
    # A radian about each axis, and ten kilometres beside what the prior knows.
    place, variances = np.array([400.0, -500.0, 600.0]), sigma_m**2 * np.array([1.0, 4.0, 9.0])
    prior = PositionPrior(position_world=place, covariance=np.diag(variances))
    first = SlidingWindow(WindowConfig(size=5)).add_pose("a", 0, [], prior)
    np.testing.assert_allclose(first.T_world_frame, se3.make_transform(np.eye(3), place), atol=1e-9)
    expected = np.r_[np.ones(3), 1.0 / (1.0 / variances + 1e-8)]
    np.testing.assert_allclose(np.diag(first.covariance), expected, rtol=1e-6)


# Edges.


def test_edges_many_sizes_apart_do_not_break_the_window() -> None:
    # Uncertainty of coasting beside edges surer by 1e5: Cholesky factors would be indefinite.
    window = SlidingWindow(WindowConfig(size=3))
    for frame in range(60):
        (estimate,) = go_on(window, frame, frame + 1, np.eye(4), 30.0 if frame % 7 == 3 else 1e-4)
        assert np.isfinite(estimate.covariance).all()
    assert len(window.finish()) == 60


def test_arrays_rounded_to_single_precision_are_good_enough() -> None:
    def rounded(edge: Edge) -> Edge:
        return replace(
            edge,
            T_reference_frame=edge.T_reference_frame.astype(np.float32),
            covariance=edge.covariance.astype(np.float32),
        )

    found = run(edges=tuple(rounded(edge) for edge in good_edges()[FAULTY]))
    assert found.causal[FAULTY].rejected == ()
    assert_complete(found)
    for one, other in zip(found.causal, plain_twin().causal, strict=True):
        np.testing.assert_allclose(one.T_world_frame, other.T_world_frame, atol=1e-5)


def test_late_measurements_are_listed_with_the_others() -> None:
    window = walk(WindowConfig(size=9, kernel="none"), 4)
    place = PositionPrior(position_world=power(2)[:3, 3] + 0.3, covariance=0.09 * np.eye(3))
    assert isinstance(window.add_prior(2, place), Estimate)
    assert isinstance(window.add_edge(3, edge(0, power(3))), Estimate)
    ends = [(each.reference_id, each.frame_id) for each in window.graph()]
    assert ends == [(0, 1), (1, 2), (None, 2), (2, 3), (0, 3)]


# A pose without edges.


def straight_window(n: int = 4, config: WindowConfig = CONFIG) -> tuple[SlidingWindow, FloatArray]:
    """Return a window that moved by the same step n - 1 times, and that step."""
    step = se3.exp(np.array([0.02, 0.05, -0.01, 0.1, 0.0, 0.3]))
    return walk(config, n, step, 1e-3), step


def test_a_pose_without_edges_continues_the_last_velocity() -> None:
    for share in (0.5, 1.0, 3.0):
        window, step = straight_window()
        newest = window.pose(3)
        estimate = window.add_pose("x", 3 * STEP_NS + round(share * STEP_NS), [])
        assert estimate.status == Status.COASTING
        assert estimate.rejected == ()
        expected = newest @ se3.exp(share * se3.log(step))
        np.testing.assert_allclose(estimate.T_world_frame, expected, atol=1e-6)
        assert window.counts.n_coasting == 1
        assert [e.status for e in window.finish()][-1] == Status.COASTING


def test_the_covariance_of_coasting_grows_by_the_sigmas_per_second() -> None:
    for seconds in (0.1, 0.5, 2.0):
        window, _ = straight_window()
        before = window.covariance(3)
        estimate = window.add_pose("x", 3 * STEP_NS + round(seconds * 1e9), [])
        turn = np.deg2rad(30.0) * seconds
        shift = 3.0 * seconds
        sigmas = np.r_[np.full(3, turn), np.full(3, shift)]
        Ad = se3.adjoint(se3.invert(window.pose("x")) @ window.pose(3))
        expected = Ad @ before @ Ad.T + np.diag(sigmas**2)
        scale = np.outer(sigmas, sigmas)
        np.testing.assert_allclose(estimate.covariance / scale, expected / scale, atol=1e-3)


def test_a_gap_of_many_poses_loses_none_and_an_edge_across_it_brings_all_back() -> None:
    window, step = straight_window(config=WindowConfig(size=60, kernel="none"))
    last = 3
    for frame in range(4, 44):
        estimate = window.add_pose(frame, frame * STEP_NS, [])
        assert_sound(estimate)
        seconds = 1e-9 * (frame - last) * STEP_NS
        if abs(seconds - 2.0) > 0.15:  # a step more or less is all the same
            is_lost = seconds > 2.0
            assert estimate.status == (Status.LOST if is_lost else Status.COASTING)
    across = step @ step
    back = window.add_pose(44, 44 * STEP_NS, [edge(last, across, 1e-3)])
    assert back.rejected == ()
    assert back.status == Status.RESUMED
    assert window.counts.n_coasting == 40
    np.testing.assert_allclose(back.T_world_frame, window.pose(last) @ across, atol=1e-5)
    assert [e.frame_id for e in window.finish()] == list(range(45))


def test_a_full_prior_alone_is_enough_for_a_pose() -> None:
    window, _ = straight_window()
    place = se3.exp(np.array([0.1, 0.2, 0.3, 5.0, 6.0, 7.0]))
    prior = PosePrior(T_world_frame=place, covariance=1e-4 * np.eye(6))
    estimate = window.add_pose("x", 4 * STEP_NS, [], prior)
    assert (estimate.status, estimate.rejected) == (Status.OK, ())
    np.testing.assert_allclose(estimate.T_world_frame, place, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance, 1e-4 * np.eye(6), atol=1e-6)
    assert [e.frame_id for e in window.finish()] == [0, 1, 2, 3, "x"]


def test_a_position_alone_holds_a_coasting_pose() -> None:
    window, step = straight_window()
    place = (window.pose(3) @ step)[:3, 3] + [0.1, -0.1, 0.05]
    prior = PositionPrior(position_world=place, covariance=1e-6 * np.eye(3))
    estimate = window.add_pose("x", 4 * STEP_NS, [], prior)
    assert estimate.rejected == ()
    np.testing.assert_allclose(estimate.T_world_frame[:3, 3], place, atol=1e-3)
    assert np.diag(estimate.covariance)[3:].max() < 1.1e-6


def test_a_status_that_is_given_counts_where_a_measurement_ties_the_pose() -> None:
    window = walk(WindowConfig(size=4), 2)
    found = window.add_pose(2, 2 * STEP_NS, [edge(1, STEP)], status=Status.RESUMED)
    assert found.status is Status.RESUMED
    found = window.add_pose(3, 3 * STEP_NS, [], status=Status.RESUMED)
    assert found.status is Status.COASTING
    found = window.add_pose(4, 4 * STEP_NS, [], POSE_PRIOR, status=Status.OK)
    assert found.status is Status.OK
    found = window.add_pose(5, 5 * STEP_NS, [])
    assert found.status is Status.COASTING
    found = window.add_pose(6, 6 * STEP_NS, [edge(5, STEP)])
    assert found.status is Status.RESUMED


# A keyframe outlives what it was measured against.


def two_edges(frame: int) -> list[Edge]:
    return [edge(frame - span, power(span), 0.01) for span in (1, 2) if span <= frame]


def test_a_keyframe_forgets_edges_to_poses_that_left() -> None:
    # A name that left is free again: an edge to the old bearer must not be told of the new one.
    window = SlidingWindow(WindowConfig(size=3, kernel="none"))
    for frame in range(8):
        window.add_pose(frame, frame * STEP_NS, two_edges(frame))
        if frame == 2:
            window.keep(2)
    assert 2 in window
    assert not {0, 1, 3} & set(window.poses())
    for again, frame in zip((0, 1), (8, 9), strict=True):
        window.add_pose(again, frame * STEP_NS, [edge(7 if again == 0 else 0, STEP, 0.01)])
        told = [(each.reference_id, each.frame_id) for each in window.graph()]
        assert (again, 2) not in told
        assert ((7, 0) if again == 0 else (0, 1)) in told
    assert all(each.chi2 < 1.0 for each in window.graph())


def test_a_keyframe_keeps_edges_to_keyframes_only() -> None:
    window = SlidingWindow(WindowConfig(size=2, kernel="none"))
    window.add_pose(0, 0, [])
    window.keep(0)
    window.add_pose(1, STEP_NS, two_edges(1))
    window.keep(1)
    for frame in range(2, 30):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP, 0.01)])
        if frame % 3:
            loop = edge(frame, se3.invert(power(frame - 1)), 0.1)
            assert isinstance(window.add_edge(1, loop), Estimate)
    ends = [(each.reference_id, each.frame_id) for each in window.graph()]
    assert sorted(ends, key=str) == sorted([(0, 1), (28, 1), (29, 1), (28, 29)], key=str)


# Keyframes by distance, as a ruler on the known path tells.


def drive(steps: list[FloatArray], config: WindowConfig) -> list[list[int]]:
    """Return whom the window keeps after each pose of a path of exact steps."""
    window = SlidingWindow(config, keyframes="distance")
    kept = []
    for frame in range(len(steps) + 1):
        go_on(window, frame, frame + 1, steps[frame - 1], 1e-3)
        # What is in the window besides is recent alone.
        recent = range(max(frame + 1 - (config.size or 0), 0), frame + 1)
        assert set(window.poses()) >= {*recent}
        names = window.kept()
        kept.append([name for name in names if isinstance(name, int)])
    return kept


def turn(angle_deg: float) -> FloatArray:
    return se3.exp(np.array([0.0, np.radians(angle_deg), 0.0, 0.0, 0.0, 0.0]))


def config_of(**changes: float) -> WindowConfig:
    values = {
        "size": 3,
        "n_keyframes": 4,
        "keyframe_distance_m": 1.0,
        "keyframe_angle_deg": 10.0,
    }
    return WindowConfig.model_validate(values | changes)


@pytest.mark.parametrize("step", [shifted(z=0.3), turn(3.0)], ids=["distance", "turn"])
def test_the_next_keyframe_is_a_metre_or_ten_degrees_from_the_last(step: FloatArray) -> None:
    # Steps of 0.3 of the distance: each fourth pose is the first beyond it.
    kept = drive([step] * 30, config_of())
    for frame, names in enumerate(kept):
        every = list(range(0, frame + 1, 4))
        # Four at most.
        assert names == every[-4:]
    assert kept[-1] == [16, 20, 24, 28]


def test_a_keyframe_leaves_where_too_little_is_left_in_common() -> None:
    kept = drive([shifted(z=0.3)] * 30, config_of(n_keyframes=100))
    for frame, names in enumerate(kept):
        assert names == [name for name in range(0, frame + 1, 4) if 0.3 * (frame - name) < 8.1]


def test_a_camera_that_comes_back_needs_no_new_keyframe() -> None:
    there, back = [shifted(z=0.6)] * 6, [shifted(z=-0.6)] * 6
    kept = drive([*there, *back], config_of())
    assert kept[6] == [0, 2, 4, 6]
    assert kept[12] == [0, 2, 4, 6]


def test_without_keyframes_nobody_is_kept() -> None:
    assert drive([shifted(z=2.0)] * 5, config_of(n_keyframes=0)) == [[]] * 6


# How far edges agree.


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_the_misfit_of_edges_is_the_variance_of_their_errors_in_what_is_stated(
    n: int, scale: float
) -> None:
    rng, misfits = np.random.default_rng(3), []
    for _ in range(200):
        sigmas = 10.0 ** rng.uniform(-4.0, -2.0, (n, 6))
        noises = scale * sigmas * rng.normal(size=(n, 6))
        window = SlidingWindow()
        window.add_pose(0, 0, [])
        edges = [
            Edge(reference_id=0, T_reference_frame=se3.exp(noise), covariance=np.diag(of_one**2))
            for noise, of_one in zip(noises, sigmas, strict=True)
        ]
        window.add_pose(1, STEP_NS, edges)
        misfits.append(window.misfit)
    assert np.mean(misfits) == pytest.approx(scale**2, rel=0.1)
    window.add_pose(2, 2 * STEP_NS, [edge(1, STEP)])
    assert np.isnan(window.misfit)


def test_edges_are_compared_from_their_references_as_these_were_given_out() -> None:
    window, off = SlidingWindow(), shifted(x=0.02)
    window.add_pose(0, 0, [])
    window.add_pose(1, STEP_NS, [edge(0, STEP @ off)])
    assert window.add_edge(1, edge(0, STEP, 1e-5))
    np.testing.assert_allclose(window.pose(1), STEP, atol=1e-4)
    window.add_pose(2, 2 * STEP_NS, [edge(1, STEP), edge(0, STEP @ STEP)])
    assert window.misfit == pytest.approx(0.5 * (0.02 / 0.01) ** 2 / 6.0, rel=0.01)


# From one start to the next.


@pytest.mark.parametrize(("before", "after"), [(5, None), (None, 5), (3, 6)])
def test_an_empty_window_takes_a_size_as_its_own(before: int | None, after: int | None) -> None:
    window = SlidingWindow(WindowConfig(size=before))
    window.reconfigure(WindowConfig(size=after))
    go_on(window, 0, 12)
    assert len(window) == (12 if after is None else after)
    assert len(window.pop_finished()) == (0 if after is None else 12 - after)
    window.finish()
    assert (window.batch_result is not None) == (after is None)


def test_what_the_last_batch_optimization_gained_is_not_told_of_the_next_run() -> None:
    window = walk(WindowConfig(size=None), 4)
    window.finish()
    assert window.batch_result is not None
    window.reconfigure(WindowConfig(size=3))
    go_on(window, 0, 6)
    assert len(window) == 3
    assert [each.frame_id for each in window.finish()] == list(range(6))
    assert window.batch_result is None
    # And back: a window that slid can keep everything from its next start on.
    go_on(window, 0, 4)
    window.reconfigure(WindowConfig(size=None))
    window.finish()
    assert window.batch_result is None
    go_on(window, 0, 4)
    window.finish()
    assert window.batch_result is not None


def test_a_window_that_finished_knows_nothing_of_the_motion_before() -> None:
    window = walk(WindowConfig(size=4), 4)
    assert window.add_pose("lost", 4 * STEP_NS, []).status is Status.COASTING
    window.finish()
    first = window.add_pose("a", 0, [])
    assert first.status is Status.OK
    np.testing.assert_allclose(first.T_world_frame, np.eye(4), atol=1e-12)
    second = window.add_pose("b", STEP_NS, [])
    assert second.status is Status.COASTING
    np.testing.assert_allclose(second.T_world_frame, np.eye(4), atol=1e-9)
    assert window.newest == "b"


# Another configuration while it runs.


COVARIANCE = np.diag([1e-5, 2e-5, 1e-5, 1e-4, 2e-4, 1e-4])


GAUSSIAN = WindowConfig(kernel="none", gate=None)


def edge_to(reference: int, n_steps: int, rng: np.random.Generator) -> Edge:
    """Return a noisy edge from a frame to one a few steps later, on a bend."""
    step = se3.exp(np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.3]))
    T = np.linalg.matrix_power(step, n_steps) @ se3.exp(0.01 * rng.normal(size=6))
    return Edge(reference_id=reference, T_reference_frame=T, covariance=COVARIANCE)


def edges_of(frame: int, rng: np.random.Generator) -> list[Edge]:
    return [edge_to(frame - n, n, rng) for n in (1, 2) if frame - n >= 0]


def reconfigured(
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
    return np.stack([estimate.T_world_frame for estimate in ordered])


def test_a_smaller_window_lets_poses_leave_with_the_next_update() -> None:
    window, _ = reconfigured(
        {12: GAUSSIAN.model_copy(update={"size": 3})}, WindowConfig(size=10), 12
    )
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
    changed, _ = reconfigured(sizes, wide, 18)
    untouched, _ = reconfigured({}, wide, 18)
    for frame in (15, 16, 17):
        np.testing.assert_allclose(changed.pose(frame), untouched.pose(frame), atol=2e-4)
        expected = untouched.covariance(frame)
        np.testing.assert_allclose(changed.covariance(frame), expected, rtol=0.02, atol=1e-7)


def test_a_window_that_keeps_all_can_begin_to_slide_and_stop_again() -> None:
    whole, sliding = GAUSSIAN.model_copy(update={"size": None}), GAUSSIAN
    window, _ = reconfigured({60: sliding, 80: whole}, whole, 100)
    finished = window.pop_finished()
    assert len(window) > 20  # none left after the second change
    finished += window.finish()
    assert window.batch_result is None
    assert sorted(estimate.frame_id for estimate in finished) == list(range(100))  # type: ignore[type-var]
    reference, _ = reconfigured({}, whole, 100)
    expected = stacked(reference.finish())
    np.testing.assert_allclose(stacked(finished)[-1], expected[-1], atol=0.02)


def test_many_poses_leave_a_few_at_a_time() -> None:
    window, _ = reconfigured({}, GAUSSIAN.model_copy(update={"size": None}), 80)
    window.reconfigure(GAUSSIAN)
    sizes, rng = [], np.random.default_rng(3)
    for frame in range(80, 84):
        window.add_pose(frame, frame * STEP_NS, edges_of(frame, rng))
        sizes.append(len(window))
    assert sizes == [49, 18, 5, 5]


def test_an_edge_keeps_the_kernel_that_it_went_in_with() -> None:
    window, _ = reconfigured({}, WindowConfig(kernel="none", gate=None, size=10), 4)
    rng = np.random.default_rng(5)
    window.reconfigure(WindowConfig(kernel="cauchy", gate=None, size=10))
    window.add_pose(4, 4 * STEP_NS, [edge_to(3, 1, rng), edge_to(2, 2, rng)])
    weights = {(edge.reference_id, edge.frame_id): edge.weight for edge in window.graph()}
    assert all(weight == 1.0 for (_, frame), weight in weights.items() if frame != 4)
    assert weights[3, 4] < 1.0
    assert weights[2, 4] < 1.0


def test_the_gate_is_that_of_the_present() -> None:
    window, _ = reconfigured({}, WindowConfig(gate=None, size=10), 6)
    rng = np.random.default_rng(7)
    wrong = replace(edge_to(3, 3, rng), T_reference_frame=se3.exp(np.full(6, 1.0)))
    good = [edge_to(5, 1, rng), edge_to(4, 2, rng)]
    assert not window.add_pose(6, 6 * STEP_NS, [*good, wrong]).rejected
    window.reconfigure(WindowConfig(gate=10.0, size=10))
    good = [edge_to(6, 1, rng), edge_to(5, 2, rng)]
    wrong = replace(wrong, reference_id=4)
    assert [r.reference_id for r in window.add_pose(7, 7 * STEP_NS, [*good, wrong]).rejected] == [4]


configurations = st.builds(
    WindowConfig,
    size=st.none() | st.integers(2, 30),
    kernel=st.sampled_from(["none", "huber", "cauchy", "geman_mcclure", "dcs"]),
    gate=st.none() | st.floats(0.5, 20.0),
)


@given(
    changes=st.dictionaries(st.integers(0, 39), configurations, max_size=8),
    kept=st.sets(st.integers(0, 39)),
    gaps=st.sets(st.integers(1, 39), max_size=10),
)
@settings(max_examples=15)
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
        np.isfinite(e.T_world_frame).all() and np.isfinite(e.covariance).all() for e in finished
    )


# What edges share.

G = np.arange(12.0).reshape(6, 2) / 100.0


def biased(reference_id: int, T: FloatArray, scale: float = 1.0, sigma: float = 1e-6) -> Edge:
    return replace(edge(reference_id, T, sigma), effects=scale * G)


def test_what_all_edges_share_adds_up_along_a_way_as_it_is() -> None:
    window, T = SlidingWindow(), np.eye(4)
    window.effects_factor = 0.1
    window.add_pose(0, 0, [])
    expected = np.zeros((6, 2))
    for k in range(1, 6):
        given = window.add_pose(k, k * STEP_NS, [biased(k - 1, STEP)])
        expected = se3.adjoint(se3.invert(STEP)) @ expected + G
        np.testing.assert_allclose(given.covariance, 0.01 * expected @ expected.T, atol=1e-9)
    found = window.relative_pose(2, 5).covariance
    T = window.relative_pose(2, 5).T_reference_frame
    start = se3.adjoint(se3.invert(STEP)) @ G + G
    moved = expected - se3.adjoint(se3.invert(T)) @ start
    np.testing.assert_allclose(found, 0.01 * moved @ moved.T, atol=1e-9)
    # Without a measurement a pose moves as the one before, and so does one that keeps in step.
    coasting = window.add_pose(6, 6 * STEP_NS, [])
    assert coasting.status is Status.COASTING
    step = window.relative_pose(5, 6)
    assert np.abs(np.trace(step.covariance)) < 1.0


def test_the_mean_of_edges_is_moved_as_their_mean_and_a_prior_pins_it() -> None:
    window = SlidingWindow()
    window.add_pose(0, 0, [])
    edges = [biased(0, STEP, 1.0, 0.01), biased(0, STEP, 4.0, 0.02)]
    mean = (4.0 * G + 1.0 * 4.0 * G) / 5.0
    stated = window.add_pose(1, STEP_NS, edges).covariance
    noise = 1e-4 * 0.8 * np.eye(6)
    np.testing.assert_allclose(stated, noise + mean @ mean.T, atol=1e-6)
    sure = PosePrior(T_world_frame=STEP, covariance=1e-12 * np.eye(6))
    pinned = window.add_prior(1, sure)
    assert isinstance(pinned, Estimate)
    assert np.abs(pinned.covariance).max() < 1e-9


def test_edges_that_share_nothing_state_what_they_state() -> None:
    plain, other = SlidingWindow(), SlidingWindow()
    other.effects_factor = 5.0
    for window in (plain, other):
        go_on(window, 0, 5)
    np.testing.assert_array_equal(plain.covariance(4), other.covariance(4))
