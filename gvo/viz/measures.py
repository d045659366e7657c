"""Drift by length, to be drawn, and the part of a reference that is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.ticker import MaxNLocator

from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, Evaluation, segment_errors
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray

_MIN_PATH_M = 0.1
_MAX_STARTS = 2000  # a path in a room has many poses
_N_LENGTHS = 8


def truth_around(truth: Trajectory, evaluations: Sequence[Evaluation]) -> Trajectory:
    """Return the ground truth within the span of the associated poses."""
    stamps_ns = np.concatenate([each.reference.stamps_ns for each in evaluations])
    is_within = (truth.stamps_ns >= stamps_ns.min()) & (truth.stamps_ns <= stamps_ns.max())
    return truth.select(is_within)


def drift_lengths(path_m: float) -> tuple[float, ...]:
    """Return KITTI's 100 to 800 m for a longer path, else round lengths up to four fifths of it."""
    if path_m > KITTI_SEGMENTS_M[-1]:
        return KITTI_SEGMENTS_M
    longest_m = 0.8 * path_m if path_m >= _MIN_PATH_M else 0.0
    rounds = MaxNLocator(_N_LENGTHS, steps=[1, 2, 5, 10]).tick_values(0.0, longest_m)
    return tuple(float(length) for length in rounds if 0.0 < length <= longest_m)


def drift(evaluation: Evaluation, lengths_m: Sequence[float]) -> FloatArray:
    """Return length [m], mean errors [%], [deg/m] and number of segments, shape (k, 4)."""
    reference, estimate = evaluation.reference, evaluation.estimate
    step, rows = max(1, evaluation.n // _MAX_STARTS), []
    for length in lengths_m:
        shares, turns = segment_errors(reference, estimate, lengths_m=[length], step=step)
        if len(shares) > 0:
            rows.append((length, 100.0 * shares.mean(), np.rad2deg(turns.mean()), len(shares)))
    return np.array(rows).reshape(-1, 4)
