"""The runs of a batch as plain arrays, and which of them may be compared."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from gvo.types import BoolArray, FloatArray, IntArray

MIN_SHARE_OF_POSES = 0.95
"""Of the most that any run of a recording has: with fewer a run is too short to be compared."""
CONFIDENCE = 0.95
"""Of all intervals."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Runs:
    """The runs of a batch, each of one recording with one configuration.

    Parameters
    ----------
    recordings, variants : sequence of str, length n
        What was run, and the name of the configuration.
    parameters : mapping of str to sequence, each of length n
        Values of the swept parameters by name.
    is_failed : ndarray of bool, shape (n,)
    n_poses : ndarray of float64, shape (n,)
        Frames with a pose; NaN where unknown.
    """

    recordings: Sequence[str]
    variants: Sequence[str]
    parameters: Mapping[str, Sequence[Hashable]]
    is_failed: BoolArray
    n_poses: FloatArray

    def recording_codes(self) -> IntArray:
        """Return a number for the recording of each run, shape (n,), by first appearance."""
        return codes_of(self.recordings)[1]

    def is_comparable(self) -> BoolArray:
        """Tell of which runs, shape (n,), the figures may stand beside those of other runs.

        One that failed has none. One that lost the camera where others did not has an error over
        the easy part only: it must have as many poses as the best of its recording, but for 5 %.
        """
        codes = self.recording_codes()
        most = np.zeros(len(codes))
        np.fmax.at(most, codes, np.where(self.is_failed, np.nan, self.n_poses))
        is_short = self.n_poses < MIN_SHARE_OF_POSES * most[codes]
        return np.asarray(~self.is_failed & ~is_short)

    def has(self, measures: FloatArray) -> BoolArray:
        """Tell which runs can be compared by a measure, shape (n,): one must be positive."""
        return np.asarray(self.is_comparable() & (measures > 0.0) & np.isfinite(measures))


def codes_of(values: Sequence[Hashable]) -> tuple[list[Hashable], IntArray]:
    """Return the distinct values as they come, and the number of each value among them."""
    numbers = {value: number for number, value in enumerate(dict.fromkeys(values))}
    return list(numbers), np.array([numbers[value] for value in values], dtype=np.int64)


def student_quantile(n_free: int) -> float:
    """Return how many standard errors an interval reaches to either side.

    Examples
    --------
    >>> round(student_quantile(5), 3)
    2.571
    """
    # scipy.stats knows it too, but takes long to import
    return float(stdtrit(n_free, 0.5 + 0.5 * CONFIDENCE))
