"""Odd measurements: loops with a large turn, sigmas far apart, keyframes whose references left."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, Status

STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))


def edge(reference_id: FrameId, T: FloatArray, sigma: float) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def power(T: FloatArray, n: int) -> FloatArray:
    return se3.normalize(np.linalg.matrix_power(T, n))


def optimum_of(
    start: PosePrior, edges: Sequence[tuple[int, Edge]], poses: Sequence[FloatArray]
) -> tuple[gtsam.Values, FloatArray]:
    """Return the least squares of a start and edges (frame, edge), and all poses' covariance.

    By GTSAM's batch with QR, and a QR decomposition of the whole Jacobian.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Gaussian.Covariance(start.covariance)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(start.T_world_frame), noise))
    for frame, each in edges:
        assert isinstance(each.reference_id, int)
        noise = gtsam.noiseModel.Gaussian.Covariance(each.covariance)
        T = gtsam.Pose3(each.T_reference_frame)
        graph.add(gtsam.BetweenFactorPose3(each.reference_id, frame, T, noise))
    for frame, pose in enumerate(poses):
        values.insert(frame, gtsam.Pose3(pose))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(0.0)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    J, _ = graph.linearize(optimum).jacobian()
    R_inverse = np.linalg.inv(np.linalg.qr(J, mode="r"))
    return optimum, R_inverse @ R_inverse.T


# A loop that turns what it closes: one linearization is not enough.

N = 9
ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))


def drifted_chain(turn_rad: float) -> tuple[SlidingWindow, list[tuple[int, Edge]], FloatArray]:
    """Return a window that holds N poses whose steps turn too far, their edges, the true end."""
    wrong_step = se3.normalize(STEP @ se3.exp(np.array([0.0, turn_rad / N, 0.0, 0.0, 0.0, 0.0])))
    edges = [(frame, edge(frame - 1, wrong_step, 0.1)) for frame in range(1, N)]
    window = SlidingWindow(WindowConfig(size=N + 3, kernel="none", gate=None))
    window.add_pose(0, 0, [])
    for frame, each in edges:
        window.add_pose(frame, frame * STEP_NS, [each])
    return window, edges, power(STEP, N - 1)


@pytest.mark.parametrize("turn_rad", [0.6, -1.2])
def test_a_loop_with_a_large_turn_is_closed_when_the_call_returns(turn_rad: float) -> None:
    window, edges, T_end = drifted_chain(turn_rad)
    before = window.poses()
    loop = edge(0, T_end, 1e-3)
    answer = window.add_edge(N - 1, loop)
    assert isinstance(answer, Estimate)
    optimum, _ = optimum_of(ORIGIN, [*edges, (N - 1, loop)], list(before.values()))
    moved = se3.invert(before[N - 1]) @ optimum.atPose3(N - 1).matrix()
    assert se3.rotation_angle(moved) > 0.4
    np.testing.assert_allclose(answer.T_world_cam, optimum.atPose3(N - 1).matrix(), atol=1e-4)
    for frame, T in enumerate(window.poses().values()):
        np.testing.assert_allclose(T, optimum.atPose3(frame).matrix(), atol=1e-3)


@pytest.mark.parametrize("turn_rad", [0.6, -1.2])
def test_a_pose_that_closes_a_loop_with_a_large_turn_is_settled_at_once(turn_rad: float) -> None:
    # It starts where one of its edges leads, and ends where both pull alike.
    window, edges, _ = drifted_chain(turn_rad)
    before = window.poses()
    arriving = [edge(0, power(STEP, N), 0.3), edge(N - 1, STEP, 0.1)]
    answer = window.add_pose(N, N * STEP_NS, arriving)
    assert answer.rejected == ()
    everything = [*edges, *((N, each) for each in arriving)]
    optimum, _ = optimum_of(ORIGIN, everything, [*before.values(), power(STEP, N)])
    np.testing.assert_allclose(answer.T_world_cam, optimum.atPose3(N).matrix(), atol=1e-4)


# Sigmas many orders apart: Cholesky calls the system indeterminate, QR solves it.


