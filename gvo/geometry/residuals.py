"""Whitened stereo reprojection residuals of matches, and their Jacobians.

The residual of a match is its measurement (u, v, disparity) in the current frame less the
projection of its point in the reference. Both frames are noisy: the reference's covariance is
propagated through the motion and added before the residual is whitened.

Arrays hold one match per column: all operations run along contiguous memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import BoolArray, Failure, FloatArray

HUBER = 1.5
"""Threshold of the robust kernel on the whitened residual of a match, sigmas."""

_MIN_DEPTH_M = 1e-3
_N_ROWS = 15
# Nearer points, and points behind the camera, are no inliers: their noise is not propagated.
_MIN_NOISE_DEPTH_M = 0.1


def pose_jacobian(points_cam: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return the derivatives of (u, v, disparity) of points by the motion of the camera.

    Parameters
    ----------
    points_cam : ndarray of float64, shape (3, n)
        Points in the `cam` frame, metres.
    camera : StereoCamera

    Returns
    -------
    ndarray of float64, shape (6, 3, n)
        Of (u, v, disparity) by (rx, ry, rz, tx, ty, tz), right perturbation of the camera's pose:
        points move the other way.
    """
    inverse_z = 1.0 / points_cam[2]
    x, y = points_cam[:2] * inverse_z
    xy = x * y
    J = np.zeros((6, 3, len(x)))
    J[0, 0], J[0, 1] = camera.fx * xy, camera.fy * (1.0 + y * y)
    J[1, 0], J[1, 1] = -camera.fx * (1.0 + x * x), -camera.fy * xy
    J[2, 0], J[2, 1] = camera.fx * y, -camera.fy * x
    J[3, 0] = -camera.fx * inverse_z
    J[4, 1] = -camera.fy * inverse_z
    J[5, 0], J[5, 1] = -x * J[3, 0], -y * J[4, 1]
    disparities = camera.fx * camera.baseline * inverse_z
    J[0, 2], J[1, 2] = disparities * y, -disparities * x
    J[5, 2] = disparities * inverse_z
    return J


