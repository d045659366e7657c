"""Errors of a trajectory against a reference: ATE, RPE, segments, and their table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gvo._text import MAX_WIDTH, format_table, number_text
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import MAX_DIFFERENCE_NS, AlignMode, alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

KITTI_SEGMENTS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of the KITTI odometry benchmark, metres."""
KITTI_STEP = 10
"""Poses between the starts of segments in the KITTI odometry benchmark."""
SHORT_PATH_M = 200.0
"""Paths shorter than this have the following segments, too, metres."""
SHORT_SEGMENTS_M = (20.0, 50.0)
"""Their lengths, metres."""
SHORT_STEP = 1
"""Poses between the starts of segments of those paths."""

_MIN_PATH_M = 1e-6
# A step stands out where its error is so many times that of three in four.
_JUMP_FACTOR, _JUMP_QUANTILE, _N_JUMPS = 6.0, 0.75, 3
_MIN_POSES = 3  # a rigid transform maps any two positions onto any other two
SMOOTHED_GLOBAL = "smoothed = global"
"""How both are named where they are the same."""

_JSON_NAMES = (
    *("name", "n", "reference_share", "ate_m", "ate_mean_m", "ate_median_m", "ate_std_m"),
    *("ate_max_m", "rpe_m", "rpe_deg", "n_segments", "segments_m", "t_pct", "r_deg_per_100m"),
    *("path_ratio", "scale", "scaled_ate_m", "jumps"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """The errors of one estimate against a reference, over the associated poses.

    Against positions without rotations (GNSS) only position errors, the share of the reference and
    the path ratio are measured.

    Parameters
    ----------
    name : str
        Of the estimate.
    trajectory : Trajectory
        The whole estimate, aligned.
    reference, estimate : Trajectory
        The n associated poses of the reference, and those of the aligned estimate.
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
    reference_share : float
        Time from the first to the last associated pose over that of the whole reference, 0 to 1.
    path_ratio : float or None
        Path length of the estimate, before scaling, over that of the reference; None if the
        reference does not move.
    scale, scaled_ate_m : float or None
        The factor of the estimate's positions that fits the reference best, and the ATE with it;
        None if there is none.
    jumps : tuple of (int, int, float)
        Largest errors of single steps that stand out of all others, at most three: the number of
        the pose after it in the estimate, its stamp in nanoseconds, metres.
    """

    name: str
    trajectory: Trajectory
    reference: Trajectory
    estimate: Trajectory
    errors_m: FloatArray
    rpe_m: float | None
    rpe_deg: float | None
    t_pct: float | None
    r_deg_per_100m: float | None
    n_segments: int
    segments_m: tuple[float, ...]
    reference_share: float
    path_ratio: float | None
    scale: float | None = None
    scaled_ate_m: float | None = None
    jumps: tuple[tuple[int, int, float], ...] = ()

    def __repr__(self) -> str:
        """Return one line: how many poses, and the root mean squares of their errors."""
        rpe = f"{number_text(self.rpe_m)} m, {number_text(self.rpe_deg)} deg"
        return f"Evaluation({self.name}: {self.n} poses, ATE {self.ate_m:.4g} m, RPE {rpe})"

    @property
    def n(self) -> int:
        """Number of associated poses."""
        return len(self.errors_m)

    @property
    def errors_rad(self) -> FloatArray | None:
        """Rotation error of each pose since the first one, shape (n,); None without rotations.

        An alignment leaves the roll about a straight path undetermined.
        """
        if not _have_rotations(self.reference, self.estimate):
            return None
        later = np.arange(self.n)
        return _pair_errors(self.reference, self.estimate, np.zeros_like(later), later)[1]

    @property
    def ate_m(self) -> float:
        """Absolute trajectory error: root mean square of the position errors, metres."""
        return float(np.sqrt(np.mean(self.errors_m**2)))

    @property
    def ate_mean_m(self) -> float:
        """Mean of the position errors, metres."""
        return float(np.mean(self.errors_m))

    @property
    def ate_median_m(self) -> float:
        """Median of the position errors, metres."""
        return float(np.median(self.errors_m))

    @property
    def ate_std_m(self) -> float:
        """Standard deviation of the position errors, metres."""
        return float(np.std(self.errors_m))

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
    """Associate, align and measure, as `gvo.io.poses.inputs.evaluate` says."""
    ref, est = pair(reference, estimate, max_difference_ns=max_difference_ns, name=name)
    if len(ref) < _MIN_POSES:
        raise TrajectoryError(
            f"{name} and the reference have poses in common: {len(ref)}, expected at least "
            f"{_MIN_POSES}"
        )
    similarity = alignment(ref, est, align)
    aligned = similarity.apply(est)
    usual, usual_step = usual_segments(ref)
    segments = usual if segments is None else segments
    segment_step = usual_step if segment_step is None else segment_step
    step_t, step_r = relative_errors(ref, aligned, delta=rpe_delta)
    scale, scaled_ate_m = _scale(ref, est)
    shares, turns = segment_errors(ref, aligned, lengths_m=segments, step=segment_step)
    return Evaluation(
        name=name,
        trajectory=similarity.apply(estimate),
        reference=ref,
        estimate=aligned,
        errors_m=np.linalg.norm(ref.positions - aligned.positions, axis=1),
        rpe_m=_root(_mean(step_t**2)),
        rpe_deg=_root(_mean(np.rad2deg(step_r) ** 2)),
        t_pct=_mean(100.0 * shares),
        r_deg_per_100m=_mean(100.0 * np.rad2deg(turns)),
        n_segments=len(shares),
        segments_m=tuple(float(length) for length in segments),
        reference_share=_reference_share(reference, ref),
        path_ratio=_path_ratio(ref, est),
        scale=scale,
        scaled_ate_m=scaled_ate_m,
        jumps=_jumps(estimate, ref, aligned),
    )


def relative_errors(
    reference: Trajectory, estimate: Trajectory, *, delta: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Return the errors of the relative poses of all pairs (i, i + delta)."""
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
    if not _have_rotations(reference, estimate):
        return np.zeros(0), np.zeros(0)
    distances = reference.distances()
    starts, lengths = np.meshgrid(np.arange(0, len(reference), step), np.array(lengths_m, float))
    first, length = starts.ravel(), lengths.ravel()
    last = np.searchsorted(distances, distances[first] + length, side="right")
    fits = last < len(reference)
    translations, rotations = _pair_errors(reference, estimate, first[fits], last[fits])
    return translations / length[fits], rotations / length[fits]


def usual_segments(path: Trajectory) -> tuple[tuple[float, ...], int]:
    """Return KITTI's lengths that a path holds, and its step; of a short one 20 and 50 m too."""
    path_m = _path_length(path)
    held = tuple(length for length in KITTI_SEGMENTS_M if length < path_m)
    is_short = path_m < SHORT_PATH_M
    return ((*SHORT_SEGMENTS_M, *held), SHORT_STEP) if is_short else (held, KITTI_STEP)


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


def _scale(reference: Trajectory, estimate: Trajectory) -> tuple[float, float] | tuple[None, None]:
    """Return the scale that fits an associated estimate best, and the ATE with it."""
    try:
        fit = alignment(reference, estimate, "sim3")
    except TrajectoryError:  # the two do not move alike
        return None, None
    errors = reference.positions - fit.apply(estimate).positions
    return fit.scale, float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _jumps(
    whole: Trajectory, reference: Trajectory, estimate: Trajectory
) -> tuple[tuple[int, int, float], ...]:
    """Return the steps of an aligned estimate whose errors stand out, the largest first."""
    steps = [np.diff(each.positions, axis=0) for each in (reference, estimate)]
    errors = np.linalg.norm(steps[1] - steps[0], axis=1)
    largest = np.argsort(-errors)[:_N_JUMPS]
    far = largest[errors[largest] > _JUMP_FACTOR * np.quantile(errors, _JUMP_QUANTILE)]
    stamps_ns = estimate.stamps_ns[far + 1]
    rows = zip(np.searchsorted(whole.stamps_ns, stamps_ns), stamps_ns, errors[far], strict=True)
    return tuple((int(row), int(stamp_ns), float(error)) for row, stamp_ns, error in rows)


def _reference_share(reference: Trajectory, associated: Trajectory) -> float:
    if len(reference) == 1:
        return 1.0
    whole, part = (t.stamps_ns[-1] - t.stamps_ns[0] for t in (reference, associated))
    return float(part / whole)


def format_evaluations(evaluations: Sequence[Evaluation]) -> str:
    """Return a table of text with a column per evaluation, of 80 characters; "-" for no value.

    Of many evaluations, or long names, there are several tables below each other.
    """
    header, rows = evaluation_table(evaluations)
    room, tables = MAX_WIDTH - max(map(len, header)), list[str]()
    while rows or not tables:
        widths = np.cumsum([2 + max(map(len, row)) for row in rows])
        n_columns = max(1, int(np.searchsorted(widths, room, side="right")))
        names, *measures = zip(header, *rows[:n_columns], strict=True)
        tables.append(format_table(names, measures))
        rows = rows[n_columns:]
    return "\n".join(tables)


def evaluation_table(
    evaluations: Sequence[Evaluation],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the header and the rows of that table, as text.

    Without a loop the global trajectory equals the smoothed one, and both are one row.
    """
    rows: list[Evaluation] = []
    for each in evaluations:
        is_same = rows and (rows[-1].name, each.name) == ("smoothed", "global")
        if is_same and _figures(rows[-1]) == _figures(each):
            rows[-1] = replace(each, name=SMOOTHED_GLOBAL)
        else:
            rows.append(each)
    return tuple(_COLUMNS), [tuple(text(each) for text in _COLUMNS.values()) for each in rows]


def _figures(evaluation: Evaluation) -> list[object]:
    return [getattr(evaluation, name) for name in _JSON_NAMES if name != "name"]


def evaluations_json(evaluations: Sequence[Evaluation]) -> dict[str, list[dict[str, Any]]]:
    """Return all columns of the table as plain values: `{"estimates": [{"name", ...}, ...]}`."""
    rows = [{name: getattr(each, name) for name in _JSON_NAMES} for each in evaluations]
    return {"estimates": rows}


def _segments(evaluation: Evaluation) -> str:
    if evaluation.n_segments == 0:
        return "-"
    shortest, longest = min(evaluation.segments_m), max(evaluation.segments_m)
    return f"{shortest:g}" if shortest == longest else f"{shortest:g}..{longest:g}"


_COLUMNS: dict[str, Callable[[Evaluation], str]] = {
    "estimate": lambda e: e.name,
    "poses": lambda e: str(e.n),
    "of reference [%]": lambda e: f"{100.0 * e.reference_share:.1f}",
    "ATE RMSE [m]": lambda e: f"{e.ate_m:.4f}",
    "ATE mean [m]": lambda e: f"{e.ate_mean_m:.4f}",
    "ATE median [m]": lambda e: f"{e.ate_median_m:.4f}",
    "ATE std [m]": lambda e: f"{e.ate_std_m:.4f}",
    "ATE max [m]": lambda e: f"{e.ate_max_m:.4f}",
    "RPE RMSE [m]": lambda e: number_text(e.rpe_m, ".4f"),
    "RPE RMSE [deg]": lambda e: number_text(e.rpe_deg, ".4f"),
    "segments [m]": _segments,
    "t_err [%]": lambda e: number_text(e.t_pct, ".3f"),
    "r_err [deg/100 m]": lambda e: number_text(e.r_deg_per_100m, ".3f"),
    "path ratio": lambda e: number_text(e.path_ratio, ".3f"),
}
"""The table of evaluations: text by header."""
