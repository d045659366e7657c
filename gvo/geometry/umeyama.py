"""The rigid transform between two sets of corresponding points, in closed form.

References
----------
S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
IEEE TPAMI 13(4), 1991, doi:10.1109/34.88573. The scale is fixed to one.
B. Horn, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A
4(4), 1987, doi:10.1364/JOSAA.4.000629 (sets of points that are planes each: triples).
"""

from __future__ import annotations

import numpy as np

from gvo.geometry.se3 import make_transform
from gvo.kernels import consensus
from gvo.types import BoolArray, Failure, FloatArray


def fit_rigid_batch(
    points_a: FloatArray, points_b: FloatArray, *, weights: FloatArray | None = None
) -> tuple[FloatArray, BoolArray]:
    """Fit one rigid transform to each of many sets of corresponding points.

    Parameters
    ----------
    points_a, points_b : ndarray of float64, shape (..., n, 3)
        Corresponding points in two frames, metres.
    weights : ndarray of float64, shape (..., n), optional
        Not negative; equal weights where omitted.

    Returns
    -------
    T_a_b : ndarray of float64, shape (..., 4, 4)
        Minimizes the weighted sum of squared distances; never a reflection. Invalid fits have
        the identity rotation.
    is_valid : ndarray of bool, shape (...)
        False for fewer than three points with weight, for points on a line, for NaN.
    """
    if points_b.shape != points_a.shape or points_b.shape[-1] != 3:
        raise ValueError(f"expected two arrays (..., n, 3), got {points_a.shape}, {points_b.shape}")
    if points_b.shape[-2] < 3:
        T = np.broadcast_to(np.eye(4), (*points_b.shape[:-2], 4, 4)).copy()
        return T, np.zeros(points_b.shape[:-2], dtype=np.bool_)
    w = _normalized_weights(points_b, weights)
    mean_b = np.sum(w * points_b, axis=-2, keepdims=True)
    mean_a = np.sum(w * points_a, axis=-2, keepdims=True)
    centred_b = points_b - mean_b
    # eq. 38: cross-covariance of the two sets
    cross = np.swapaxes(w * (points_a - mean_a), -1, -2) @ centred_b
    is_finite = np.isfinite(cross).all(axis=(-1, -2))
    U, singular_values, Vt = np.linalg.svd(np.where(is_finite[..., None, None], cross, 0.0))
    extent = np.abs(points_b).max(axis=(-1, -2)) * np.abs(points_a).max(axis=(-1, -2))
    is_valid = is_finite & (singular_values[..., 0] > consensus.MIN_SPREAD_RATIO * extent)
    is_valid &= singular_values[..., 1] > consensus.MIN_VARIANCE_RATIO * singular_values[..., 0]
    signs = np.ones_like(singular_values)
    signs[..., 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))  # eq. 39: no reflection
    R = (U * signs[..., np.newaxis, :]) @ Vt  # eq. 40
    R = np.where(is_valid[..., None, None], R, np.eye(3))
    t = (mean_a - mean_b @ np.swapaxes(R, -1, -2))[..., 0, :]  # eq. 41
    return make_transform(R, t), is_valid


def fit_rigid_triples(points_a: FloatArray, points_b: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Fit one rigid transform to each of many triples of corresponding points.

    As `fit_rigid_batch` in a fraction of its time; see `gvo.kernels.consensus`.

    Parameters
    ----------
    points_a, points_b : ndarray of float64, shape (m, 3, 3)
        Triples of corresponding points in two frames, metres.

    Returns
    -------
    T_a_b : ndarray of float64, shape (m, 4, 4)
        Minimizes the sum of squared distances. Invalid fits have the identity rotation.
    is_valid : ndarray of bool, shape (m,)
        False for points on a line, for NaN.
    """
    T, is_valid = np.empty((len(points_a), 4, 4)), np.empty(len(points_a), np.bool_)
    consensus.fit_triples(points_a, points_b, T, is_valid)
    return T, is_valid


def fit_rigid(
    points_a: FloatArray, points_b: FloatArray, *, weights: FloatArray | None = None
) -> FloatArray | Failure:
    """Fit the rigid transform between two sets of corresponding points.

    Parameters
    ----------
    points_a, points_b : ndarray of float64, shape (n, 3)
        Corresponding points in two frames, metres.
    weights : ndarray of float64, shape (n,), optional
        Not negative; equal weights where omitted.

    Returns
    -------
    ndarray of float64, shape (4, 4), or Failure
        T_a_b; a failure for fewer than three points or points on a line.

    Examples
    --------
    >>> points = np.eye(3)
    >>> T = fit_rigid(points + [1.0, 2.0, 3.0], points)
    >>> T[:3, 3].round(6).tolist()
    [1.0, 2.0, 3.0]
    """
    n = len(points_b)
    if n < 3:
        return Failure(reason=f"a rigid fit needs three points, got {n}", n_matches=n)
    T, is_valid = fit_rigid_batch(points_a, points_b, weights=weights)
    if not is_valid:
        return Failure(reason=f"{n} points lie on a line", n_matches=n)
    return T


def _normalized_weights(points: FloatArray, weights: FloatArray | None) -> FloatArray:
    if weights is None:
        return np.full((1, 1), 1.0 / points.shape[-2])
    if np.any(weights < 0):
        raise ValueError("weights must not be negative")
    total = np.sum(weights, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.asarray((weights / total)[..., np.newaxis])
