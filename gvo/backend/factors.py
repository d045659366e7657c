"""Edges and priors, validated and made into factors of GTSAM with robust kernels.

GTSAM accepts a matrix that is no rotation, or an invalid covariance, silently, and fails in a
later update, naming a neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from gvo.config import Kernel, WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, FrameId, GraphEdge, PosePrior, PositionPrior, Prior

ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))
"""Prior of a first pose without one, which defines the world: radians and metres."""

# Beyond these, squared ratios leave the range of doubles. Coordinates on Earth fit in.
_MAX_COORDINATE_M = 1e8
_MIN_SIGMA = 1e-8
_MAX_SIGMA = 1e6
# Bounds of the sigmas of a replaced covariance.
_MIN_SANE_SIGMA = 1e-5
_MAX_SANE_SIGMA = 1e3
# A kernel acts on the norm of the whitened 6-vector, typically 2.45: the usual constants, for
# scalars, would down-weight most inliers. Huber's is the 95 % quantile of chi with six degrees of
# freedom; the others lose as much asymptotic efficiency as it does, 0.2 %.
_CONSTANTS: dict[Kernel, float] = {"huber": 3.55, "cauchy": 9.4, "geman_mcclure": 13.6, "dcs": 15.6}
_KERNELS: dict[Kernel, Callable[[float], gtsam.noiseModel.mEstimator.Base]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
    "dcs": gtsam.noiseModel.mEstimator.DCS.Create,
}


class Measurement(NamedTuple):
    """An edge and its GTSAM objects, made once for the gate and the factor."""

    edge: Edge
    T_reference_frame: gtsam.Pose3
    gaussian: gtsam.noiseModel.Gaussian

    @classmethod
    def of(cls, edge: Edge) -> Measurement:
        """Return the measurement of a valid edge."""
        return cls(
            edge,
            gtsam.Pose3(edge.T_reference_frame),
            gtsam.noiseModel.Gaussian.Covariance(edge.covariance),
        )


class Factors:
    """Makes factors with robust kernels.

    Parameters
    ----------
    config : WindowConfig
        Default kernel.

    References
    ----------
    Z. Zhang, "Parameter estimation techniques", Image and Vision Computing 15(1), 1997,
    doi:10.1016/S0262-8856(96)01112-2 (Huber, Cauchy, Geman-McClure); P. Agarwal et al., "Robust
    map optimization using dynamic covariance scaling", ICRA 2013,
    doi:10.1109/ICRA.2013.6630557.
    """

    def __init__(self, config: WindowConfig) -> None:
        self.default = config.kernel
        self._estimators = {
            kernel: create(_CONSTANTS[kernel]) for kernel, create in _KERNELS.items()
        }

    def between(
        self, reference_key: int, key: int, measurement: Measurement
    ) -> gtsam.NonlinearFactor:
        """Return the between-factor of an edge."""
        edge, T_reference_frame, gaussian = measurement
        noise = self._robust(gaussian, edge.kernel or self.default)
        return gtsam.BetweenFactorPose3(reference_key, key, T_reference_frame, noise)

    def prior(self, key: int, prior: Prior) -> gtsam.NonlinearFactor:
        """Return the factor of a prior."""
        gaussian = gtsam.noiseModel.Gaussian.Covariance(prior.covariance)
        noise = self._robust(gaussian, prior.kernel)
        if isinstance(prior, PosePrior):
            return gtsam.PriorFactorPose3(key, gtsam.Pose3(prior.T_world_frame), noise)
        return gtsam.GPSFactor(key, prior.position_world, noise)

    def residual_of_edge(
        self,
        edge: Edge,
        frame_id: FrameId,
        T_world_reference: FloatArray,
        T_world_frame: FloatArray,
    ) -> GraphEdge:
        """Return the whitened residual and the weight of an edge between two poses."""
        predicted = T_world_reference @ edge.T_reference_frame
        error = se3.log(se3.invert(predicted) @ T_world_frame)
        residual = _whiten(error, edge.covariance)
        return GraphEdge(
            reference_id=edge.reference_id,
            frame_id=frame_id,
            T_reference_frame=edge.T_reference_frame,
            covariance=edge.covariance,
            residual=residual,
            weight=self._weight(residual, edge.kernel or self.default),
        )

    def residual_of_prior(
        self, prior: Prior, frame_id: FrameId, T_world_frame: FloatArray
    ) -> GraphEdge:
        """Return the whitened residual and the weight of a prior of a pose."""
        if isinstance(prior, PosePrior):
            measured = prior.T_world_frame
            error = se3.log(se3.invert(measured) @ T_world_frame)
        else:
            measured = se3.make_transform(T_world_frame[:3, :3], prior.position_world)
            error = T_world_frame[:3, 3] - prior.position_world
        residual = _whiten(error, prior.covariance)
        return GraphEdge(
            reference_id=None,
            frame_id=frame_id,
            T_reference_frame=measured,
            covariance=prior.covariance,
            residual=residual,
            weight=self._weight(residual, prior.kernel),
        )

    def _robust(self, gaussian: gtsam.noiseModel.Gaussian, kernel: Kernel) -> gtsam.noiseModel.Base:
        estimator = self._estimators.get(kernel)
        return (
            gaussian if estimator is None else gtsam.noiseModel.Robust.Create(estimator, gaussian)
        )

    def _weight(self, residual: FloatArray, kernel: Kernel) -> float:
        norm = float(np.linalg.norm(residual))
        estimator = self._estimators.get(kernel)
        return 1.0 if estimator is None else float(estimator.weight(norm))  # type: ignore[attr-defined]


def _whiten(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return R e, where R is upper triangular and R^T R the inverse of the covariance."""
    # The Cholesky factor L of the covariance with reversed axes: R = L^-1, reversed.
    L = np.linalg.cholesky(covariance[::-1, ::-1])
    return np.asarray(np.linalg.solve(L, error[::-1])[::-1])


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
