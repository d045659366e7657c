"""The same measurements smoothed in three ways, against GTSAM's own count of the error."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from gvo.backend.comparison import MeasurementLog, Smoothing
from gvo.backend.window import SlidingWindow
from gvo.config import Kernel, WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PositionPrior

N = 60
STEP_NS = 100_000_000
SIGMA = 0.02
HUBER = 3.55
POSITION_SIGMA = 0.5


def true_pose(frame: int) -> FloatArray:
    """Return a pose on a circle, come round twice after N steps."""
    step = se3.exp(np.array([0.0, 4.0 * np.pi / N, 0.02, 0.1, 0.0, 0.5]))
    return se3.normalize(np.linalg.matrix_power(step, frame))


def measured(reference: int, frame: int, sigma: float) -> Edge:
    rng = np.random.default_rng([reference, frame])
    T = se3.invert(true_pose(reference)) @ true_pose(frame) @ se3.exp(sigma * rng.normal(size=6))
    return Edge(
        reference_id=reference,
        T_reference_frame=se3.normalize(T),
        covariance=sigma**2 * np.eye(6),
    )


@cache
def edges_of(frame: int) -> list[Edge]:
    """Return edges to recent poses and to the keyframe 0; one in five is far off, not gross."""
    references = sorted({0, *range(max(frame - 2, 0), frame)})
    edges = [measured(reference, frame, SIGMA) for reference in references if frame > reference]
    if frame % 5 == 0 and frame > 0:
        slip = se3.exp(np.array([0.0, 0.0, 0.0, 8 * SIGMA, 0.0, 0.0]))
        T = se3.normalize(edges[-1].T_reference_frame @ slip)
        edges[-1] = replace(edges[-1], T_reference_frame=T)
    return edges


def prior_of(frame: int) -> PositionPrior | None:
    if frame != N // 2:
        return None
    return PositionPrior(
        position_world=true_pose(frame)[:3, 3] + 0.1,
        covariance=POSITION_SIGMA**2 * np.eye(3),
        kernel="none",
    )


@cache
def run(kernel: Kernel) -> tuple[list[Estimate], MeasurementLog]:
    """Return what a window of five poses and one keyframe smoothed, and its log."""
    log = MeasurementLog()
    window = SlidingWindow(WindowConfig(size=5, kernel=kernel, gate=None), log=log)
    for frame in range(N):
        window.add_pose(frame, frame * STEP_NS, edges_of(frame), prior_of(frame))
        if frame == 0:
            window.keep(0)
        if frame % 10 == 9:
            window.add_edge(frame, measured(frame - 3, frame, SIGMA))
    assert window.counts.n_rejected == 0
    return window.finish(), log


@cache
def compared(kernel: Kernel) -> dict[str, Smoothing]:
    smoothed, log = run(kernel)
    return {row.name: row for row in log.compare(smoothed)}


def graph_of(kernel: Kernel) -> gtsam.NonlinearFactorGraph:
    """Return all measurements in GTSAM's own words."""
    graph = gtsam.NonlinearFactorGraph()
    start = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), start))
    gaussian = gtsam.noiseModel.Isotropic.Sigma(6, SIGMA)
    estimator = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    robust = gtsam.noiseModel.Robust.Create(estimator, gaussian)
    noise = robust if kernel == "huber" else gaussian
    measurements = [(frame, edge) for frame in range(N) for edge in edges_of(frame)]
    late = [(frame, measured(frame - 3, frame, SIGMA)) for frame in range(9, N, 10)]
    for frame, edge in measurements + late:
        assert isinstance(edge.reference_id, int)
        T = gtsam.Pose3(edge.T_reference_frame)
        graph.add(gtsam.BetweenFactorPose3(edge.reference_id, frame, T, noise))
    prior = prior_of(N // 2)
    assert prior is not None
    sigma = gtsam.noiseModel.Isotropic.Sigma(3, POSITION_SIGMA)
    graph.add(gtsam.GPSFactor(N // 2, prior.position_world, sigma))
    return graph


def error_of(kernel: Kernel, poses: Mapping[FrameId, FloatArray]) -> float:
    values = gtsam.Values()
    for frame, T in poses.items():
        assert isinstance(frame, int)
        values.insert(frame, gtsam.Pose3(T))
    return float(graph_of(kernel).error(values))


KERNELS: list[Kernel] = ["none", "huber"]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["window", "full iSAM2", "batch LM"])
def test_the_error_of_each_smoothing_is_that_of_its_poses(name: str, kernel: Kernel) -> None:
    row = compared(kernel)[name]
    assert list(row.poses) == list(range(N))
    assert row.error == pytest.approx(error_of(kernel, row.poses), rel=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_poses_of_the_window_are_those_that_it_gave(kernel: Kernel) -> None:
    smoothed, _ = run(kernel)
    row = compared(kernel)["window"]
    for estimate in smoothed:
        np.testing.assert_allclose(row.poses[estimate.frame_id], estimate.T_world_cam, atol=1e-12)
    own = {estimate.frame_id: estimate.T_world_cam for estimate in smoothed}
    assert row.error == pytest.approx(error_of(kernel, own), rel=1e-6)
    # Nothing is judged here but what was handed in: the true poses are as good as any.
    true = [
        replace(each, T_world_cam=true_pose(round(each.stamp_ns / STEP_NS))) for each in smoothed
    ]
    (judged,) = (each for each in run(kernel)[1].compare(true) if each.name == "window")
    expected = error_of(kernel, {frame: true_pose(frame) for frame in range(N)})
    assert judged.error == pytest.approx(expected, rel=1e-6)
    assert judged.error > 1.01 * row.error


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_batch_has_the_least_error_and_a_window_has_its_price(kernel: Kernel) -> None:
    errors = {name: row.error for name, row in compared(kernel).items()}
    least = errors["batch LM"]
    assert least <= errors["full iSAM2"]
    assert least < errors["window"] * (1 - 1e-4)
    values = gtsam.Values()
    for frame in range(N):
        values.insert(frame, gtsam.Pose3(true_pose(frame)))
    graph = graph_of(kernel)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert least == pytest.approx(graph.error(optimum), rel=1e-3)
    assert least <= graph.error(optimum) * (1 + 1e-6)
