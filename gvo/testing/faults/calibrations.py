"""Faults of the calibration: the images are right, what is said of the camera is not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gvo.geometry.camera import Calibration
from gvo.io.recording import RecordingInfo
from gvo.testing.faults.fault import Fault
from gvo.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationFault(Fault):
    """A wrong calibration of the streams; a subclass overrides `miscalibrate`.

    It holds for the whole recording, whatever `first`, `end`, `every` and `share` say.
    """

    def change_info(self, info: RecordingInfo) -> RecordingInfo:
        """Return the info with wrong calibrations."""
        calibrations = tuple(
            self.miscalibrate(calibration) if stream in self.streams else calibration
            for stream, calibration in enumerate(info.calibrations)
        )
        return replace(info, calibrations=calibrations)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return a wrong calibration in place of the right one."""
        return calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongBaseline(CalibrationFault):
    """A baseline in another unit, or of another rig.

    Parameters
    ----------
    factor : float
        By which it is wrong.
    """

    factor: float = 2.0

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with P[0, 3] multiplied."""
        P = calibration.P.copy()
        P[:, 3] *= self.factor
        return replace(calibration, P=P)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongFocalLength(CalibrationFault):
    """The focal length of another lens, or of another image size; the baseline stays right.

    Parameters
    ----------
    factor : float
        By which it is wrong.
    """

    factor: float = 1.3

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with fx, fy and fx * baseline multiplied."""
        scaling = np.diag([self.factor, self.factor, 1.0])
        return replace(
            calibration,
            K=_with_focal(calibration.K, scaling),
            P=_with_focal(calibration.P, scaling),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongPrincipalPoint(CalibrationFault):
    """The principal point of another camera, or of a cropped image.

    Parameters
    ----------
    by : tuple of two float
        (u, v), as shares of width and height.
    """

    by: tuple[float, float] = (0.1, 0.1)

    def miscalibrate(self, calibration: Calibration) -> Calibration:
        """Return the calibration with cx and cy shifted."""
        K, P = calibration.K.copy(), calibration.P.copy()
        shift = np.array([self.by[0] * calibration.width, self.by[1] * calibration.height])
        K[:2, 2] += shift
        P[:2, 2] += shift
        return replace(calibration, K=K, P=P)


def _with_focal(matrix: FloatArray, scaling: FloatArray) -> FloatArray:
    """Scale all but the principal point."""
    scaled = scaling @ matrix
    scaled[:2, 2] = matrix[:2, 2]
    return np.asarray(scaled, dtype=np.float64)
