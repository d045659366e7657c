"""Errors of a trajectory against a reference: ATE, RPE, KITTI segment errors, and their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvo._text import format_table, number_text
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import MAX_DIFFERENCE_NS, AlignMode, alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

KITTI_SEGMENTS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of the KITTI odometry benchmark, metres."""
KITTI_STEP = 10
"""Poses between the starts of segments in the KITTI odometry benchmark."""
SHORT_SEGMENTS_M = (20.0, 50.0)
"""Segment lengths for paths shorter than KITTI's longest segment, metres."""
SHORT_STEP = 1
"""Poses between the starts of those segments."""

_MIN_PATH_M = 1e-6
_MIN_POSES = 3  # a rigid transform maps any two positions onto any other two
_HEADER = (
    "estimate",
    "poses",
    "coverage [%]",
    "ATE RMSE [m]",
    "ATE max [m]",
    "RPE [m]",
    "RPE [deg]",
    "segments [m]",
    "t_err [%]",
    "r_err [deg/100 m]",
    "path ratio",
)
_JSON_NAMES = (
    *("name", "n", "coverage", "ate_m", "ate_max_m", "rpe_m", "rpe_deg"),
    *("n_segments", "segments_m", "t_pct", "r_deg_per_100m", "path_ratio"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """The errors of one estimate against a reference, over the associated poses.

    Against positions without rotations (GNSS) only position errors, coverage and path ratio are
    measured.

    Parameters
    ----------
    name : str
        Of the estimate.
    stamps_ns : ndarray of int64, shape (n,)
        Of the associated reference poses, nanoseconds.
    errors_m : ndarray of float64, shape (n,)
        Distance of each aligned position from the reference, metres.
    rpe_m, rpe_deg : float or None
        Relative pose error: RMSE of translation and rotation; None without pairs or rotations.
    t_pct : float or None
        Mean translation error of KITTI's segments, % of their length; None without segments or
        rotations.
    r_deg_per_100m : float or None
        Mean rotation error of the same segments, degrees per 100 m.
    n_segments : int
        Segments evaluated.
    segments_m : tuple of float
        Their nominal lengths, metres.
    coverage : float
        Time from the first to the last associated pose over that of the whole reference, 0 to 1.
    path_ratio : float or None
        Path length of the estimate, before scaling, over that of the reference; None if the
        reference does not move.
    """

    name: str
    stamps_ns: IntArray
    errors_m: FloatArray
    rpe_m: float | None
    rpe_deg: float | None
    t_pct: float | None
    r_deg_per_100m: float | None
    n_segments: int
    segments_m: tuple[float, ...]
    coverage: float
    path_ratio: float | None

    @property
    def n(self) -> int:
        """Number of associated poses."""
        return len(self.errors_m)

    @property
    def ate_m(self) -> float:
        """Absolute trajectory error: root mean square of the position errors, metres."""
        return float(np.sqrt(np.mean(self.errors_m**2)))

    @property
    def ate_mean_m(self) -> float:
        """Mean position error, metres."""
        return float(np.mean(self.errors_m))

    @property
    def ate_median_m(self) -> float:
        """Median position error, metres."""
        return float(np.median(self.errors_m))

    @property
    def ate_max_m(self) -> float:
        """Largest position error, metres."""
        return float(np.max(self.errors_m))


def evaluate(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    name: str,
    align: AlignMode = "se3",
    segments: Sequence[float] | None = None,
    segment_step: int | None = None,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
    rpe_delta: int = 1,
) -> Evaluation:
    """Associate an estimate with its reference, align it and measure its errors.

    Parameters
    ----------
    reference, estimate : Trajectory
        Poses of the same frame, see `Trajectory.transformed`.
    name : str
        Of the estimate.
    align : {"none", "origin", "se3", "sim3"}
        How the estimate is aligned first, see `alignment`.
    segments : sequence of float, optional
        Segment lengths in metres; by default KITTI's 100 to 800 m if the associated reference is
        at least 800 m long, else 20 and 50 m.
    segment_step : int, optional
        Poses between the starts of segments; by default 10 as in KITTI, or 1, likewise.
    max_difference_ns : int
        Largest difference of associated stamps, nanoseconds; see `pair`.
    rpe_delta : int
        Distance of the two poses of a relative pose error, in poses.

    Returns
    -------
    Evaluation

    Raises
    ------
    TrajectoryError
        If fewer than three poses can be associated, `sim3` finds no scale, or `origin` lacks a
        rotation.
    ValueError
        If a segment length, the step or the delta is not positive.
    """
    ref, est = pair(reference, estimate, max_difference_ns=max_difference_ns, name=name)
    if len(ref) < _MIN_POSES:
        raise TrajectoryError(
            f"{name} and the reference have poses in common: {len(ref)}, expected at least "
            f"{_MIN_POSES}"
        )
    aligned = alignment(ref, est, align).apply(est)
    is_long = _path_length(ref) >= KITTI_SEGMENTS_M[-1]
    if segments is None:
        segments = KITTI_SEGMENTS_M if is_long else SHORT_SEGMENTS_M
    if segment_step is None:
        segment_step = KITTI_STEP if is_long else SHORT_STEP
    step_t, step_r = relative_errors(ref, aligned, delta=rpe_delta)
    shares, turns = segment_errors(ref, aligned, lengths_m=segments, step=segment_step)
    return Evaluation(
        name=name,
        stamps_ns=ref.stamps_ns,
        errors_m=np.linalg.norm(ref.positions - aligned.positions, axis=1),
        rpe_m=_root(_mean(step_t**2)),
        rpe_deg=_root(_mean(np.rad2deg(step_r) ** 2)),
        t_pct=_mean(100.0 * shares),
        r_deg_per_100m=_mean(100.0 * np.rad2deg(turns)),
        n_segments=len(shares),
        segments_m=tuple(float(length) for length in segments),
        coverage=_coverage(reference, ref),
        path_ratio=_path_ratio(ref, est),
    )


def relative_errors(
    reference: Trajectory, estimate: Trajectory, *, delta: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Return the errors of the relative poses of all pairs (i, i + delta).

    Parameters
    ----------
    reference, estimate : Trajectory
        Associated: of equal length.
    delta : int
        Distance of the two poses, in poses.

    Returns
    -------
    translations : ndarray of float64, shape (m,)
        Metres.
    rotations : ndarray of float64, shape (m,)
        Radians; both are empty if one of the trajectories has no rotations.

    References
    ----------
    J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012,
    doi:10.1109/IROS.2012.6385773.
    """
    if delta < 1:
        raise ValueError(f"delta must be at least 1, got {delta}")
    n_pairs = max(len(reference) - delta, 0) if _have_rotations(reference, estimate) else 0
    first = np.arange(n_pairs)
    return _pair_errors(reference, estimate, first, first + delta)


def segment_errors(
    reference: Trajectory, estimate: Trajectory, *, lengths_m: Sequence[float], step: int
) -> tuple[FloatArray, FloatArray]:
    """Return the errors over segments of given path lengths, as KITTI's devkit does.

    A segment ends at the first pose whose path from its start exceeds the length.

    Parameters
    ----------
    reference, estimate : Trajectory
        Associated: of equal length. The path is the reference's.
    lengths_m : sequence of float
        Metres.
    step : int
        Poses between the starts of segments.

    Returns
    -------
    translations : ndarray of float64, shape (m,)
        Translation error over the length of the segment.
    rotations : ndarray of float64, shape (m,)
        Rotation error over the length of the segment, radians per metre; both are empty if one of
        the trajectories has no rotations.

    References
    ----------
    A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving? The KITTI vision
    benchmark suite", CVPR 2012, doi:10.1109/CVPR.2012.6248074.
    """
    if step < 1 or not all(0 < length < np.inf for length in lengths_m):
        raise ValueError(f"step and lengths must be positive, got {step} and {lengths_m}")
    distances = reference.distances()
    starts, lengths = np.meshgrid(np.arange(0, len(reference), step), np.array(lengths_m, float))
    first, length = starts.ravel(), lengths.ravel()
    last = np.searchsorted(distances, distances[first] + length, side="right")
    fits = (last < len(reference)) & _have_rotations(reference, estimate)
    translations, rotations = _pair_errors(reference, estimate, first[fits], last[fits])
    return translations / length[fits], rotations / length[fits]


def _have_rotations(reference: Trajectory, estimate: Trajectory) -> bool:
    return reference.has_rotations and estimate.has_rotations


def _pair_errors(
    reference: Trajectory, estimate: Trajectory, first: IntArray, last: IntArray
) -> tuple[FloatArray, FloatArray]:
    T_ref, T_est = reference.T_world_frame, estimate.T_world_frame
    motion_ref = se3.invert(T_ref[first]) @ T_ref[last]
    motion_est = se3.invert(T_est[first]) @ T_est[last]
    errors = se3.invert(motion_est) @ motion_ref
    return np.linalg.norm(errors[:, :3, 3], axis=1), se3.rotation_angle(errors)


def _mean(values: FloatArray) -> float | None:
    return float(np.mean(values)) if len(values) > 0 else None


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))


def _path_length(trajectory: Trajectory) -> float:
    return float(trajectory.distances()[-1])


def _path_ratio(reference: Trajectory, estimate: Trajectory) -> float | None:
    length = _path_length(reference)
    return _path_length(estimate) / length if length > _MIN_PATH_M else None


def _coverage(reference: Trajectory, associated: Trajectory) -> float:
    if len(reference) == 1:
        return 1.0
    whole, part = (t.stamps_ns[-1] - t.stamps_ns[0] for t in (reference, associated))
    return float(part / whole)


def format_evaluations(evaluations: Sequence[Evaluation]) -> str:
    """Return a table of text with a row per evaluation; "-" for missing values."""
    return format_table(_HEADER, [_cells(evaluation) for evaluation in evaluations])


def evaluations_json(
    evaluations: Sequence[Evaluation],
) -> dict[str, list[dict[str, Any]]]:
    """Return all columns of the table as plain values: `{"estimates": [{"name", ...}, ...]}`."""
    rows = [{name: getattr(each, name) for name in _JSON_NAMES} for each in evaluations]
    return {"estimates": rows}


def _cells(evaluation: Evaluation) -> tuple[str, ...]:
    return (
        evaluation.name,
        str(evaluation.n),
        f"{100.0 * evaluation.coverage:.1f}",
        f"{evaluation.ate_m:.4f}",
        f"{evaluation.ate_max_m:.4f}",
        number_text(evaluation.rpe_m, ".4f"),
        number_text(evaluation.rpe_deg, ".4f"),
        _segments(evaluation),
        number_text(evaluation.t_pct, ".3f"),
        number_text(evaluation.r_deg_per_100m, ".3f"),
        number_text(evaluation.path_ratio, ".3f"),
    )


def _segments(evaluation: Evaluation) -> str:
    if evaluation.n_segments == 0:
        return "-"
    shortest, longest = min(evaluation.segments_m), max(evaluation.segments_m)
    return f"{shortest:g}" if shortest == longest else f"{shortest:g}..{longest:g}"