@pytest.mark.parametrize(("start_sigma", "sigma"), [(1e2, 1e-2), (1e4, 1.0), (1.0, 1e-4)])
def test_a_whole_graph_takes_sigmas_at_which_cholesky_gives_up(
    start_sigma: float, sigma: float
) -> None:
    start = PosePrior(T_world_frame=np.eye(4), covariance=start_sigma**2 * np.eye(6))
    window = SlidingWindow(WindowConfig(size=None, kernel="none"))
    window.add_pose(0, 0, [], start)
    edges: list[tuple[int, Edge]] = []
    for frame in range(1, N):
        arriving = [
            edge(frame - span, power(STEP, span), sigma) for span in (1, 2) if span <= frame
        ]
        estimate = window.add_pose(frame, frame * STEP_NS, arriving)
        assert (estimate.rejected, estimate.status) == ((), Status.OK)
        edges += [(frame, each) for each in arriving]
    counts = window.counts
    assert counts.n_restored >= 1  # there was something to survive
    assert (counts.n_rejected, counts.n_coasting, counts.n_rebuilt) == (0, 0, 0)
    assert (counts.n_edges, len(window.graph())) == (len(edges), len(edges) + 1)
    optimum, covariance = optimum_of(start, edges, [power(STEP, frame) for frame in range(N)])
    relative = window.relative_pose(0, N - 1)
    np.testing.assert_allclose(relative.T_reference_frame, power(STEP, N - 1), atol=1e-6 * N)
    np.testing.assert_allclose(window.pose(N - 1), optimum.atPose3(N - 1).matrix(), atol=1e-4)
    expected = covariance[-6:, -6:]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(window.covariance(N - 1) / scale, expected / scale, atol=1e-3)


# A keyframe outlives what it was measured against.


def two_edges(frame: int) -> list[Edge]:
    return [edge(frame - span, power(STEP, span), 0.01) for span in (1, 2) if span <= frame]


def test_a_keyframe_forgets_edges_to_poses_that_left() -> None:
    # A name that left is free again: an edge to the old bearer must not be told of the new one.
    window = SlidingWindow(WindowConfig(size=3, kernel="none"))
    for frame in range(3):
        window.add_pose(frame, frame * STEP_NS, two_edges(frame))
    window.keep(2)
    for frame in range(3, 8):
        window.add_pose(frame, frame * STEP_NS, two_edges(frame))
    assert 2 in window
    assert not {0, 1, 3} & set(window.poses())
    for again, frame in zip((0, 1), (8, 9), strict=True):
        previous = edge(7 if again == 0 else 0, STEP, 0.01)
        window.add_pose(again, frame * STEP_NS, [previous])
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
            loop = edge(frame, power(se3.invert(STEP), frame - 1), 0.1)
            assert isinstance(window.add_edge(1, loop), Estimate)
    ends = [(each.reference_id, each.frame_id) for each in window.graph()]
    assert sorted(ends, key=str) == sorted([(0, 1), (28, 1), (29, 1), (28, 29)], key=str)


def test_a_pose_that_closes_a_loop_with_a_large_turn_settles_the_others_too() -> None:
    window, edges, _ = drifted_chain(-1.2)
    before = window.poses()
    arriving = [edge(0, power(STEP, N), 1e-3), edge(N - 1, STEP, 0.1)]
    window.add_pose(N, N * STEP_NS, arriving)
    everything = [*edges, *((N, each) for each in arriving)]
    optimum, _ = optimum_of(ORIGIN, everything, [*before.values(), power(STEP, N)])
    for frame, T in enumerate(window.poses().values()):
        np.testing.assert_allclose(T, optimum.atPose3(frame).matrix(), atol=1e-3)


def test_a_late_edge_at_which_cholesky_gives_up_is_taken() -> None:
    start = PosePrior(T_world_frame=np.eye(4), covariance=1e4 * np.eye(6))
    window = SlidingWindow(WindowConfig(size=None, kernel="none"))
    window.add_pose(0, 0, [], start)
    for frame in range(1, N):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP, 1.0)])
    assert window.counts.n_restored == 0
    answer = window.add_edge(N - 1, edge(0, power(STEP, N - 1), 1e-6))
    assert isinstance(answer, Estimate), answer


def test_an_edge_to_a_name_that_left_is_not_told_of_its_next_bearer() -> None:
    window = SlidingWindow(WindowConfig(size=3, kernel="none"))
    for frame in range(4):
        window.add_pose(frame, frame * STEP_NS, two_edges(frame))
    window.add_pose(0, 4 * STEP_NS, [edge(3, STEP, 0.01)])
    ends = [(each.reference_id, each.frame_id) for each in window.graph()]
    assert ends == [(2, 3), (3, 0)]
