"""Whitened stereo reprojection residuals of matches; see `gvo.kernels.residuals`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.kernels import residuals as kernels
from gvo.types import BoolArray, FloatArray

HUBER = 1.5
"""Threshold of the robust kernel on the whitened residual of a match, sigmas."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoResiduals:
    """Matches with the factors that whiten their residuals.

    Parameters
    ----------
    points : ndarray of float64, shape (n, 3)
        In the reference, metres.
    uvd : ndarray of float64, shape (n, 3)
        (u, v, disparity) measured in the current frame.
    factors : ndarray of float64, shape (n, 6)
        The lower triangle (00, 10, 11, 20, 21, 22) of the factor W with W^T W the inverse
        covariance of the residual.
    sensitivities : ndarray of float64, shape (k, 2, n, 3)
        Derivatives of (u, v, disparity) in reference and current frame by each constant.
    constants : tuple of str
        Names of the k constants of the camera whose errors are to be estimated.
    camera : StereoCamera
        Of both frames.
    huber : float
        Threshold of the robust kernel, sigmas.
    """

    points: FloatArray
    uvd: FloatArray
    factors: FloatArray
    sensitivities: FloatArray
    constants: tuple[str, ...]
    camera: StereoCamera
    huber: float

    @classmethod
    def of(
        cls, T: FloatArray, matches: Correspondences, camera: StereoCamera, *, huber: float = HUBER
    ) -> StereoResiduals:
        """Whiten by the noise of both frames, propagated through the start value T.

        It is not propagated again: it changes by far less than its own uncertainty.
        """
        n, given = len(matches), matches.sensitivities
        points, uvd, factors = matches.reference_points, matches.current_uvd, np.empty((n, 6))
        sigmas = matches.reference_sigmas, matches.current_sigmas
        kernels.write_factors(np.array(T), points, *sigmas, camera.parameters, factors)
        return cls(
            points=points,
            uvd=uvd,
            factors=factors,
            sensitivities=np.array([*given.values()]) if given else np.empty((0, 2, n, 3)),
            constants=tuple(given),
            camera=camera,
            huber=huber,
        )

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points, measurements and factors, as kernels take them."""
        return self.points, self.uvd, self.factors

    def squared(self, T: FloatArray) -> FloatArray:
        """Return the squared lengths of the residuals, in sigmas; infinite behind the camera."""
        squared = np.empty(len(self.points))
        kernels.square_residuals(np.array(T), *self.arrays, self.camera.parameters, squared)
        return squared

    def within(self, T: FloatArray, gate: float) -> BoolArray:
        """Tell which residuals are shorter than a gate in sigmas; none behind the camera."""
        return np.asarray(self.squared(T) < gate**2)
