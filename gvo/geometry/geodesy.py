"""Geodetic positions (latitude, longitude, height) in metres: geocentric, and local ENU.

References
----------
IOGP, "Coordinate conversions and transformations including formulas", Geomatics guidance note 7
part 2: section 4.1.1 (geographic to geocentric, EPSG method 9602) and section 4.1.2 (geocentric
to topocentric, EPSG method 9836). WGS 84: NGA.STND.0036.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gvo.types import FloatArray

SEMI_MAJOR_AXIS = 6378137.0
"""Of the WGS 84 ellipsoid, metres."""
FLATTENING = 1.0 / 298.257223563
"""Of the WGS 84 ellipsoid."""

_ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def geodetic_to_ecef(
    latitudes_deg: ArrayLike, longitudes_deg: ArrayLike, heights: ArrayLike
) -> FloatArray:
    """Return geocentric positions of points given on the WGS 84 ellipsoid.

    Parameters
    ----------
    latitudes_deg, longitudes_deg : array_like of float, shape (...)
        Geodetic, degrees, north and east positive.
    heights : array_like of float, shape (...)
        Above the ellipsoid, metres.

    Returns
    -------
    ndarray of float64, shape (..., 3)
        In the Earth-centred, Earth-fixed frame: x towards latitude and longitude 0, z towards the
        north pole, metres.

    Examples
    --------
    >>> geodetic_to_ecef(0.0, 90.0, 10.0).round(3).tolist()
    [0.0, 6378147.0, 0.0]
    """
    latitudes, longitudes = np.radians(latitudes_deg), np.radians(longitudes_deg)
    h = np.asarray(heights, dtype=np.float64)
    sines = np.sin(latitudes)
    # radius of curvature in the prime vertical
    nu = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * sines**2)
    across = (nu + h) * np.cos(latitudes)  # distance from the axis of the Earth
    return np.stack(
        np.broadcast_arrays(
            across * np.cos(longitudes),
            across * np.sin(longitudes),
            ((1.0 - _ECCENTRICITY_SQUARED) * nu + h) * sines,
        ),
        axis=-1,
    )


def enu_of_ecef(latitude_deg: float, longitude_deg: float) -> FloatArray:
    """Return the rotation R_enu_ecef, shape (3, 3), at a geodetic position.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
        Geodetic, degrees.

    Returns
    -------
    ndarray of float64, shape (3, 3)
        Its rows are east, north and up in the Earth-centred frame.
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def local_enu(
    latitudes_deg: ArrayLike, longitudes_deg: ArrayLike, heights: ArrayLike
) -> FloatArray:
    """Return positions in the local tangent plane (east, north, up) at the first one.

    Parameters
    ----------
    latitudes_deg, longitudes_deg : array_like of float, shape (n,)
        Geodetic on WGS 84, degrees.
    heights : array_like of float, shape (n,)
        Above the ellipsoid, metres.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        East, north, up (REP 103), metres; the first is zero.
    """
    latitudes, longitudes = np.asarray(latitudes_deg), np.asarray(longitudes_deg)
    ecef = geodetic_to_ecef(latitudes, longitudes, heights)
    if len(ecef) == 0:
        return np.empty((0, 3))
    R_enu_ecef = enu_of_ecef(float(latitudes[0]), float(longitudes[0]))
    return np.asarray((ecef - ecef[0]) @ R_enu_ecef.T)
