"""The window against GTSAM's batch optimizer on the same measurements."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import (
    Edge,
    Estimate,
    FloatArray,
    PosePrior,
    PositionPrior,
    Prior,
    Rejected,
    Status,
)
from tests.backend.walks import (
    STEP,
    STEP_NS,
    edge,
    go_on,
    number,
    power,
    seeds,
    shifted,
    values_of,
    walk,
)

KERNELS = ["none", "huber", "cauchy", "geman_mcclure", "dcs"]


THRESHOLDS = {"huber": 3.55, "cauchy": 9.4, "geman_mcclure": 13.6, "dcs": 15.6}


def wander(rng: np.random.Generator, n: int) -> list[FloatArray]:
    """Return n poses on a winding way, the first the identity."""
    poses = [np.eye(4)]
    for _ in range(n - 1):
        twist = np.r_[0.1 * rng.normal(size=3), [0.0, 0.0, 0.3] + 0.1 * rng.normal(size=3)]
        poses.append(se3.normalize(poses[-1] @ se3.exp(twist)))
    return poses


def random_covariance(rng: np.random.Generator, sigma: float, n: int = 6) -> FloatArray:
    sigmas = sigma * rng.uniform(0.5, 2.0, size=n)
    factor = np.eye(n) + 0.2 * rng.normal(size=(n, n))
    return np.asarray((sigmas[:, None] * (factor @ factor.T)) * sigmas)


def measure(
    poses: Sequence[FloatArray], i: int, j: int, rng: np.random.Generator, sigma: float
) -> Edge:
    covariance = random_covariance(rng, sigma)
    noise = se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
    T = se3.normalize(np.linalg.inv(poses[i]) @ poses[j] @ noise)
    return Edge(reference_id=i, T_reference_frame=T, covariance=covariance)


def make_kernel(kernel: str) -> Any:
    makers: dict[str, Any] = {
        "huber": gtsam.noiseModel.mEstimator.Huber,
        "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
        "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
        "dcs": gtsam.noiseModel.mEstimator.DCS,
    }
    return makers[kernel].Create(THRESHOLDS[kernel])


def make_noise(covariance: FloatArray, kernel: str) -> Any:
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if kernel == "none":
        return gaussian
    return gtsam.noiseModel.Robust.Create(make_kernel(kernel), gaussian)


def between_factor(frame: int, edge: Edge, kernel: str) -> Any:
    noise = make_noise(edge.covariance, edge.kernel or kernel)
    measured = gtsam.Pose3(edge.T_reference_frame)
    return gtsam.BetweenFactorPose3(number(edge.reference_id), frame, measured, noise)


def prior_factor(frame: int, prior: Prior) -> Any:
    noise = make_noise(prior.covariance, prior.kernel)
    if isinstance(prior, PosePrior):
        return gtsam.PriorFactorPose3(frame, gtsam.Pose3(prior.T_world_frame), noise)
    return gtsam.GPSFactor(frame, prior.position_world, noise)


def net(
    poses: Sequence[FloatArray], rng: np.random.Generator, sigma: float, *, n_back: int = 1
) -> list[list[Edge]]:
    """Return for each pose edges to the few before it."""
    return [
        [measure(poses, i, frame, rng, sigma) for i in range(max(frame - n_back, 0), frame)]
        for frame in range(len(poses))
    ]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Measurements in the order of their coming."""

    poses: list[FloatArray]
    edges: list[list[Edge]]
    """With each pose."""
    late_edges: dict[int, list[tuple[int, Edge]]] = field(default_factory=dict)
    """By the pose after which they come: frame and edge."""
    priors: dict[int, Prior] = field(default_factory=dict)
    """With their pose."""
    late_priors: dict[int, list[tuple[int, Prior]]] = field(default_factory=dict)
    """By the pose after which they come: frame and prior."""

    def all_edges(self, n: int) -> list[tuple[int, Edge]]:
        found = [(frame, edge) for frame in range(n) for edge in self.edges[frame]]
        return found + [late for after in range(n) for late in self.late_edges.get(after, [])]

    def all_priors(self, n: int) -> list[tuple[int, Prior]]:
        found = [(frame, prior) for frame, prior in self.priors.items() if frame < n]
        return found + [late for after in range(n) for late in self.late_priors.get(after, [])]


