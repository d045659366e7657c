"""The latest samples of an IMU, from which intervals of any length are cut."""

from __future__ import annotations

import numpy as np

from gvo.geometry.imu import HOLE_S, ImuSamples, are_in_order
from gvo.types import FloatArray, IntArray

# No IMU measures as much: m/s^2 and rad/s.
_LARGEST = 1e4


class ImuBuffer:
    """Samples by stamp, in the clock of the camera; those that nobody needs any more are dropped.

    Attributes
    ----------
    delay_ns : int
        Added to the stamps of the IMU.
    """

    def __init__(self) -> None:
        self.delay_ns = 0
        self._stamps_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._values: FloatArray = np.zeros((0, 6))

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._stamps_ns)

    @property
    def stamps_ns(self) -> IntArray:
        """By the clock of the IMU, nanoseconds, shape (n,)."""
        return self._stamps_ns

    @property
    def gyro(self) -> FloatArray:
        """Angular velocity, rad/s, shape (n, 3)."""
        return self._values[:, :3]

    def add(self, samples: ImuSamples) -> None:
        """Add samples; absurd ones, and those not later than all before, are passed over."""
        values = np.hstack([samples.gyro, samples.acceleration])
        is_sane = (np.abs(values) < _LARGEST).all(axis=1)
        n = max(len(self) - 2, 0)  # the stamp of the last one may turn out to be damaged
        stamps_ns = np.concatenate([self._stamps_ns[n:], samples.stamps_ns[is_sane]])
        values = np.concatenate([self._values[n:], values[is_sane]])
        are_kept = are_in_order(stamps_ns)
        self._stamps_ns = np.concatenate([self._stamps_ns[:n], stamps_ns[are_kept]])
        self._values = np.concatenate([self._values[:n], values[are_kept]])

    def drop(self, stamp_ns: int) -> None:
        """Drop samples that are not needed for intervals from a stamp of the camera on."""
        n = int(np.searchsorted(self._stamps_ns, stamp_ns - self.delay_ns)) - 2
        if 2 * n > len(self):  # not with each frame: the rest is copied
            self._stamps_ns, self._values = self._stamps_ns[n:], self._values[n:]

    def between(self, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Return an interval in pieces: seconds (n,), mean rates and accelerations (n, 6).

        They are linear between samples. None if a hole is in the interval.
        """
        start, end = start_ns - self.delay_ns, end_ns - self.delay_ns
        first = int(np.searchsorted(self._stamps_ns, start, "right"))
        last = int(np.searchsorted(self._stamps_ns, end, "left"))
        if self._has_hole(start, end, slice(max(first - 1, 0), last + 1)):
            return None
        knots_ns = np.concatenate([[start], self._stamps_ns[first:last], [end]])
        ends = self._at(start, first), self._at(end, last)
        values = np.vstack([ends[0], self._values[first:last], ends[1]])
        return 1e-9 * np.diff(knots_ns), 0.5 * (values[1:] + values[:-1])

    def _has_hole(self, start: int, end: int, near: slice) -> bool:
        """Tell whether a time without samples lies in an interval, or at either end of it."""
        stamps_ns = self._stamps_ns[near]
        if len(stamps_ns) == 0:
            return True
        inside = np.diff(stamps_ns).max(initial=0)
        return bool(max(inside, stamps_ns[0] - start, end - stamps_ns[-1]) > 1e9 * HOLE_S)

    def _at(self, stamp_ns: int, after: int) -> FloatArray:
        """Return the values at a stamp, by the samples before and after it; held at the ends."""
        if after == 0 or after == len(self):
            return np.asarray(self._values[min(after, len(self) - 1)])
        before_ns, after_ns = self._stamps_ns[after - 1 : after + 1].tolist()
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        return np.asarray((1.0 - share) * self._values[after - 1] + share * self._values[after])