def reference_jacobian(
    T_reference_current: FloatArray, reference_points: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return the derivatives of what is predicted by what the reference measured.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
    reference_points : ndarray of float64, shape (3, n)
        Points in the reference, metres.
    camera : StereoCamera
        Of both frames.

    Returns
    -------
    ndarray of float64, shape (3, 3, n)
        Of (u, v, disparity) in the current frame by (u, v, disparity) in the reference.
        Meaningless, but finite, for points less than 0.1 m in front of the current camera.
    """
    T_current_reference = se3.invert(T_reference_current)
    R, t = T_current_reference[:3, :3], T_current_reference[:3, 3:]
    rotated = R @ reference_points
    points = rotated + t
    points[:, points[2] < _MIN_NOISE_DEPTH_M] = ((0.0,), (0.0,), (1.0,))
    inverse_z = 1.0 / points[2]
    x, y = points[:2] * inverse_z
    depths = reference_points[2]
    moved = np.empty((3, 3, len(depths)))  # the point's motion in the current frame
    moved[0] = R[:, :1] * (depths / camera.fx)
    moved[1] = R[:, 1:2] * (depths / camera.fy)
    moved[2] = rotated * (depths / (-camera.fx * camera.baseline))
    forward = moved[:, 2] * inverse_z
    J = np.empty_like(moved)
    J[:, 0] = camera.fx * (moved[:, 0] * inverse_z - x * forward)
    J[:, 1] = camera.fy * (moved[:, 1] * inverse_z - y * forward)
    J[:, 2] = (-camera.fx * camera.baseline * inverse_z) * forward
    return J


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearization:
    """Residuals and Jacobian at one pose, whitened, times the square root of robust weights.

    Parameters
    ----------
    J : ndarray of float64, shape (6, 3, n)
        Of the predictions by the pose.
    r : ndarray of float64, shape (3, n)
        Residuals: measurement less prediction.
    factors : ndarray of float64, shape (6, n)
        Factors W of `StereoResiduals`, times the square roots of the weights.
    H : ndarray of float64, shape (6, 6)
    g : ndarray of float64, shape (6,)
        The normal equations H step = g.
    """

    J: FloatArray
    r: FloatArray
    factors: FloatArray
    H: FloatArray
    g: FloatArray

    def scores(self) -> FloatArray:
        """Return each match's contribution to g, shape (6, n); they sum to zero at the optimum."""
        return np.asarray(np.einsum("kin,in->kn", self.J, self.r))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoResiduals:
    """Matches with the factors that whiten their residuals.

    Parameters
    ----------
    columns : ndarray of float64, shape (15 + 6 k, n)
        Points in the reference, (u, v, disparity) in the current frame, the lower triangle
        (00, 10, 11, 20, 21, 22) of the factor W with W^T W the inverse covariance of the
        residual, the variances of (u, v, disparity) in the reference, and the derivatives of
        (u, v, disparity) in reference and current frame by each constant.
    camera : StereoCamera
    huber : float
        Threshold of the robust kernel, sigmas.
    constants : tuple of str
        Names of the k constants of the camera whose errors are to be estimated.
    """

    columns: FloatArray
    camera: StereoCamera
    huber: float
    constants: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, T: FloatArray, matches: Correspondences, camera: StereoCamera, *, huber: float = HUBER
    ) -> StereoResiduals:
        """Whiten by the noise of both frames, propagated through the start value T.

        It is not propagated again: it changes by far less than its own uncertainty.
        """
        constants = tuple(matches.sensitivities)
        columns = np.empty((_N_ROWS + 6 * len(constants), len(matches)))
        columns[:3] = matches.reference_points.T
        columns[3:6] = matches.current_uvd.T
        columns[12:_N_ROWS] = matches.reference_sigmas.T**2
        for rows, name in zip(
            columns[_N_ROWS:].reshape(len(constants), 6, len(matches)), constants, strict=True
        ):
            rows[:3], rows[3:] = np.swapaxes(matches.sensitivities[name], 1, 2)
        J = reference_jacobian(T, columns[:3], camera)
        J *= matches.reference_sigmas.T[:, np.newaxis]
        _write_factors(columns[6:12], J, matches.current_sigmas.T**2)
        return cls(columns=columns, camera=camera, huber=huber, constants=constants)

    @property
    def reference_points(self) -> FloatArray:
        """Points in the reference, shape (3, n), metres."""
        return self.columns[:3]

    def select(self, chosen: BoolArray) -> StereoResiduals:
        """Return the residuals of some matches."""
        return replace(self, columns=self.columns.take(np.flatnonzero(chosen), axis=1))

    def without(self, errors: FloatArray) -> StereoResiduals:
        """Return the residuals after current measurements were corrected, shape (3, n)."""
        columns = self.columns.copy()
        columns[3:6] -= errors
        return replace(self, columns=columns)

    def sensitivities(self, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives by the constants, not whitened.

        Parameters
        ----------
        T : ndarray of float64, shape (4, 4)
            T_reference_current.

        Returns
        -------
        of_residuals : ndarray of float64, shape (k, 3, n)
        of_current : ndarray of float64, shape (k, 3, n)
            The part of the measurements in the current frame.
        """
        n = self.columns.shape[1]
        in_reference, in_current = np.swapaxes(
            self.columns[_N_ROWS:].reshape(len(self.constants), 2, 3, n), 0, 1
        )
        J = reference_jacobian(T, self.reference_points, self.camera)
        # An error moves the current measurement directly, the prediction through the reference.
        return in_current - np.einsum("jin,kjn->kin", J, in_reference), in_current.copy()

    def linearize(self, T: FloatArray) -> Linearization | Failure:
        """Linearize at T; a failure if points fall behind the camera.

        Parameters
        ----------
        T : ndarray of float64, shape (4, 4)
            T_reference_current.
        """
        points = self._moved(T)
        if isinstance(points, Failure):
            return points
        r, roots = self._weighed(points)
        r *= roots
        factors = self.columns[6:12] * roots
        J = pose_jacobian(points, self.camera)
        whiten_in_place(factors, J)
        flat = J.reshape(6, -1)
        return Linearization(J=J, r=r, factors=factors, H=flat @ flat.T, g=flat @ r.ravel())

    def within(self, T: FloatArray, gate: float) -> BoolArray:
        """Tell which residuals are shorter than a gate in sigmas; none behind the camera."""
        return np.asarray(self.squared(T) < gate**2)

    def squared(self, T: FloatArray) -> FloatArray:
        """Return the squared lengths of the residuals, in sigmas; infinite behind the camera."""
        points = T[:3, :3].T @ (self.columns[:3] - T[:3, 3:])
        is_in_front = points[2] > _MIN_DEPTH_M
        points[2, ~is_in_front] = 1.0
        _, squared = self._whitened(points)
        return np.where(is_in_front, squared, np.inf)

    def _moved(self, T: FloatArray) -> FloatArray | Failure:
        """Return the points in the current frame, shape (3, n)."""
        points = T[:3, :3].T @ (self.columns[:3] - T[:3, 3:])
        if np.any(points[2] < _MIN_DEPTH_M):
            return Failure(reason="the motion puts points behind the camera")
        return points

    def _weighed(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (3, n) and the square roots (n,) of their Huber weights."""
        r, squared = self._whitened(points)
        return r, np.sqrt(self.huber / np.maximum(np.sqrt(squared), self.huber))

    def _whitened(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (3, n) and their squared norms (n,)."""
        camera = self.camera
        scaled = camera.fx / points[2]
        r = self.columns[3:6].copy()
        r[0] -= points[0] * scaled + camera.cx
        r[1] -= points[1] * scaled * (camera.fy / camera.fx) + camera.cy
        r[2] -= camera.baseline * scaled
        whiten_in_place(self.columns[6:12], r)
        return r, r[0] ** 2 + r[1] ** 2 + r[2] ** 2


def whiten_in_place(factors: FloatArray, rows: FloatArray) -> None:
    """Multiply (u, v, disparity), shape (..., 3, n), by lower triangles (6, n)."""
    u, v, d = rows[..., 0, :], rows[..., 1, :], rows[..., 2, :]
    d *= factors[5]
    d += factors[4] * v
    d += factors[3] * u
    v *= factors[2]
    v += factors[1] * u
    u *= factors[0]


def _write_factors(out: FloatArray, J: FloatArray, current_variances: FloatArray) -> None:
    """Write the inverse Cholesky factors of J^T J + diag(current_variances), shape (6, n).

    The squared pivots are no less than the current variances, but for rounding.
    """
    covariance = np.einsum("kin,kjn->ijn", J, J)
    var_u, var_v, var_d = current_variances
    out[0] = 1.0 / np.sqrt(covariance[0, 0] + var_u)
    l_vu, l_du = covariance[1:, 0] * out[0]
    out[2] = 1.0 / np.sqrt(np.maximum(covariance[1, 1] + var_v - l_vu**2, var_v))
    l_dv = (covariance[2, 1] - l_du * l_vu) * out[2]
    out[5] = 1.0 / np.sqrt(np.maximum(covariance[2, 2] + var_d - l_du**2 - l_dv**2, var_d))
    out[1] = -l_vu * out[0] * out[2]
    out[4] = -l_dv * out[2] * out[5]
    out[3] = -(l_du * out[0] + l_dv * out[1]) * out[5]
