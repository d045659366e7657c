"""What is known of an IMU, and what it measured, is checked at once."""

from typing import Any

import numpy as np
import pytest

from gvo.geometry.imu import Imu, ImuSamples

DENSITIES = "gyro_noise", "gyro_walk", "acceleration_noise", "acceleration_walk"


@pytest.mark.parametrize("name", DENSITIES)
@pytest.mark.parametrize("value", [0.0, -1e-3, 10.1, np.inf, np.nan])
def test_a_density_that_is_not_positive_is_refused(name: Any, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive and at most 10, got {value}"):
        Imu(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e300, -60.1])
def test_a_delay_must_be_short(value: float) -> None:
    with pytest.raises(ValueError, match="delay_s must be within 60"):
        Imu(delay_s=value)


@pytest.mark.parametrize("T", [np.eye(3), 2.0 * np.eye(4), np.full((4, 4), np.nan)])
def test_a_place_must_be_a_transform(T: Any) -> None:
    with pytest.raises(ValueError, match="T_camera_imu"):
        Imu(T_camera_imu=T)


def test_a_place_is_copied_and_cannot_be_written_to() -> None:
    T = np.eye(4)
    imu = Imu(T_camera_imu=T)
    T[0, 3] = 1.0
    assert imu.T_camera_imu is not None
    np.testing.assert_array_equal(imu.T_camera_imu, np.eye(4))
    with pytest.raises(ValueError, match="read-only"):
        imu.T_camera_imu[0, 3] = 1.0


def test_one_sample_may_be_given_as_plain_numbers() -> None:
    samples = ImuSamples.of(7, [1, 2, 3], [4, 5, 6])
    assert len(samples) == 1
    assert samples.stamps_ns.tolist() == [7]
    assert samples.gyro.tolist() == [[1.0, 2.0, 3.0]]
    assert samples.acceleration.tolist() == [[4.0, 5.0, 6.0]]


@pytest.mark.parametrize("nothing", [[], np.zeros((0, 3))])
def test_no_samples_may_be_given(nothing: Any) -> None:
    assert ImuSamples.of([], nothing, nothing).gyro.shape == (0, 3)


@pytest.mark.parametrize("stamps_ns", [[1403.5, 1403.6], [True, False], [None, None], [1j, 2j]])
def test_stamps_that_are_no_whole_numbers_are_refused(stamps_ns: Any) -> None:
    with pytest.raises(ValueError, match="whole nanoseconds"):
        ImuSamples.of(stamps_ns, np.zeros((2, 3)), np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("stamps_ns", "gyro", "acceleration", "name"),
    [
        ([0, 1], np.zeros((1, 3)), np.zeros((2, 3)), "gyro"),
        ([0, 1], np.zeros((2, 3)), np.zeros((2, 4)), "acceleration"),
        ([[0, 1]], np.zeros((1, 3)), np.zeros((1, 3)), "stamps_ns"),
    ],
)
def test_samples_whose_shapes_do_not_fit_are_refused(
    stamps_ns: Any, gyro: Any, acceleration: Any, name: str
) -> None:
    with pytest.raises(ValueError, match=name):
        ImuSamples.of(stamps_ns, gyro, acceleration)
