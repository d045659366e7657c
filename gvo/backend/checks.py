"""What an edge or a prior must be, so that GTSAM survives it.

GTSAM takes a matrix that is no rotation, or a covariance that is none, without a word, and dies
of it in a later update, naming a neighbour.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior

# Beyond, squared ratios leave the range of doubles. Coordinates of the whole Earth fit in.
_MAX_COORDINATE_M = 1e8
_MIN_SIGMA = 1e-8
_MAX_SIGMA = 1e6
# Of a covariance that has to be made up.
_MIN_SANE_SIGMA = 1e-5
_MAX_SANE_SIGMA = 1e3
_MAX_SKEW = 1e-6
_MIN_EIGENVALUE = 1e-12
_IDENTITY = np.eye(3)
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
_NOT_DEFINITE = "its covariance is not positive definite"


def find_faults(edges: Sequence[Edge]) -> list[str]:
    """Return for each edge what is wrong with its values; empty where nothing is."""
    if not edges:
        return []
    T = np.array([edge.T_reference_frame for edge in edges])
    covariances = np.array([edge.covariance for edge in edges])
    if _are_rigid(T) and _are_covariances(covariances):
        return [""] * len(edges)
    return [
        transform_fault(edge.T_reference_frame) or covariance_fault(edge.covariance)
        for edge in edges
    ]


def pose_fault(T_world_frame: FloatArray, covariance: FloatArray) -> str:
    """Return why a result cannot be right; empty where it may be."""
    if not (np.isfinite(T_world_frame).all() and np.isfinite(covariance).all()):
        return "the pose is not finite"
    largest = float(np.abs(T_world_frame[:3, 3]).max())
    return f"the pose diverged to {largest:.3g} m" if largest > 2.0 * _MAX_COORDINATE_M else ""


def sane_covariance(covariance: FloatArray) -> FloatArray:
    """Return the covariance, or one of the same sigmas, bounded, where it is none to work with."""
    if not covariance_fault(covariance):
        return covariance
    variances = np.nan_to_num(
        np.diag(covariance), nan=_MAX_SANE_SIGMA**2, posinf=_MAX_SANE_SIGMA**2
    )
    return np.diag(np.clip(variances, _MIN_SANE_SIGMA**2, _MAX_SANE_SIGMA**2))


def prior_fault(prior: Prior) -> str:
    """Return what is wrong with a prior; empty where nothing is."""
    if isinstance(prior, PosePrior):
        return transform_fault(prior.T_world_frame) or covariance_fault(prior.covariance)
    return _position_fault(prior) or covariance_fault(prior.covariance)


def _position_fault(prior: PositionPrior) -> str:
    if not np.isfinite(prior.position_world).all():
        return "its position is not finite"
    largest = float(np.abs(prior.position_world).max())
    return _coordinate_fault(largest) if largest > _MAX_COORDINATE_M else ""


def _coordinate_fault(largest: float) -> str:
    return f"a coordinate of {largest:.3g} m is beyond {_MAX_COORDINATE_M:.0e} m"


def _are_rigid(T: FloatArray) -> bool:
    # The size first: not-a-number fails every comparison, and nothing overflows behind it.
    if not np.abs(T).max() <= _MAX_COORDINATE_M:
        return False
    R = T[:, :3, :3]
    skew = R @ R.transpose(0, 2, 1) - _IDENTITY
    return bool(
        np.abs(skew).max() <= _MAX_SKEW
        and np.linalg.det(R).min() > 0.0
        and (T[:, 3] == _LAST_ROW).all()
    )


def _are_covariances(covariances: FloatArray) -> bool:
    if not np.abs(covariances).max() <= _MAX_SIGMA**2:
        return False
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    if variances.min() < _MIN_SIGMA**2:
        return False
    # Of correlations: rounding leaves elements that should be zero at any ratio.
    scales = 1.0 / np.sqrt(variances)
    correlations = covariances * scales[:, :, np.newaxis] * scales[:, np.newaxis, :]
    if np.abs(correlations - correlations.transpose(0, 2, 1)).max() > _MAX_SKEW:
        return False
    return bool(np.linalg.eigvalsh(correlations).min() > _MIN_EIGENVALUE)


def transform_fault(T: FloatArray) -> str:
    """Return why a matrix is no rigid transform, or empty."""
    if not np.isfinite(T).all():
        return "its transform is not finite"
    if not np.array_equal(T[3], _LAST_ROW):
        return "its transform must have (0, 0, 0, 1) as its last row"
    largest = float(np.abs(T[:3, 3]).max())
    if largest > _MAX_COORDINATE_M:
        return _coordinate_fault(largest)
    return "" if _are_rigid(T[np.newaxis]) else "its transform holds no rotation"


def covariance_fault(covariance: FloatArray) -> str:
    """Return why a matrix is no covariance that can be worked with, or empty."""
    if not np.isfinite(covariance).all():
        return "its covariance is not finite"
    variances = np.diag(covariance)
    if variances.min() <= 0.0:
        return _NOT_DEFINITE
    sigmas = np.sqrt(variances)
    if sigmas.min() < _MIN_SIGMA or sigmas.max() > _MAX_SIGMA:
        wrong = sigmas.min() if sigmas.min() < _MIN_SIGMA else sigmas.max()
        return f"its sigma {wrong:.3g} is outside {_MIN_SIGMA:.0e} to {_MAX_SIGMA:.0e}"
    correlations = covariance / np.outer(sigmas, sigmas)
    if np.abs(correlations - correlations.T).max() > _MAX_SKEW:
        return "its covariance is not symmetric"
    return "" if _are_covariances(covariance[np.newaxis]) else _NOT_DEFINITE
