"""The graph of a run, by its own truth: simulated drives whose poses are known."""

import logging
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.batch import BatchOptimizer, WholeGraph
from gvo.backend.factors import ORIGIN
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.odometry.graph import RunGraph
from gvo.types import Edge, FloatArray, Optimum, PosePrior, Status
from tests.make.results import estimate_at
from tests.odometry.drives import (
    PERIOD_NS,
    SIGMAS,
    Bias,
    Drive,
    block,
    go_round,
    measured,
    poses,
    position_error,
)

N_LAP = 100


def looped(
    seed: int | None,
    *,
    n_loops: int = 5,
    n_laps: float = 1.3,
    bias: Bias = None,
    told: Bias = None,
    n_links: int = 2,
    max_frames: int = 3000,
) -> Drive:
    """Return a drive around the block and a bit more, with loops where it came back."""
    rng = None if seed is None else np.random.default_rng(seed)
    truth = block(n_laps, n_per_lap=N_LAP)
    drive = Drive(truth, rng, bias=bias, told=told, n_links=n_links, max_frames=max_frames).run()
    drive.graph.loops = [drive.loop(5 * k, N_LAP + 5 * k) for k in range(n_loops)]
    return drive


def nees(optimum: Optimum, truth: FloatArray) -> FloatArray:
    """Return the normalized squared error of each pose but the first."""
    errors = se3.log(se3.invert(truth) @ poses(optimum))
    covariances = np.array([each.covariance for each in optimum.estimates])
    return se3.mahalanobis(errors[1:], covariances[1:])


def whole(drive: Drive) -> BatchOptimizer:
    """Return the optimum of all frames at once."""
    graph = WholeGraph()
    for j, T in enumerate(drive.truth):
        prior = PosePrior(T_world_frame=T, covariance=ORIGIN.covariance) if j == 0 else None
        graph.add_pose(j * PERIOD_NS, j * PERIOD_NS, prior)
    for j, edges in enumerate(drive.edges):
        graph.add_edges(j * PERIOD_NS, edges)
    for loop in drive.graph.loops:
        graph.add_edges(loop.stamp_ns, [loop.edge])
    optimizer = BatchOptimizer(graph)
    optimizer.run()
    return optimizer


def test_exact_edges_give_the_true_poses() -> None:
    drive = looped(None)
    optimum = drive.graph.optimize()
    assert not any(loop.reason for loop in optimum.loops)
    np.testing.assert_allclose(poses(optimum), drive.truth, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("n_links", "max_frames", "most"), [(2, 3000, 1e-3), (0, 30, 0.1), (2, 30, 0.5)]
)
def test_the_optimum_is_that_of_all_edges(n_links: int, max_frames: int, most: float) -> None:
    drive = looped(3, n_links=n_links, n_laps=2.2, max_frames=max_frames)
    assert (len(drive.graph) < len(drive.truth)) == (max_frames == 30)
    optimizer = whole(drive)
    differences = se3.log(se3.invert(optimizer.poses()) @ poses(drive.graph.optimize()))
    sigmas = np.sqrt(se3.mahalanobis(differences[1:], optimizer.covariances()[1:]) / 6.0)
    assert np.median(sigmas) < most


def test_the_covariances_tell_the_errors() -> None:
    found = []
    for seed in range(6):
        drive = looped(seed)
        found.append(nees(drive.graph.optimize(), drive.truth).mean())
    assert 3.5 < np.mean(found) < 7.0


@pytest.mark.parametrize("max_frames", [3000, 30])
def test_the_covariances_tell_the_errors_that_all_edges_share(max_frames: int) -> None:
    sizes, found = np.array([0.003, 0.0003]), []
    for seed in range(12):
        bias = tuple(np.random.default_rng(seed).normal(size=2) * sizes)
        drive = looped(seed, bias=bias, told=tuple(sizes), max_frames=max_frames)
        optimum = drive.graph.optimize()
        assert not any(loop.reason for loop in optimum.loops)
        found.append(nees(optimum, drive.truth).mean())
    assert 3.0 < np.mean(found) < 9.0


