"""What was learnt of a camera beyond its calibration: values, and how well they are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gvo.errors import CalibrationError
from gvo.types import FloatArray

LENS = "d0", "dx", "dy", "dxx", "dxy", "dyy", "tx", "ty", "k1", "p1", "p2"
"""Constants of pixels and disparities, see `gvo.kernels.lens`."""
ROWS = "r0", "rx", "ry", "rxx", "rxy", "ryy"
"""Constants of the rows of the right image."""
READOUT = "readout_s"
"""The time that a rolling shutter takes from the first row of an image to the last."""
DELAY = "delay_s"
"""By how much later the right image is exposed than the left one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LearntRig:
    """Constants of a camera as learnt by a run.

    Parameters
    ----------
    constants : mapping of str to (float, float)
        Value and standard deviation of some of `LENS`, `ROWS`, `READOUT` and `DELAY`; pixels,
        focal lengths and seconds.
    information : ndarray of float64, shape (k, k)
        What the images told of them, in their order: without what is presumed of any camera.
    n_frames : int
        Number of frames that it was learnt from.

    Raises
    ------
    CalibrationError
        For unknown constants, or information of another shape or not symmetric, or what is not
        finite.
    """

    constants: Mapping[str, tuple[float, float]]
    information: FloatArray
    n_frames: int

    def __post_init__(self) -> None:
        """Refuse what could not be used."""
        names, told = [*self.constants], self.information
        if unknown := sorted({*names} - {*LENS, *ROWS, READOUT, DELAY}):
            raise CalibrationError(f"unknown constants {', '.join(unknown)}")
        if told.shape != (len(names), len(names)):
            raise CalibrationError(
                f"information of {len(names)} constants must be as many rows and columns"
            )
        if not (np.all(np.isfinite(told)) and np.all(np.isfinite([*self.constants.values()]))):
            raise CalibrationError("values, sigmas and information must be finite")
        if not np.allclose(told, told.T) or np.any(np.diag(told) < 0.0):
            raise CalibrationError("information must be symmetric, and not negative")

    def of(self, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
        """Return the values (k,) of some constants and the information (k, k) on them.

        Of constants that were not learnt these are zero.
        """
        values = np.array([self.constants.get(name, (0.0, 0.0))[0] for name in names])
        rows = [*self.constants]
        known = [k for k, name in enumerate(names) if name in self.constants]
        places = [rows.index(names[k]) for k in known]
        information = np.zeros((len(names), len(names)))
        information[np.ix_(known, known)] = self.information[np.ix_(places, places)]
        return values, information
