"""Whole graphs: against exact poses, GTSAM's own optimizers, and in other gauges and orders."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gvo
from gvo.backend.batch import BatchOptimizer, Robust, WholeGraph, sparse_marginals
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, PosePrior
from tests.backend.walks import seeds, values_of

SIGMAS = np.array([0.01] * 3 + [0.05] * 3)
N = 24


def circle(n: int = N) -> FloatArray:
    """Return poses of two rounds, so that each place is seen twice."""
    step = se3.exp(np.array([0.0, 4.0 * np.pi / n, 0.02, 0.0, 0.0, 1.0]))
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def edge(poses: FloatArray, a: int, b: int, rng: np.random.Generator | None = None) -> Edge:
    """Return an edge from a to b, with noise where there is a generator."""
    noise = np.zeros(6) if rng is None else rng.normal(0.0, SIGMAS)
    T = se3.invert(poses[a]) @ poses[b] @ se3.exp(noise)
    return Edge(reference_id=a, T_reference_frame=T, covariance=np.diag(SIGMAS**2))


def links(poses: FloatArray, rng: np.random.Generator | None = None) -> list[tuple[int, Edge]]:
    """Return odometry and the loops of the second round to the first, each with its frame."""
    n = len(poses)
    ends = [(k, k + 1) for k in range(n - 1)] + [(k, k + n // 2) for k in range(n // 2)]
    return [(b, edge(poses, a, b, rng)) for a, b in ends]


def graph_of(
    edges: list[tuple[int, Edge]], *, n: int = N, T_world_first: FloatArray | None = None
) -> WholeGraph:
    graph = WholeGraph()
    for number in range(n):
        prior = None
        if number == 0 and T_world_first is not None:
            prior = PosePrior(T_world_frame=T_world_first, covariance=1e-10 * np.eye(6))
        graph.add_pose(number, number * 10, prior)
    for frame, each in edges:
        graph.add_edges(frame, [each])
    return graph


def optimum(graph: WholeGraph, robust: Robust = "none") -> BatchOptimizer:
    optimizer = BatchOptimizer(graph, robust)
    optimizer.run()
    return optimizer


def false_loops(poses: FloatArray, rng: np.random.Generator, n: int = 10) -> list[tuple[int, Edge]]:
    """Return edges between places that are metres apart, which say that they are the same."""
    found: list[tuple[int, Edge]] = []
    while len(found) < n:
        a, b = sorted(rng.choice(len(poses), 2, replace=False).tolist())
        if np.linalg.norm(poses[a][:3, 3] - poses[b][:3, 3]) > 2.0 and b - a > 1:
            covariance = np.diag(SIGMAS**2)
            T = se3.exp(rng.normal(0.0, SIGMAS))
            found.append((b, Edge(reference_id=a, T_reference_frame=T, covariance=covariance)))
    return found


def by_gtsam(edges: list[tuple[int, Edge]], T_world: FloatArray) -> gtsam.NonlinearFactorGraph:
    factors = gtsam.NonlinearFactorGraph()
    first = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T_world), first))
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    for frame, each in edges:
        T = gtsam.Pose3(each.T_reference_frame)
        assert isinstance(each.reference_id, int)
        factors.add(gtsam.BetweenFactorPose3(each.reference_id, frame, T, noise))
    return factors


@pytest.mark.parametrize("robust", ["none", "huber", "gnc"])
def test_exact_edges_give_the_exact_poses_from_any_start(robust: Robust) -> None:
    poses = circle()
    graph = graph_of(links(poses))
    rng = np.random.default_rng(0)
    graph.given = {number: T @ se3.exp(rng.normal(size=6)) for number, T in enumerate(poses)}
    found = optimum(graph, robust)
    assert found.error < 1e-12
    assert found.start != "given"
    np.testing.assert_allclose(found.poses(), poses, atol=1e-6)


def test_the_error_and_covariances_are_those_of_gtsam_by_hand() -> None:
    poses = circle()
    edges = links(poses, np.random.default_rng(1))
    found = optimum(graph_of(edges))
    factors = by_gtsam(edges, np.eye(4))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values_of(poses), parameters)
    values = optimizer.optimize()
    assert found.error == pytest.approx(optimizer.error(), rel=1e-6)
    assert factors.error(values_of(found.poses())) == pytest.approx(found.error, rel=1e-6)
    marginals = gtsam.Marginals(factors, values)
    expected = [marginals.marginalCovariance(number) for number in range(N)]
    np.testing.assert_allclose(found.covariances(), expected, rtol=1e-3, atol=1e-9)


def test_stiff_parts_that_are_loosely_joined_have_covariances() -> None:
    """As keyframes before and after frames that coast: GTSAM's marginals refuse them."""
    poses = circle(40)
    loose, stiff = np.array([0.04] * 3 + [0.3] * 3) ** 2, np.full(6, 1e-10)
    ends = [(a, b) for a in range(40) for b in range(a + 1, min(a + 6, 40)) if not a < 20 <= b]
    edges = [
        (b, replace(edge(poses, a, b), covariance=np.diag(loose if a == 19 else stiff)))
        for a, b in [*ends, (19, 20)]
    ]
    covariances = optimum(graph_of(edges, n=40)).covariances()
    for number in (20, 39):
        Ad = se3.adjoint(se3.invert(poses[number]) @ poses[20])
        expected = Ad @ np.diag(loose) @ Ad.T
        np.testing.assert_allclose(covariances[number], expected, rtol=1e-3, atol=1e-6)
    assert np.diagonal(covariances[19]).max() < 1e-6


