"""What the window answers where GTSAM gives no answer, and what it counts."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import pytest

from gvo.backend.isam2 import PoseGraph
from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, PositionPrior, Rejected

STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))


def edge(reference_id: FrameId, T: FloatArray, sigma: float = 0.01) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def walk(config: WindowConfig, n: int) -> SlidingWindow:
    """Return a window that was given n poses, each seen from the one before."""
    window = SlidingWindow(config)
    for frame in range(n):
        edges = [edge(frame - 1, STEP)] if frame else []
        window.add_pose(frame, frame * STEP_NS, edges)
    return window


@contextmanager
def giving_up(*names: str) -> Iterator[None]:
    """Let methods of ISAM2 fail."""

    def give_up(*_: Any) -> None:
        raise RuntimeError("Indeterminant linear system detected\nand more lines")

    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setattr(gtsam.ISAM2, name, give_up)
        yield


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.name.startswith("gvo")]


def test_a_first_pose_that_gtsam_never_takes_is_handed_over_where_the_world_begins() -> None:
    window = SlidingWindow(WindowConfig(size=5))
    with giving_up("update"):
        first = window.add_pose("a", 0, [])
        second = window.add_pose("b", STEP_NS, [])
    assert len(window) == 0
    for estimate in (first, second):
        np.testing.assert_array_equal(estimate.T_world_cam, np.eye(4))
    assert np.linalg.eigvalsh(first.covariance)[0] > 0.0
    assert second.covariance[5, 5] > first.covariance[5, 5]
    # The window itself is whole: the next pose that GTSAM takes begins it.
    third = window.add_pose("c", 2 * STEP_NS, [])
    assert list(window.poses()) == ["c"]
    assert [each.frame_id for each in window.finish()] == ["a", "b", "c"]
    assert third.stamp_ns == 2 * STEP_NS


def test_where_there_is_no_covariance_any_more_the_causal_pose_stands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    window = walk(WindowConfig(size=5, kernel="none", gate=None), 4)
    causal = window.add_pose(4, 4 * STEP_NS, [edge(3, STEP), edge("nobody", STEP)])
    assert len(causal.rejected) == 1
    turned = edge(0, se3.normalize(STEP @ STEP @ STEP @ STEP @ STEP), 1e-3)
    assert isinstance(window.add_edge(4, turned), Estimate)
    assert not np.allclose(window.pose(4), causal.T_world_cam, atol=1e-4)
    with caplog.at_level(logging.WARNING, logger="gvo"), giving_up("marginalCovariance"):
        found = window.estimate(4)
    np.testing.assert_array_equal(found.T_world_cam, causal.T_world_cam)
    np.testing.assert_array_equal(found.covariance, causal.covariance)
    assert (found.frame_id, found.stamp_ns, found.status) == (4, 4 * STEP_NS, causal.status)
    assert found.rejected == ()  # told once, with the pose
    (line,) = messages(caplog)
    assert "4 at 400000000 ns" in line
    assert "\n" not in line


def test_a_pose_that_went_to_infinity_is_where_it_was_when_it_came() -> None:
    window = walk(WindowConfig(size=5), 4)
    here = window.poses()
    far = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 1e12, 0.0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, "calculateEstimatePose3", lambda *_: far)
        for frame_id, T in window.poses().items():
            np.testing.assert_allclose(T, here[frame_id], atol=1e-9)


def test_where_the_joint_covariance_is_lost_two_poses_share_nothing() -> None:
    window = walk(WindowConfig(size=6, kernel="none"), 6)
    first, last = (window.estimate(frame) for frame in (2, 5))
    with giving_up("jointMarginalCovariance"):
        found = window.relative_pose(2, 5)
    H_first, H_last = np.zeros((6, 6), order="F"), np.zeros((6, 6), order="F")
    between = gtsam.Pose3(first.T_world_cam).between(gtsam.Pose3(last.T_world_cam), H_first, H_last)
    expected = H_first @ first.covariance @ H_first.T + H_last @ last.covariance @ H_last.T
    np.testing.assert_allclose(found.T_reference_frame, between.matrix(), atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-12)
    shared = window.relative_pose(2, 5)
    np.testing.assert_allclose(shared.T_reference_frame, found.T_reference_frame, atol=1e-12)
    assert np.linalg.eigvalsh(found.covariance - shared.covariance)[0] > 0.0
    assert not window.relative_pose(4, 4).covariance.any()


def test_a_whole_window_that_cannot_be_made_to_slide_goes_on_all_the_same(
    caplog: pytest.LogCaptureFixture,
) -> None:
    window = walk(WindowConfig(size=None), 6)
    before = window.poses()
    with caplog.at_level(logging.WARNING, logger="gvo"), giving_up("update"):
        window.reconfigure(WindowConfig(size=3))
    (line,) = messages(caplog)
    assert "the graph stays as it is" in line
    assert "\n" not in line
    for frame_id, T in window.poses().items():
        np.testing.assert_allclose(T, before[frame_id], atol=1e-9)
    for frame in range(6, 12):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)])
    assert len(window) == 3
    finished = window.finish()
    assert [each.frame_id for each in finished] == list(range(12))
    for frame, each in enumerate(finished):
        expected = np.linalg.matrix_power(STEP, frame)
        np.testing.assert_allclose(each.T_world_cam, expected, atol=1e-6)


def test_measurements_at_which_cholesky_gives_up_are_smoothed_and_polished() -> None:
    window = SlidingWindow(WindowConfig(size=None, kernel="none"))
    window.add_pose(0, 0, [], PosePrior(T_world_frame=np.eye(4), covariance=1e4 * np.eye(6)))
    for frame in range(1, 6):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP, 1e-3)])
    assert window.counts.n_restored >= 1  # there was something to survive
    smoothed = window.finish()
    assert window.polish is not None
    assert window.polish.error_after == pytest.approx(0.0, abs=1e-6)
    for frame, each in enumerate(smoothed):
        expected = np.linalg.matrix_power(STEP, frame)
        np.testing.assert_allclose(each.T_world_cam, expected, atol=1e-4)


def test_what_goes_in_is_counted_once_and_what_is_refused_by_its_kind() -> None:
    window = SlidingWindow(WindowConfig(size=9, kernel="none", gate=10.0))
    place = PositionPrior(position_world=np.zeros(3), covariance=np.eye(3))
    window.add_pose(0, 0, [])
    for frame in range(1, 6):
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)])
    known = window.relative_pose(1, 4).T_reference_frame
    assert isinstance(window.add_edge(4, edge(1, known)), Estimate)
    assert isinstance(window.add_prior(0, place), Estimate)
    assert [each.reference_id for each in window.edges(4)] == [3, 1]
    assert window.edges("nobody") == ()
    counts = window.counts
    assert (counts.n_poses, counts.n_edges, counts.n_priors) == (6, 6, 1)
    assert (counts.n_rejected, counts.n_gated, counts.n_coasting) == (0, 0, 0)
    assert counts.first_rejected == ""
    # By the gate; of itself; to nobody; not a place; and a pose without a usable edge.
    jump = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 50.0]))
    refused: list[object] = [
        window.add_edge(4, edge(1, se3.normalize(known @ jump))),
        window.add_edge(3, edge(3, STEP)),
        window.add_edge(3, edge("nobody", STEP)),
        window.add_edge("nobody", edge(3, STEP)),
        window.add_prior(
            3, PositionPrior(position_world=place.position_world + 1e9, covariance=np.eye(3))
        ),
        window.add_prior("nobody", place),
    ]
    for answer in refused:
        assert isinstance(answer, Rejected)
        assert not answer
    estimate = window.add_pose(6, 6 * STEP_NS, [edge("nobody", STEP)], place)
    counts = window.counts
    assert (counts.n_poses, counts.n_edges, counts.n_priors) == (7, 6, 2)
    assert (counts.n_rejected, counts.n_gated, counts.n_coasting) == (7, 1, 0)
    assert counts.first_rejected == str(refused[0])
    assert [each.reference_id for each in estimate.rejected] == ["nobody"]
    window.add_pose(7, 7 * STEP_NS, [])
    assert window.counts.n_coasting == 1


def test_the_gate_of_a_late_edge_is_in_sigmas_of_what_it_and_the_window_know() -> None:
    # Translations of steps along one line add up: four steps, and the edge itself.
    step_sigma, loop_sigma = 0.01, 0.03
    straight = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    sigma = np.sqrt(4 * step_sigma**2 + loop_sigma**2)
    for n_sigmas, is_in in ((3.9, True), (4.1, False)):
        T = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 4.0 + n_sigmas * sigma]))
        window = SlidingWindow(WindowConfig(size=9, kernel="none", gate=4.0))
        window.add_pose(0, 0, [])
        for frame in range(1, 5):
            window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, straight, step_sigma)])
        answer = window.add_edge(4, edge(0, T, loop_sigma))
        assert isinstance(answer, Estimate) == is_in
        if isinstance(answer, Rejected):
            assert "4.1 sigma" in answer.reason
            assert "window.gate: 4" in answer.reason


def test_an_edge_that_sends_another_pose_away_is_refused_and_leaves_no_trace() -> None:
    window = walk(WindowConfig(size=9, kernel="none"), 5)
    before = window.poses()
    known = window.relative_pose(1, 4).T_reference_frame
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseGraph, "positions", lambda _: np.array([[0.0, 0, 0], [0, -1e12, 0]]))
        answer = window.add_edge(4, edge(1, known))
    assert isinstance(answer, Rejected)
    assert "diverged to 1e+12 m" in answer.reason
    assert (window.counts.n_restored, window.counts.n_edges) == (1, 4)
    for frame_id, T in window.poses().items():
        np.testing.assert_array_equal(T, before[frame_id])
    assert isinstance(window.add_edge(4, edge(1, known)), Estimate)


def test_all_late_measurements_are_polished_with_the_others() -> None:
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    loop = edge(0, se3.normalize(np.linalg.matrix_power(STEP, 4) @ se3.exp(np.full(6, 0.02))))
    assert isinstance(window.add_edge(4, loop), Estimate)
    place = PositionPrior(position_world=window.pose(2)[:3, 3] + 0.05, covariance=1e-4 * np.eye(3))
    assert isinstance(window.add_prior(2, place), Estimate)
    smoothed = window.finish()
    assert window.polish is not None
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
    sure = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), sure))
    for frame in range(1, 5):
        graph.add(gtsam.BetweenFactorPose3(frame - 1, frame, gtsam.Pose3(STEP), noise))
    graph.add(gtsam.BetweenFactorPose3(0, 4, gtsam.Pose3(loop.T_reference_frame), noise))
    position = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(3.55), position
    )
    graph.add(gtsam.GPSFactor(2, place.position_world, robust))
    for frame in range(5):
        values.insert(frame, gtsam.Pose3(np.linalg.matrix_power(STEP, frame)))
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    # The polish of the window is the same optimum, and its error the same sum.
    assert window.polish.error_after == pytest.approx(graph.error(optimum), rel=1e-4)
    assert window.polish.error_after > 1.0
    assert window.polish.as_json() == {
        "error_isam2": window.polish.error_before,
        "error": window.polish.error_after,
        "iterations": window.polish.n_iterations,
    }
    for frame, each in enumerate(smoothed):
        expected = optimum.atPose3(frame).matrix()
        np.testing.assert_allclose(each.T_world_cam, expected, atol=1e-4)


def test_where_cholesky_gives_up_the_polish_is_done_by_qr() -> None:
    window = walk(WindowConfig(size=None, kernel="none"), 5)
    place = PositionPrior(position_world=window.pose(4)[:3, 3] + 0.1, covariance=1e-4 * np.eye(3))
    assert isinstance(window.add_prior(4, place), Estimate)
    original, solvers = gtsam.LevenbergMarquardtOptimizer, []

    def picky(factors: Any, values: Any, parameters: Any) -> Any:
        solvers.append(parameters.getLinearSolverType())
        if solvers[-1] == "MULTIFRONTAL_CHOLESKY":
            raise RuntimeError("Indeterminant linear system detected")
        return original(factors, values, parameters)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam, "LevenbergMarquardtOptimizer", picky)
        finished = window.finish()
    assert solvers == ["MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR"]
    assert window.polish is not None
    assert window.polish.error_after < window.polish.error_before
    assert window.polish.n_iterations > 0
    assert [each.frame_id for each in finished] == list(range(5))
