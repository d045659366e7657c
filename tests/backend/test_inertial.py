"""An IMU says how the camera goes on where it sees nothing, beside known motions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.backend.inertial import InertialEstimator
from gvo.geometry.imu import Imu
from gvo.types import Edge, FloatArray, InertialState
from tests.backend.imus import (
    ADIS16448,
    CHEAP,
    EXACT,
    FRAMES_HZ,
    HAND,
    STILL,
    Hand,
    Ride,
    Sensor,
    adjoint,
    errors_of,
    ns,
    transform,
)

# The IMU is 10 cm beside the camera and turned.
PLACE = transform([1.2, -1.1, 1.3], [0.06, -0.06, 0.05])
SEEN = (5e-4, 1e-3)
PAUSE = replace(HAND, rest_s=(2.0, 8.0))


def estimator(imu: Imu = EXACT, *, max_coast_s: float = 5.0) -> InertialEstimator:
    return InertialEstimator(imu, max_coast_s=max_coast_s)


def noisy_ride(
    densities: dict[str, float], hand: Hand = HAND, *, seed: int = 0, sigmas: Any = SEEN
) -> tuple[Ride, Sensor]:
    """Return a ride with an IMU beside a camera, both as noisy as they say, and how it measures."""
    rng = np.random.default_rng([seed, 2])
    sensor = Sensor(
        gyro_bias=rng.normal(0.0, 0.03, 3),
        acceleration_bias=rng.normal(0.0, 0.2, 3),
        densities=densities,
        seed=seed,
    )
    known = estimator(replace(EXACT, T_camera_imu=PLACE, **densities))
    return Ride(known, hand, sensor, T_camera_imu=PLACE, sigmas=sigmas, seed=seed), sensor


def state_of(ride: Ride) -> InertialState:
    state = ride.estimator.state
    assert state is not None
    return state


@pytest.mark.parametrize("place", [np.eye(4), PLACE], ids=["in_the_camera", "beside_it"])
def test_an_exact_imu_carries_an_exact_camera_over_a_gap(place: FloatArray) -> None:
    sensor = Sensor(gyro_bias=[0.02, -0.01, 0.03], acceleration_bias=[0.1, 0.05, -0.1])
    known = estimator(replace(EXACT, T_camera_imu=place))
    ride = Ride(known, sensor=sensor, T_camera_imu=place).ride(6.0)
    shift_m, turn_deg = ride.carried(1.0)
    assert np.linalg.norm(ride.true_step(6.0, 7.0)[:3, 3]) > 0.2
    assert shift_m < 0.002
    assert turn_deg < 0.02


def test_a_lever_that_is_not_told_costs_centimetres() -> None:
    elsewhere = PLACE.copy()
    elsewhere[:3, 3] = 0.0
    known = estimator(replace(EXACT, T_camera_imu=elsewhere))
    ride = Ride(known, T_camera_imu=PLACE).ride(3.0)
    assert 0.01 < ride.carried(1.0)[0] < 0.2
    assert known.n_restarts == 0


def nees(edge: Edge, T: FloatArray) -> float:
    """Return the squared error of an edge in sigmas, per degree of freedom."""
    difference = np.linalg.inv(edge.T_reference_frame) @ T
    error = np.r_[Rotation.from_matrix(difference[:3, :3]).as_rotvec(), difference[:3, 3]]
    return float(error @ np.linalg.solve(edge.covariance, error)) / 6.0


@pytest.mark.parametrize("sigmas", [(2e-4, 5e-4), (1e-3, 3e-3)])
def test_it_is_wrong_by_as_much_as_it_says(sigmas: tuple[float, float]) -> None:
    found = []
    for seed in range(15):
        ride, _ = noisy_ride(ADIS16448, seed=seed, sigmas=sigmas)
        ride.ride(2.0)
        edge = ride.carry(1.0)
        assert edge is not None
        assert edge.kernel == "none"
        found.append(nees(edge, ride.true_step(2.0, 3.0)))
    assert 0.3 < np.mean(found) < 3.0
    assert np.median(found) < 2.0


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_how_much_noisier_it_is_than_it_says_is_learnt(factor: float) -> None:
    found = []
    for seed in range(10):
        true = {name: factor * density for name, density in ADIS16448.items()}
        known = replace(EXACT, T_camera_imu=np.eye(4), **ADIS16448)
        sensor = Sensor(densities=true, seed=seed)
        ride = Ride(estimator(known), sensor=sensor, sigmas=SEEN, seed=seed)
        edge = ride.ride(12.0).carry(1.0)
        assert edge is not None
        found.append(nees(edge, ride.true_step(12.0, 13.0)))
    assert 0.2 < np.mean(found) < 3.0


def true_twist(time_s: float, ride: Ride) -> FloatArray:
    """Return how the camera turns and moves, in its own axes."""
    T_imu_camera = np.linalg.inv(ride.hand.imu_pose(time_s)) @ ride.camera_pose(time_s)
    turn = ride.hand.gyro(time_s)
    velocity = ride.hand.imu_pose(time_s)[:3, :3].T @ ride.hand.velocity(time_s)
    velocity = velocity + np.cross(turn, T_imu_camera[:3, 3])
    R_camera_imu = T_imu_camera[:3, :3].T
    return np.concatenate([R_camera_imu @ turn, R_camera_imu @ velocity])


@pytest.mark.parametrize("sigmas", [SEEN, (1e-3, 3e-3)])
def test_the_state_is_wrong_by_as_much_as_it_says(sigmas: tuple[float, float]) -> None:
    ratios = []
    for seed in range(6):
        ride, sensor = noisy_ride(ADIS16448, seed=seed, sigmas=sigmas)
        for time_s in (1.0, 2.0, 4.0):
            state = state_of(ride.ride(time_s))
            assert state.stamp_ns == ns(time_s)
            turn, velocity = np.split(state.twist - true_twist(time_s, ride), 2)
            turn_sigmas, _ = np.split(np.sqrt(state.twist_covariance.diagonal()), 2)
            ratios.append(
                [
                    turn / turn_sigmas,
                    velocity / state.velocity_sigma,
                    (state.up - ride.camera_pose(time_s)[2, :3]) / state.sigmas[0],
                    (state.gyro_bias - sensor.gyro_bias) / state.sigmas[1],
                    (state.acceleration_bias - sensor.acceleration_bias) / state.sigmas[2],
                ]
            )
    assert np.max(np.abs(ratios)) < 4.0
    sizes = np.sqrt(np.square(ratios).mean(axis=(0, 2)))
    assert 0.15 < sizes.min() < sizes.max() < 2.0


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0, 333.0])
def test_there_is_a_state_at_each_frame_at_any_rate(rate_hz: float) -> None:
    ride = Ride(estimator(), sensor=Sensor(rate_hz=rate_hz)).ride(1.0)
    for time_s in ride.go(3.0):
        np.testing.assert_allclose(state_of(ride).twist, true_twist(time_s, ride), atol=0.02)


def test_turns_since_the_way_began_make_no_velocity_less_sure() -> None:
    errors = []
    for seed in range(6):
        densities = {**ADIS16448, "gyro_noise": 5e-3}
        ride, _ = noisy_ride(densities, seed=seed, sigmas=(2e-2, 1e-3))
        state = state_of(ride.ride(4.0))
        errors.append((state.twist - true_twist(4.0, ride))[3:] / state.velocity_sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_in_the_dark_the_state_goes_on_until_nothing_is_known() -> None:
    ride = Ride(estimator(max_coast_s=0.5)).ride(2.0)
    for time_s in ride.go(2.5, is_seen=False):
        state = state_of(ride)
        assert state.stamp_ns == ns(time_s)
        np.testing.assert_allclose(state.twist, true_twist(time_s, ride), atol=0.01)
    assert ride.ride(2.55, is_seen=False).estimator.state is None


def test_an_accelerometer_that_feels_too_much_gravity_is_found_at_rest() -> None:
    for seed in range(8):
        ride, sensor = noisy_ride(ADIS16448, PAUSE, seed=seed)
        found = state_of(ride.ride(4.0)).acceleration_bias - sensor.acceleration_bias
        assert abs(found @ PAUSE.imu_pose(4.0)[2, :3]) < 0.04


def test_edges_one_after_the_other_make_the_whole_way_with_its_covariance() -> None:
    ride, _ = noisy_ride(ADIS16448)
    ride.ride(2.0)
    T, covariance, before_s, sizes = np.eye(4), np.zeros((6, 6)), 2.0, []
    for frame in range(41, 81):
        time_s = frame / FRAMES_HZ
        ride.feed(time_s)
        step = ride.estimator.carry(ns(before_s), ns(time_s))
        assert step is not None
        assert step.reference_id == ns(before_s)
        T = T @ step.T_reference_frame
        back = adjoint(np.linalg.inv(step.T_reference_frame))
        covariance = back @ covariance @ back.T + step.covariance
        sizes.append(step.covariance[3, 3])
        ride.ride(time_s, is_seen=False)
        before_s = time_s
    whole = ride.estimator.carry(ns(2.0), ns(4.0))
    assert whole is not None
    np.testing.assert_allclose(T, whole.T_reference_frame, atol=1e-9)
    scale = np.sqrt(whole.covariance.diagonal())
    difference = (covariance - whole.covariance) / np.outer(scale, scale)
    assert np.abs(difference).max() < 0.02
    assert whole.covariance[3, 3] > 4.0 * max(sizes)


def test_a_covariance_grows_with_the_gap() -> None:
    ride, _ = noisy_ride(ADIS16448)
    ride.ride(2.0)
    sigmas = []
    for span_s in (0.05, 0.5, 1.0, 2.0, 4.0):
        edge = ride.carry(span_s)
        assert edge is not None
        np.testing.assert_array_equal(edge.covariance, edge.covariance.T)
        sigmas.append(np.sqrt(np.linalg.eigvalsh(edge.covariance)[-1]))
    assert (np.diff(sigmas) > 0.0).all()


def test_later_than_it_may_carry_nothing_is_known() -> None:
    ride = Ride(estimator(max_coast_s=0.5)).ride(2.0)
    assert ride.carry(0.5) is not None
    assert ride.carry(0.55) is None
    ride.estimator.max_coast_s = 1.0
    assert ride.carry(0.55) is not None
    ride.ride(2.75, is_seen=False)
    assert ride.carry(0.25) is not None
    assert ride.carry(0.3) is None


def test_nothing_is_known_from_a_frame_before_the_newest_measured_one() -> None:
    ride = Ride(estimator()).ride(2.0)
    ride.feed(2.1)
    assert ride.estimator.carry(ns(1.95), ns(2.1)) is None
    assert ride.estimator.carry(ns(2.02), ns(2.1)) is None
    assert ride.estimator.carry(ns(2.0), ns(2.1)) is not None


def test_it_starts_after_fifteen_frames_that_follow_each_other() -> None:
    ride = Ride(estimator())
    assert ride.ride(0.65).estimator.state is None
    assert ride.carry(0.05) is None
    assert ride.ride(0.7).estimator.state is not None
    ride = Ride(estimator()).ride(0.5).ride(0.55, is_seen=False)
    assert ride.ride(1.2).estimator.state is None
    assert ride.ride(1.25).estimator.state is not None


def test_a_minute_of_darkness_is_forgotten() -> None:
    ride = Ride(estimator(), length_s=70.0).ride(2.0).ride(62.0, is_seen=False)
    assert ride.estimator.n_restarts == 0
    assert ride.ride(62.1, is_seen=False).estimator.n_restarts == 1
    assert ride.ride(66.0).carried(1.0)[0] < 0.005
    assert ride.estimator.n_restarts == 1


def test_a_hole_in_the_imu_makes_it_begin_anew() -> None:
    ride = Ride(estimator(), sensor=Sensor(hole_s=(2.0, 2.2)))
    assert ride.ride(2.0).carry(0.1) is None
    assert ride.estimator.n_restarts == 0
    ride.ride(2.3)
    assert ride.estimator.n_restarts == 1
    assert ride.estimator.state is None
    ride.ride(3.2)
    assert ride.estimator.n_restarts == 1
    assert ride.carried(1.0)[0] < 0.002


AWAY = transform([0.0, 0.2, 0.0], [0.5, 0.0, 0.3])


@pytest.mark.parametrize(("n", "n_restarts"), [(5, 0), (6, 1)])
def test_six_steps_in_a_row_that_contradict_it_make_it_begin_anew(n: int, n_restarts: int) -> None:
    ride = Ride(estimator()).ride(2.0).ride(2.0 + n / FRAMES_HZ, wrong=AWAY)
    assert ride.estimator.n_restarts == n_restarts
    ride.ride(2.0 + (n + 1) / FRAMES_HZ).ride(2.0 + (2 * n + 1) / FRAMES_HZ, wrong=AWAY)
    assert ride.estimator.n_restarts == n_restarts
    ride.ride(4.0)
    assert ride.carried(1.0)[0] < 0.002


def test_a_step_that_contradicts_it_is_not_believed() -> None:
    ride = Ride(estimator()).ride(2.0).ride(2.05, wrong=AWAY)
    assert ride.estimator.carry(ns(2.0), ns(2.1)) is not None
    ride.ride(2.1)
    assert ride.estimator.carry(ns(2.0), ns(2.15)) is None
    assert ride.carried(1.0)[0] < 0.002


@pytest.mark.parametrize("since_s", [2.0, 2.3])
def test_it_goes_on_from_a_step_over_a_gap(since_s: float) -> None:
    ride = Ride(estimator()).ride(2.0).ride(2.5, is_seen=False)
    ride.feed(2.55)
    ride.frame += 1
    ride.estimator.follow(ride.newest_ns, ride.step_to(2.55, since_s=since_s))
    assert ride.estimator.carry(ns(2.5), ns(2.6)) is None
    np.testing.assert_allclose(state_of(ride).twist, true_twist(2.55, ride), atol=0.01)
    assert ride.carried(1.0)[0] < 0.005
    assert ride.estimator.n_restarts == 0


def test_missing_samples_hardly_matter() -> None:
    errors = []
    for share_missing in (0.0, 0.2):
        ride = Ride(estimator(), sensor=Sensor(share_missing=share_missing, seed=3)).ride(3.0)
        errors.append(ride.carried(1.0)[0])
        assert ride.estimator.n_restarts == 0
    assert errors[0] < errors[1] < errors[0] + 0.005


@pytest.mark.parametrize("delay_s", [0.02, -0.013])
def test_a_known_delay_is_taken_off(delay_s: float) -> None:
    late = Sensor(delay_s=delay_s)
    right = Ride(estimator(replace(EXACT, delay_s=delay_s)), sensor=late).ride(3.0)
    assert right.carried(1.0)[0] < 0.002
    wrong = Ride(estimator(), sensor=late).ride(3.0)
    assert wrong.carried(1.0)[1] > 10.0 * right.carried(1.0)[1]


@pytest.mark.parametrize("densities", [ADIS16448, CHEAP], ids=["adis16448", "cheap"])
def test_at_rest_it_stays_and_feels_when_it_begins_to_move(densities: dict[str, float]) -> None:
    moved_m = np.linalg.norm(PAUSE.imu_pose(10.0)[:3, 3] - PAUSE.imu_pose(8.0)[:3, 3])
    assert moved_m > 0.3
    for seed in range(3):
        ride, _ = noisy_ride(densities, PAUSE, seed=seed, sigmas=(2e-4, 3e-4))
        ride.ride(3.0)
        assert ride.carried(5.0)[0] < 0.005
        ride, _ = noisy_ride(densities, PAUSE, seed=seed, sigmas=(2e-4, 3e-4))
        ride.ride(6.0)
        assert ride.carried(1.9)[0] < 0.005
        assert ride.carried(4.0)[0] < 0.4 * moved_m


@pytest.mark.parametrize("rest_s", [None, (1.0, 4.0)])
def test_a_gyro_in_degrees_does_not_carry_the_camera_away(rest_s: Any) -> None:
    hand, errors = replace(HAND, rest_s=rest_s), {}
    ride = Ride(estimator(), hand, Sensor(gyro_unit=180.0 / np.pi))
    for time_s in ride.go(8.0):
        if (edge := ride.carry(1.0)) is not None:
            T = ride.true_step(time_s, time_s + 1.0)
            errors[time_s] = errors_of(edge.T_reference_frame, T)[0]
    assert max(errors.values(), default=0.0) < 10.0
    assert not [time_s for time_s in errors if rest_s is None or time_s > 5.0]


def test_accelerations_in_g_carry_nothing() -> None:
    ride = Ride(estimator(), STILL, Sensor(acceleration_bias=[0.0, 0.0, 1.0 - 9.81])).ride(3.0)
    assert ride.estimator.state is None
    assert ride.carry(0.5) is None