def test_a_loosely_joined_tree_without_residuals_has_covariances() -> None:
    step = se3.make_transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    edges: dict[object, list[Edge]] = {0: [], "apart": []}
    for k in range(1, 6):
        covariance = (9.0 if k == 3 else 1e-6) * np.eye(6)
        edges[k] = [Edge(reference_id=k - 1, T_reference_frame=step, covariance=covariance)]
    covariances = gvo.optimize(edges, covariances=True).covariances
    assert covariances is not None
    expected = np.zeros((6, 6))
    for k in range(1, 6):
        expected = se3.compose_covariance(expected, step, edges[k][0].covariance)
        np.testing.assert_allclose(covariances[k], expected, rtol=1e-3, atol=1e-6)


def test_poses_that_nothing_joins_to_the_first_have_no_covariances() -> None:
    poses = circle()
    apart = [(b, each) for b, each in links(poses)[: N - 1] if b != N // 2]
    with pytest.raises(RuntimeError):
        sparse_marginals(by_gtsam(apart, np.eye(4)).linearize(values_of(poses)))


@given(seeds)
def test_another_world_moves_all_poses_and_nothing_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = links(circle(12), rng)
    T_map_world = se3.exp(rng.normal(size=6) * [2.0, 2.0, 2.0, 50.0, 50.0, 50.0])
    here = optimum(graph_of(edges, n=12, T_world_first=np.eye(4)))
    there = optimum(graph_of(edges, n=12, T_world_first=T_map_world))
    assert there.error == pytest.approx(here.error, rel=1e-6)
    np.testing.assert_allclose(there.poses(), T_map_world @ here.poses(), atol=1e-4)


@given(seeds, st.randoms(use_true_random=False))
def test_the_order_of_edges_is_without_effect(seed: int, random: object) -> None:
    edges = links(circle(12), np.random.default_rng(seed))
    shuffled = list(edges)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    first, second = optimum(graph_of(edges, n=12)), optimum(graph_of(shuffled, n=12))
    assert second.error == pytest.approx(first.error, rel=1e-6)
    np.testing.assert_allclose(second.poses(), first.poses(), atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_ten_false_loops_among_ten_true_ones_do_not_bend_the_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = circle(60)
    true = links(poses, rng)[: 59 + 10]
    without = optimum(graph_of(true, n=60), "gnc")
    planted = false_loops(poses, rng)
    with_them = optimum(graph_of(true + planted, n=60), "gnc")
    assert not without.refused
    refused = {(link.frame, link.edge.reference_id) for link in with_them.refused}
    assert refused == {(frame, each.reference_id) for frame, each in planted}
    assert with_them.error == pytest.approx(without.error, rel=0.05)
    distances = np.linalg.norm((with_them.poses() - without.poses())[:, :3, 3], axis=1)
    assert distances.max() < 0.01
    bent = optimum(graph_of(true + planted, n=60))
    assert np.linalg.norm((bent.poses() - without.poses())[:, :3, 3], axis=1).max() > 0.3


def test_graduated_non_convexity_refuses_what_gtsams_own_does() -> None:
    rng = np.random.default_rng(7)
    poses = circle(16)
    edges = links(poses, rng) + false_loops(poses, rng, 4)
    factors = by_gtsam(edges, np.eye(4))
    known = [0, *range(1, 16)]
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(known)
    parameters.setLossType(gtsam.GncLossType.TLS)
    chained = values_of(optimum(graph_of(edges[:15], n=16)).poses())
    optimizer = gtsam.GncLMOptimizer(factors, chained, parameters)
    values = optimizer.optimize()
    refused = {k - 1 for k, weight in enumerate(optimizer.getWeights()) if weight < 0.5}
    found = optimum(graph_of(edges, n=16), "gnc")
    mine = {k for k, (b, e) in enumerate(edges) for link in found.refused if link.edge is e}
    assert mine == refused
    for number in range(16):
        expected = values.atPose3(number).matrix()
        np.testing.assert_allclose(found.poses()[number], expected, atol=1e-2)


def test_bad_starts_are_mended_by_the_chordal_relaxation() -> None:
    """A torus whose odometry has turned by far more than a radian when it comes back."""
    rng = np.random.default_rng(3)
    n = 200
    angles = np.linspace(0.0, 4.0 * np.pi, n)
    poses = np.array(
        [
            se3.exp(np.array([0, 0, a, 0, 0, 0])) @ se3.exp(np.array([0, 5 * a, 0, 9.0, 0, 0]))
            for a in angles
        ]
    )
    noisy = [(k, k + 1) for k in range(n - 1)] + [(k, k + n // 2) for k in range(n // 2)]
    edges = [(b, edge(poses, a, b)) for a, b in noisy]
    turned = [
        (
            b,
            Edge(
                reference_id=e.reference_id,
                T_reference_frame=e.T_reference_frame
                @ se3.exp(rng.normal(0.0, [0.1] * 3 + [0.1] * 3)),
                covariance=e.covariance,
            ),
        )
        for b, e in edges
    ]
    graph = graph_of(turned, n=n)
    graph.given = {k: se3.exp(rng.normal(size=6) * 3.0) for k in range(n)}
    found = optimum(graph)
    assert found.start == "chordal"
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    factors = by_gtsam(turned, found.poses()[0])
    best = gtsam.LevenbergMarquardtOptimizer(factors, values_of(poses), parameters)
    best.optimize()
    assert found.error == pytest.approx(best.error(), rel=1e-6)


def test_invalid_edges_are_refused_and_what_they_alone_hold_is_left_out() -> None:
    poses = circle()
    edges = links(poses)[: N - 1]
    broken = Edge(reference_id=9, T_reference_frame=np.full((4, 4), np.nan), covariance=np.eye(6))
    edges[9] = (10, broken)
    edges.append((3, edge(poses, 3, 3)))
    edges.append((4, Edge(reference_id=99, T_reference_frame=np.eye(4), covariance=np.eye(6))))
    graph = graph_of(edges)
    found = optimum(graph)
    reasons = " ".join(str(rejected) for rejected in graph.rejected)
    assert len(graph.rejected) == 3
    for word in ("not finite", "to itself", "99"):
        assert word in reasons
    assert found.numbers == list(range(10))
    np.testing.assert_allclose(found.poses(), poses[:10], atol=1e-6)


def test_a_graph_is_optimized_out_of_a_mapping_of_any_names() -> None:
    poses = circle()
    edges: dict[object, list[Edge]] = {f"pose {k}": [] for k in range(N)}
    for frame, each in links(poses):
        edges[f"pose {frame}"].append(
            Edge(
                reference_id=f"pose {each.reference_id}",
                T_reference_frame=each.T_reference_frame,
                covariance=each.covariance,
            )
        )
    trajectory = gvo.optimize(edges, covariances=True)
    np.testing.assert_allclose(trajectory.T_world_frame, poses, atol=1e-6)
    assert trajectory.stamps_ns[:3].tolist() == [0, 10**9, 2 * 10**9]
    assert trajectory.covariances is not None
    sigmas = trajectory.covariances[:, 5, 5]
    assert sigmas[0] < sigmas[2] < sigmas[N // 4]


def test_ids_of_numpy_are_whole_numbers_too() -> None:
    poses = circle(4)
    graph = WholeGraph()
    for number in np.array([0, 2, 1, 3]):
        graph.add_pose(number, int(number))
    for b in (1, 2, 3):
        graph.add_edges(b, [edge(poses, b - 1, b)])
    assert graph.trusted() == [0, 1, 2]


def test_misuse_of_optimize_is_a_value_error() -> None:
    with pytest.raises(ValueError, match="robust must be one of"):
        gvo.optimize({"a": []}, robust="cauchy")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="holds no pose"):
        gvo.optimize({})


def test_the_best_poses_so_far_stand_where_the_work_is_ended() -> None:
    graph = graph_of(links(circle(), np.random.default_rng(1)))
    told: list[str] = []

    def end(text: str) -> None:
        told.append(text)
        raise KeyboardInterrupt

    optimizer = BatchOptimizer(graph, on_step=end)
    with pytest.raises(KeyboardInterrupt):
        optimizer.run()
    assert told == [f"iteration 1: error {optimizer.error:.6g}"]
    assert optimizer.error < optimizer.starts[optimizer.start]
    factors = by_gtsam(links(circle(), np.random.default_rng(1)), np.eye(4))
    assert factors.error(values_of(optimizer.poses())) == pytest.approx(optimizer.error)
