"""Geodetic positions against published examples, arcs integrated numerically, and symmetries."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from gvo.geometry.geodesy import (
    FLATTENING,
    SEMI_MAJOR_AXIS,
    enu_of_ecef,
    geodetic_to_ecef,
    local_enu,
)

latitudes = st.floats(-89.9, 89.9)
longitudes = st.floats(-180.0, 180.0)
heights = st.floats(-500.0, 9000.0)

POINT_DEG = 53 + 48 / 60 + 33.820 / 3600, 2 + 7 / 60 + 46.380 / 3600


def test_the_published_example_of_geocentric_positions_is_met() -> None:
    """Section 4.1.1 of the guidance note, rounded to the millimetre."""
    expected = [3771793.968, 140253.342, 5124304.349]
    np.testing.assert_allclose(geodetic_to_ecef(*POINT_DEG, 73.0), expected, atol=6e-4)


def test_the_published_example_of_topocentric_positions_is_met() -> None:
    """Section 4.1.2 of the guidance note: the same point seen from 55 N, 5 E, 200 m."""
    found = local_enu([55.0, POINT_DEG[0]], [5.0, POINT_DEG[1]], [200.0, 73.0])
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_allclose(found[1], [-189013.869, -128642.040, -4220.171], atol=6e-4)


def test_the_axes_of_the_ellipsoid_are_met() -> None:
    polar = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    found = geodetic_to_ecef([0.0, 0.0, 90.0, -90.0], [0.0, 180.0, 12.0, 0.0], [0.0, 1.0, 0.0, 2.0])
    expected = np.array(
        [[6378137.0, 0, 0], [-6378138.0, 0, 0], [0, 0, polar], [0, 0, -polar - 2.0]]
    )
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert polar == pytest.approx(6356752.3142, abs=1e-4)


@given(latitudes, longitudes, heights)
def test_the_point_lies_its_height_above_the_ellipsoid_along_the_normal(
    latitude: float, longitude: float, height: float
) -> None:
    """The foot satisfies the equation of the ellipsoid, whose gradient points along up."""
    up = enu_of_ecef(latitude, longitude)[2]
    foot = geodetic_to_ecef(latitude, longitude, height) - height * up
    squares = np.array([SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS * (1 - FLATTENING)]) ** 2
    assert np.sum(foot**2 / squares) == pytest.approx(1.0, abs=1e-12)
    gradient = foot / squares
    np.testing.assert_allclose(gradient / np.linalg.norm(gradient), up, atol=1e-12)


@given(latitudes, longitudes)
def test_the_axes_of_enu_are_right_handed_and_as_named(latitude: float, longitude: float) -> None:
    R = enu_of_ecef(latitude, longitude)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(R[0], R[1]), R[2], atol=1e-12)
    # numerical derivatives of the position point along the axes
    here, small = geodetic_to_ecef(latitude, longitude, 0.0), 1e-5
    for axis, step in enumerate([(0.0, small, 0.0), (small, 0.0, 0.0), (0.0, 0.0, 1.0)]):
        there = geodetic_to_ecef(latitude + step[0], longitude + step[1], step[2])
        direction = (there - here) / np.linalg.norm(there - here)
        assert direction @ R[axis] == pytest.approx(1.0, abs=1e-6)


def meridian_arc(start_deg: float, end_deg: float) -> float:
    """Integrate the length of the ellipse, in its parametric latitude, between two latitudes."""
    a, b = SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    first, last = np.arctan(b / a * np.tan(np.radians([start_deg, end_deg])))
    length, _ = quad(lambda beta: np.hypot(a * np.sin(beta), b * np.cos(beta)), first, last)
    return float(length)


@given(st.floats(-80.0, 80.0), longitudes)
def test_a_hundred_metres_north_are_a_hundred_metres(latitude: float, longitude: float) -> None:
    step_deg = 1e-3 * 100.0 / meridian_arc(latitude, latitude + 1e-3)
    east, north, up = local_enu([latitude, latitude + step_deg], [longitude] * 2, [5.0, 5.0])[1]
    assert north == pytest.approx(100.0, abs=1e-3)
    # on a globe of 6.4e6 m a step of 100 m falls 0.8 mm below the plane
    assert (east, up) == pytest.approx((0.0, -(100.0**2) / (2 * SEMI_MAJOR_AXIS)), abs=1e-4)


@given(st.floats(-80.0, 80.0), longitudes)
def test_a_hundred_metres_east_are_a_hundred_metres(latitude: float, longitude: float) -> None:
    # a circle of latitude has the radius a cos(beta), beta the parametric latitude
    beta = np.arctan((1.0 - FLATTENING) * np.tan(np.radians(latitude)))
    step_deg = np.degrees(100.0 / (SEMI_MAJOR_AXIS * np.cos(beta)))
    east, north, up = local_enu([latitude] * 2, [longitude, longitude + step_deg], [0.0, 0.0])[1]
    assert east == pytest.approx(100.0, abs=1e-6 + 1e-7 / np.cos(beta) ** 2)
    assert abs(north) < 0.01
    assert up == pytest.approx(-(100.0**2) / (2 * SEMI_MAJOR_AXIS), abs=1e-5)


def test_no_positions_give_no_positions() -> None:
    assert local_enu([], [], []).shape == (0, 3)
