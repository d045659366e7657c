"""Robust Gauss-Newton of a relative pose over stereo reprojection residuals.

The covariance is A^-1 S A^-1 (sandwich estimator), with A the second derivative of the robust cost
and S the sample covariance of the matches' gradients, not that implied by their sigmas. A common
scale would not do: if disparities are better than stated and pixels are not, it would call the
pixels better as well.

Errors of constants of the camera show in the residuals too. If all disparities are too large by the
same amount in both frames, near and far points disagree about the motion; if rows are exposed one
after the other, upper and lower ones. They are further parameters beside the pose, estimated by one
step of least squares from the pose that assumes they are zero.

References
----------
P. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35(1), 1964,
doi:10.1214/aoms/1177703732.
H. White, "A heteroskedasticity-consistent covariance matrix estimator and a direct test for
heteroskedasticity", Econometrica 48(4), 1980, doi:10.2307/1912934 (the covariance).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.linalg.lapack import dposv

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import (
    HUBER,
    Linearization,
    StereoResiduals,
    whiten_in_place,
)
from gvo.types import BoolArray, ConstantError, Failure, FloatArray

GATE = 3.0
"""Maximum whitened residual of an inlier of a refined pose, sigmas."""

# Iterations at most after the inliers are chosen again.
_N_ITERATIONS = 10
# Squared length of a step, in sigmas, that no longer matters.
_CONVERGED = 1e-3
# Variance inflation of a parameter above which a direction of motion is unobservable.
_MAX_INFLATION = 1e10
# Lower bound of the noise scale: two copies of one image, which recordings do hold, fit exactly
# and tell no more about the motion than other pairs.
_MIN_SCALE = 0.1
# Pseudo-observations with the covariance implied by the sigmas: the sample covariance of few
# gradients is itself uncertain. Without them 12 matches give an NEES of 3 instead of 1.
_N_PROMISED = 24
# Largest ratio of variances with and without the curvature of the kernel: if long residuals alone
# constrain a direction, their curvature is no measure of it.
_MAX_LOSS = 10.0
# The first round only has to be good enough to choose the inliers again.
_N_FIRST_ITERATIONS = 2
# Information on a constant, relative to that of the current measurements alone, below which it is
# rounding.
_MIN_SHARE = 1e-10
_IDENTITY = np.eye(6)
_OPEN = "the matches leave a direction of motion open"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """A refined pose with its covariance.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation.
    inliers : ndarray of bool, shape (n,)
        The matches used.
    scale : float
        Weighted root mean square of the whitened residuals; one if the sigmas are right.
    residuals : StereoResiduals
        Of all matches, whitened at the start value.
    calibration_errors : mapping of str to ConstantError
        See `estimate_constants`.
    """

    T_reference_current: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    scale: float
    residuals: StereoResiduals
    calibration_errors: Mapping[str, ConstantError] = field(default_factory=dict)


def refine_pose(
    T_reference_current: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    *,
    huber: float = HUBER,
    gate: float = GATE,
) -> Refinement | Failure:
    """Minimize the Huber cost of whitened (u, v, disparity) residuals.

    The inliers of a minimal sample are biased towards its error, which shortens or stretches the
    motion: after a few iterations they are chosen again from all matches.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Start value.
    matches : Correspondences
        All n putative matches.
    inliers : ndarray of bool, shape (n,)
        Initial inliers.
    camera : StereoCamera
        Of both frames.
    huber : float
        Threshold of the Huber kernel on the whitened residual of a match, sigmas.
    gate : float
        Maximum whitened residual of an inlier of the refined pose, sigmas.

    Returns
    -------
    Refinement or Failure
        A failure if a direction of motion is unobservable.
    """
    residuals = StereoResiduals.of(T_reference_current, matches, camera, huber=huber)
    # Unobservable directions may give steps that are not finite; they are checked.
    with np.errstate(over="ignore", invalid="ignore"):
        rough = _gauss_newton(
            T_reference_current, residuals.select(inliers), n_iterations=_N_FIRST_ITERATIONS
        )
        if isinstance(rough, Failure):
            return rough
        chosen = residuals.within(rough, gate)
        if np.count_nonzero(chosen) < np.count_nonzero(inliers) // 2:
            chosen = inliers
        every, residuals = residuals, residuals.select(chosen)
        T = _gauss_newton(rough, residuals, n_iterations=_N_ITERATIONS)
        if isinstance(T, Failure):
            return T
        # Orthonormal to the last digit: many motions are composed with this one.
        T = se3.normalize(T)
        return _with_covariance(T, residuals, (chosen, every))


def descend(
    T_reference_current: FloatArray, residuals: StereoResiduals, *, n_iterations: int
) -> FloatArray | None:
    """Minimize the cost of residuals by a few Gauss-Newton steps; None if they fail.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Start value.
    residuals : StereoResiduals
    n_iterations : int
        Maximum number.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        T = _gauss_newton(T_reference_current, residuals, n_iterations=n_iterations)
    return None if isinstance(T, Failure) else T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjustment:
    """A pose and errors of constants, estimated together.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
    values : ndarray of float64, shape (k,)
        Errors of the constants, in units of what is known of them.
    covariance : ndarray of float64, shape (k, k)
        Of these.
    effects : ndarray of float64, shape (6, k)
        Derivative of the pose, right perturbation, by what is taken off for each error.
    """

    T_reference_current: FloatArray
    values: FloatArray
    covariance: FloatArray
    effects: FloatArray


