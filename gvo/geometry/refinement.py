"""Robust Gauss-Newton of a relative pose over stereo reprojection residuals.

The residual of a match is its measurement in the target frame, (u, v, disparity), less the
projection of the source frame's point. Both frames are noisy: the source's noise is carried
through the motion and added before the residual is whitened.

References
----------
P. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35(1), 1964,
doi:10.1214/aoms/1177703732.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.config import RegistrationConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import BoolArray, Failure, FloatArray

_MIN_DEPTH_M = 1e-3
# A step of the pose, radians and metres, that no longer matters.
_CONVERGED = 1e-5
# The first round only has to be good enough to choose the inliers again.
_N_FIRST_ITERATIONS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """A refined pose with its covariance.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), perturbing T_target_source on the left, that is its
        inverse on the right.
    inliers : ndarray of bool, shape (n,)
        The matches that the pose rests on.
    scale : float
        Root of the weighted mean square of the whitened residuals; one where the sigmas fit.
    """

    T_target_source: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    scale: float


def refine_pose(
    T_target_source: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    config: RegistrationConfig,
) -> Refinement | Failure:
    """Minimize the Huber cost of whitened (u, v, disparity) residuals.

    The inliers of a minimal sample lean towards its error, which shortens or stretches the
    motion; so they are chosen again from all matches, around the pose that rests on many.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        Start value.
    matches : Correspondences
        All putative matches, n of them.
    inliers : ndarray of bool, shape (n,)
        The first choice.
    camera : StereoCamera
        Of both frames.
    config : RegistrationConfig
        Iterations, kernel threshold, gate.

    Returns
    -------
    Refinement or Failure
        A failure where the residuals leave a direction of motion open.
    """
    T: FloatArray | Failure = _gauss_newton(
        T_target_source,
        matches.select(inliers),
        camera,
        huber=config.huber,
        n_iterations=min(_N_FIRST_ITERATIONS, config.n_iterations),
    )
    if isinstance(T, Failure):
        return T
    chosen = _within_gate(T, matches, camera, config.gate)
    if np.count_nonzero(chosen) < np.count_nonzero(inliers) // 2:
        chosen = inliers
    inlying = matches.select(chosen)
    T = _gauss_newton(T, inlying, camera, huber=config.huber, n_iterations=config.n_iterations)
    if isinstance(T, Failure):
        return T
    covariance, scale = _covariance(T, inlying, camera, config)
    return Refinement(T_target_source=T, covariance=covariance, inliers=chosen, scale=scale)


def projection_jacobian(points_cam: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return d(u, v, disparity) / d(x, y, z) of points (n, 3), shape (n, 3, 3)."""
    x, y, z = points_cam.T
    J = np.zeros((len(points_cam), 3, 3))
    J[:, 0, 0] = camera.fx / z
    J[:, 0, 2] = -camera.fx * x / z**2
    J[:, 1, 1] = camera.fy / z
    J[:, 1, 2] = -camera.fy * y / z**2
    J[:, 2, 2] = -camera.fx * camera.baseline / z**2
    return J


def unprojection_jacobian(points_cam: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return d(x, y, z) / d(u, v, disparity) of points (n, 3), shape (n, 3, 3)."""
    z = points_cam[:, 2]
    J = np.zeros((len(points_cam), 3, 3))
    J[:, 0, 0] = z / camera.fx
    J[:, 1, 1] = z / camera.fy
    J[:, :, 2] = -points_cam * (z / (camera.fx * camera.baseline))[:, np.newaxis]
    return J


def pose_jacobian(points_cam: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return d(u, v, disparity) / d(left perturbation) of points, shape (n, 3, 6)."""
    J_point = projection_jacobian(points_cam, camera)
    return np.concatenate([-J_point @ se3.skew(points_cam), J_point], axis=2)


def _gauss_newton(
    T: FloatArray,
    matches: Correspondences,
    camera: StereoCamera,
    *,
    huber: float,
    n_iterations: int,
) -> FloatArray | Failure:
    information = _information(T, matches, camera)
    for _ in range(n_iterations):
        points = se3.transform_points(T, matches.source_points)
        if np.any(points[:, 2] < _MIN_DEPTH_M):
            return Failure(reason="the motion puts points behind the camera")
        H, g, _ = _normal_equations(points, matches, information, camera, huber=huber)
        step = _solve(H, g)
        if isinstance(step, Failure):
            return step
        # Not the exponential map but a retraction: the same to first order, and cheap.
        T = se3.make_transform(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]) @ T
        if np.abs(step).max() < _CONVERGED:
            break
    if not np.isfinite(T).all():
        return Failure(reason="the refinement diverged", n_matches=len(matches))
    return se3.normalize(T)


