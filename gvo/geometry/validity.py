"""Whether a matrix is a rigid transform or a covariance, told at little cost.

Poses and covariances are checked wherever they come in, most of them several times per frame. In
plain numbers, and by LAPACK itself, that takes a tenth of the time of numpy's own checks.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dpotrf

from gvo.types import FloatArray

# The largest deviation of R R^T from the identity, and the largest asymmetry of correlations, that
# is still rounding.
_MAX_SKEW = 1e-6
# Of correlations: the smallest eigenvalue that is more than rounding.
_MIN_EIGENVALUE = 1e-12
LAST_ROW = [0.0, 0.0, 0.0, 1.0]
# A covariance times this is positive definite where all eigenvalues of its correlations are
# larger.
_LESS_DEFINITE = 1.0 - _MIN_EIGENVALUE * np.eye(6)


def is_rigid(T: FloatArray) -> bool:
    """Tell whether a matrix, shape (4, 4), is a rigid transform of finite numbers."""
    # What is not a number fails every comparison.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last_row = T.tolist()
    return bool(
        last_row == LAST_ROW
        and math.isfinite(x + y + z)
        and abs(a * a + b * b + c * c - 1.0) <= _MAX_SKEW
        and abs(d * d + e * e + f * f - 1.0) <= _MAX_SKEW
        and abs(g * g + h * h + i * i - 1.0) <= _MAX_SKEW
        and abs(a * d + b * e + c * f) <= _MAX_SKEW
        and abs(a * g + b * h + c * i) <= _MAX_SKEW
        and abs(d * g + e * h + f * i) <= _MAX_SKEW
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    )


def is_definite(symmetric: FloatArray) -> bool:
    """Tell whether a symmetric matrix of finite numbers is positive definite."""
    _, failed_minor = dpotrf(symmetric)
    return bool(failed_minor == 0)


def is_plain_covariance(covariance: FloatArray) -> bool:
    """Tell whether a matrix of finite numbers, shape (6, 6), is exactly symmetric and definite.

    One that is symmetric but for rounding is not plain; whether it will do takes longer to tell.
    """
    # What is symmetric has the same bytes row by row and column by column. Numbers that are none
    # pass through LAPACK unnoticed, but not through a sum of squares.
    return (
        math.isfinite(np.vdot(covariance, covariance))
        and covariance.tobytes() == covariance.tobytes("F")
        and is_definite(covariance * _LESS_DEFINITE)
    )


def covariance_flaw(covariance: FloatArray) -> str:
    """Return what keeps a matrix of finite numbers from being a covariance; empty where nothing."""
    variances = np.diag(covariance)
    if variances.min() <= 0.0:
        return "not positive definite"
    # Of correlations: rounding leaves elements that should be zero at any ratio.
    sigmas = np.sqrt(variances)
    correlations = covariance / np.outer(sigmas, sigmas)
    if np.abs(correlations - correlations.T).max() > _MAX_SKEW:
        return "not symmetric"
    is_sound = np.linalg.eigvalsh(correlations).min() > _MIN_EIGENVALUE
    return "" if is_sound else "not positive definite"
