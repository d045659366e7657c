"""Validation of edges and priors before GTSAM gets them.

GTSAM accepts a matrix that is no rotation, or an invalid covariance, silently, and fails in a
later update, naming a neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gvo.geometry import se3
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior

# Beyond these, squared ratios leave the range of doubles. Coordinates on Earth fit in.
_MAX_COORDINATE_M = 1e8
_MIN_SIGMA = 1e-8
_MAX_SIGMA = 1e6
# Bounds of the sigmas of a replaced covariance.
_MIN_SANE_SIGMA = 1e-5
_MAX_SANE_SIGMA = 1e3


def find_faults(edges: Sequence[Edge]) -> list[str]:
    """Say for each edge why it is invalid; empty if it is valid."""
    return [
        transform_fault(edge.T_reference_frame) or covariance_fault(edge.covariance)
        for edge in edges
    ]


def place_fault(positions_world: FloatArray) -> str:
    """Say why optimized positions, shape (..., 3), are invalid; empty if they are valid."""
    return _divergence(float(np.abs(positions_world).max()))


def pose_fault(T_world_frame: FloatArray) -> str:
    """Say why an optimized pose is invalid; empty if it is valid."""
    rows = T_world_frame.tolist()
    if not math.isfinite(sum(map(sum, rows))):
        return "a pose is not finite"
    (_, _, _, x), (_, _, _, y), (_, _, _, z), _ = rows
    return _divergence(max(abs(x), abs(y), abs(z)))


def _divergence(largest: float) -> str:
    is_far = not largest <= 2.0 * _MAX_COORDINATE_M  # NaN too
    return f"a pose diverged to {largest:.3g} m" if is_far else ""


def sane_covariance(covariance: FloatArray) -> FloatArray:
    """Return the covariance; if invalid, a diagonal one of its sigmas within bounds."""
    if not covariance_fault(covariance):
        return np.asarray(0.5 * (covariance + covariance.T))
    variances = np.nan_to_num(
        np.diag(covariance), nan=_MAX_SANE_SIGMA**2, posinf=_MAX_SANE_SIGMA**2
    )
    return np.diag(np.clip(variances, _MIN_SANE_SIGMA**2, _MAX_SANE_SIGMA**2))


def prior_fault(prior: Prior) -> str:
    """Say why a prior is invalid; empty if it is valid."""
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


def transform_fault(T: FloatArray) -> str:
    """Say why a matrix is no rigid transform within bounds; empty if it is one."""
    fault = se3.transform_fault(T)
    if fault:
        return f"its transform {fault}"
    (_, _, _, x), (_, _, _, y), (_, _, _, z), _ = T.tolist()
    largest = max(abs(x), abs(y), abs(z))
    return _coordinate_fault(largest) if largest > _MAX_COORDINATE_M else ""


def covariance_fault(covariance: FloatArray) -> str:
    """Say why a matrix is no covariance with sigmas within bounds; empty if it is one."""
    fault = se3.covariance_fault(covariance)
    if fault:
        return f"its covariance {fault}"
    variances = covariance.diagonal().tolist()
    smallest, largest = min(variances), max(variances)
    if smallest >= _MIN_SIGMA**2 and largest <= _MAX_SIGMA**2:
        return ""
    wrong = math.sqrt(smallest if smallest < _MIN_SIGMA**2 else largest)
    return f"its sigma {wrong:.3g} is outside {_MIN_SIGMA:.0e} to {_MAX_SIGMA:.0e}"
