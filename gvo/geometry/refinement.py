"""Robust Gauss-Newton of a relative pose over stereo reprojection residuals.

The covariance is A^-1 S A^-1 with A the second derivative of the robust cost and S the spread that
the matches' gradients show, not the one that their sigmas promise. A common scale would not do:
where disparities are better than stated and pixels are not, it calls the pixels better as well.

Where every disparity is too large by the same amount, in both frames, near and far points
disagree about the motion: so the offset is a seventh parameter beside the pose. It is eliminated
after the fact, by one step of least squares from the pose that assumes it is zero.

References
----------
P. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35(1), 1964,
doi:10.1214/aoms/1177703732.
H. White, "A heteroskedasticity-consistent covariance matrix estimator and a direct test for
heteroskedasticity", Econometrica 48(4), 1980, doi:10.2307/1912934 (the covariance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg.lapack import dposv

from gvo._trace import note
from gvo.config import RegistrationConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import (
    Linearization,
    StereoResiduals,
    pose_jacobian,
    source_jacobian,
    whiten_in_place,
)
from gvo.types import BoolArray, Failure, FloatArray

# A step of three hundredths of a sigma no longer matters; this is its square.
_CONVERGED = 1e-3
# After a step that moves the residuals by less, root mean square in sigmas, that is by a pixel or
# so, the derivatives are still right to a hundredth.
_SHORT = 1.0
# The variance of a parameter, as a multiple of what it is with the others known: beyond, a
# direction of motion is open, and what closes it is rounding.
_MAX_INFLATION = 1e10
# Residuals may prove the noise smaller than stated, but not absent: two copies of one image, which
# recordings do hold, fit exactly and know no more of the motion than other pairs.
_MIN_SCALE = 0.1
# The spread of the scores of few matches is itself uncertain: so many more stand in with the
# spread that the sigmas promise. Without them 12 matches give an NEES of 3 where 1 is due.
_N_PROMISED = 24
# Where long residuals are all that holds a direction, their curvature is no measure of it: no more
# variance than so many times that of the weights.
_MAX_LOSS = 10.0
# The first round only has to be good enough to choose the inliers again.
_N_FIRST_ITERATIONS = 2
# Information on the offset, as a share of what target disparities would tell of it if nothing else
# explained them: below, it is rounding.
_MIN_SHARE = 1e-10
_IDENTITY = np.eye(6)
_OPEN = "the matches leave a direction of motion open"


@dataclass(frozen=True, slots=True, kw_only=True)
class DisparityOffset:
    """By how much disparities are measured too large.

    Parameters
    ----------
    offset_px, sigma_px : float
        Estimate and standard deviation, pixels.
    """

    offset_px: float
    sigma_px: float


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
    residuals : StereoResiduals
        Of all matches, whitened around the start value.
    offset : DisparityOffset or None
        What the inliers tell of a constant offset of the disparities, where it was asked for
        and they tell of it.
    """

    T_target_source: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    scale: float
    residuals: StereoResiduals
    offset: DisparityOffset | None = None


