"""How large errors of a calibration are that all registrations share.

Constants of the camera that are a little wrong move all registrations alike: neither more points
nor more links make that smaller, and along a way it adds up as it is, not as a random walk does. So
they are considered (Schmidt 1966): the derivative of each pose by each constant is carried beside
it. How large they are is one number for all constants of a camera, in pixels. The residuals tell
it, because most constants bend them in a way that no motion does: it is the size at which those
constants are as probable as they can be (MacKay 1992).

That size does not shrink because constants are corrected: a rig that is off by so much in the terms
that are learnt is so in those that are not. Of what is corrected the uncertainty remains; of what
is learnt and not corrected, as of RGB-D cameras, the value adds to it.

References
----------
S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control
Systems 3, 1966.
D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992,
doi:10.1162/neco.1992.4.3.415.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from gvo.geometry.camera import StereoCamera
from gvo.geometry.rig import LENS
from gvo.types import FloatArray

CONSIDERED: Final = (*LENS[:6], "k1", "f", "baseline")
"""Constants that are considered; k1, focal length and baseline are worse known than the first."""
LEARNT: Final = 7
"""So many of them are learnt of a stereo camera, and can be corrected."""
# Errors of these are judged: bends of the disparity, and k1. The offset has hardly a limit.
_JUDGED = (*LENS[1:6], "k1")
_FREE, _FREE_FACTOR = "d0", 3.0
# What is presumed, pixels, and as how many constants it counts.
_PRESUMED_PX, _N_PRESUMED = 0.3, 0.05
# Of what is corrected so much stays, pixels: patches on more than one surface feign that.
_LEFT_PX = 0.03


class CalibrationErrors:
    """Size of the errors of a calibration, and the root of their covariance.

    Parameters
    ----------
    camera : StereoCamera
    names : tuple of str
        Constants that images tell of.
    in_pixels : bool
        In the units below; else those of `LENS` are in their own, and others are no errors of a
        calibration.

    Attributes
    ----------
    size_px : float
        Standard deviation of each constant: pixels at the middle of the left border, or of the
        upper one where it vanishes there; twice as much of k1, three times of the focal length,
        and per cent per pixel of the baseline.
    root : ndarray of float64, shape (9, 9)
        Of the covariance of `CONSIDERED`, in units of these sizes.
    """

    def __init__(self, camera: StereoCamera, names: tuple[str, ...], *, in_pixels: bool) -> None:
        f, X, Y = camera.fx, 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fx
        units = {
            **{"d0": 1.0, "dx": 1.0 / (f * X), "dy": 1.0 / (f * Y)},
            **{"dxx": 1.0 / (f * X * X), "dxy": 1.0 / (f * X * Y), "dyy": 1.0 / (f * Y * Y)},
            **{"tx": 1.0 / (f * X * X), "ty": 1.0 / (f * X * Y), "k1": 2.0 / (f * X**3)},
            **{"p1": 1.0 / (f * X * X), "p2": 1.0 / (3.0 * f * X * X)},
        }
        self._units = np.array([1.0 if in_pixels else units.get(name, np.nan) for name in names])
        self._is_free = np.array([name == _FREE for name in names], dtype=np.bool_)
        self._judged = np.array([k for k, name in enumerate(names) if name in _JUDGED], np.int64)
        wanted = CONSIDERED[:LEARNT]
        self._learnt = np.array([k for k, name in enumerate(names) if name in wanted], np.int64)
        self.size_px, self.root = _PRESUMED_PX, np.eye(len(CONSIDERED))

    @property
    def left_px(self) -> float:
        """Root mean square of what stays of the constants that can be corrected, pixels."""
        learnt = self.root[:LEARNT, :LEARNT]
        return self.size_px * float(np.sqrt(np.sum(learnt**2) / LEARNT))

    def judge(
        self, information: FloatArray, vector: FloatArray, prior: FloatArray, *, is_corrected: bool
    ) -> None:
        """Take what images told of the constants so far.

        Parameters
        ----------
        information : ndarray of float64, shape (k, k)
        vector : ndarray of float64, shape (k,)
            Information times the constants.
        prior : ndarray of float64, shape (k,)
            Standard deviations of constants that are no errors of a calibration.
        is_corrected : bool
            Those of the lens are taken off measurements.
        """
        sigmas = np.where(np.isfinite(self._units), self.size_px * self._units, prior)
        sigmas[self._is_free] *= _FREE_FACTOR
        covariance = np.linalg.inv(information + np.diag(sigmas**-2.0))
        values = covariance @ vector / self._units
        variances = np.diagonal(covariance)[self._judged] / self._units[self._judged] ** 2
        n_told = float(np.sum(1.0 - variances / self.size_px**2))
        total = float(np.sum(values[self._judged] ** 2)) + _N_PRESUMED * _PRESUMED_PX**2
        self.size_px = float(np.sqrt(total / (n_told + _N_PRESUMED)))
        units = self._units[self._learnt]
        left = np.eye(LEARNT)
        if is_corrected:
            left = covariance[np.ix_(self._learnt, self._learnt)] / np.outer(units, units)
            left = (left + _LEFT_PX**2 * np.eye(LEARNT)) / self.size_px**2
        else:
            learnt = values[self._learnt] / self.size_px
            left += np.outer(learnt, learnt)
        variances, axes = np.linalg.eigh(left)
        self.root[:LEARNT, :LEARNT] = axes * np.sqrt(variances) @ axes.T
