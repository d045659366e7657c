"""An IMU begins from registered frames: moving or at rest, but not with samples of other units."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gvo.backend.imu_buffer import ImuBuffer
from gvo.backend.imu_motion import Front, Preintegrator
from gvo.backend.imu_start import find_start
from gvo.geometry.imu import ImuSamples
from gvo.types import Edge, Failure
from tests.backend.imus import EXACT, FRAMES_HZ, HAND, STILL, UP, Hand, Sensor, ns, transform

BIAS = np.array([0.05, -0.03, 0.02])
SIGMAS = np.array([3e-4, 3e-4, 3e-4, 1e-3, 1e-3, 1e-3])


def started(
    hand: Hand, samples: ImuSamples, *, begin_s: float = 2.0, rng: Any = None
) -> Front | Failure:
    """Return the start from fifteen frames."""
    buffer, times_s = ImuBuffer(), begin_s + np.arange(15) / FRAMES_HZ
    buffer.add(samples)
    T, steps = [hand.imu_pose(time_s) for time_s in times_s], []
    for k in range(14):
        noise = np.zeros(6) if rng is None else SIGMAS * rng.normal(size=6)
        step = np.linalg.inv(T[k]) @ T[k + 1] @ transform(noise[:3], noise[3:])
        steps.append(
            Edge(
                reference_id=ns(times_s[k]),
                T_reference_frame=step,
                covariance=np.diag(SIGMAS**2),
            )
        )
    return find_start([ns(each) for each in times_s], steps, Preintegrator(EXACT, buffer))


@pytest.mark.parametrize("begin_s", [0.0, 1.3, 2.0])
@pytest.mark.parametrize("hand", [HAND, STILL])
def test_gravity_velocity_and_the_bias_of_the_gyro_are_found(hand: Hand, begin_s: float) -> None:
    found = started(hand, Sensor(gyro_bias=BIAS).measure(hand, 4.0), begin_s=begin_s)
    assert isinstance(found, Front)
    R_imu_world = hand.imu_pose(begin_s)[:3, :3].T
    np.testing.assert_allclose(found.gravity, -R_imu_world @ UP, atol=0.01)
    np.testing.assert_allclose(found.velocity, R_imu_world @ hand.velocity(begin_s), atol=0.003)
    np.testing.assert_allclose(found.biases, [*BIAS, 0.0, 0.0, 0.0], atol=2e-3)


def test_they_are_found_from_noisy_steps_too() -> None:
    samples, errors = Sensor(gyro_bias=BIAS).measure(HAND, 4.0), []
    for seed in range(10):
        found = started(HAND, samples, rng=np.random.default_rng(seed))
        assert isinstance(found, Front)
        R_imu_world = HAND.imu_pose(2.0)[:3, :3].T
        errors.append(np.linalg.norm(found.velocity - R_imu_world @ HAND.velocity(2.0)))
        assert np.linalg.norm(found.gravity + R_imu_world @ UP) < 0.5
        np.testing.assert_allclose(found.biases[:3], BIAS, atol=6e-3)
    assert 1e-5 < float(np.mean(errors)) < 0.05


@pytest.mark.parametrize("hand", [HAND, STILL])
@pytest.mark.parametrize("unit", ["g", "without_gravity"])
def test_accelerations_that_are_something_else_are_refused(hand: Hand, unit: str) -> None:
    samples, times_s = Sensor().measure(hand, 4.0), np.arange(-0.2, 4.0, 0.005)
    if unit == "g":
        samples = replace(samples, acceleration=samples.acceleration / 9.81)
    else:
        felt = hand.rotations(times_s).inv().apply(UP)
        samples = replace(samples, acceleration=samples.acceleration - felt)
    found = started(hand, samples)
    assert isinstance(found, Failure)
    expected = "1.00" if unit == "g" and hand is STILL else "gravity of"
    assert expected in found.reason
    assert "m/s^2" in found.reason


def test_a_hole_in_the_samples_is_refused() -> None:
    found = started(HAND, Sensor(hole_s=(2.2, 2.35)).measure(HAND, 4.0))
    assert isinstance(found, Failure)
    assert "hole" in found.reason
