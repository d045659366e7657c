"""Residuals of stereo matches: whitening, gates, what lies behind the camera."""

import numpy as np
import pytest
from hypothesis import given
from scipy.optimize import approx_fprime

from gvo.geometry import se3
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import StereoResiduals
from gvo.types import FloatArray
from tests.geometry.scenes import (
    CAMERA,
    matched,
    project,
    random_motion,
    random_points,
    seeds,
    seen_from,
    unproject,
)


def random_matches(rng: np.random.Generator, T: FloatArray, n: int) -> Correspondences:
    reference = random_points(rng, n)
    current = seen_from(T, reference)
    return matched(
        reference,
        current,
        current_uvd=project(current) + rng.normal(size=(n, 3)),
        reference_sigmas=rng.uniform(0.0, 1.0, size=(n, 3)),
        current_sigmas=rng.uniform(0.1, 1.0, size=(n, 3)),
    )


def covariance_of(T: FloatArray, matches: Correspondences, i: int) -> FloatArray:
    """Return that of a residual, the noise of the reference carried by numerical derivatives."""

    def predicted(uvd: FloatArray) -> FloatArray:
        return project(seen_from(T, unproject(uvd)))

    J = approx_fprime(project(matches.reference_points[i]), predicted, 1e-6)
    of_reference = J @ np.diag(matches.reference_sigmas[i] ** 2) @ J.T
    return np.asarray(of_reference + np.diag(matches.current_sigmas[i] ** 2))


@given(seed=seeds)
def test_lengths_are_those_of_the_inverse_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    matches = random_matches(rng, T, 9)
    expected = np.empty(9)
    for i, point in enumerate(seen_from(T, matches.reference_points)):
        r = matches.current_uvd[i] - project(point)
        expected[i] = r @ np.linalg.solve(covariance_of(T, matches, i), r)
    residuals = StereoResiduals.of(T, matches, CAMERA)
    np.testing.assert_allclose(residuals.squared(T), expected, rtol=2e-3)
    gate = float(np.median(np.sqrt(expected))) * 1.01
    np.testing.assert_array_equal(residuals.within(T, gate), residuals.squared(T) < gate**2)


def test_noise_is_carried_for_points_well_in_front_alone() -> None:
    # Of the reference only: at rest the factor is the inverse of its sigmas, at whatever depth.
    points = np.array([[0.2, 0.2, 0.2], [0.1, 0.1, 0.1], [0.11, 0.09, 0.09], [0.11, 0.09, -5.0]])
    matches = matched(points, points, reference_sigmas=0.5, current_sigmas=1e-6)
    factors = StereoResiduals.of(np.eye(4), matches, CAMERA).factors
    assert np.isfinite(factors).all()
    for i, is_carried in enumerate((True, True, False, False)):
        is_that = np.allclose(factors[i], [2.0, 0.0, 2.0, 0.0, 0.0, 2.0], atol=1e-5)
        assert is_that == is_carried


@pytest.mark.parametrize(("depth", "is_good"), [(1.01e-3, True), (0.99e-3, False)])
def test_what_is_nearer_than_a_millimetre_is_behind(depth: float, is_good: bool) -> None:
    near = np.array([[0.0, 0.0, depth]])
    residuals = StereoResiduals.of(np.eye(4), matched(near, near), CAMERA)
    assert residuals.within(np.eye(4), 1e9).tolist() == [is_good]


def test_points_behind_the_camera_are_in_no_gate() -> None:
    matches = random_matches(np.random.default_rng(0), np.eye(4), 30)
    ahead = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 6.0]))
    is_behind = matches.reference_points[:, 2] < 6.0
    assert 0 < is_behind.sum() < 30
    residuals = StereoResiduals.of(ahead, matches, CAMERA, huber=2.8)
    assert np.isfinite(residuals.factors).all()
    np.testing.assert_array_equal(residuals.within(ahead, 1e9), ~is_behind)
