"""Rigid fits to triples by singular values, and inliers by projected points."""

import numpy as np
import pytest

from gvo.kernels.consensus import find_inliers, fit_triples
from gvo.types import FloatArray
from tests.geometry.scenes import move, project, random_motion, random_points, seen_from
from tests.kernels.matches import PARAMETERS


def fit_plainly(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return T_a_b of one triple, or that of the identity rotation."""
    T, centred_a, centred_b = np.eye(4), a - a.mean(axis=0), b - b.mean(axis=0)
    cross = centred_a.T @ centred_b
    if np.isfinite(cross).all() and np.linalg.matrix_rank(cross, rtol=1e-6) == 2:
        U, _, Vt = np.linalg.svd(cross)
        T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = a.mean(axis=0) - T[:3, :3] @ b.mean(axis=0)
    return T


@pytest.mark.parametrize("n", [0, 1, 40])
def test_triples_are_fitted_as_by_singular_values(n: int) -> None:
    rng = np.random.default_rng(n)
    b = rng.normal(size=(n, 3, 3)) + 5.0 * rng.normal(size=(n, 1, 3))
    a = np.reshape([move(random_motion(rng, 1.0), each) for each in b], (n, 3, 3))
    a += rng.choice([0.0, 0.1, 3.0], (n, 1, 1)) * rng.normal(size=(n, 3, 3))
    b[10:12, 2] = 2.0 * b[10:12, 1] - b[10:12, 0]  # on a line
    a[12:13], a[13:14, 1, 2] = a[12:13, :1], np.nan
    a[14:15], b[14:15] = 1e-8 * a[14:15], 1e-8 * b[14:15]
    T, is_valid = np.full((n, 4, 4), 7.0), np.ones(n, np.bool_)
    fit_triples(a, b, T, is_valid)
    expected = np.reshape([fit_plainly(*each) for each in zip(a, b, strict=True)], (n, 4, 4))
    np.testing.assert_allclose(T, expected, rtol=1e-9, atol=1e-9)
    assert np.flatnonzero(~is_valid).tolist() == [10, 11, 12, 13][: max(n - 10, 0)]


@pytest.mark.parametrize("n", [0, 1, 50])
@pytest.mark.parametrize("m", [0, 1, 5])
@pytest.mark.parametrize("is_distance", [False, True])
def test_inliers_are_those_below_the_threshold(n: int, m: int, is_distance: bool) -> None:
    rng, threshold = np.random.default_rng(n), 0.2 if is_distance else 6.0
    motions = np.reshape([random_motion(rng, 0.003, 0.02) for _ in range(m)], (m, 4, 4))
    points = random_points(rng, n)
    points[3:5] = np.array([[0.1, 0.2, -3.0], [np.nan, 0.0, 4.0]])[: max(n - 3, 0)]
    current = points + 0.1 * rng.normal(size=(n, 3))
    uvd = project(points) + 2.0 * rng.normal(size=(n, 3))
    inliers = np.ones((m, n), np.bool_)
    find_inliers(motions, points, current, uvd, PARAMETERS, threshold, is_distance, inliers)
    for T, found in zip(motions, inliers, strict=True):
        seen = seen_from(T, points)
        errors = seen - current if is_distance else project(seen) - uvd
        is_near = np.linalg.norm(errors, axis=1) < threshold
        np.testing.assert_array_equal(found, is_near & (is_distance | (seen[:, 2] > 1e-3)))
    if m and n > 1:
        assert 0.1 < inliers.mean() < 0.9
