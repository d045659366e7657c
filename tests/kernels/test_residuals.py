"""Whitened residuals against the covariance that their docstring states."""

import numpy as np
import pytest

from gvo.kernels.residuals import square_residuals, write_factors
from gvo.types import FloatArray
from tests.geometry.scenes import project, random_motion, random_points, seen_from
from tests.kernels.matches import LOWER, PARAMETERS, by_reference, random_matches, whitening


def factors_of(T: FloatArray, points: FloatArray, *sigmas: FloatArray) -> FloatArray:
    factors = np.full((len(points), 6), 7.0)
    write_factors(T, points, *sigmas, PARAMETERS, factors)
    return factors


@pytest.mark.parametrize("n", [0, 1, 30])
def test_factors_are_those_of_the_inverse_covariances(n: int) -> None:
    rng = np.random.default_rng(n)
    T, points = random_motion(rng), random_points(rng, n)
    before, now = rng.uniform(0.1, 1.0, (n, 3)), rng.uniform(0.1, 1.0, (n, 3))
    found = factors_of(T, points, before, now)
    for k in range(n):
        J = by_reference(T, points[k])
        C = J @ np.diag(before[k] ** 2) @ J.T + np.diag(now[k] ** 2)
        expected = np.linalg.inv(np.linalg.cholesky(C))
        np.testing.assert_allclose(found[k], expected[LOWER], rtol=1e-9, atol=1e-12)


def test_noise_is_carried_from_a_depth_of_a_tenth_of_a_metre_on() -> None:
    # At rest what is predicted is what was measured: the variances of both frames add up.
    points = np.array([[0.02, 0.01, 0.1], [0.02, 0.01, 0.0999], [0.1, 0.2, -1.0], [0.1, 0.2, 0.0]])
    sigmas = np.full((4, 3), 0.3), np.full((4, 3), 0.4)
    found = factors_of(np.eye(4), points, *sigmas)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[0], [2.0, 0.0, 2.0, 0.0, 0.0, 2.0], atol=1e-12)
    assert np.all(np.abs(found[1:, 5] - 2.0) > 1e-3)


def test_an_unknown_point_or_sigma_spoils_its_own_factor_alone() -> None:
    rng = np.random.default_rng(0)
    points, sigmas = random_points(rng, 4), rng.uniform(0.1, 1.0, (2, 4, 3))
    whole = factors_of(np.eye(4), points, *sigmas)
    points[1], sigmas[1, 2] = np.nan, np.nan
    found = factors_of(np.eye(4), points, *sigmas)
    np.testing.assert_array_equal(found[[0, 3]], whole[[0, 3]])
    assert np.isnan(found[[1, 2], 0]).all()


@pytest.mark.parametrize("n", [0, 1, 30])
def test_squares_are_those_of_whitened_residuals(n: int) -> None:
    matches = random_matches(np.random.default_rng(n), n)
    found = np.full(n, 7.0)
    square_residuals(matches.T, *matches.arrays[:3], PARAMETERS, found)
    r = matches.uvd - project(seen_from(matches.T, matches.points))
    expected = [np.sum((whitening(matches.factors[k]) @ r[k]) ** 2) for k in range(n)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_is_behind_the_camera_or_unknown_is_infinitely_far_off() -> None:
    matches = random_matches(np.random.default_rng(1), 6)
    points, uvd = matches.points.copy(), matches.uvd.copy()
    points[:5, 2] = 1.001e-3, 0.999e-3, 0.0, -3.0, np.nan
    uvd[5] = np.nan
    found = np.empty(6)
    square_residuals(np.eye(4), points, uvd, matches.factors, PARAMETERS, found)
    assert np.isfinite(found[0])
    np.testing.assert_array_equal(found[1:], [np.inf, np.inf, np.inf, np.inf, np.nan])
