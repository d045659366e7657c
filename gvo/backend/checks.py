"""What an edge or a prior must be, so that GTSAM survives it.

GTSAM takes a matrix that is no rotation, or a covariance that is none, without a word, and dies
of it in a later update, naming a neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gvo.geometry.validity import LAST_ROW, covariance_flaw, is_plain_covariance, is_rigid
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior

# Beyond, squared ratios leave the range of doubles. Coordinates of the whole Earth fit in.
_MAX_COORDINATE_M = 1e8
_MIN_SIGMA = 1e-8
_MAX_SIGMA = 1e6
# Of a covariance that has to be made up.
_MIN_SANE_SIGMA = 1e-5
_MAX_SANE_SIGMA = 1e3


def find_faults(edges: Sequence[Edge]) -> list[str]:
    """Return for each edge what is wrong with its values; empty where nothing is."""
    return [
        ""
        if is_rigid(edge.T_reference_frame)
        and _is_near(edge.T_reference_frame)
        and is_plain_covariance(edge.covariance)
        and _has_sane_sigmas(edge.covariance)
        else transform_fault(edge.T_reference_frame) or covariance_fault(edge.covariance)
        for edge in edges
    ]


def place_fault(positions_world: FloatArray) -> str:
    """Return why positions, shape (..., 3), cannot be right; empty where they may be."""
    return _divergence(float(np.abs(positions_world).max()))


def pose_fault(T_world_frame: FloatArray) -> str:
    """Return why a pose that came out cannot be right; empty where it may be."""
    rows = T_world_frame.tolist()
    if not math.isfinite(sum(map(sum, rows))):
        return "a pose is not finite"
    return _divergence(max(abs(row[3]) for row in rows))


def _divergence(largest: float) -> str:
    is_far = not largest <= 2.0 * _MAX_COORDINATE_M  # nor is what is not a number near
    return f"a pose diverged to {largest:.3g} m" if is_far else ""


def sane_covariance(covariance: FloatArray) -> FloatArray:
    """Return the covariance, or one of the same sigmas, bounded, where it is none to work with."""
    if not covariance_fault(covariance):
        return np.asarray(0.5 * (covariance + covariance.T))
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


def _is_near(T: FloatArray) -> bool:
    (_, _, _, x), (_, _, _, y), (_, _, _, z), _ = T.tolist()
    return bool(max(abs(x), abs(y), abs(z)) <= _MAX_COORDINATE_M)


def _has_sane_sigmas(covariance: FloatArray) -> bool:
    variances = covariance.diagonal().tolist()
    return bool(min(variances) >= _MIN_SIGMA**2 and max(variances) <= _MAX_SIGMA**2)


def transform_fault(T: FloatArray) -> str:
    """Return why a matrix is no rigid transform, or empty."""
    if not np.isfinite(T).all():
        return "its transform is not finite"
    if T[3].tolist() != LAST_ROW:
        return "its transform must have (0, 0, 0, 1) as its last row"
    largest = float(np.abs(T[:3, 3]).max())
    if largest > _MAX_COORDINATE_M:
        return _coordinate_fault(largest)
    return "" if is_rigid(T) else "its transform holds no rotation"


def covariance_fault(covariance: FloatArray) -> str:
    """Return why a matrix is no covariance that can be worked with, or empty."""
    if not np.isfinite(covariance).all():
        return "its covariance is not finite"
    variances = np.diag(covariance)
    if variances.min() > 0.0:
        sigmas = np.sqrt(variances)
        if sigmas.min() < _MIN_SIGMA or sigmas.max() > _MAX_SIGMA:
            wrong = sigmas.min() if sigmas.min() < _MIN_SIGMA else sigmas.max()
            return f"its sigma {wrong:.3g} is outside {_MIN_SIGMA:.0e} to {_MAX_SIGMA:.0e}"
    flaw = covariance_flaw(covariance)
    return f"its covariance is {flaw}" if flaw else ""