def refine_pose(
    T_target_source: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    config: RegistrationConfig,
    *,
    with_offset: bool = False,
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
    with_offset : bool
        Estimate a constant offset of the disparities too.

    Returns
    -------
    Refinement or Failure
        A failure where the residuals leave a direction of motion open.
    """
    residuals = StereoResiduals.of(T_target_source, matches, camera, huber=config.huber)
    note("refinement.begin", residuals=residuals)
    n_first = min(_N_FIRST_ITERATIONS, config.n_iterations)
    # Where directions are open, steps go anywhere: not finite is an answer like another.
    with np.errstate(over="ignore", invalid="ignore"):
        rough = _gauss_newton(T_target_source, residuals.select(inliers), n_iterations=n_first)
        if isinstance(rough, Failure):
            return rough
        chosen = residuals.within(rough, config.gate)
        if np.count_nonzero(chosen) < np.count_nonzero(inliers) // 2:
            chosen = inliers
        note("refinement.gated", T_target_source=rough, inliers=chosen)
        every, residuals = residuals, residuals.select(chosen)
        T = _gauss_newton(rough, residuals, n_iterations=config.n_iterations)
        if isinstance(T, Failure):
            return T
        # Many motions are multiplied up from this one: it shall be a rotation to the last digit.
        T = se3.normalize(T)
        return _with_covariance(T, residuals, (chosen, every), with_offset=with_offset)


def descend(
    T_target_source: FloatArray, residuals: StereoResiduals, *, n_iterations: int
) -> FloatArray | None:
    """Return where a few steps lead that minimize the cost of some residuals; None where nowhere.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        Start value.
    residuals : StereoResiduals
    n_iterations : int
        At most.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        T = _gauss_newton(T_target_source, residuals, n_iterations=n_iterations)
    return None if isinstance(T, Failure) else T


def fit_covariance(
    T_target_source: FloatArray,
    matches: Correspondences,
    inliers: BoolArray,
    camera: StereoCamera,
    config: RegistrationConfig,
    *,
    with_offset: bool = False,
) -> Refinement | Failure:
    """Give an unrefined pose the covariance that its residuals in the image imply.

    Parameters and results are those of `refine_pose`; pose and inliers stay as they are.
    """
    residuals = StereoResiduals.of(T_target_source, matches, camera, huber=config.huber)
    note("refinement.begin", residuals=residuals)
    chosen = residuals.select(inliers)
    return _with_covariance(T_target_source, chosen, (inliers, residuals), with_offset=with_offset)


def _gauss_newton(
    T: FloatArray, residuals: StereoResiduals, *, n_iterations: int
) -> FloatArray | Failure:
    """Return where steps lead; after a short one the derivatives stay."""
    max_gain = _SHORT**2 * residuals.columns.shape[1]
    near: Linearization | None = None
    for _ in range(n_iterations):
        at = near or residuals.linearize(T)
        if isinstance(at, Failure):
            return at
        g = residuals.gradient(T, near) if near else at.g
        if isinstance(g, Failure):
            return g
        # By LAPACK itself: numpy takes several times as long for so small a matrix.
        _, step, info = dposv(at.H, g)
        if info != 0 or not np.isfinite(step).all():
            return Failure(reason=_OPEN)
        # Not the exponential map but a retraction: the same to first order, and cheap.
        T = se3.make_transform(cv2.Rodrigues(step[:3])[0], step[3:]) @ T
        note("refinement.step", T_target_source=T, step=step)
        gain = step @ g
        if gain < _CONVERGED:
            break
        near = at if gain < max_gain else None
    return T


def _with_covariance(
    T: FloatArray,
    residuals: StereoResiduals,
    inliers: tuple[BoolArray, StereoResiduals],
    *,
    with_offset: bool,
) -> Refinement | Failure:
    """Finish a refinement; `inliers` are chosen of all matches, whose residuals come with them."""
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
    offset = None
    if with_offset:
        offset = estimate_disparity_offset(T, residuals, last)
    return Refinement(
        T_target_source=T,
        covariance=0.5 * (covariance + covariance.T),
        inliers=inliers[0],
        scale=scale,
        residuals=inliers[1],
        offset=offset,
    )


def _sensitivity(
    at: Linearization, scores: FloatArray, H_inverse: FloatArray, huber: float
) -> FloatArray:
    """Return the inverse second derivative of the robust cost: how far a gradient moves the pose.

    Beyond its threshold a residual pulls with the same force however long it is, so that along it
    the cost does not curve. The weights of H say that it does; H alone calls the pose too sure.
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
    """Return the covariance of the gradient, shape (6, 6), as the matches show it."""
    n = at.r.shape[1]
    seen = n / max(n - 2, 1) * (scores @ scores.T)
    promised = scale**2 * at.H
    spread = (n * seen + _N_PROMISED * promised) / (n + _N_PROMISED)
    return np.asarray(spread + _MIN_SCALE**2 * at.H)


def estimate_disparity_offset(
    T_target_source: FloatArray, residuals: StereoResiduals, at: Linearization
) -> DisparityOffset | None:
    """Estimate a constant offset of the disparities of both frames.

    The derivatives are those at the points where both frames together see them. At the points as
    measured, noise of the source would be in the derivatives and in the residuals alike, and pull
    the estimate off zero by some hundredths of a pixel.

    The sigma comes from the spread that the matches show, not from the one their sigmas promise.

    Parameters
    ----------
    T_target_source : ndarray of float64, shape (4, 4)
        The refined pose.
    residuals : StereoResiduals
        Of the matches it rests on.
    at : Linearization
        Of the residuals, at the refined pose.

    Returns
    -------
    DisparityOffset or None
        None where an offset acts as a motion does, as for points at one depth.
    """
    camera = residuals.camera
    source_points = residuals.settled_points(T_target_source, at)
    # An offset moves the measurement in the target by itself, the prediction by the source's.
    J_offset = -source_jacobian(T_target_source, source_points, camera)[2]
    J_offset[2] += 1.0
    target_points = T_target_source[:3, :3] @ source_points + T_target_source[:3, 3:]
    J = pose_jacobian(target_points, camera)
    for rows in (J_offset, J):
        whiten_in_place(at.factors, rows)
    flat, flat_pose = J_offset.ravel(), J.reshape(6, -1)
    h_pose_offset = flat_pose @ flat
    _, motion, info = dposv(flat_pose @ flat_pose.T, h_pose_offset)
    # Of the offset, what no motion explains (Schur complement).
    information = float(flat @ flat - h_pose_offset @ motion)
    if info != 0 or not information > _MIN_SHARE * np.sum(at.factors[5] ** 2):
        return None
    unexplained = J_offset - np.einsum("k,kin->in", motion, J)
    scores = np.einsum("in,in->n", unexplained, at.r)
    return DisparityOffset(
        offset_px=float(np.sum(scores)) / information,
        sigma_px=float(np.sqrt(scores @ scores)) / information,
    )
