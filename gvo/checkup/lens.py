"""Lens distortion that rectified images should not have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.checkup.stereo_matches import FreeMatches
from gvo.geometry.camera import PinholeCamera
from gvo.types import Failure, FloatArray

_MAX_ROW_PX = 8.0
_N_ROUNDS = 5
_N_SIGMAS = 3.0
_MAX_SIGMA = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class LensError:
    """Radial distortion that is left in a pair.

    Parameters
    ----------
    k1 : float
        First radial coefficient, as of `plumb_bob`; the same in both cameras.
    sigma : float
        Its standard deviation.
    """

    k1: float
    sigma: float


def lens_error(matches: FreeMatches, camera: PinholeCamera) -> LensError | Failure:
    """Estimate the radial distortion that both images of a pair still have.

    With distortion a point moves along its radius by the factor 1 + k1 r^2. Left and right see it
    at other radii, so that its rows differ by fy y k1 (r_left^2 - r_right^2): a pattern that
    neither an offset nor a turn of the cameras makes. These are fitted along.

    Parameters
    ----------
    matches : FreeMatches
        Of images that should be rectified.
    camera : PinholeCamera
        Of the left one.

    Returns
    -------
    LensError or Failure
        The failure says that the matches do not show it: all far away, or near the centre.

    References
    ----------
    D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering, 1966.
    """
    left = camera.unproject(matches.pixels_left)[:, :2]
    right = camera.unproject(matches.pixels_right)[:, :2]
    rows = -matches.row_differences
    y = camera.fy * left[:, 1]
    pattern = y * (np.sum(left**2, axis=1) - np.sum(right**2, axis=1))
    columns = np.column_stack([np.ones(len(y)), y, camera.fy * left[:, 0], pattern])
    is_kept = np.abs(rows - np.median(rows)) < _MAX_ROW_PX
    for _ in range(_N_ROUNDS):
        errors = rows - columns @ _solve(columns[is_kept], rows[is_kept])
        spread = 1.4826 * np.median(np.abs(errors[is_kept]))
        is_kept = np.abs(errors) <= _N_SIGMAS * spread + 1e-6
    kept = columns[is_kept]
    variance = float(np.var(errors[is_kept]))
    sigma = float(np.sqrt(variance * np.linalg.pinv(kept.T @ kept)[3, 3]))
    if np.linalg.matrix_rank(kept) < kept.shape[1] or sigma > _MAX_SIGMA:
        return Failure(reason=f"{len(rows)} matches do not show it (k1 to +/- {sigma:.2f})")
    return LensError(k1=float(_solve(kept, rows[is_kept])[3]), sigma=sigma)


def _solve(columns: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0])
