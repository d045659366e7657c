"""Errors, drift and consistency of estimates, as arrays to be drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import AlignMode, alignment, pair
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, KITTI_STEP, segment_errors
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

_MIN_PATH_M = 0.1
_MAX_STARTS = 2000
_N_LENGTHS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """The associated, aligned poses of an estimate and its reference, with their errors (n,)."""

    name: str
    trajectory: Trajectory
    reference: Trajectory
    estimate: Trajectory
    errors_m: FloatArray
    errors_rad: FloatArray | None

    @property
    def ate_m(self) -> float:
        """Root mean square of the position errors, metres."""
        return float(np.sqrt(np.mean(self.errors_m**2)))


def compare(truth: Trajectory, estimate: Trajectory, *, name: str, align: AlignMode) -> Comparison:
    """Associate and align an estimate, and compute its error at each pose.

    Rotations are compared since the first associated pose, not after alignment, which leaves the
    roll about a straight path undetermined.

    Raises
    ------
    TrajectoryError
        When nothing can be associated.
    """
    ref, est = _paired(truth, estimate, name)
    similarity = alignment(ref, est, align)
    moved = similarity.apply(est)
    errors_rad = None
    if ref.has_rotations and est.has_rotations:
        turned = [se3.invert(t.T_world_frame[:1]) @ t.T_world_frame for t in (ref, est)]
        errors_rad = se3.rotation_angle(se3.invert(turned[0]) @ turned[1])
    return Comparison(
        name=name,
        trajectory=similarity.apply(estimate),
        reference=ref,
        estimate=moved,
        errors_m=np.linalg.norm(ref.positions - moved.positions, axis=1),
        errors_rad=errors_rad,
    )


def _paired(truth: Trajectory, estimate: Trajectory, name: str) -> tuple[Trajectory, Trajectory]:
    try:
        return pair(truth, estimate, name=name)
    except TrajectoryError:
        if truth.stamps_from != "file":
            raise
        # the file may hold poses of a topic, of another rate and phase
        return pair(replace(truth, stamps_from="topic"), estimate, name=name)


def truth_around(truth: Trajectory, parts: Sequence[Trajectory]) -> Trajectory:
    """Return the ground truth within the span of the associated poses."""
    first_ns = min(int(part.stamps_ns[0]) for part in parts)
    last_ns = max(int(part.stamps_ns[-1]) for part in parts)
    return truth.select((truth.stamps_ns >= first_ns) & (truth.stamps_ns <= last_ns))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """Mean errors over the segments of each length, shape (k,)."""

    lengths_m: FloatArray
    translations_pct: FloatArray
    rotations_deg_per_m: FloatArray
    n_segments: IntArray


def drift_lengths(path_m: float) -> tuple[float, ...]:
    """Return KITTI's 100 to 800 m for a longer path, else round lengths up to four fifths of it."""
    if path_m > KITTI_SEGMENTS_M[-1]:
        return KITTI_SEGMENTS_M
    if path_m < _MIN_PATH_M:
        return ()
    longest = 0.8 * path_m
    power = float(10.0 ** np.floor(np.log10(longest / _N_LENGTHS)))
    step = next(f * power for f in (5.0, 2.0, 1.0) if f * power <= longest / _N_LENGTHS)
    n_lengths = int(longest / step + 1e-9)
    every = max(1, round(n_lengths / _N_LENGTHS))
    return tuple(round(n * step, 9) for n in range(every, n_lengths + 1, every))


def drift(comparison: Comparison, lengths_m: Sequence[float]) -> Drift | None:
    """Return the drift by length; None if no segment fits."""
    n = len(comparison.reference)
    is_standard = tuple(lengths_m) == KITTI_SEGMENTS_M
    # a path in a room has many poses: starts are spread evenly
    step = KITTI_STEP if is_standard else max(1, n // _MAX_STARTS)
    rows = []
    for length in lengths_m:
        shares, turns = segment_errors(
            comparison.reference, comparison.estimate, lengths_m=[length], step=step
        )
        if len(shares) > 0:
            mean_deg = float(np.rad2deg(np.mean(turns)))
            rows.append((length, 100.0 * float(np.mean(shares)), mean_deg, len(shares)))
    if not rows:
        return None
    lengths, translations, rotations, counts = np.array(rows, dtype=np.float64).T
    return Drift(
        lengths_m=lengths,
        translations_pct=translations,
        rotations_deg_per_m=rotations,
        n_segments=counts.astype(np.int64),
    )


def chi2_density(values: FloatArray) -> FloatArray:
    """Return the density of chi-square with 6 degrees of freedom."""
    return np.asarray(values**2 * np.exp(-0.5 * values) / 16.0)