def adjust(
    T_reference_current: FloatArray,
    residuals: StereoResiduals,
    *,
    n_iterations: int,
    sigma_factor: float = 1.0,
) -> Adjustment | None:
    """Estimate a pose and the constants of the residuals together; None where it fails.

    Errors of the constants are around zero by a sigma of one, in their units.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Start value.
    residuals : StereoResiduals
        Of the matches used.
    n_iterations : int
        Of Gauss-Newton steps.
    sigma_factor : float
        Inflation of the matches' sigmas, relative to what is known of the constants.
    """
    T = T_reference_current
    J_constants, _ = residuals.sensitivities(T)
    k, weight = len(J_constants), sigma_factor**2
    values, H = np.zeros(k), np.eye(6 + k)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(n_iterations):
            at = residuals.without(np.einsum("kin,k->in", J_constants, values)).linearize(T)
            if isinstance(at, Failure):
                return None
            rows = np.concatenate([at.J, J_constants])
            whiten_in_place(at.factors, rows[6:])
            flat = rows.reshape(6 + k, -1)
            H, g = flat @ flat.T, flat @ at.r.ravel()
            H[6:, 6:] += weight * np.eye(k)
            g[6:] -= weight * values
            _, step, info = dposv(H, g)
            if info != 0 or not np.isfinite(step).all():
                return None
            T = T @ se3.make_transform(cv2.Rodrigues(step[:3])[0], step[3:6])
            values = values + step[6:]
    return Adjustment(
        T_reference_current=se3.normalize(T),
        values=values,
        covariance=weight * np.asarray(np.linalg.inv(H)[6:, 6:], dtype=np.float64),
        effects=-np.asarray(np.linalg.solve(H[:6, :6], H[:6, 6:]), dtype=np.float64),
    )


def fit_covariance(
    T_reference_current: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    *,
    huber: float = HUBER,
) -> Refinement | Failure:
    """Return an unrefined pose with the covariance implied by its residuals.

    Parameters and results are those of `refine_pose`; pose and inliers stay as they are.
    """
    residuals = StereoResiduals.of(T_reference_current, matches, camera, huber=huber)
    return _with_covariance(T_reference_current, residuals.select(inliers), (inliers, residuals))


def _gauss_newton(
    T: FloatArray, residuals: StereoResiduals, *, n_iterations: int
) -> FloatArray | Failure:
    """Return the pose after the last step."""
    for _ in range(n_iterations):
        at = residuals.linearize(T)
        if isinstance(at, Failure):
            return at
        # LAPACK called directly: numpy takes several times as long for so small a matrix.
        _, step, info = dposv(at.H, at.g)
        if info != 0 or not np.isfinite(step).all():
            return Failure(reason=_OPEN)
        # Not the exponential map but a retraction: the same to first order, and cheap.
        T = T @ se3.make_transform(cv2.Rodrigues(step[:3])[0], step[3:])
        if step @ at.g < _CONVERGED:
            break
    return T


