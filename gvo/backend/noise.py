"""Noise models of GTSAM from covariances and robust kernels."""

from __future__ import annotations

import gtsam
import numpy as np

from gvo.config import WindowConfig
from gvo.types import FloatArray


def edge_noise(covariance: FloatArray, config: WindowConfig) -> gtsam.noiseModel.Base:
    """Return the noise model of a between-factor.

    A robust kernel acts on the norm of the whitened 6-vector, 2.45 for a good edge, so its
    threshold must lie above that.

    Parameters
    ----------
    covariance : ndarray of float64, shape (6, 6)
    config : WindowConfig
        Kernel and threshold.
    """
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if config.kernel == "none":
        return gaussian
    huber = gtsam.noiseModel.mEstimator.Huber.Create(config.kernel_threshold)
    return gtsam.noiseModel.Robust.Create(huber, gaussian)


def check_transform(T: FloatArray, name: str) -> None:
    """Raise ValueError for what is no rigid transform; GTSAM would take it silently."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"{name} must be a finite 4x4 matrix")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise ValueError(f"{name} holds no rotation")
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name} must have (0, 0, 0, 1) as its last row")


def check_covariance(covariance: FloatArray, name: str) -> None:
    """Raise ValueError for what is no covariance; GTSAM would die of it later."""
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"{name} must be a finite 6x6 matrix")
    variances = np.diag(covariance)
    if np.any(variances <= 0):
        raise ValueError(f"{name} must be positive definite")
    # Of correlations: rounding leaves elements that should be zero at any ratio to each other.
    sigmas = np.sqrt(variances)
    correlations = covariance / np.outer(sigmas, sigmas)
    if np.abs(correlations - correlations.T).max() > 1e-6:
        raise ValueError(f"{name} must be symmetric")
    if np.linalg.eigvalsh(correlations)[0] <= 1e-12:
        raise ValueError(f"{name} must be positive definite")
