"""When pixels are exposed: points moved by the motion in between, one by one."""

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.kernels.shutter import settle_rows, write_exposure_errors, write_velocity_errors
from gvo.types import FloatArray
from tests.geometry.scenes import CAMERA, derivative, project, unproject
from tests.kernels.matches import PARAMETERS

VELOCITY = np.array([0.3, -0.5, 0.2, 0.8, -0.4, 1.5])
READOUT_S = 0.03
OFFSET = np.array([0.0, 0.0, 0.25])
LENS = OFFSET[2] * np.eye(11)[0]


def random_uvd(n: int) -> FloatArray:
    return np.random.default_rng(n).uniform([0.0, 0.0, 5.0], [640.0, 480.0, 50.0], size=(n, 3))


def settled(uvd: FloatArray, readout_s: float = READOUT_S, delay_s: float = 0.0) -> FloatArray:
    found, exposure = np.full_like(uvd, 7.0), np.array([readout_s, delay_s])
    settle_rows(uvd + OFFSET, LENS, VELOCITY, exposure, PARAMETERS, found)
    return found


def times(uvd: FloatArray) -> FloatArray:
    """Return when rows are exposed, as a share of the readout time after its middle."""
    return np.asarray(uvd[:, 1] / CAMERA.height - 0.5)


def rates_of(points: FloatArray) -> FloatArray:
    return np.asarray(np.cross(VELOCITY[:3], points) + VELOCITY[3:])


@pytest.mark.parametrize("n", [0, 1, 40])
def test_rows_are_settled_by_the_exponential_to_second_order(n: int) -> None:
    uvd = random_uvd(n)
    points, dt = unproject(uvd), READOUT_S * times(uvd)[:, np.newaxis]
    first = rates_of(points)
    moved = points + dt * first + 0.5 * dt**2 * np.cross(VELOCITY[:3], first)
    np.testing.assert_allclose(settled(uvd), project(moved), rtol=1e-9)
    twists = [se3.exp(VELOCITY * each) for each in dt[:, 0]]
    exact = [T[:3, :3] @ point + T[:3, 3] for T, point in zip(twists, points, strict=True)]
    np.testing.assert_allclose(settled(uvd), project(np.reshape(exact, (n, 3))), atol=1e-3)


def test_the_middle_row_stays_and_so_does_what_would_come_to_lie_behind() -> None:
    middle = np.array([[100.0, 240.0, 20.0]])
    np.testing.assert_allclose(settled(middle), middle, rtol=1e-15)
    # The first row is moved by half of the readout time, backward in time.
    for speed, is_settled in ((0.049, True), (0.051, False)):
        top = project(np.array([[0.0, -0.5, 0.1]]))
        top[0, 1] = 0.0
        assert unproject(top)[0, 2] == pytest.approx(0.1)
        found = np.empty_like(top)
        forward = np.array([0.0, 0.0, 0.0, 0.0, 0.0, speed])
        settle_rows(top, 0.0 * LENS, forward, np.array([2.0, 0.0]), PARAMETERS, found)
        assert np.array_equal(found, top) != is_settled


def test_an_unknown_row_spoils_itself_alone() -> None:
    uvd = random_uvd(3)
    whole = settled(uvd)
    uvd[1, 0] = np.nan
    found = settled(uvd)
    np.testing.assert_array_equal(found[[0, 2]], whole[[0, 2]])
    assert np.isnan(found[1, 0])


@pytest.mark.parametrize("n", [0, 1, 40])
def test_errors_of_the_exposure_are_derivatives_of_what_is_settled(n: int) -> None:
    uvd = random_uvd(n)
    errors = np.full((2, n, 3), 7.0)
    write_exposure_errors(uvd + OFFSET, LENS, VELOCITY, PARAMETERS, errors)
    points = unproject(uvd)
    motions = times(uvd)[:, np.newaxis] * rates_of(points)
    expected = [
        derivative(point)[:, 3:] @ motion for point, motion in zip(points, motions, strict=True)
    ]
    np.testing.assert_allclose(errors[0], -np.reshape(expected, (n, 3)), rtol=1e-9, atol=1e-9)
    for by_unit, step in zip(errors, 1e-5 * np.eye(2), strict=True):
        numerical = (settled(uvd, *-step) - settled(uvd, *step)) / 2e-5
        np.testing.assert_allclose(by_unit, numerical, rtol=1e-4, atol=1e-4)


def test_a_right_image_is_settled_as_if_exposed_with_the_left_one() -> None:
    ideal, late_s = random_uvd(60), 0.005
    until_late = se3.invert(se3.exp(late_s * VELOCITY))
    later = project(unproject(ideal) @ until_late[:3, :3].T + until_late[:3, 3])
    measured = ideal.copy()
    measured[:, 2] = ideal[:, 0] - (later[:, 0] - later[:, 2])
    assert np.median(np.abs(measured - ideal)[:, 2]) > 0.5
    # Right to first order.
    left = settled(measured, 0.0, late_s) - ideal
    assert np.abs(left).max() < 0.03 * np.abs(measured - ideal).max()


@pytest.mark.parametrize("n", [0, 1, 20])
def test_errors_of_the_velocity_are_those_of_the_camera_for_that_time(n: int) -> None:
    uvd, sigmas = random_uvd(n), np.arange(1.0, 7.0)
    points, errors = unproject(uvd), np.full((6, n, 3), 7.0)
    write_velocity_errors(points, uvd, sigmas, READOUT_S, PARAMETERS, errors)
    for k in range(n):
        # The camera's motion, where `derivative` is by the point's.
        expected = -READOUT_S * times(uvd)[k] * derivative(points[k]) * sigmas
        np.testing.assert_allclose(errors[:, k].T, expected, rtol=1e-9, atol=1e-12)