def _with_covariance(
    T: FloatArray, residuals: StereoResiduals, inliers: tuple[BoolArray, StereoResiduals]
) -> Refinement | Failure:
    """Finish a refinement; `inliers` are the mask of the matches used and the residuals of all."""
    last = residuals.linearize(T)
    if isinstance(last, Failure):
        return last
    _, H_inverse, info = dposv(last.H, _IDENTITY)
    inflation = np.diagonal(last.H) * np.diagonal(H_inverse)
    if info != 0 or not np.all(inflation < _MAX_INFLATION):
        return Failure(reason=_OPEN)
    scale = _scale(last)
    scores = last.scores()
    sensitivity = _sensitivity(last, scores, H_inverse, residuals.huber)
    covariance = sensitivity @ _spread(last, scores, scale) @ sensitivity.T
    return Refinement(
        T_reference_current=T,
        covariance=0.5 * (covariance + covariance.T),
        inliers=inliers[0],
        scale=scale,
        residuals=inliers[1],
        calibration_errors=estimate_constants(T, residuals, last),
    )


def _sensitivity(
    at: Linearization, scores: FloatArray, H_inverse: FloatArray, huber: float
) -> FloatArray:
    """Return the inverse Hessian of the robust cost, shape (6, 6).

    Beyond its threshold the Huber cost is linear: residuals there have no curvature along their
    own direction. H, which weighs them as if they had, would make the pose overconfident.
    """
    squares = at.r[0] ** 2 + at.r[1] ** 2 + at.r[2] ** 2
    far = np.flatnonzero(squares > huber**2)
    pulls = scores[:, far] / np.sqrt(squares[far])
    _, inverse, info = dposv(at.H - pulls @ pulls.T, _IDENTITY)
    is_sane = info == 0 and np.all(np.diagonal(inverse) < _MAX_LOSS * np.diagonal(H_inverse))
    return np.asarray(inverse) if is_sane else H_inverse


def _scale(at: Linearization) -> float:
    mean_square = float(np.vdot(at.r, at.r)) / max(at.r.size - 6, 1)
    return max(math.sqrt(mean_square), _MIN_SCALE)


def _spread(at: Linearization, scores: FloatArray, scale: float) -> FloatArray:
    """Return the sample covariance of the gradient, shape (6, 6)."""
    n = at.r.shape[1]
    seen = n / max(n - 2, 1) * (scores @ scores.T)
    promised = scale**2 * at.H
    spread = (n * seen + _N_PROMISED * promised) / (n + _N_PROMISED)
    return np.asarray(spread + _MIN_SCALE**2 * at.H)


def estimate_constants(
    T_reference_current: FloatArray, residuals: StereoResiduals, at: Linearization
) -> dict[str, ConstantError]:
    """Estimate the errors of constants of the camera, each beside the pose and the others.

    Errors are in units of what is known of them: the others are around zero by a sigma of one.

    Sigma is that of the sample, not implied by the matches' sigmas.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        The refined pose.
    residuals : StereoResiduals
        Of the matches used.
    at : Linearization
        Of the residuals, at the refined pose.

    Returns
    -------
    dict of str to ConstantError
        By name, without those that are unobservable: for points at one depth an offset of the
        disparities acts as a motion does.
    """
    if not residuals.constants:
        return {}
    J_constants, J_alone = residuals.sensitivities(T_reference_current)
    for rows in (J_constants, J_alone):
        whiten_in_place(at.factors, rows)
    flat, flat_pose = J_constants.reshape(len(J_constants), -1), at.J.reshape(6, -1)
    _, motion, info = dposv(at.H, flat_pose @ flat.T)
    if info != 0:
        return {}
    # Schur complement: what no motion explains.
    unexplained = flat - motion.T @ flat_pose
    information = unexplained @ unexplained.T
    alone = np.sum(J_alone**2, axis=(1, 2))
    told = np.flatnonzero(np.diagonal(information) > _MIN_SHARE * alone)
    scores = np.einsum("kin,in->kn", unexplained.reshape(J_constants.shape), at.r)
    # One at a time is free, the others are known.
    free = np.eye(len(scores))[told]
    known = np.eye(len(scores)) - free[:, np.newaxis] * free[:, :, np.newaxis]
    gains = np.linalg.solve(information + known, free[:, :, np.newaxis])[:, :, 0]
    variances = np.einsum("mi,mij,mj->m", gains, scores @ scores.T + known, gains)
    return {
        residuals.constants[k]: ConstantError(
            value=float(value), sigma=float(np.sqrt(variance)), effect=motion[:, k]
        )
        for k, value, variance in zip(told, gains @ np.sum(scores, axis=1), variances, strict=True)
    }
