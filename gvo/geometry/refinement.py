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

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.residuals import HUBER, StereoResiduals
from gvo.kernels import refinement as kernels
from gvo.types import BoolArray, Failure, FloatArray

GATE = 3.0
"""Maximum whitened residual of an inlier of a refined pose, sigmas."""

_REASONS = {
    kernels.BEHIND: "the motion puts points behind the camera",
    kernels.OPEN: "the matches leave a direction of motion open",
}


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
    effects : mapping of str to ndarray of float64, shape (6,)
        By how much a unit of each constant of the residuals moves the pose.
    """

    T_reference_current: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    scale: float
    residuals: StereoResiduals
    effects: Mapping[str, FloatArray] = field(default_factory=dict)


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
    T, is_used = np.array(T_reference_current), np.array(inliers)
    ended = kernels.refine(T, *residuals.arrays, is_used, camera.parameters, huber, gate)
    if ended != kernels.DONE:
        return Failure(reason=_REASONS[ended])
    return _with_covariance(T, residuals, is_used)


def descend(
    T_reference_current: FloatArray,
    residuals: StereoResiduals,
    is_used: BoolArray,
    *,
    n_iterations: int,
) -> FloatArray | None:
    """Minimize the cost of residuals by a few Gauss-Newton steps; None if they fail.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Start value.
    residuals : StereoResiduals
        Of n matches.
    is_used : ndarray of bool, shape (n,)
        Those that count.
    n_iterations : int
        Maximum number.
    """
    T, camera = np.array(T_reference_current), residuals.camera.parameters
    ended = kernels.descend(T, *residuals.arrays, is_used, camera, residuals.huber, n_iterations)
    return T if ended == kernels.DONE else None


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
    effects : ndarray of float64, shape (k, 6)
        Derivative of the pose, right perturbation, by what is taken off for each error.
    """

    T_reference_current: FloatArray
    values: FloatArray
    covariance: FloatArray
    effects: FloatArray


def adjust(
    T_reference_current: FloatArray,
    residuals: StereoResiduals,
    is_used: BoolArray,
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
        Of n matches.
    is_used : ndarray of bool, shape (n,)
        Those that count.
    n_iterations : int
        Of Gauss-Newton steps.
    sigma_factor : float
        Inflation of the matches' sigmas, relative to what is known of the constants.
    """
    k, T = len(residuals.constants), np.array(T_reference_current)
    values, covariance, effects = np.zeros(k), np.empty((k, k)), np.empty((k, 6))
    ended = kernels.adjust(
        *(T, *residuals.arrays, is_used, residuals.sensitivities, residuals.camera.parameters),
        *(residuals.huber, sigma_factor**2, n_iterations, values, covariance, effects),
    )
    if ended != kernels.DONE:
        return None
    return Adjustment(T_reference_current=T, values=values, covariance=covariance, effects=effects)


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
    return _with_covariance(T_reference_current, residuals, inliers)


def _with_covariance(
    T: FloatArray, residuals: StereoResiduals, inliers: BoolArray
) -> Refinement | Failure:
    """Finish a refinement."""
    covariance, scale = np.empty((6, 6)), np.empty(1)
    ended = kernels.write_covariance(
        *(np.array(T), *residuals.arrays, inliers, residuals.camera.parameters),
        *(residuals.huber, covariance, scale),
    )
    if ended != kernels.DONE:
        return Failure(reason=_REASONS[ended])
    effects = np.empty((len(residuals.constants), 6))
    ended = kernels.write_effects(
        *(np.array(T), *residuals.arrays, inliers, residuals.sensitivities),
        *(residuals.camera.parameters, residuals.huber, effects),
    )
    if ended != kernels.DONE:
        return Failure(reason=_REASONS[ended])
    return Refinement(
        T_reference_current=T,
        covariance=covariance,
        inliers=inliers,
        scale=float(scale[0]),
        residuals=residuals,
        effects=dict(zip(residuals.constants, effects, strict=True)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Constants:
    """What matches tell of errors of k constants of the camera, whatever the pose.

    Parameters
    ----------
    information : ndarray of float64, shape (k, k)
        Of the errors, by what no motion explains.
    score : ndarray of float64, shape (k,)
        The right-hand side: the errors are information^-1 score.
    """

    information: FloatArray
    score: FloatArray


def eliminate_pose(
    T_reference_current: FloatArray, residuals: StereoResiduals, is_used: BoolArray
) -> Constants | None:
    """Return the normal equations of the constants of residuals; None where there are none.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        The refined pose.
    residuals : StereoResiduals
        Of n matches.
    is_used : ndarray of bool, shape (n,)
        Those that count.
    """
    k = len(residuals.constants)
    information, score = np.empty((k, k)), np.empty(k)
    ended = kernels.eliminate_pose(
        *(np.array(T_reference_current), *residuals.arrays, is_used, residuals.sensitivities),
        *(residuals.camera.parameters, residuals.huber, information, score),
    )
    if ended != kernels.DONE:
        return None
    return Constants(information=information, score=score)
