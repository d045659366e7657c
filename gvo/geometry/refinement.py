"""Robust Gauss-Newton of a relative pose over stereo reprojection residuals.

The residual of a match is its measurement in the target frame, (u, v, disparity), less the
projection of the source frame's point. Both frames are noisy: the source's noise is carried
through the motion and added before the residual is whitened.

The covariance is H^-1 S H^-1 with S the spread that the matches' gradients show, not the one
that their sigmas promise. A common scale would not do: where disparities are better than stated
and pixels are not, it calls the pixels better as well.

References
----------
P. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35(1), 1964,
doi:10.1214/aoms/1177703732.
H. White, "A heteroskedasticity-consistent covariance matrix estimator and a direct test for
heteroskedasticity", Econometrica 48(4), 1980, doi:10.2307/1912934 (the covariance).
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
# Nearer points, or points behind the camera, have no noise to speak of: they are no inliers.
_MIN_NOISE_DEPTH_M = 0.1
# A step of three hundredths of a sigma no longer matters; this is its square.
_CONVERGED = 1e-3
# Residuals may prove the noise smaller than stated, but not absent: two copies of one image, which
# recordings do hold, fit exactly and know no more of the motion than other pairs.
_MIN_SCALE = 0.1
# The spread of the scores of few matches is itself uncertain: so many more stand in with the
# spread that the sigmas promise. Without them 12 matches give an NEES of 3 where 1 is due.
_N_PROMISED = 24
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
    problem = _Problem.of(T_target_source, matches, camera, huber=config.huber)
    n_first = min(_N_FIRST_ITERATIONS, config.n_iterations)
    T = _gauss_newton(T_target_source, problem.select(inliers), n_iterations=n_first)
    if isinstance(T, Failure):
        return T
    chosen = _within_gate(T, problem, config.gate)
    if np.count_nonzero(chosen) < np.count_nonzero(inliers) // 2:
        chosen = inliers
    T = _gauss_newton(T, problem.select(chosen), n_iterations=config.n_iterations)
    if isinstance(T, Failure):
        return T
    return _with_covariance(T, problem.select(chosen), chosen)


def fit_covariance(
    T_target_source: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    config: RegistrationConfig,
) -> Refinement | Failure:
    """Give an unrefined pose the covariance that its residuals in the image imply.

    Parameters and results are those of `refine_pose`; pose and inliers stay as they are.
    """
    problem = _Problem.of(T_target_source, matches, camera, huber=config.huber)
    return _with_covariance(T_target_source, problem.select(inliers), inliers)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Normal:
    """The normal equations H step = g at one pose, and the weighted sum of squares there."""

    H: FloatArray
    g: FloatArray
    sum_of_squares: float
    n_matches: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Points, their measurements and the inverse covariances of the residuals (n, 3, 3)."""

    source_points: FloatArray
    target_uvd: FloatArray
    information: FloatArray
    camera: StereoCamera
    huber: float

    @classmethod
    def of(
        cls, T: FloatArray, matches: Correspondences, camera: StereoCamera, *, huber: float
    ) -> _Problem:
        # The noise is carried through the start value and not again: it changes by far less
        # than it is known.
        return cls(
            source_points=matches.source_points,
            target_uvd=matches.target_uvd,
            information=_information(T, matches, camera),
            camera=camera,
            huber=huber,
        )

    def select(self, chosen: BoolArray) -> _Problem:
        return _Problem(
            source_points=self.source_points[chosen],
            target_uvd=self.target_uvd[chosen],
            information=self.information[chosen],
            camera=self.camera,
            huber=self.huber,
        )

    def residuals(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, 3) and their squared whitened norms (n,)."""
        r = self.target_uvd - self.camera.project_stereo(points)
        return r, np.asarray(np.einsum("ni,nij,nj->n", r, self.information, r))

    def linearize(self, T: FloatArray) -> _Normal | Failure:
        points = se3.transform_points(T, self.source_points)
        if np.any(points[:, 2] < _MIN_DEPTH_M):
            return Failure(reason="the motion puts points behind the camera")
        r, squared = self.residuals(points)
        weights = self.huber / np.maximum(np.sqrt(squared), self.huber)
        J = pose_jacobian(points, self.camera)
        weighted = ((self.information * weights[:, np.newaxis, np.newaxis]) @ J).reshape(-1, 6)
        return _Normal(
            H=weighted.T @ J.reshape(-1, 6),
            g=weighted.T @ r.ravel(),
            sum_of_squares=float(np.sum(weights * squared)),
            n_matches=len(points),
        )

    def scores(self, T: FloatArray) -> FloatArray:
        """Return the share of each match in g, shape (n, 6); at the optimum they sum to zero."""
        points = se3.transform_points(T, self.source_points)
        r, squared = self.residuals(points)
        weights = self.huber / np.maximum(np.sqrt(squared), self.huber)
        whitened = weights[:, np.newaxis] * np.einsum("nij,nj->ni", self.information, r)
        return np.asarray(np.einsum("nij,ni->nj", pose_jacobian(points, self.camera), whitened))


def _information(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    points = se3.transform_points(T, matches.source_points)
    points[points[:, 2] < _MIN_NOISE_DEPTH_M] = (0.0, 0.0, 1.0)  # of no account, but finite
    J = (
        projection_jacobian(points, camera)
        @ T[:3, :3]
        @ unprojection_jacobian(matches.source_points, camera)
    )
    covariance = (J * matches.source_sigmas[:, np.newaxis] ** 2) @ np.swapaxes(J, 1, 2)
    covariance[:, range(3), range(3)] += matches.target_sigmas**2
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def _gauss_newton(T: FloatArray, problem: _Problem, *, n_iterations: int) -> FloatArray | Failure:
    for _ in range(n_iterations):
        normal = problem.linearize(T)
        if isinstance(normal, Failure):
            return normal
        step = _solve(normal)
        if isinstance(step, Failure):
            return step
        # Not the exponential map but a retraction: the same to first order, and cheap.
        T = se3.make_transform(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]) @ T
        if step @ normal.g < _CONVERGED:
            break
    if not np.isfinite(T).all():
        return Failure(reason="the refinement diverged", n_matches=len(problem.source_points))
    return se3.normalize(T)


def _solve(normal: _Normal) -> FloatArray | Failure:
    scale = np.sqrt(np.diag(normal.H))
    if not np.all(np.isfinite(scale)) or np.any(scale <= 0):
        return Failure(reason="the matches leave a direction of motion open")
    eigenvalues, V = np.linalg.eigh(normal.H / np.outer(scale, scale))
    if eigenvalues[0] < 1e-10 * eigenvalues[-1]:
        return Failure(reason="the matches leave a direction of motion open")
    return np.asarray(V @ ((V.T @ (normal.g / scale)) / eigenvalues) / scale)


def _within_gate(T: FloatArray, problem: _Problem, gate: float) -> BoolArray:
    points = se3.transform_points(T, problem.source_points)
    is_in_front = points[:, 2] > _MIN_DEPTH_M
    points[~is_in_front, 2] = 1.0
    _, squared = problem.residuals(points)
    return np.asarray(is_in_front & (squared < gate**2))


def _with_covariance(T: FloatArray, problem: _Problem, inliers: BoolArray) -> Refinement | Failure:
    normal = problem.linearize(T)
    if isinstance(normal, Failure):
        return normal
    open_direction = _solve(normal)
    if isinstance(open_direction, Failure):
        return open_direction
    n = normal.n_matches
    scale_squared = max(normal.sum_of_squares / max(3 * n - 6, 1), _MIN_SCALE**2)
    promised = scale_squared * normal.H
    scores = problem.scores(T)
    seen = n / max(n - 2, 1) * scores.T @ scores
    spread = (n * seen + _N_PROMISED * promised) / (n + _N_PROMISED)
    H_inverse = np.linalg.inv(normal.H)
    covariance = H_inverse @ (spread + _MIN_SCALE**2 * normal.H) @ H_inverse
    return Refinement(
        T_target_source=T,
        covariance=0.5 * (covariance + covariance.T),
        inliers=inliers,
        scale=float(np.sqrt(scale_squared)),
    )
