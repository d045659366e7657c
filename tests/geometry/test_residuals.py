"""Residuals of stereo matches: derivatives, whitening, weights, what lies behind the camera."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import (
    Linearization,
    StereoResiduals,
    pose_jacobian,
    source_jacobian,
)
from gvo.types import Failure, FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)
CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)


def project(point: FloatArray) -> FloatArray:
    x, y, z = point
    return np.array([500 * x / z + 320, 480 * y / z + 240, 100 / z])


def unproject(uvd: FloatArray) -> FloatArray:
    z = 100 / uvd[2]
    return np.array([(uvd[0] - 320) * z / 500, (uvd[1] - 240) * z / 480, z])


def motion(rng: np.random.Generator) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix()
    T[:3, 3] = 0.2 * rng.normal(size=3)
    return T


def random_matches(rng: np.random.Generator, T: FloatArray, n: int) -> Correspondences:
    source = rng.uniform([-2, -1.5, 3], [2, 1.5, 9], size=(n, 3))
    target = source @ T[:3, :3].T + T[:3, 3]
    uvd = np.array([project(point) for point in target]) + rng.normal(size=(n, 3))
    return Correspondences(
        source_points=source,
        target_points=target,
        source_uvd=np.array([project(point) for point in source]),
        target_uvd=uvd,
        source_sigmas=rng.uniform(0.0, 1.0, size=(n, 3)),
        target_sigmas=rng.uniform(0.1, 1.0, size=(n, 3)),
    )


def linearize(residuals: StereoResiduals, T: FloatArray) -> Linearization:
    at = residuals.linearize(T)
    assert isinstance(at, Linearization)
    return at


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_the_derivatives_by_the_pose_are_the_numerical_ones(seed: int) -> None:
    point = np.random.default_rng(seed).uniform([-2, -2, 1], [2, 2, 9])

    def perturbed(xi: FloatArray) -> FloatArray:
        return project(Rotation.from_rotvec(xi[:3]).as_matrix() @ point + xi[3:])

    expected = approx_fprime(np.zeros(6), perturbed, 1e-7)
    J = pose_jacobian(point[:, np.newaxis], CAMERA)[..., 0].T
    np.testing.assert_allclose(J, expected, atol=5e-3)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_the_derivatives_by_the_source_are_the_numerical_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, point = motion(rng), rng.uniform([-2, -2, 2], [2, 2, 9])

    def predicted(uvd: FloatArray) -> FloatArray:
        return project(T[:3, :3] @ unproject(uvd) + T[:3, 3])

    expected = approx_fprime(project(point), predicted, 1e-6)
    J = source_jacobian(T, point[:, np.newaxis], CAMERA)[..., 0].T
    np.testing.assert_allclose(J, expected, rtol=1e-3, atol=1e-4)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_normal_equations_are_those_of_the_inverse_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = motion(rng)
    matches = random_matches(rng, T, 9)
    at = linearize(StereoResiduals.of(T, matches, CAMERA, huber=1.5), T)
    H, g = np.zeros((6, 6)), np.zeros(6)
    for i in range(9):
        point = T[:3, :3] @ matches.source_points[i] + T[:3, 3]
        J_source = source_jacobian(T, matches.source_points[i][:, np.newaxis], CAMERA)[..., 0].T
        covariance = J_source @ np.diag(matches.source_sigmas[i] ** 2) @ J_source.T
        covariance += np.diag(matches.target_sigmas[i] ** 2)
        r = matches.target_uvd[i] - project(point)
        length = np.sqrt(r @ np.linalg.solve(covariance, r))
        weighted = min(1.0, 1.5 / length) * np.linalg.inv(covariance)
        J = pose_jacobian(point[:, np.newaxis], CAMERA)[..., 0].T
        H += J.T @ weighted @ J
        g += J.T @ weighted @ r
    np.testing.assert_allclose(at.H, H, rtol=1e-7, atol=1e-7 * np.abs(H).max())
    np.testing.assert_allclose(at.g, g, rtol=1e-7, atol=1e-7 * np.abs(g).max())
    np.testing.assert_allclose(at.scores().sum(axis=1), at.g, rtol=1e-7, atol=1e-6)


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_a_gradient_has_new_residuals_and_weights_and_the_derivatives_it_is_given(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    T = motion(rng)
    residuals = StereoResiduals.of(T, random_matches(rng, T, 9), CAMERA, huber=1.5)
    here = linearize(residuals, T)
    near = linearize(residuals, se3.exp(0.01 * rng.normal(size=6)) @ T)
    J = near.J / near.roots * here.roots
    expected = np.einsum("kin,in->k", J, here.r)
    for at, g in ((here, here.g), (near, expected)):
        found = residuals.gradient(T, at)
        assert not isinstance(found, Failure)
        np.testing.assert_allclose(found, g, rtol=1e-9, atol=1e-9)


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_the_gate_counts_sigmas_of_the_residual(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = motion(rng)
    residuals = StereoResiduals.of(T, random_matches(rng, T, 30), CAMERA, huber=1e9)
    lengths = np.linalg.norm(linearize(residuals, T).r, axis=0)
    gate = float(np.median(lengths)) + 1e-6
    np.testing.assert_array_equal(residuals.within(T, gate), lengths < gate)
    chosen = lengths < gate
    np.testing.assert_array_equal(
        linearize(residuals.select(chosen), T).r, linearize(residuals, T).r[:, chosen]
    )


@settings(deadline=None, max_examples=15)
@given(seed=seeds)
def test_settled_points_are_the_likeliest_for_both_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = motion(rng)
    n = 5
    source = rng.uniform([-2, -1.5, 3], [2, 1.5, 9], size=(n, 3))
    seen = np.array([project(T[:3, :3] @ point + T[:3, 3]) for point in source])
    matches = Correspondences(
        source_points=source,
        target_points=source @ T[:3, :3].T + T[:3, 3],
        source_uvd=np.array([project(point) for point in source]),
        # Small against the curvature of the projection: one linear step is the whole way.
        target_uvd=seen + 1e-3 * rng.normal(size=(n, 3)),
        source_sigmas=rng.uniform(0.3, 1.0, size=(n, 3)),
        target_sigmas=rng.uniform(0.3, 1.0, size=(n, 3)),
    )
    residuals = StereoResiduals.of(T, matches, CAMERA, huber=1e9)
    settled = residuals.settled_points(T, linearize(residuals, T)).T
    for i in range(n):

        def misfit(point: FloatArray, i: int = i) -> FloatArray:
            here = (project(point) - matches.source_uvd[i]) / matches.source_sigmas[i]
            there = project(T[:3, :3] @ point + T[:3, 3]) - matches.target_uvd[i]
            return 1e4 * np.concatenate([here, there / matches.target_sigmas[i]])

        best = least_squares(misfit, source[i], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        moved = float(np.linalg.norm(best - source[i]))
        np.testing.assert_allclose(settled[i], best, atol=1e-2 * moved)


def test_a_settled_point_goes_to_at_most_twice_its_distance() -> None:
    # A disparity of 10 px that the target says is -5: no point lies there.
    point = np.array([[0.5, -0.4, 10.0]])
    seen = np.array([project(point[0])])
    for sigma, expected in ((0.1, 20.0), (10.0, None)):
        matches = Correspondences(
            source_points=point,
            target_points=point,
            source_uvd=seen,
            target_uvd=seen - [0.0, 0.0, 15.0],
            source_sigmas=np.full((1, 3), 1.0),
            target_sigmas=np.full((1, 3), sigma),
        )
        residuals = StereoResiduals.of(np.eye(4), matches, CAMERA, huber=1e9)
        (settled,) = residuals.settled_points(np.eye(4), linearize(residuals, np.eye(4))).T
        if expected is None:
            expected = 100.0 / (10.0 - 15.0 / 101.0)  # the weighted mean of both disparities
        np.testing.assert_allclose(settled, point[0] * expected / 10.0, rtol=1e-9)


def test_noise_is_carried_for_points_well_in_front_alone() -> None:
    T = np.eye(4)
    points = np.array([[0.2, 0.2, 0.2], [0.1, 0.1, 0.1], [0.11, 0.09, -5.0]])
    J = source_jacobian(T, points, CAMERA)
    assert np.isfinite(J).all()
    np.testing.assert_allclose(J[..., 0].T, np.eye(3), atol=1e-12)
    assert not np.allclose(J[..., 1].T, np.eye(3), atol=0.1)
    assert not np.allclose(J[..., 2].T, np.eye(3), atol=0.1)
    # What lies a millimetre in front has a derivative by the pose, what lies nearer has none.
    for depth, is_good in ((1.01e-3, True), (0.99e-3, False)):
        near = np.array([[0.0, 0.0, depth]])
        ones = np.ones((1, 3))
        matches = Correspondences(
            source_points=near,
            target_points=near,
            source_uvd=np.array([project(near[0])]),
            target_uvd=np.array([project(near[0])]),
            source_sigmas=ones,
            target_sigmas=ones,
        )
        residuals = StereoResiduals.of(T, matches, CAMERA, huber=2.0)
        assert isinstance(residuals.linearize(T), Linearization) == is_good
        assert residuals.within(T, 1e9).tolist() == [is_good]


def test_points_behind_the_camera_are_in_no_gate_and_have_no_derivative() -> None:
    rng = np.random.default_rng(0)
    matches = random_matches(rng, np.eye(4), 30)
    back = se3.make_transform(np.eye(3), np.array([0.0, 0.0, -6.0]))
    is_behind = matches.source_points[:, 2] < 6.0
    assert 0 < is_behind.sum() < 30
    residuals = StereoResiduals.of(back, matches, CAMERA, huber=2.8)
    assert np.isfinite(residuals.columns).all()
    np.testing.assert_array_equal(residuals.within(back, 1e9), ~is_behind)
    assert isinstance(residuals.linearize(back), Failure)
    near = linearize(residuals, np.eye(4))
    assert isinstance(residuals.gradient(back, near), Failure)