@settings(max_examples=4)
@given(
    twist=st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6), order=st.permutations(range(5))
)
def test_the_world_and_the_order_of_loops_are_free(twist: list[float], order: list[int]) -> None:
    T = se3.exp(np.array(twist))
    drive, moved = looped(1), RunGraph()
    for j, edges in enumerate(drive.edges):
        T_world_frame = T @ drive.truth[j]
        moved.add_frame(estimate_at(j * PERIOD_NS, T_world_frame), edges, is_place=j % 5 == 0)
    moved.loops = [drive.graph.loops[k] for k in order]
    expected = T @ poses(drive.graph.optimize())
    np.testing.assert_allclose(poses(moved.optimize()), expected, atol=1e-6)


def test_frames_between_keyframes_lie_between_both_ends() -> None:
    # Steps of 1 m along x are 10 % short: a loop stretches them.
    graph = RunGraph()
    step = se3.make_transform(np.eye(3), np.array([0.9, 0.0, 0.0]))
    T, edges = np.eye(4), list[Edge]()
    for j in range(21):
        graph.add_frame(estimate_at(j * PERIOD_NS, T), edges, is_place=j % 5 == 0)
        T = T @ step
        covariance = np.diag(np.full(6, 0.3) ** 2)
        edges = [Edge(reference_id=j * PERIOD_NS, T_reference_frame=step, covariance=covariance)]
    whole_way = se3.make_transform(np.eye(3), np.array([20.0, 0.0, 0.0]))
    graph.loops = [Drive(np.array([np.eye(4)] * 21)).loop(0, 20, T=whole_way)]
    x = poses(graph.optimize())[:, 0, 3]
    np.testing.assert_allclose(np.diff(x), 1.0, atol=0.01)


def test_frames_after_a_loss_go_with_what_comes_after_it() -> None:
    truth = np.array([se3.exp(np.array([0, 0.01 * j, 0, 0, 0, 0.05 * j])) for j in range(66)])
    graph, drive = RunGraph(), Drive(truth)
    for j in range(66):
        # After five seconds in the dark the camera is somewhere else than the guess says.
        status, edges = Status.OK, []
        if 8 <= j <= 58:
            status = Status.LOST
        elif j > 0:
            edges = [measured(truth, j - 1, j, SIGMAS, None)]
        T = truth[j] if j < 8 else truth[j] @ se3.exp(np.array([0, 0.5, 0, 3.0, 0, 0]))
        estimate = estimate_at(j * PERIOD_NS, T, status=status)
        graph.add_frame(estimate, edges, is_place=j % 5 == 0)
    graph.loops = [drive.loop(0, 65)]
    optimum = graph.optimize()
    seen = [*range(8), *range(58, 66)]
    np.testing.assert_allclose(poses(optimum)[seen], truth[seen], atol=1e-3)
    assert max(float(np.trace(optimum.estimates[j].covariance)) for j in seen) < 0.1


def test_covariances_are_proper_through_ten_seconds_in_the_dark() -> None:
    truth = np.array([se3.exp(np.array([0, 0, 0, 0, 0, 1.0 * j])) for j in range(120)])
    graph = RunGraph()
    for j, T in enumerate(truth):
        is_dark = 10 <= j <= 110
        edges = [] if is_dark or j == 0 else [measured(truth, j - 1, j, SIGMAS, None)]
        status = Status.LOST if is_dark else Status.OK
        graph.add_frame(estimate_at(j * PERIOD_NS, T, status=status), edges, is_place=False)
    graph.loops = [Drive(truth).loop(0, 9)]
    covariances = np.array([each.covariance for each in graph.optimize().estimates[1:]])
    assert np.linalg.eigvalsh(covariances).min() > 0.0
    # The guess between both ends is a guess still.
    assert np.sqrt(np.linalg.eigvalsh(covariances[50]).max()) > 10.0


def test_an_optimum_on_the_way_changes_nothing_that_comes_later() -> None:
    asked, other = (Drive(block(1.3, n_per_lap=N_LAP), np.random.default_rng(2)) for _ in range(2))
    for j in range(len(asked.truth)):
        asked.step(j)
        other.step(j)
        if j % 7 == 3:
            assert len(asked.graph.optimize().estimates) == j + 1
    expected, found = other.graph.optimize(), asked.graph.optimize()
    np.testing.assert_array_equal(poses(found), poses(expected))
    np.testing.assert_array_equal(poses(asked.graph.optimize()), poses(expected))


