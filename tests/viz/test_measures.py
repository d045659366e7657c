"""What the report measures, against other routes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from gvo.geometry import se3
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, chi2_bound, evaluate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.measures import chi2_density, compare, drift, drift_lengths
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


@given(st.floats(0.1, 800.0))
def test_segments_suit_the_path_in_round_numbers(path_m: float) -> None:
    lengths = drift_lengths(path_m)
    assert 4 <= len(lengths) <= 12
    assert 0.4 * path_m < lengths[-1] <= 0.8 * path_m * (1 + 1e-9)
    np.testing.assert_allclose(np.diff(lengths), lengths[0], rtol=1e-6)
    assert all(len(f"{length:.10g}".replace(".", "").strip("0")) <= 3 for length in lengths)


def test_long_paths_take_the_standard_segments_and_no_path_none() -> None:
    assert drift_lengths(1200.0) == KITTI_SEGMENTS_M
    assert drift_lengths(0.01) == ()


def test_chi_square_agrees_with_scipy() -> None:
    for share in (0.025, 0.5, 0.95, 0.975):
        assert chi2_bound(share) == pytest.approx(chi2.ppf(share, 6))
    values = np.linspace(0.0, 40.0, 100)
    np.testing.assert_allclose(chi2_density(values), chi2.pdf(values, 6), atol=1e-12)
