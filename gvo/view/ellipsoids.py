"""Covariances as ellipsoids."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.types import FloatArray, IntArray


def position_ellipsoids(
    T_world_cam: FloatArray, covariances: FloatArray, n_sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return the half axes and orientations of the positions' ellipsoids.

    Parameters
    ----------
    T_world_cam : ndarray of float64, shape (n, 4, 4)
        Poses, metres.
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the camera frame.
    n_sigmas : float
        Half axes are so many standard deviations.

    Returns
    -------
    half_axes : ndarray of float64, shape (n, 3)
        Metres, the smallest first.
    quaternions_wxyz : ndarray of float64, shape (n, 4)
        Of the axes in the world.
    """
    variances, axes_cam = np.linalg.eigh(covariances[:, 3:, 3:])
    axes_world = T_world_cam[:, :3, :3] @ axes_cam
    axes_world[:, :, 2] *= np.sign(np.linalg.det(axes_world))[:, np.newaxis]
    half_axes = n_sigmas * np.sqrt(np.maximum(variances, 0.0))
    return half_axes, quaternions_wxyz(axes_world)


def quaternions_wxyz(rotations: FloatArray) -> FloatArray:
    """Return unit quaternions (n, 4), w first, of rotation matrices (n, 3, 3)."""
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=-1)


def position_sigmas(T_world_cam: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviations (3,) of a position along the axes of the world, metres."""
    R = T_world_cam[:3, :3]
    return np.asarray(np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T)))


def unit_sphere(n_rings: int = 10) -> tuple[FloatArray, IntArray]:
    """Return the corners (v, 3) and triangles (f, 3) of a sphere of radius 1."""
    n_around = 2 * n_rings
    polar = np.linspace(0.0, np.pi, n_rings + 1)
    around = np.linspace(0.0, 2.0 * np.pi, n_around, endpoint=False)
    z = np.repeat(np.cos(polar), n_around)
    x = np.outer(np.sin(polar), np.cos(around)).ravel()
    y = np.outer(np.sin(polar), np.sin(around)).ravel()
    ring, step = np.divmod(np.arange(n_rings * n_around), n_around)
    a = ring * n_around + step
    b = ring * n_around + (step + 1) % n_around
    lower = np.stack([a, a + n_around, b], axis=1)
    upper = np.stack([b, a + n_around, b + n_around], axis=1)
    return np.stack([x, y, z], axis=1), np.concatenate([lower, upper])