@pytest.mark.parametrize("is_consistent", [False, True])
def test_ten_false_loops_among_ten_true_ones_are_refused(is_consistent: bool) -> None:
    rng = np.random.default_rng(5)
    drive = looped(5, n_loops=10, n_laps=1.6)
    true = list(drive.graph.loops)
    expected = position_error(poses(drive.graph.optimize()), drive.truth)
    twin = se3.exp(np.array([0.0, 0.01, 0.0, 0.1, 0.0, 0.3]))
    false = [
        drive.loop(20 + 5 * k, 70 + 5 * k, T=twin)  # as on a street that looks alike
        if is_consistent
        else drive.loop(5 * k, 55 + 5 * k, T=se3.exp(rng.normal(size=6) * [1, 1, 1, 9, 9, 9]))
        for k in range(10)
    ]
    drive.graph.loops = [*false, *true]
    optimum = drive.graph.optimize()
    assert [bool(loop.reason) for loop in optimum.loops] == [True] * 10 + [False] * 10
    assert position_error(poses(optimum), drive.truth) < 1.05 * expected


def test_loops_count_where_odometry_drifts_more_than_it_says() -> None:
    drive = looped(1, bias=(0.01, 0.001))
    loops, drive.graph.loops = drive.graph.loops, ()
    before = position_error(poses(drive.graph.optimize()), drive.truth)
    drive.graph.loops = loops
    optimum = drive.graph.optimize()
    assert not any(loop.reason for loop in optimum.loops)
    assert position_error(poses(optimum), drive.truth) < before / 3.0
    # and the covariances say so
    assert np.mean(nees(optimum, drive.truth)) < 20.0


def test_frames_that_nothing_connects_with_the_others_are_somewhere() -> None:
    drive, graph = looped(1, n_links=0), RunGraph()
    for j, edges in enumerate(drive.edges):
        if j in (40, 42):  # 41 is measured from 40 alone, and 42 from 39
            edges = [measured(drive.truth, 39, 42, SIGMAS, drive.rng)] if j == 42 else []
        estimate = estimate_at(j * PERIOD_NS, drive.truth[j], frame_id=j * PERIOD_NS)
        graph.add_frame(estimate, edges, is_place=j % 5 == 0)
    graph.loops = drive.graph.loops
    optimum = graph.optimize()
    assert not any(loop.reason for loop in optimum.loops)
    sigmas_m = np.array([np.sqrt(np.trace(e.covariance[3:, 3:])) for e in optimum.estimates])
    assert sigmas_m[40:42].min() > 2.0 * np.delete(sigmas_m, [40, 41]).max()
    others = np.delete(np.arange(len(drive.truth)), [40, 41])
    assert position_error(poses(optimum)[others], drive.truth[others]) < 0.2


def test_covariances_as_stated_are_left_where_loops_agree_with_them() -> None:
    drive = looped(1, n_links=0)
    covariances = np.array([each.covariance for each in drive.graph.optimize().estimates])
    expected = whole(drive).covariances()[-1]
    np.testing.assert_allclose(np.diag(covariances[-1]), np.diag(expected), rtol=0.05)


def test_the_newest_pose_is_corrected_while_the_run_goes() -> None:
    drives = [go_round(block(1.35, n_per_lap=N_LAP), N_LAP, bias=(0.0, 0.001)) for _ in range(2)]
    T_map_world, again = (drive.graph.T_map_world for drive in drives)
    np.testing.assert_array_equal(T_map_world, again)
    end = drives[0].truth[-1:]
    causal = position_error(drives[0].T[np.newaxis], end)
    assert position_error((T_map_world @ drives[0].T)[np.newaxis], end) < 0.35 * causal