def feed(window: SlidingWindow, problem: Problem) -> list[Estimate]:
    causal = []
    for frame, frame_edges in enumerate(problem.edges):
        stamp = frame * STEP_NS
        estimate = window.add_pose(frame, stamp, frame_edges, problem.priors.get(frame))
        assert estimate.rejected == ()
        for late_frame, late in problem.late_edges.get(frame, []):
            answer: object = window.add_edge(late_frame, late)
            assert isinstance(answer, Estimate), answer
        for late_frame, prior in problem.late_priors.get(frame, []):
            answer = window.add_prior(late_frame, prior)
            assert isinstance(answer, Estimate), answer
        causal.append(estimate)
    return causal


def build(
    problem: Problem, kernel: str = "none", n: int | None = None
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of the first n poses in GTSAM's own words."""
    n = len(problem.poses) if n is None else n
    graph = gtsam.NonlinearFactorGraph()
    if not isinstance(problem.priors.get(0), PosePrior):
        sigmas = np.full(6, 1e-5)
        if isinstance(problem.priors.get(0), PositionPrior):
            sigmas = np.r_[np.ones(3), np.full(3, 1e6)]
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    for frame, each in problem.all_edges(n):
        graph.add(between_factor(frame, each, kernel))
    for frame, prior in problem.all_priors(n):
        graph.add(prior_factor(frame, prior))
    return graph


def optimise(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    parameters.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def batch(
    problem: Problem, kernel: str = "none", n: int | None = None
) -> tuple[gtsam.Values, gtsam.Marginals]:
    """Optimise all measurements of the first n poses at once, from the true poses."""
    n = len(problem.poses) if n is None else n
    graph = build(problem, kernel, n)
    optimum = optimise(graph, values_of(problem.poses[:n]))
    return optimum, gtsam.Marginals(graph, optimum)


def loopy_problem(seed: int, n: int, sigma: float, *, with_priors: bool = False) -> Problem:
    """Return a chain with random links, loops that come late, and absolute measurements."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, n)
    edges: list[list[Edge]] = [[]]
    late_edges: dict[int, list[tuple[int, Edge]]] = {}
    for frame in range(1, n):
        older = rng.permutation(np.arange(max(frame - 6, 0), frame - 1))[: rng.integers(3)]
        references = [frame - 1, *older.tolist()]
        edges.append([measure(poses, i, frame, rng, sigma) for i in references])
        if frame > 5 and rng.random() < 0.3:
            i, j = sorted(rng.choice(frame + 1, size=2, replace=False).tolist())
            if rng.random() < 0.5:
                i, j = j, i  # a late edge may point either way
            late_edges.setdefault(frame, []).append((j, measure(poses, i, j, rng, sigma)))
    problem = Problem(poses=poses, edges=edges, late_edges=late_edges)
    return add_priors(problem, rng, sigma) if with_priors else problem


def random_prior(rng: np.random.Generator, T: FloatArray, sigma: float) -> Prior:
    if rng.random() < 0.5:
        covariance = random_covariance(rng, sigma)
        noise = se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
        return PosePrior(T_world_frame=se3.normalize(T @ noise), covariance=covariance)
    covariance = random_covariance(rng, sigma, 3)
    position = rng.multivariate_normal(T[:3, 3], covariance)
    return PositionPrior(position_world=position, covariance=covariance, kernel="none")


def add_priors(problem: Problem, rng: np.random.Generator, sigma: float) -> Problem:
    start = PosePrior(T_world_frame=np.eye(4), covariance=random_covariance(rng, sigma))
    priors: dict[int, Prior] = {0: start}
    late_priors: dict[int, list[tuple[int, Prior]]] = {}
    for frame in range(1, len(problem.poses)):
        if rng.random() < 0.2:
            priors[frame] = random_prior(rng, problem.poses[frame], sigma)
        if rng.random() < 0.1:
            older = int(rng.integers(frame + 1))
            late = random_prior(rng, problem.poses[older], sigma)
            late_priors.setdefault(frame, []).append((older, late))
    return replace(problem, priors=priors, late_priors=late_priors)


def assert_equal_covariances(found: FloatArray, expected: FloatArray, tolerance: float) -> None:
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=tolerance)


@settings(max_examples=8)
@given(seed=seeds, with_priors=st.booleans())
def test_full_smoothing_of_a_loopy_graph_is_the_batch_optimum(seed: int, with_priors: bool) -> None:
    problem = loopy_problem(seed, 40, 0.01, with_priors=with_priors)
    window = SlidingWindow(WindowConfig(size=None, kernel="none"))
    feed(window, problem)
    smoothed = window.finish()
    optimum, marginals = batch(problem)
    assert [e.frame_id for e in smoothed] == list(range(40))
    for frame, estimate in enumerate(smoothed):
        expected = optimum.atPose3(frame).matrix()
        np.testing.assert_allclose(estimate.T_world_frame, expected, atol=1e-6)
        assert_equal_covariances(estimate.covariance, marginals.marginalCovariance(frame), 0.05)
    assert window.batch_result is not None
    error = build(problem).error(optimum)
    assert window.batch_result.error_after == pytest.approx(error, rel=1e-6)
    assert window.batch_result.error_before >= window.batch_result.error_after * (1 - 1e-9)
    assert window.batch_result.as_json()["error"] == window.batch_result.error_after


@settings(max_examples=6)
@given(seed=seeds, with_priors=st.booleans())
def test_each_answer_is_the_batch_optimum_of_what_was_known(seed: int, with_priors: bool) -> None:
    # Measurements so good that one linearization is as good as many.
    problem = loopy_problem(seed, 20, 2e-5, with_priors=with_priors)
    causal = feed(SlidingWindow(WindowConfig(size=None, kernel="none")), problem)
    for n in (3, 8, 14, 20):
        known = replace(
            problem,
            late_edges={k: v for k, v in problem.late_edges.items() if k < n - 1},
            late_priors={k: v for k, v in problem.late_priors.items() if k < n - 1},
        )
        optimum, marginals = batch(known, n=n)
        expected = optimum.atPose3(n - 1).matrix()
        np.testing.assert_allclose(causal[n - 1].T_world_frame, expected, atol=1e-7)
        covariance = marginals.marginalCovariance(n - 1)
        assert_equal_covariances(causal[n - 1].covariance, covariance, 1e-3)


def small_window(seed: int, size: int | None) -> tuple[SlidingWindow, Problem]:
    """Return a window of very good measurements, fed with short links alone."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, 25)
    problem = Problem(poses=poses, edges=net(poses, rng, 2e-5, n_back=3))
    window = SlidingWindow(WindowConfig(size=size, kernel="none"))
    feed(window, problem)
    return window, problem


@pytest.mark.parametrize("size", [5, 8, None])
@pytest.mark.parametrize("seed", [0, 1])
def test_poses_and_covariances_of_a_window_are_of_the_batch(seed: int, size: int | None) -> None:
    window, problem = small_window(seed, size)
    optimum, marginals = batch(problem)
    poses = window.poses()
    assert list(poses) == list(range(25 - (size or 25), 25))
    for frame, T in poses.items():
        # A whole graph relinearizes rarely; it is optimized in a batch at its end.
        atol = 1e-7 if size else 1e-5
        np.testing.assert_allclose(T, optimum.atPose3(number(frame)).matrix(), atol=atol)
        np.testing.assert_array_equal(T, window.pose(frame))
        expected = marginals.marginalCovariance(number(frame))
        assert_equal_covariances(window.covariance(frame), expected, 1e-3)


def relative_covariance(marginals: gtsam.Marginals, values: gtsam.Values, a: int, b: int) -> Any:
    """Propagate the joint covariance of two poses by GTSAM's own derivatives of `between`."""
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector([a, b]))
    H_a, H_b = np.zeros((6, 6), order="F"), np.zeros((6, 6), order="F")
    values.atPose3(a).between(values.atPose3(b), H_a, H_b)
    H = np.hstack([H_a, H_b])
    return H @ np.block([[joint.at(i, j) for j in (a, b)] for i in (a, b)]) @ H.T


@pytest.mark.parametrize("size", [5, None])
@pytest.mark.parametrize(("back_a", "back_b"), [(1, 0), (3, 1), (0, 4), (2, 3)])
def test_relative_poses_have_joint_covariances(size: int | None, back_a: int, back_b: int) -> None:
    window, problem = small_window(2, size)
    optimum, marginals = batch(problem)
    a, b = 24 - back_a, 24 - back_b
    edge = window.relative_pose(a, b)
    assert edge.reference_id == a
    expected = optimum.atPose3(a).between(optimum.atPose3(b)).matrix()
    np.testing.assert_allclose(edge.T_reference_frame, expected, atol=1e-7)
    covariance = relative_covariance(marginals, optimum, a, b)
    # Far less than two independent poses would give.
    assert np.trace(edge.covariance) < 0.5 * np.trace(window.covariance(b))
    assert_equal_covariances(edge.covariance, covariance, 2e-3)


def test_the_residuals_of_the_graph_add_up_to_its_error() -> None:
    problem = loopy_problem(11, 30, 0.02, with_priors=True)
    window = SlidingWindow(WindowConfig(size=None, kernel="none", gate=None))
    feed(window, problem)
    graph, error = window.graph(), build(problem).error(values_of(window.poses()))
    assert len(graph) == len(problem.all_edges(30)) + len(problem.all_priors(30))
    assert 0.5 * sum(each.chi2 for each in graph) == pytest.approx(error, rel=1e-6)
    assert {each.weight for each in graph} == {1.0}


@pytest.mark.parametrize("kernel", KERNELS[1:])
def test_full_smoothing_with_a_kernel_is_the_batch(kernel: Any) -> None:
    problem = loopy_problem(12, 30, 0.01)
    for frame in (10, 20):  # a dozen sigmas, one of several edges each
        edge = problem.edges[frame][0]
        wrong = edge.T_reference_frame @ se3.exp(np.array([0.05, -0.05, 0.0, 0.1, 0.0, 0.1]))
        problem.edges[frame][0] = replace(edge, T_reference_frame=wrong)
    config = WindowConfig(size=None, kernel=kernel, gate=None)
    window = SlidingWindow(config)
    feed(window, problem)
    assert min(edge.weight for edge in window.graph()) < 0.9  # the kernel has something to do
    smoothed = window.finish()
    graph = build(problem, kernel)
    found = values_of({number(e.frame_id): e.T_world_frame for e in smoothed})
    truth = values_of(problem.poses)
    assert graph.error(found) <= graph.error(optimise(graph, found)) * (1 + 1e-6)
    if kernel in ("huber", "cauchy"):  # the others have many optima
        assert graph.error(found) <= graph.error(optimise(graph, truth)) * (1 + 1e-6)
    assert window.batch_result is not None
    assert window.batch_result.error_after == pytest.approx(graph.error(found), rel=1e-6)
    if kernel in ("huber", "cauchy"):
        assert graph.error(found) < graph.error(optimise(build(problem), truth))


@pytest.mark.parametrize("kernel", KERNELS[1:])
def test_an_edge_may_have_its_own_kernel(kernel: Any) -> None:
    def second_pose(ours: Any, windows: Any) -> list[float]:
        window = SlidingWindow(WindowConfig(kernel=windows, gate=None))
        window.add_pose(0, 0, [])
        edges = [replace(edge(0, shifted(x)), kernel=ours) for x in (0.0, 0.01, 0.09)]
        window.add_pose(1, 1, edges)
        return [each.weight for each in window.graph() if each.reference_id == 0]

    assert second_pose(kernel, "none") == pytest.approx(second_pose(None, kernel), rel=1e-9)
    assert second_pose("none", kernel) == [1.0, 1.0, 1.0]
    assert min(second_pose(kernel, "none")) < 1.0


def assert_refused(
    seed: int,
    place: int,
    n_edges: int,
    offset: FloatArray,
    *,
    sigma: float = 1e-3,
    kernel: Any = "none",
    atol: float = 1e-4,
) -> None:
    """Check that of the edges of a ninth pose one outlier is refused, and leaves no trace."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, 9)
    edges = net(poses[:8], rng, sigma, n_back=3)
    arriving = [measure(poses, i, 8, rng, 1e-3) for i in range(8 - n_edges, 8)]
    right = arriving.pop(place)
    T = se3.normalize(right.T_reference_frame @ se3.exp(offset))
    wrong = replace(right, T_reference_frame=T)
    window, twin = (SlidingWindow(WindowConfig(size=8, kernel=kernel)) for _ in range(2))
    for each in (window, twin):
        feed(each, Problem(poses=poses[:8], edges=edges))
    found = window.add_pose(8, 8 * STEP_NS, [*arriving[:place], wrong, *arriving[place:]])
    expected = twin.add_pose(8, 8 * STEP_NS, arriving)
    assert [r.reference_id for r in found.rejected] == [wrong.reference_id]
    assert found.rejected[0].reason
    assert (window.counts.n_gated, twin.counts.n_gated) == (1, 0)
    np.testing.assert_allclose(found.T_world_frame, expected.T_world_frame, atol=atol)
    # Of other start values: linearized a hundredth elsewhere.
    assert_equal_covariances(found.covariance, expected.covariance, 0.03)


@given(
    seed=seeds,
    n_edges=st.integers(3, 5),
    place=st.integers(0, 4),
    size=st.floats(0.3, 1000.0),
    is_turn=st.booleans(),
)
def test_one_gross_outlier_is_refused_wherever_it_stands(
    seed: int, n_edges: int, place: int, size: float, is_turn: bool
) -> None:
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    offset = np.r_[np.zeros(3), size * direction]
    if is_turn:
        offset = np.r_[min(size, 2.0) * direction, np.zeros(3)]
    assert_refused(seed, place % n_edges, n_edges, offset, atol=2e-5)


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(
    ("size", "sigma", "kernel"), [(1.0, 1e-2, "none"), (1000.0, 1e-4, "none"), (1.0, 1e-3, "huber")]
)
def test_a_gross_outlier_is_refused_in_sure_and_unsure_windows_and_under_a_kernel(
    place: int, size: float, sigma: float, kernel: str
) -> None:
    offset = np.array([0.0, 0.0, 0.0, size, 0.0, 0.0])
    assert_refused(0, place, 3, offset, sigma=sigma, kernel=kernel)


@settings(max_examples=5)
@given(seed=seeds)
def test_edges_whose_covariance_is_true_are_not_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = wander(rng, 80)
    window = SlidingWindow(WindowConfig(size=6))
    for frame in range(80):
        sigma = 10 ** rng.uniform(-4, -1.5)
        references = range(max(frame - 4, 0), frame)
        edges = [measure(poses, i, frame, rng, sigma) for i in references]
        assert window.add_pose(frame, frame, edges).rejected == ()
    assert window.counts.n_rejected == 0


def drifting(seed: int, n: int) -> tuple[list[FloatArray], list[list[Edge]], Edge]:
    """Return poses, a noisy chain with short links, and a good edge from the first to the last."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, n)
    return poses, net(poses, rng, 0.01, n_back=2), measure(poses, 0, n - 1, rng, 1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_closure_after_long_drift_is_not_refused_with_a_pose(seed: int) -> None:
    poses, edges, loop = drifting(seed, 300)
    window = SlidingWindow(WindowConfig(size=5))
    for frame in range(299):
        window.add_pose(frame, frame, edges[frame])
        if frame == 0:
            window.keep(0)
    drifted = window.pose(298) @ edges[299][-1].T_reference_frame
    estimate = window.add_pose(299, 299, [*edges[299], loop])
    expected = loop.T_reference_frame
    # The drift is many sigmas of the loop.
    assert np.linalg.norm(drifted[:3, 3] - expected[:3, 3]) > 0.1
    assert estimate.rejected == ()
    np.testing.assert_allclose(estimate.T_world_frame, expected, atol=0.1)
    following = replace(edges[1][0], reference_id=299)
    assert window.add_pose(300, 300, [following]).rejected == ()
    np.testing.assert_allclose(window.pose(299), expected, atol=0.01)
    np.testing.assert_allclose(expected, poses[299], atol=0.01)


@pytest.mark.parametrize("seed", range(2))
def test_a_loop_closure_after_long_drift_is_not_refused_later(seed: int) -> None:
    poses, edges, loop = drifting(seed, 150)
    window = SlidingWindow(WindowConfig(size=None))
    feed(window, Problem(poses=poses, edges=edges))
    assert np.linalg.norm(window.pose(149)[:3, 3] - poses[149][:3, 3]) > 0.05
    answer = window.add_edge(149, loop)
    assert not isinstance(answer, Rejected)
    np.testing.assert_allclose(answer.T_world_frame, poses[149], atol=0.1)
    np.testing.assert_allclose(window.finish()[149].T_world_frame, poses[149], atol=0.01)


def test_without_a_prior_the_first_pose_is_the_identity_and_nearly_sure() -> None:
    first = SlidingWindow().add_pose("a", 0, [])
    np.testing.assert_allclose(first.T_world_frame, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(first.covariance, 1e-10 * np.eye(6), atol=1e-16)


@pytest.mark.parametrize("size", [10, None])
def test_positions_alone_turn_the_trajectory_into_the_world(size: int | None) -> None:
    rng = np.random.default_rng(8)
    T_world_start = se3.exp(np.array([0.2, 0.6, -0.3, 10.0, -4.0, 2.0]))
    poses = [T_world_start @ T for T in wander(rng, 80)]
    edges = net(poses, rng, 2e-3)
    priors: dict[int, Prior] = {
        frame: PositionPrior(
            position_world=poses[frame][:3, 3] + 0.01 * rng.normal(size=3),
            covariance=1e-4 * np.eye(3),
        )
        for frame in range(80)
    }
    problem = Problem(poses=poses, edges=edges, priors=priors)
    window = SlidingWindow(WindowConfig(size=size, kernel="none"))
    causal = feed(window, problem)
    optimum, _ = batch(problem)
    np.testing.assert_allclose(causal[-1].T_world_frame, poses[-1], atol=0.05)
    np.testing.assert_allclose(causal[-1].T_world_frame, optimum.atPose3(79).matrix(), atol=0.01)
    if size is None:
        for estimate in window.finish():
            expected = optimum.atPose3(number(estimate.frame_id)).matrix()
            np.testing.assert_allclose(estimate.T_world_frame, expected, atol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("size", "n"), [(2, 100), (5, 200), (None, 100)])
def test_smoothing_consecutive_edges_gives_the_chain(kernel: Any, size: int | None, n: int) -> None:
    rng = np.random.default_rng(n)
    poses = wander(rng, n)
    edges = net(poses, rng, 0.02)
    window = SlidingWindow(WindowConfig(size=size, kernel=kernel))
    causal = feed(window, Problem(poses=poses, edges=edges))
    smoothed = window.pop_finished() + window.finish()
    chained = np.eye(4)
    for frame in range(n):
        if frame:
            chained = chained @ edges[frame][0].T_reference_frame
        np.testing.assert_allclose(causal[frame].T_world_frame, chained, atol=1e-6)
        np.testing.assert_allclose(smoothed[frame].T_world_frame, chained, atol=1e-6)


# Keyframes that come and go.


def random_soak(
    seed: int, n: int, n_kept_limit: int
) -> tuple[list[FloatArray], list[list[Edge]], list[Estimate], int]:
    """Drive a window of five with keyframes kept and released at random."""
    rng = np.random.default_rng(seed)
    poses = wander(rng, n)
    window = SlidingWindow(WindowConfig(size=5, kernel="none"))
    edges: list[list[Edge]] = []
    kept: list[int] = []
    finished: list[Estimate] = []
    largest = 0
    for frame in range(n):
        references = [frame - 1] if frame else []
        candidates = [number(i) for i in window.poses() if i != frame - 1]
        references += rng.permutation(np.array(candidates, dtype=int))[:2].tolist()
        edges.append([measure(poses, i, frame, rng, 2e-3) for i in references])
        estimate = window.add_pose(frame, frame * STEP_NS, edges[-1])
        assert np.isfinite(estimate.T_world_frame).all()
        assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
        finished += window.pop_finished()
        if rng.random() < 0.4:
            window.keep(frame)
            kept.append(frame)
        while len(kept) > n_kept_limit or (kept and rng.random() < 0.1):
            window.release(kept.pop(int(rng.integers(len(kept)))))
        largest = max(largest, len(window))
        assert all(i in window for i in kept)
    finished += window.finish()
    return poses, edges, finished, largest


@pytest.mark.parametrize("seed", [0, 1])
def test_keyframes_may_come_and_go_for_hundreds_of_poses(seed: int) -> None:
    n = 200
    poses, edges, finished, largest = random_soak(seed, n, n_kept_limit=6)
    # Each pose is handed over exactly once.
    assert sorted(number(estimate.frame_id) for estimate in finished) == list(range(n))
    assert all(e.stamp_ns == number(e.frame_id) * STEP_NS for e in finished)
    assert largest <= 5 + 6 + 1
    optimum, _ = batch(Problem(poses=poses, edges=edges))
    windowed = np.array(
        [e.T_world_frame[:3, 3] for e in sorted(finished, key=lambda e: e.stamp_ns)]
    )
    batched = np.array([optimum.atPose3(i).matrix()[:3, 3] for i in range(n)])
    length = np.linalg.norm(np.diff(batched, axis=0), axis=1).sum()
    assert np.abs(windowed - batched).max() < 0.002 * length
    chained = [np.eye(4)]
    for frame_edges in edges[1:]:
        chained.append(chained[-1] @ frame_edges[0].T_reference_frame)
    drift = np.abs(np.array(chained)[:, :3, 3] - batched).max()
    assert np.abs(windowed - batched).max() < 0.7 * drift


def test_factors_that_left_make_room_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    slots, original = list[int](), gtsam.ISAM2.update

    def update(isam: Any, *arguments: Any) -> Any:
        slots.append(isam.getFactorsUnsafe().size())
        return original(isam, *arguments)

    monkeypatch.setattr(gtsam.ISAM2, "update", update)
    walk(WindowConfig(size=3), 60)
    assert max(slots[10:]) == max(slots[-10:]) < 12


# A loop that turns what it closes: one linearization is not enough.


N = 9


def optimum_of(
    poses: Mapping[Any, FloatArray], edges: Sequence[tuple[int, Edge]], start: Prior | None = None
) -> tuple[gtsam.Values, gtsam.NonlinearFactorGraph]:
    """Return the least squares of edges (frame, edge), from these poses, and their graph."""
    priors: dict[int, Prior] = {} if start is None else {0: start}
    without: list[list[Edge]] = [[] for _ in poses]
    problem = Problem(
        poses=[*poses.values()], edges=without, late_edges={0: [*edges]}, priors=priors
    )
    graph = build(problem)
    return optimise(graph, values_of(poses)), graph


def drifted_chain(turn_rad: float) -> tuple[SlidingWindow, list[tuple[int, Edge]], FloatArray]:
    """Return a window that holds N poses whose steps turn too far, their edges, the true end."""
    wrong_step = se3.normalize(STEP @ se3.exp(np.array([0.0, turn_rad / N, 0.0, 0.0, 0.0, 0.0])))
    edges = [(frame, edge(frame - 1, wrong_step, 0.1)) for frame in range(1, N)]
    config = WindowConfig(size=N + 3, kernel="none", gate=None)
    return walk(config, N, wrong_step, 0.1), edges, power(N - 1)


@pytest.mark.parametrize("turn_rad", [0.6, -1.2])
def test_a_loop_with_a_large_turn_is_closed_when_the_call_returns(turn_rad: float) -> None:
    window, edges, T_end = drifted_chain(turn_rad)
    before = window.poses()
    loop = edge(0, T_end, 1e-3)
    answer = window.add_edge(N - 1, loop)
    assert isinstance(answer, Estimate)
    optimum, _ = optimum_of(before, [*edges, (N - 1, loop)])
    moved = se3.invert(before[N - 1]) @ optimum.atPose3(N - 1).matrix()
    assert se3.rotation_angle(moved) > 0.4
    np.testing.assert_allclose(answer.T_world_frame, optimum.atPose3(N - 1).matrix(), atol=1e-4)
    for frame, T in enumerate(window.poses().values()):
        np.testing.assert_allclose(T, optimum.atPose3(frame).matrix(), atol=1e-3)


@pytest.mark.parametrize("turn_rad", [0.6, -1.2])
@pytest.mark.parametrize("sigma", [0.3, 1e-3])
def test_a_pose_that_closes_a_large_turn_settles_with_others(turn_rad: float, sigma: float) -> None:
    # It starts where one of its edges leads, and ends where both pull alike.
    window, edges, _ = drifted_chain(turn_rad)
    before = window.poses()
    arriving = [edge(0, power(N), sigma), edge(N - 1, STEP, 0.1)]
    answer = window.add_pose(N, N * STEP_NS, arriving)
    assert answer.rejected == ()
    everything = [*edges, *((N, each) for each in arriving)]
    optimum, _ = optimum_of(before | {N: power(N)}, everything)
    np.testing.assert_allclose(answer.T_world_frame, optimum.atPose3(N).matrix(), atol=1e-3)
    for frame, T in enumerate(window.poses().values()):
        np.testing.assert_allclose(T, optimum.atPose3(frame).matrix(), atol=1e-3)


# Sigmas many orders of magnitude apart: Cholesky calls the system indeterminate, QR solves it.


@pytest.mark.parametrize(("start_sigma", "sigma"), [(1e2, 1e-2), (1e4, 1.0), (1.0, 1e-4)])
@pytest.mark.parametrize("size", [None, N])
def test_a_graph_takes_sigmas_that_defeat_cholesky(
    size: int | None, start_sigma: float, sigma: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="gvo")
    start = PosePrior(T_world_frame=np.eye(4), covariance=start_sigma**2 * np.eye(6))
    window = SlidingWindow(WindowConfig(size=size, kernel="none"))
    window.add_pose(0, 0, [], start)
    edges: list[tuple[int, Edge]] = []
    for frame in range(1, N):
        arriving = [edge(frame - span, power(span), sigma) for span in (1, 2) if span <= frame]
        estimate = window.add_pose(frame, frame * STEP_NS, arriving)
        assert (estimate.rejected, estimate.status) == ((), Status.OK)
        edges += [(frame, each) for each in arriving]
    counts = window.counts
    assert "solved by QR" in caplog.text  # there was something to survive
    assert (counts.n_rejected, counts.n_coasting, counts.n_restored) == (0, 0, 0)
    assert (counts.n_edges, len(window.graph())) == (len(edges), len(edges) + 1)
    optimum, graph = optimum_of({frame: power(frame) for frame in range(N)}, edges, start)
    J, _ = graph.linearize(optimum).jacobian()
    R_inverse = np.linalg.inv(np.linalg.qr(J, mode="r"))
    covariance = R_inverse @ R_inverse.T
    relative = window.relative_pose(0, N - 1)
    np.testing.assert_allclose(relative.T_reference_frame, power(N - 1), atol=1e-6 * N)
    np.testing.assert_allclose(window.pose(N - 1), optimum.atPose3(N - 1).matrix(), atol=1e-4)
    expected = covariance[-6:, -6:]
    assert_equal_covariances(window.covariance(N - 1), expected, 1e-3)
    for frame, each in enumerate(window.finish()):
        np.testing.assert_allclose(each.T_world_frame, power(frame), atol=1e-4)
    if size is None:
        assert window.batch_result is not None
        assert window.batch_result.error_after == pytest.approx(0.0, abs=1e-6)


def test_a_late_edge_at_which_cholesky_gives_up_is_taken() -> None:
    start = PosePrior(T_world_frame=np.eye(4), covariance=1e4 * np.eye(6))
    window = SlidingWindow(WindowConfig(size=None, kernel="none"))
    window.add_pose(0, 0, [], start)
    go_on(window, 1, N, sigma=1.0)
    assert window.counts.n_restored == 0
    answer = window.add_edge(N - 1, edge(0, power(N - 1), 1e-6))
    assert isinstance(answer, Estimate), answer
