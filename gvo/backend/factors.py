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
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior

ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))
"""Prior of a first pose without one, which defines the world: radians and metres."""

# Beyond these, squared ratios leave the range of doubles. Coordinates on Earth fit in.
_MAX_COORDINATE_M = 1e8
_MIN_SIGMA = 1e-8
_MAX_SIGMA = 1e6
_MIN_EIGENVALUE = 1e-10
_MAX_ROUNDING = 1e-6
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
    ) -> gtsam.NoiseModelFactor:
        """Return the between-factor of an edge."""
        edge, T_reference_frame, gaussian = measurement
        noise = self._robust(gaussian, edge.kernel or self.default)
        return gtsam.BetweenFactorPose3(reference_key, key, T_reference_frame, noise)

    def prior(self, key: int, prior: Prior) -> gtsam.NoiseModelFactor:
        """Return the factor of a prior."""
        gaussian = gtsam.noiseModel.Gaussian.Covariance(prior.covariance)
        noise = self._robust(gaussian, prior.kernel)
        if isinstance(prior, PosePrior):
            return gtsam.PriorFactorPose3(key, gtsam.Pose3(prior.T_world_frame), noise)
        return gtsam.GPSFactor(key, prior.position_world, noise)

    def _robust(self, gaussian: gtsam.noiseModel.Gaussian, kernel: Kernel) -> gtsam.noiseModel.Base:
        estimator = self._estimators.get(kernel)
        return (
            gaussian if estimator is None else gtsam.noiseModel.Robust.Create(estimator, gaussian)
        )


def residual_of(factor: gtsam.NoiseModelFactor, values: gtsam.Values) -> tuple[FloatArray, float]:
    """Return the whitened residual of a factor at these poses, and the weight of its kernel."""
    noise = factor.noiseModel()
    residual = np.asarray(noise.unweightedWhiten(factor.unwhitenedError(values)))
    return residual, float(noise.weight(residual))


def find_faults(edges: Sequence[Edge]) -> list[str]:
    """Say for each edge why it is invalid; empty if it is valid."""
    return [
        transform_fault(edge.T_reference_frame) or covariance_fault(edge.covariance)
        for edge in edges
    ]


def check_places(poses: FloatArray) -> None:
    """Raise a `RuntimeError`, as GTSAM does, if optimized poses or positions diverged."""
    largest = float(np.abs(poses).max())
    if not largest <= 2.0 * _MAX_COORDINATE_M:  # NaN too
        raise RuntimeError(f"a pose diverged to {largest:.3g} m")


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


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, or the name of its type."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def definite(covariance: FloatArray) -> FloatArray:
    """Return the covariance, symmetric positive definite in spite of rounding.

    With sigmas many orders of magnitude apart, rounding may leave the smallest eigenvalue of the
    correlations at or below zero.
    """
    symmetric = np.asarray(0.5 * (covariance + covariance.T))
    if not math.isfinite(np.add.reduce(symmetric, axis=None)):
        raise RuntimeError("a covariance is not finite")
    if se3.is_definite(symmetric):
        return symmetric
    variances = np.diag(symmetric)
    if variances.min() <= 0.0:
        raise RuntimeError("a variance is not positive")
    # On correlations: sigmas may be many orders of magnitude apart.
    scale = np.sqrt(np.outer(variances, variances))
    eigenvalues, vectors = np.linalg.eigh(symmetric / scale)
    if eigenvalues[0] < -_MAX_ROUNDING:
        raise RuntimeError("a covariance is not positive definite")
    repaired = (vectors * np.maximum(eigenvalues, _MIN_EIGENVALUE)) @ vectors.T * scale
    return np.asarray(0.5 * (repaired + repaired.T))
