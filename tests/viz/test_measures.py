"""What the report measures, against other routes."""

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.trajectory.evaluation import evaluate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.measures import compare, drift
from tests.trajectory.paths import circle

COVARIANCE = np.diag([1e-4, 4e-4, 1e-4, 1e-2, 1e-2, 9e-2])


def disturbed(truth: Trajectory, covariance: FloatArray, *, stated: float = 1.0) -> Trajectory:
    n = len(truth)
    noise = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance, size=n)
    noise[0] = 0.0
    covariances = np.tile(stated * covariance, (n, 1, 1))
    covariances[0] = 1e-10 * np.eye(6)
    # the truth is the estimate, perturbed from the right
    T = truth.T_world_frame @ se3.invert(se3.exp(noise))
    return Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=T, covariances=covariances)


def test_errors_agree_with_the_evaluation() -> None:
    truth = circle(300)
    estimate = disturbed(truth, COVARIANCE)
    comparison = compare(truth, estimate, name="raw", align="se3")
    evaluation = evaluate(truth, estimate, name="raw", segments=[20.0], segment_step=1)
    np.testing.assert_allclose(comparison.errors_m, evaluation.errors_m)
    found = drift(comparison, [20.0])
    assert found is not None
    assert evaluation.t_pct == pytest.approx(found.translations_pct[0])
    assert evaluation.r_deg_per_100m == pytest.approx(100.0 * found.rotations_deg_per_m[0])
    assert drift(comparison, [1e6]) is None


def test_rotation_errors_are_of_the_rotation_since_the_first_pose() -> None:
    truth = circle(50)
    turned = truth.T_world_frame.copy()
    turned[25:] = turned[25:] @ se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=turned)
    errors = compare(
        truth, estimate.moved(truth.T_world_frame[7]), name="a", align="se3"
    ).errors_rad
    assert errors is not None
    np.testing.assert_allclose(errors, [0.0] * 25 + [0.1] * 25, atol=1e-6)
