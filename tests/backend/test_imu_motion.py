"""Where an IMU says that it has moved to, and how sure that is, beside known motions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.backend.imu_buffer import ImuBuffer
from gvo.backend.imu_motion import Front, Preintegrator, step_covariance
from gvo.geometry.imu import Imu
from gvo.types import Edge, FloatArray
from tests.backend.imus import (
    EXACT,
    HAND,
    SAMPLES_HZ,
    STILL,
    UP,
    Hand,
    Sensor,
    adjoint,
    errors_of,
    ns,
    transform,
)

NO_BIAS = np.zeros(6)


def integrator(imu: Imu, hand: Hand, sensor: Sensor, *, end_s: float = 8.0) -> Preintegrator:
    buffer = ImuBuffer()
    buffer.add(sensor.measure(hand, end_s))
    return Preintegrator(imu, buffer)


def front_at(
    hand: Hand,
    time_s: float,
    covariance: Any = None,
    *,
    bias: FloatArray = NO_BIAS,
    is_resting: bool = False,
) -> Front:
    """Return the true state at a time; the bias is that of gyro and accelerometer."""
    T = hand.imu_pose(time_s)
    return Front(
        stamp_ns=ns(time_s),
        T_world_imu=T,
        velocity=T[:3, :3].T @ hand.velocity(time_s),
        biases=bias,
        gravity=-T[:3, :3].T @ UP,
        covariance=np.zeros((18, 18)) if covariance is None else covariance,
        is_resting=is_resting,
    )


@pytest.mark.parametrize("start_s", [0.0, 0.0123, 2.5])
def test_exact_samples_of_a_turning_hand_lead_to_where_it_is(start_s: float) -> None:
    rates = np.linalg.norm(HAND.gyro(np.linspace(0.0, 8.0, 800)), axis=1)
    assert np.degrees(rates.max()) > 55.0
    bias = np.array([0.01, 0.02, -0.03, 0.1, -0.2, 0.05])
    sensor = Sensor(gyro_bias=bias[:3], acceleration_bias=bias[3:])
    front = front_at(HAND, start_s, bias=bias)
    end = integrator(EXACT, HAND, sensor).advance(front, ns(start_s + 5.0))
    assert end is not None
    shift_m, turn_deg = errors_of(end.T_world_imu, HAND.imu_pose(start_s + 5.0))
    assert shift_m < 0.002
    assert turn_deg < 0.001
    velocity = end.T_world_imu[:3, :3] @ end.velocity
    assert np.linalg.norm(velocity - HAND.velocity(start_s + 5.0)) < 0.001


def test_an_interval_may_be_taken_at_once_or_in_frames() -> None:
    integrate, front = integrator(EXACT, HAND, Sensor()), front_at(HAND, 1.0, 1e-6 * np.eye(18))
    once, each = integrate.advance(front, ns(3.0)), front
    for k in range(1, 41):
        following = integrate.advance(each, ns(1.0 + 0.05 * k))
        assert following is not None
        each = following
    assert once is not None
    shift_m, turn_deg = errors_of(each.T_world_imu, once.T_world_imu)
    assert shift_m < 1e-4
    assert turn_deg < 1e-4
    found, expected = (front.covariance.diagonal() for front in (each, once))
    np.testing.assert_allclose(found, expected, rtol=0.04)


def test_a_hole_before_the_stamp_is_no_front() -> None:
    integrate = integrator(EXACT, HAND, Sensor(hole_s=(2.0, 2.2)))
    assert integrate.advance(front_at(HAND, 1.0), ns(1.95)) is not None
    assert integrate.advance(front_at(HAND, 1.0), ns(3.0)) is None
    assert integrate.between(ns(1.9), ns(2.3), NO_BIAS) is None


def drawn(imu: Imu, front: Front, end_s: float, *, n: int) -> FloatArray:
    """Return differences (n, 18) of what may have been from what is said, at a later time.

    By explicit steps of n motions at once: of what the IMU measured as it was, with states, biases
    and noise drawn. Its noise in use is three times that of its data sheet.
    """
    rng, dt = np.random.default_rng(4), 1.0 / SAMPLES_HZ
    start_s = 1e-9 * (front.stamp_ns - ns(0.0))
    start = rng.multivariate_normal(np.zeros(18), front.covariance, n)
    turned = Rotation.from_matrix(front.T_world_imu[:3, :3])
    R = turned * Rotation.from_rotvec(start[:, :3])
    p = front.T_world_imu[:3, 3] + turned.apply(start[:, 3:6])
    v, gravity = R.apply(front.velocity + start[:, 6:9]), R.apply(front.gravity + start[:, 15:])
    bias = start[:, 9:15].copy()
    for middle_s in np.arange(start_s, end_s - 0.5 * dt, dt) + 0.5 * dt:
        white = rng.normal(0.0, 3.0 / np.sqrt(dt), (n, 6))
        w = HAND.gyro(middle_s) - bias[:, :3] - imu.gyro_noise * white[:, :3]
        f = HAND.force(middle_s) - bias[:, 3:] - imu.acceleration_noise * white[:, 3:]
        a = (R * Rotation.from_rotvec(0.5 * dt * w)).apply(f) + gravity
        p, v, R = p + dt * v + 0.5 * dt * dt * a, v + dt * a, R * Rotation.from_rotvec(dt * w)
        walk = np.repeat([imu.gyro_walk, imu.acceleration_walk], 3)
        bias = bias + walk * np.sqrt(dt) * rng.normal(size=(n, 6))
    end = front_at(HAND, end_s)
    turned = Rotation.from_matrix(end.T_world_imu[:3, :3])
    shifts = turned.apply(p - end.T_world_imu[:3, 3], inverse=True)
    changes = R.apply(v, inverse=True) - end.velocity
    tilts = R.apply(gravity, inverse=True) - end.gravity
    return np.hstack([(turned.inv() * R).as_rotvec(), shifts, changes, bias, tilts])


# Of rotation, position, velocity, biases of gyro and accelerometer, gravity.
KNOWN = np.full(18, 1e-9)
UNSURE = np.repeat([0.01, 0.02, 0.05, 0.01, 0.1, 0.1], 3)


@pytest.mark.parametrize("sigmas", [KNOWN, UNSURE], ids=["from_the_true_state", "from_an_unsure"])
def test_its_covariance_is_that_of_many_noisy_motions(sigmas: FloatArray) -> None:
    imu = replace(EXACT, gyro_noise=1e-3, gyro_walk=1e-2, acceleration_noise=1e-2)
    imu = replace(imu, acceleration_walk=0.1)
    front = front_at(HAND, 1.0, np.diag(sigmas**2))
    end = integrator(imu, HAND, Sensor()).advance(front, ns(2.0))
    assert end is not None
    differences = drawn(imu, front, 2.0, n=2000)
    n = 18 if sigmas is UNSURE else 15  # where gravity is known, it is wrong as the rotation is
    scale = np.sqrt(end.covariance.diagonal()[:n])
    L = np.linalg.cholesky(end.covariance[:n, :n] / np.outer(scale, scale))
    white = np.linalg.solve(L, (differences[:, :n] / scale).T)
    ratios = np.linalg.eigvalsh(white @ white.T / len(differences))
    assert 0.7 < ratios.min() < ratios.max() < 1.3


def test_a_step_corrects_what_led_to_its_end() -> None:
    # By least squares of what was known, the rows above, and of the step.
    rng, noise = np.random.default_rng(3), np.array([1e-5, 2e-5, 1e-5, 1e-4, 5e-5, 2e-4])
    A = 1e-4 * rng.normal(size=(18, 18))
    front, error = front_at(HAND, 1.3, A @ A.T), noise * rng.normal(size=6)
    T = front.T_world_imu @ transform(error[:3], error[3:])
    step = Edge(reference_id=0, T_reference_frame=T, covariance=np.diag(noise**2))
    found = front.measured(step)
    rows = np.vstack([np.linalg.inv(A), np.diag(1.0 / noise) @ np.eye(6, 18)])
    expected = np.linalg.lstsq(rows, np.r_[np.zeros(18), error / noise])[0]
    np.testing.assert_allclose(found.velocity - front.velocity, expected[6:9], rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(found.biases - front.biases, expected[9:15], rtol=1e-3, atol=1e-8)
    up = front.gravity / 9.81
    across = expected[15:] - up * (up @ expected[15:])  # its length is known
    np.testing.assert_allclose(found.gravity - front.gravity, across, rtol=0.01, atol=1e-7)
    covariance = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(found.covariance[6:, 6:], covariance[6:, 6:], rtol=1e-3, atol=1e-13)


@pytest.mark.parametrize(
    "step", [None, Edge(reference_id=0, T_reference_frame=np.eye(4), covariance=np.eye(6))]
)
def test_a_measured_front_is_where_its_world_begins(step: Edge | None) -> None:
    front = front_at(HAND, 1.3, np.diag(np.arange(1.0, 19.0)))
    found = front.measured(step)
    np.testing.assert_array_equal(found.T_world_imu, np.eye(4))
    assert not found.covariance[:6].any()
    assert not found.covariance[:, :6].any()
    np.testing.assert_allclose(found.covariance.diagonal()[6:], np.arange(7.0, 19.0))
    np.testing.assert_allclose(found.velocity, front.velocity)
    np.testing.assert_allclose(found.gravity, front.gravity)


RESTING = replace(HAND, rest_s=(1.0, 3.0))


def test_an_imu_at_rest_stays_until_it_feels_that_it_moves() -> None:
    bias = np.array([0.0, 5e-4, 0.0, 0.03, 0.0, 0.0])
    sensor = Sensor(gyro_bias=bias[:3], acceleration_bias=bias[3:])
    integrate = integrator(EXACT, RESTING, sensor)
    front = front_at(RESTING, 1.0, is_resting=True)  # its biases are not known
    rest = integrate.advance(front, ns(2.9))
    free = integrate.advance(replace(front, is_resting=False), ns(2.9))
    assert rest is not None
    assert free is not None
    assert rest.is_resting
    assert errors_of(rest.T_world_imu, front.T_world_imu)[0] == 0.0
    assert not rest.velocity.any()
    assert rest.covariance[3, 3] < 0.01 * free.covariance[3, 3]
    assert errors_of(free.T_world_imu, front.T_world_imu)[0] > 0.05
    moving = integrate.advance(rest, ns(4.0))
    assert moving is not None
    assert not moving.is_resting
    true = np.linalg.norm(RESTING.imu_pose(4.0)[:3, 3] - RESTING.imu_pose(3.0)[:3, 3])
    assert true > 0.1
    assert errors_of(moving.T_world_imu, RESTING.imu_pose(4.0))[0] < 0.3 * true


@pytest.mark.parametrize(("hand", "is_still"), [(STILL, True), (HAND, False)])
def test_it_tells_whether_it_felt_nothing_but_gravity(hand: Hand, is_still: bool) -> None:
    integrate = integrator(EXACT, hand, Sensor())
    end = integrate.advance(front_at(hand, 1.0), ns(1.05))
    assert end is not None
    assert end.is_still == is_still


def chained(before: FloatArray, T: FloatArray, step: FloatArray) -> FloatArray:
    J = adjoint(np.linalg.inv(T))
    return J @ before @ J.T + step


def test_covariances_of_steps_add_up_to_that_of_the_way() -> None:
    rng, T_way, ways = np.random.default_rng(5), np.eye(4), [np.zeros((6, 6))]
    whole, steps = np.zeros((6, 6)), []
    for k in range(1, 8):
        T = transform(rng.normal(0.0, 0.2, 3), rng.normal(0.0, 0.3, 3))
        A = rng.normal(0.0, [[0.01], [0.01], [0.01], [0.1], [0.1], [0.1]], (6, 8))
        ways.append(chained(ways[-1], T, k * A @ A.T))
        steps.append(step_covariance(ways[-2], T, ways[-1]))
        whole = chained(whole, T, steps[-1])
        T_way = T_way @ T
    np.testing.assert_allclose(whole, ways[-1], rtol=1e-9, atol=1e-12)
    for step in steps:
        assert np.linalg.eigvalsh(step).min() > 0.0


def test_a_step_is_positive_definite_along_what_became_more_certain() -> None:
    before = np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0]) * 1e-4
    after = np.diag([2.0, 2.0, 2.0, 1.0, 9.0, 9.0]) * 1e-4
    step = step_covariance(before, np.eye(4), after)
    np.testing.assert_allclose(step.diagonal()[[0, 1, 2, 4, 5]], [1e-4] * 3 + [5e-4] * 2)
    assert 0.0 < step[3, 3] < 1e-3 * after[3, 3]
    np.testing.assert_allclose(step, step.T)
