"""Online calibration of constant disparity and row offsets of a stereo rig.

A baseline, a principal point or a rectification that is slightly off adds the same fraction of a
pixel to every disparity: a large change of depth for far points, a small one for near ones, so
that they disagree about the motion. Each registration estimates the offset; over a second of a
recording it is known to a few hundredths of a pixel. A row offset shows in each match.
"""

from __future__ import annotations

import math

from gvo._trace import note
from gvo.config import StereoConfig
from gvo.types import RelativePose

# Errors of registrations are correlated (the same walls, the same lens): their sigmas are too small
# by this factor.
_SIGMA_FACTOR = 3.0
# Sigmas of the row offset measured in one frame, and of its prior, pixels.
_ROW_SIGMA_PX = 0.1
_ROW_PRIOR_PX = 0.3
# Drift of an offset per frame, pixels: temperature, vibration.
_DRIFT_PX = 5e-4
# Innovations are clipped to so many sigmas.
_MAX_SURPRISE = 3.0


class OffsetFilter:
    """A scalar Kalman filter of a value that starts at zero and hardly changes.

    Parameters
    ----------
    prior_sigma_px : float
        Standard deviation of the prior around zero, pixels.

    Attributes
    ----------
    value_px : float
        The present estimate, pixels.
    """

    def __init__(self, prior_sigma_px: float) -> None:
        self._prior_variance = prior_sigma_px**2
        self._variance = self._prior_variance
        self.value_px = 0.0

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the value, pixels."""
        return math.sqrt(self._variance)

    def update(self, left_px: float, sigma_px: float) -> None:
        """Add a measurement of the remaining offset, and its standard deviation, pixels."""
        variance = min(self._variance + _DRIFT_PX**2, self._prior_variance)
        limit = _MAX_SURPRISE * math.sqrt(variance + sigma_px**2)
        gain = variance / (variance + sigma_px**2)
        self.value_px += gain * min(max(left_px, -limit), limit)
        self._variance = (1.0 - gain) * variance


class RigOffsets:
    """Disparity and row offsets of a stereo rig, estimated while it runs.

    Measurements take effect with `advance`, so that all steps of one frame use the same values.

    Parameters
    ----------
    config : StereoConfig
        `estimate_offset`, else all stays at zero; `offset_sigma_px`, sigma of the prior.
    is_stereo : bool
        Of other sensors all stays at zero.
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
        """Take the remaining offset of a registration; only the first of each frame counts.

        Parameters
        ----------
        result : RelativePose
            With `offset_px`, after the present value was subtracted.
        stamp_ns : int
            Of the current frame.
        """
        if result.offset_px is None or result.offset_sigma_px is None:
            return
        if self.is_learning and (self._last_ns is None or stamp_ns > self._last_ns):
            self._last_ns = stamp_ns
            self._pending = result.offset_px, _SIGMA_FACTOR * result.offset_sigma_px

    def note_rows(self, shift_px: float | None, stamp_ns: int) -> None:
        """Take the remaining row offset of a frame; each frame counts once.

        Parameters
        ----------
        shift_px : float or None
            Row in the right image minus row in the left, minus the present value.
        stamp_ns : int
            Of that frame.
        """
        is_new = self._last_row_ns is None or stamp_ns > self._last_row_ns
        if self.is_learning and is_new and shift_px is not None:
            self._last_row_ns = stamp_ns
            self._pending_row = shift_px

    def advance(self) -> None:
        """Apply the measurements taken since the last frame."""
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
