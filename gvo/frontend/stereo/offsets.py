"""Constant errors of a stereo rig, learnt while it runs.

A baseline, a principal point or a rectification that is off by a little adds the same fraction of
a pixel to every disparity. To far points that is a large change of depth, to near ones a small
one, so that near and far points disagree about the motion; each registration tells by how much.
One alone knows little, but a second of a recording is enough to know it to a few hundredths of a
pixel. Where the rows of left and right differ, each match shows it by itself.
"""

from __future__ import annotations

import math

from gvo._trace import note
from gvo.config import StereoConfig
from gvo.types import RelativePose

# Registrations share errors (the same walls, the same lens): their sigmas are too small by this
# against the spread that they show among each other.
_SIGMA_FACTOR = 3.0
# What the matches of one frame show of the rows, and how large an error of rows may be: pixels.
_ROW_SIGMA_PX = 0.1
_ROW_PRIOR_PX = 0.3
# How far an offset may wander from one frame to the next, pixels: temperature, vibration.
_DRIFT_PX = 5e-4
# A measurement that is farther off, in sigmas, counts as this far: something else moved it.
_MAX_SURPRISE = 3.0


class OffsetFilter:
    """A scalar Kalman filter of a value that starts at zero and hardly changes.

    Parameters
    ----------
    prior_sigma_px : float
        How large the value may be, pixels.
    """

    def __init__(self, prior_sigma_px: float) -> None:
        self._prior_variance = prior_sigma_px**2
        self._variance = self._prior_variance
        self._value = 0.0

    @property
    def value_px(self) -> float:
        """The value, pixels."""
        return self._value

    @property
    def sigma_px(self) -> float:
        """Its standard deviation, pixels."""
        return math.sqrt(self._variance)

    def update(self, left_px: float, sigma_px: float) -> None:
        """Take a measurement of what is left when the present value is taken off.

        Parameters
        ----------
        left_px, sigma_px : float
            Measurement and its standard deviation, pixels.
        """
        variance = min(self._variance + _DRIFT_PX**2, self._prior_variance)
        limit = _MAX_SURPRISE * math.sqrt(variance + sigma_px**2)
        gain = variance / (variance + sigma_px**2)
        self._value += gain * min(max(left_px, -limit), limit)
        self._variance = (1.0 - gain) * variance


class RigOffsets:
    """What is to be taken off the disparities and rows that a rig measures.

    What is noted takes effect with `advance`, so that all that is done with one frame sees the
    same values.

    Parameters
    ----------
    config : StereoConfig
        `estimate_offset`, else all stays at zero; `offset_sigma_px`, how large it may be.
    is_stereo : bool
        Of other sensors nothing is learnt, and all stays at zero.
    """

    def __init__(self, config: StereoConfig, *, is_stereo: bool = True) -> None:
        self.is_learning = is_stereo and config.estimate_offset
        self.disparity = OffsetFilter(config.offset_sigma_px)
        self.row = OffsetFilter(_ROW_PRIOR_PX)
        self._pending: tuple[float, float] | None = None
        self._pending_row: float | None = None
        self._last_ns: int | None = None
        self._last_row_ns: int | None = None

    def note(self, result: RelativePose, stamp_ns: int) -> None:
        """Take what a registration says of disparities; only the first of each frame counts.

        Parameters
        ----------
        result : RelativePose
            With `offset_px`, what is left after the present value was taken off.
        stamp_ns : int
            Of the current frame.
        """
        if result.offset_px is None or result.offset_sigma_px is None:
            return
        if self.is_learning and (self._last_ns is None or stamp_ns > self._last_ns):
            self._last_ns = stamp_ns
            self._pending = result.offset_px, _SIGMA_FACTOR * result.offset_sigma_px

    def note_rows(self, shift_px: float | None, stamp_ns: int) -> None:
        """Take by how much the rows of a frame still differ; each frame counts once.

        Parameters
        ----------
        shift_px : float or None
            Row in the right image less the row in the left, and less the present value.
        stamp_ns : int
            Of that frame.
        """
        is_new = self._last_row_ns is None or stamp_ns > self._last_row_ns
        if self.is_learning and is_new and shift_px is not None:
            self._last_row_ns = stamp_ns
            self._pending_row = shift_px

    def advance(self) -> None:
        """Let what was noted take effect."""
        if self._pending is not None:
            self.disparity.update(*self._pending)
            self._pending = None
        if self._pending_row is not None:
            self.row.update(self._pending_row, _ROW_SIGMA_PX)
            self._pending_row = None
        note("rig.offsets", disparity_px=self.disparity.value_px, row_px=self.row.value_px)

    def as_json(self) -> dict[str, float]:
        """Return values and sigmas as plain numbers."""
        return {
            "disparity_px": round(self.disparity.value_px, 4),
            "disparity_sigma_px": round(self.disparity.sigma_px, 4),
            "row_px": round(self.row.value_px, 4),
        }
