"""Residuals of stereo matches: derivatives, whitening, weights, what lies behind the camera."""

import numpy as np
from hypothesis import given
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import Linearization, StereoResiduals, pose_jacobian, reference_jacobian
from gvo.types import Failure, FloatArray
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


def linearize(residuals: StereoResiduals, T: FloatArray) -> Linearization:
    at = residuals.linearize(T)
    assert isinstance(at, Linearization)
    return at


@given(seed=seeds)
def test_the_derivatives_by_the_pose_are_the_numerical_ones(seed: int) -> None:
    point = np.random.default_rng(seed).uniform([-2, -2, 1], [2, 2, 9])

    def perturbed(xi: FloatArray) -> FloatArray:
        return project(Rotation.from_rotvec(-xi[:3]).as_matrix() @ (point - xi[3:]))

    expected = approx_fprime(np.zeros(6), perturbed, 1e-7)
    J = pose_jacobian(point[:, np.newaxis], CAMERA)[..., 0].T
    np.testing.assert_allclose(J, expected, atol=5e-3)


@given(seed=seeds)
def test_the_derivatives_by_the_reference_are_the_numerical_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, point = random_motion(rng), rng.uniform([-2, -2, 2], [2, 2, 9])

    def predicted(uvd: FloatArray) -> FloatArray:
        return project(seen_from(T, unproject(uvd)))

    expected = approx_fprime(project(point), predicted, 1e-6)
    J = reference_jacobian(T, point[:, np.newaxis], CAMERA)[..., 0].T
    np.testing.assert_allclose(J, expected, rtol=1e-3, atol=1e-4)


@given(seed=seeds)
def test_normal_equations_are_those_of_the_inverse_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    matches = random_matches(rng, T, 9)
    at = linearize(StereoResiduals.of(T, matches, CAMERA, huber=1.5), T)
    H, g = np.zeros((6, 6)), np.zeros(6)
    for i in range(9):
        point = seen_from(T, matches.reference_points[i])
        J_reference = reference_jacobian(T, matches.reference_points[i][:, np.newaxis], CAMERA)[
            ..., 0
        ].T
        covariance = J_reference @ np.diag(matches.reference_sigmas[i] ** 2) @ J_reference.T
        covariance += np.diag(matches.current_sigmas[i] ** 2)
        r = matches.current_uvd[i] - project(point)
        length = np.sqrt(r @ np.linalg.solve(covariance, r))
        weighted = min(1.0, 1.5 / length) * np.linalg.inv(covariance)
        J = pose_jacobian(point[:, np.newaxis], CAMERA)[..., 0].T
        H += J.T @ weighted @ J
        g += J.T @ weighted @ r
    np.testing.assert_allclose(at.H, H, rtol=1e-7, atol=1e-7 * np.abs(H).max())
    np.testing.assert_allclose(at.g, g, rtol=1e-7, atol=1e-7 * np.abs(g).max())
    np.testing.assert_allclose(at.scores().sum(axis=1), at.g, rtol=1e-7, atol=1e-6)


@given(seed=seeds)
def test_the_gate_counts_sigmas_of_the_residual(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    residuals = StereoResiduals.of(T, random_matches(rng, T, 30), CAMERA, huber=1e9)
    lengths = np.linalg.norm(linearize(residuals, T).r, axis=0)
    gate = float(np.median(lengths)) + 1e-6
    np.testing.assert_array_equal(residuals.within(T, gate), lengths < gate)
    chosen = lengths < gate
    np.testing.assert_array_equal(
        linearize(residuals.select(chosen), T).r, linearize(residuals, T).r[:, chosen]
    )


def test_noise_is_carried_for_points_well_in_front_alone() -> None:
    T = np.eye(4)
    points = np.array([[0.2, 0.2, 0.2], [0.1, 0.1, 0.1], [0.11, 0.09, -5.0]])
    J = reference_jacobian(T, points, CAMERA)
    assert np.isfinite(J).all()
    np.testing.assert_allclose(J[..., 0].T, np.eye(3), atol=1e-12)
    assert not np.allclose(J[..., 1].T, np.eye(3), atol=0.1)
    assert not np.allclose(J[..., 2].T, np.eye(3), atol=0.1)
    # What lies a millimetre in front has a derivative by the pose, what lies nearer has none.
    for depth, is_good in ((1.01e-3, True), (0.99e-3, False)):
        near = np.array([[0.0, 0.0, depth]])
        residuals = StereoResiduals.of(T, matched(near, near), CAMERA, huber=2.0)
        assert isinstance(residuals.linearize(T), Linearization) == is_good
        assert residuals.within(T, 1e9).tolist() == [is_good]


def test_points_behind_the_camera_are_in_no_gate_and_have_no_derivative() -> None:
    matches = random_matches(np.random.default_rng(0), np.eye(4), 30)
    ahead = se3.make_transform(np.eye(3), np.array([0.0, 0.0, 6.0]))
    is_behind = matches.reference_points[:, 2] < 6.0
    assert 0 < is_behind.sum() < 30
    residuals = StereoResiduals.of(ahead, matches, CAMERA, huber=2.8)
    assert np.isfinite(residuals.columns).all()
    np.testing.assert_array_equal(residuals.within(ahead, 1e9), ~is_behind)
    assert isinstance(residuals.linearize(ahead), Failure)