def _information(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    """Return the inverse covariances of the residuals, both frames' noise, shape (n, 3, 3)."""
    points = se3.transform_points(T, matches.source_points)
    points[:, 2] = np.maximum(points[:, 2], _MIN_DEPTH_M)
    J = (
        projection_jacobian(points, camera)
        @ T[:3, :3]
        @ unprojection_jacobian(matches.source_points, camera)
    )
    covariance = (J * matches.source_sigmas[:, np.newaxis] ** 2) @ np.swapaxes(J, 1, 2)
    covariance[:, range(3), range(3)] += matches.target_sigmas**2
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def _residuals(
    points: FloatArray, matches: Correspondences, information: FloatArray, camera: StereoCamera
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (n, 3) and their squared whitened norms (n,)."""
    r = matches.target_uvd - camera.project_stereo(points)
    return r, np.asarray(np.einsum("ni,nij,nj->n", r, information, r))


def _normal_equations(
    points: FloatArray,
    matches: Correspondences,
    information: FloatArray,
    camera: StereoCamera,
    *,
    huber: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Return H (6, 6), g (6,) and the weighted sum of squares at transformed points."""
    r, squared = _residuals(points, matches, information, camera)
    weights = huber / np.maximum(np.sqrt(squared), huber)
    J = pose_jacobian(points, camera)
    weighted = (information * weights[:, np.newaxis, np.newaxis]) @ J
    flat = weighted.reshape(-1, 6)
    return flat.T @ J.reshape(-1, 6), flat.T @ r.ravel(), float(np.sum(weights * squared))


def _solve(H: FloatArray, g: FloatArray) -> FloatArray | Failure:
    scale = np.sqrt(np.diag(H))
    if not np.all(np.isfinite(scale)) or np.any(scale <= 0):
        return Failure(reason="the matches leave a direction of motion open")
    eigenvalues, V = np.linalg.eigh(H / np.outer(scale, scale))
    if eigenvalues[0] < 1e-10 * eigenvalues[-1]:
        return Failure(reason="the matches leave a direction of motion open")
    return np.asarray(V @ ((V.T @ (g / scale)) / eigenvalues) / scale)


def _within_gate(
    T: FloatArray, matches: Correspondences, camera: StereoCamera, gate: float
) -> BoolArray:
    points = se3.transform_points(T, matches.source_points)
    is_in_front = points[:, 2] > _MIN_DEPTH_M
    points[~is_in_front, 2] = 1.0
    _, squared = _residuals(points, matches, _information(T, matches, camera), camera)
    return np.asarray(is_in_front & (squared < gate**2))


def _covariance(
    T: FloatArray, matches: Correspondences, camera: StereoCamera, config: RegistrationConfig
) -> tuple[FloatArray, float]:
    points = se3.transform_points(T, matches.source_points)
    information = _information(T, matches, camera)
    H, _, sum_of_squares = _normal_equations(
        points, matches, information, camera, huber=config.huber
    )
    scale_squared = max(sum_of_squares / max(3 * len(matches) - 6, 1), 1e-12)
    covariance = np.linalg.inv(H) * scale_squared
    return 0.5 * (covariance + covariance.T), float(np.sqrt(scale_squared))


def fit_covariance(
    T_target_source: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    config: RegistrationConfig,
) -> Refinement | Failure:
    """Give an unrefined pose the covariance that its residuals in the image imply."""
    inlying = matches.select(inliers)
    points = se3.transform_points(T_target_source, inlying.source_points)
    if np.any(points[:, 2] < _MIN_DEPTH_M):
        return Failure(reason="the motion puts points behind the camera")
    information = _information(T_target_source, inlying, camera)
    H, g, _ = _normal_equations(points, inlying, information, camera, huber=config.huber)
    open_direction = _solve(H, g)
    if isinstance(open_direction, Failure):
        return open_direction
    covariance, scale = _covariance(T_target_source, inlying, camera, config)
    return Refinement(
        T_target_source=T_target_source, covariance=covariance, inliers=inliers, scale=scale
    )
