"""Rigid transforms against scipy, GTSAM and matrix exponentials."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.special import bernoulli

from gvo.geometry import se3
from gvo.types import FloatArray
from tests.geometry.scenes import seeds

# From exactly zero over the change of formulas to just below half a turn.
angles = st.one_of(
    st.just(0.0),
    st.floats(min_value=-14.0, max_value=0.3).map(lambda exponent: 10.0**exponent),
    st.floats(min_value=1e-9, max_value=1e-2).map(lambda rest: np.pi - rest),
)


def random_direction(rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))


def twist(angle: float, seed: int, *, length: float = 3.0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.concatenate([angle * random_direction(rng), length * rng.normal(size=3)])


def generator(xi: FloatArray) -> FloatArray:
    """Return the 4x4 matrix of the Lie algebra, written down element by element."""
    rx, ry, rz, tx, ty, tz = xi
    return np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]])


@given(angle=angles, seed=seeds)
def test_exp_is_the_matrix_exponential(angle: float, seed: int) -> None:
    xi = twist(angle, seed)
    np.testing.assert_allclose(se3.exp(xi), expm(generator(xi)), rtol=0, atol=1e-12)


@given(angle=angles, seed=seeds)
def test_log_undoes_exp_from_zero_to_half_a_turn(angle: float, seed: int) -> None:
    xi = twist(angle, seed)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=0, atol=1e-12)


@given(seed=seeds)
def test_exp_undoes_log_at_half_a_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(np.pi * random_direction(rng)).as_matrix()
    T = se3.make_transform(R, rng.normal(size=3))
    xi = se3.log(T)
    assert np.linalg.norm(xi[:3]) == pytest.approx(np.pi)
    np.testing.assert_allclose(se3.exp(xi), T, atol=1e-7)


@given(angle=st.one_of(angles, st.just(np.pi)), seed=seeds)
def test_quaternions_are_those_of_scipy(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec([angle * random_direction(rng) for _ in range(6)])
    q = se3.quaternions(rotations.as_matrix().reshape(2, 3, 3, 3))
    assert q.shape == (2, 3, 4)
    assert np.all(q[..., 3] >= 0.0)
    theirs = rotations.as_quat(canonical=True).reshape(2, 3, 4)
    cosines = np.abs(np.sum(q * theirs, axis=-1))  # at half a turn the sign is anyone's
    np.testing.assert_allclose(cosines, 1.0, atol=1e-14)
    if angle < 3.0:
        np.testing.assert_allclose(q, theirs, rtol=0, atol=1e-15)


@given(angle=st.floats(min_value=0.0, max_value=3.0), seed=seeds)
def test_order_and_side_of_twists_are_those_of_gtsam(angle: float, seed: int) -> None:
    xi = twist(angle, seed)
    theirs = gtsam.Pose3.Expmap(xi)
    np.testing.assert_allclose(se3.exp(xi), theirs.matrix(), atol=1e-12)
    np.testing.assert_allclose(se3.log(theirs.matrix()), gtsam.Pose3.Logmap(theirs), atol=1e-9)
    np.testing.assert_allclose(se3.adjoint(theirs.matrix()), theirs.AdjointMap(), atol=1e-12)


@given(seed=seeds)
def test_the_adjoint_moves_a_perturbation_to_the_other_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, xi = se3.exp(rng.normal(size=6)), rng.normal(size=6)
    np.testing.assert_allclose(
        T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, rtol=1e-9, atol=1e-9
    )


@given(seed=seeds)
def test_batches_equal_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(2, 3, 6))
    T = se3.exp(xi)
    points = rng.normal(size=(2, 3, 5, 3))
    assert T.shape == (2, 3, 4, 4)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(T[index], se3.exp(xi[index]), atol=1e-15)
        np.testing.assert_allclose(se3.log(T)[index], se3.log(T[index]), atol=1e-14)
        np.testing.assert_allclose(se3.invert(T)[index], np.linalg.inv(T[index]), atol=1e-12)
        np.testing.assert_allclose(se3.adjoint(T)[index], se3.adjoint(T[index]), atol=1e-15)
        np.testing.assert_allclose(se3.rotation_angle(T)[index], se3.rotation_angle(T[index]))
        homogeneous = np.column_stack([points[index], np.ones(5)]) @ T[index].T
        np.testing.assert_allclose(
            se3.transform_points(T, points)[index], homogeneous[:, :3], atol=1e-12
        )


def test_skew_is_the_cross_product() -> None:
    v, w = np.random.default_rng(0).normal(size=(2, 7, 3))
    np.testing.assert_allclose((se3.skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-14)


@given(angle=angles, seed=seeds)
def test_the_rotation_angle_is_the_length_of_the_rotation_vector(angle: float, seed: int) -> None:
    T = se3.exp(twist(angle, seed))
    assert float(se3.rotation_angle(T)) == pytest.approx(angle, abs=2e-8)


@given(seed=seeds)
def test_normalizing_gives_the_nearest_rotation_and_keeps_the_translation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    spoilt = T.copy()
    spoilt[:3, :3] += 0.1 * rng.normal(size=(3, 3))
    normal = se3.normalize(spoilt)
    # scipy solves the same problem (orthogonal Procrustes) by another way.
    nearest = Rotation.align_vectors(spoilt[:3, :3].T, np.eye(3))[0].as_matrix()
    np.testing.assert_allclose(normal[:3, :3], nearest, atol=1e-7)
    np.testing.assert_allclose(normal[:3, :3] @ normal[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(normal[:, 3], T[:, 3])


def test_a_reflection_is_normalized_to_a_rotation() -> None:
    assert np.linalg.det(se3.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)
    batch = se3.nearest_rotation(np.stack([np.diag([2.0, 3.0, -1.0]), np.eye(3)]))
    np.testing.assert_allclose(batch, np.stack([np.eye(3), np.eye(3)]), atol=1e-12)


def random_covariance(rng: np.random.Generator, sigma: float) -> FloatArray:
    factor = sigma * rng.normal(size=(6, 6))
    return np.asarray(factor @ factor.T)


def test_a_transported_covariance_is_that_of_the_transported_twists() -> None:
    rng = np.random.default_rng(6)
    T, twists = se3.exp(rng.normal(size=(3, 6))), rng.normal(size=(3, 6, 20))
    transported = np.stack([np.cov(each) for each in se3.adjoint(T) @ twists])
    covariances = np.stack([np.cov(each) for each in twists])
    np.testing.assert_allclose(se3.transport_covariance(covariances, T), transported, atol=1e-12)


def test_composed_covariance_is_that_of_sampled_compositions() -> None:
    rng = np.random.default_rng(5)
    T_a_b, T_b_c = se3.exp(rng.normal(size=(2, 6)))
    C_a_b, C_b_c = random_covariance(rng, 1e-3), random_covariance(rng, 1e-3)
    n = 40_000
    noisy_a_b = T_a_b @ se3.exp(rng.multivariate_normal(np.zeros(6), C_a_b, n))
    noisy_b_c = T_b_c @ se3.exp(rng.multivariate_normal(np.zeros(6), C_b_c, n))
    errors = se3.log(np.linalg.inv(T_a_b @ T_b_c) @ noisy_a_b @ noisy_b_c)
    composed = se3.compose_covariance(C_a_b, T_b_c, C_b_c)
    np.testing.assert_array_equal(composed, composed.T)
    scale = np.sqrt(np.diag(composed))
    deviation = (np.cov(errors.T) - composed) / np.outer(scale, scale)
    assert np.abs(deviation).max() < 0.05


@settings(max_examples=10)
@given(seed=seeds)
def test_the_covariance_of_a_ros_message_is_that_of_the_twist_it_causes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, position = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    T = se3.make_transform(R, position)

    def twist_of(error: FloatArray) -> FloatArray:
        # REP 103 and geometry_msgs: position, then turns about the fixed axes of the parent.
        turned = Rotation.from_rotvec(error[3:]).as_matrix() @ R
        moved = gtsam.Pose3(gtsam.Rot3(turned), position + error[:3])
        return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(T).inverse().compose(moved)))

    J = approx_fprime(np.zeros(6), twist_of, 1e-7)
    of_message = random_covariance(rng, 1.0)
    found = se3.covariance_from_ros(of_message, R)
    np.testing.assert_allclose(found, J @ of_message @ J.T, atol=1e-4)
    batch = se3.covariance_from_ros(np.stack([of_message, np.eye(6)]), np.stack([R, np.eye(3)]))
    np.testing.assert_allclose(batch[0], found, atol=1e-12)
    np.testing.assert_array_equal(batch[1], np.eye(6))


# Below the change of formulas, digit by digit. With the axis in the x-z plane and the translation
# along x, each element of the translation is one term of its series alone.

small_angles = st.floats(min_value=-12.0, max_value=-0.001).map(lambda exponent: 10.0**exponent)


@given(share=small_angles)
def test_small_turns_are_those_of_the_power_series_to_the_last_digits(share: float) -> None:
    angle = 1e-5 * share
    p, q = 0.6 * angle, 0.8 * angle
    T = se3.exp(np.array([p, 0.0, q, 1.0, 0.0, 0.0]))
    b = 1 / 2 - angle**2 / 24 + angle**4 / 720
    c = 1 / 6 - angle**2 / 120 + angle**4 / 5040
    np.testing.assert_allclose(T[:3, 3], [1.0 - c * q * q, b * q, c * p * q], rtol=1e-14)
    # Off the diagonal of a turn about z stands its sine alone.
    turn = se3.exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(turn[[1, 0], [0, 1]], np.sin(angle) * np.array([1, -1]), rtol=4e-16)
    np.testing.assert_allclose(turn[0, 0], np.cos(angle), rtol=4e-16)


@given(share=small_angles)
def test_the_twist_of_a_small_turn_is_that_of_bernoullis_series(share: float) -> None:
    angle = 1e-4 * share
    p, q = 0.6 * angle, 0.8 * angle
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([p, 0.0, q]).as_matrix()
    T[:3, 3] = [1.0, 0.0, 0.0]
    B = bernoulli(6)
    c = B[2] / 2 - B[4] / 24 * angle**2 + B[6] / 720 * angle**4
    xi = se3.log(T)
    np.testing.assert_allclose(xi[[0, 2]], [p, q], rtol=1e-12)
    rx, rz = xi[[0, 2]]
    np.testing.assert_allclose(xi[3:], [1.0 - c * rz * rz, -0.5 * rz, c * rx * rz], rtol=3e-14)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_any_number_of_transforms_goes_through_every_function(shape: tuple[int, ...]) -> None:
    T = se3.exp(np.random.default_rng(1).normal(size=(*shape, 6)))
    for found, tail in (
        (T, (4, 4)),
        (se3.log(T), (6,)),
        (se3.invert(T), (4, 4)),
        (se3.adjoint(T), (6, 6)),
        (se3.normalize(T), (4, 4)),
        (se3.rotation_angle(T), ()),
        (se3.covariance_from_ros(se3.adjoint(T), T[..., :3, :3]), (6, 6)),
    ):
        assert found.shape == (*shape, *tail)


@given(seeds)
def test_mahalanobis_lengths_are_those_of_whitened_twists(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(3, 6, 6)) + 3.0 * np.eye(6)
    whitened = rng.normal(size=(3, 6))
    twists = (factors @ whitened[..., np.newaxis])[..., 0]
    covariances = factors @ np.swapaxes(factors, 1, 2)
    squares = np.sum(whitened**2, axis=1)
    np.testing.assert_allclose(se3.mahalanobis(twists, covariances), squares, rtol=1e-6)
    np.testing.assert_allclose(se3.mahalanobis(twists[1], covariances[1]), squares[1], rtol=1e-6)