def test_without_loops_the_poses_are_as_the_window_has_them() -> None:
    drive = go_round(block(0.9, n_per_lap=N_LAP), N_LAP)
    moved = [estimate_at(j * PERIOD_NS, T) for j, T in enumerate(drive.truth)]
    drive.graph.settle(moved)
    optimum = drive.graph.optimize()
    np.testing.assert_array_equal(drive.graph.T_map_world, np.eye(4))
    assert optimum.n_iterations == 0
    for found, before in zip(optimum.estimates, moved, strict=True):
        np.testing.assert_array_equal(found.T_world_frame, before.T_world_frame)
        np.testing.assert_array_equal(found.covariance, before.covariance)


def test_a_failure_on_the_way_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(optimizer: BatchOptimizer) -> None:
        raise SmoothingError("singular")

    monkeypatch.setattr(BatchOptimizer, "run", fail)
    with caplog.at_level(logging.WARNING):
        drive = go_round(block(1.6, n_per_lap=N_LAP), N_LAP)
    assert "not corrected while the run goes: singular" in caplog.text
    np.testing.assert_array_equal(drive.graph.T_map_world, np.eye(4))


def test_an_edge_beyond_all_bounds_is_an_error() -> None:
    drive = looped(0)
    drive.sigmas = 1e9 * SIGMAS
    n = len(drive.truth)
    drive.truth = np.append(drive.truth, drive.truth[-5:], axis=0)
    for j in range(n, n + 5):
        drive.step(j)
    with pytest.raises(SmoothingError, match=r"a frame has no valid edge: .* its sigma"):
        drive.graph.optimize()


def test_rotations_that_are_not_quite_orthonormal_add_up_to_no_invalid_edge() -> None:
    drive, graph = looped(0), RunGraph()
    for j, edges in enumerate(drive.edges):
        scale = np.diag([1.0 + 2e-7, 1.0 + 2e-7, 1.0 + 2e-7, 1.0])
        scaled = [replace(e, T_reference_frame=e.T_reference_frame @ scale) for e in edges]
        T_world_frame = drive.truth[j]
        graph.add_frame(estimate_at(j * PERIOD_NS, T_world_frame), scaled, is_place=j % 20 == 0)
    graph.loops = drive.graph.loops
    assert position_error(poses(graph.optimize()), drive.truth) < 0.2


def test_one_invalid_loop_costs_no_poses() -> None:
    drive = looped(0)
    expected = poses(drive.graph.optimize())
    first, *rest = drive.graph.loops
    drive.graph.loops = [replace(first, covariance=1e13 * np.eye(6)), *rest]
    np.testing.assert_allclose(poses(drive.graph.optimize()), expected, atol=0.1)


def test_a_frame_that_is_merged_takes_little_memory() -> None:
    drive = Drive(np.tile(np.eye(4), (1_500, 1, 1)), every=200, n_links=0, max_frames=50)
    sizes = []
    tracemalloc.start()
    try:
        for j in range(len(drive.truth)):
            drive.step(j)
            drive.edges.clear()
            if j in (600, 1_000):  # between these the rows are not doubled
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert (sizes[1] - sizes[0]) / 400 < 300
    assert len(drive.graph) < 120
    assert len(drive.graph.optimize().estimates) == len(drive.truth)


def test_a_graph_that_begins_later_leaves_out_what_was_before() -> None:
    whole, later = Drive(block(0.3, n_per_lap=N_LAP)).run(), RunGraph()
    for j in range(10, 30):
        pose = estimate_at(j * PERIOD_NS, whole.truth[j])
        later.add_frame(pose, whole.edges[j], is_place=j % 5 == 0)
    np.testing.assert_allclose(poses(later.optimize()), whole.truth[10:30], atol=1e-9)


def test_pairs_of_frames_that_nothing_else_connects_are_merged_and_placed() -> None:
    truth = np.array([se3.exp(np.array([0, 0, 0, 0, 0, 0.1 * j])) for j in range(400)])
    graph = RunGraph(max_frames=10)
    for j in range(400):
        edges = [measured(truth, j - 1, j, SIGMAS, None)] if j % 2 or j > 390 else []
        graph.add_frame(estimate_at(j * PERIOD_NS, truth[j]), edges, is_place=j > 390)
    assert len(graph) < 320
    graph.loops = [Drive(truth).loop(392, 399)]
    np.testing.assert_allclose(poses(graph.optimize()), truth, atol=1e-6)
