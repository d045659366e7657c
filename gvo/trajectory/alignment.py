"""Association of two trajectories by their stamps, and alignment of one to the other."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory, format_stamp
from gvo.types import FloatArray, IntArray

AlignMode = Literal["none", "origin", "se3", "sim3"]

MAX_DIFFERENCE_NS = 10_000_000
"""Largest difference of associated stamps, nanoseconds: 10 ms as in the TUM tools and evo."""

_MIN_CORRELATION = 0.3

MAX_GAP_NS = 250_000_000
"""Largest gap between poses that is interpolated, nanoseconds.

At an acceleration of 2 m/s^2 linear interpolation is then wrong by at most 16 mm.
"""


def pair(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
    name: str = "estimate",
) -> tuple[Trajectory, Trajectory]:
    """Return the reference and the estimate at common stamps.

    Poses of files are associated one to one, see `associate`. If the stamps of either come from a
    topic (`stamps_from="topic"`), rates and phases differ by nature: the trajectory of the higher
    rate is interpolated at the stamps of the other, except in gaps longer than `MAX_GAP_NS`.

    Parameters
    ----------
    reference, estimate : Trajectory
        With at least one pose each.
    max_difference_ns : int
        Largest difference of associated stamps, nanoseconds; unused in interpolation.
    name : str
        Of the estimate, for messages.

    Returns
    -------
    tuple of two Trajectory
        Of n poses each, n >= 1. An interpolated one has no covariances.

    Raises
    ------
    TrajectoryError
        If nothing can be associated.
    """
    origins = {reference.stamps_from, estimate.stamps_from}
    if "topic" not in origins or "rows" in origins or 0 in (len(reference), len(estimate)):
        indices, others = associate(
            reference, estimate, max_difference_ns=max_difference_ns, name=name
        )
        return reference.select(indices), estimate.select(others)
    if _step(estimate) < _step(reference):
        inner, outer = _interpolated(estimate, reference)
        pairs = outer, inner
    else:
        pairs = _interpolated(reference, estimate)
    if len(pairs[0]) == 0:
        raise TrajectoryError(
            f"{name} and the reference share no stamps, none lies between two poses at most "
            f"{MAX_GAP_NS / 1e6:g} ms apart: {name} {_range(estimate)}, reference "
            f"{_range(reference)}; give files of one recording and one clock"
        )
    return pairs


def clock_offset(reference: Trajectory, estimate: Trajectory) -> int:
    """Return what to add to the stamps of an estimate of another clock, nanoseconds.

    Both turn and move at the same times: the rates of turning and moving correlate best.

    Raises
    ------
    TrajectoryError
        If they correlate nowhere.
    """
    from scipy.signal import correlate  # slow to import

    step_ns = int(min(_step(reference), _step(estimate)))
    rates, others = (_rates(each, step_ns) for each in (reference, estimate))
    found = np.sum([correlate(a, b) for a, b in zip(rates, others, strict=True)], axis=0)
    best = int(np.argmax(found))
    least = _MIN_CORRELATION * np.sqrt(np.sum(rates**2) * np.sum(others**2))
    if not 0 < best < len(found) - 1 or found[best] < least:
        raise TrajectoryError("no offset of the clocks: the trajectories do not move alike")
    before, peak, after = found[best - 1 : best + 2]
    lag = best - (others.shape[1] - 1) + 0.5 * (before - after) / (before - 2.0 * peak + after)
    return int(reference.stamps_ns[0] - estimate.stamps_ns[0] + round(lag * step_ns))


def _rates(trajectory: Trajectory, step_ns: int) -> FloatArray:
    """Return the rates of turning and moving at equal steps, shape (2, n), normalized."""
    first_ns, last_ns = trajectory.stamps_ns[[0, -1]]
    T = trajectory.interpolate(np.arange(first_ns, last_ns + 1, step_ns)).T_world_frame
    steps = se3.invert(T[:-1]) @ T[1:]
    rates = np.array([se3.rotation_angle(steps), np.linalg.norm(steps[:, :3, 3], axis=1)])
    rates -= rates.mean(axis=1, keepdims=True)
    return np.asarray(rates / np.maximum(rates.std(axis=1, keepdims=True), 1e-12))


def _step(trajectory: Trajectory) -> float:
    """Return the median step between stamps, nanoseconds; infinite for a single pose."""
    return float(np.median(np.diff(trajectory.stamps_ns))) if len(trajectory) > 1 else np.inf


def _interpolated(dense: Trajectory, sparse: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return both at the stamps of the sparse one that lie in no long gap of the dense one."""
    between = dense.interpolate(sparse.stamps_ns, max_gap_ns=MAX_GAP_NS)
    return between, sparse.select(np.isin(sparse.stamps_ns, between.stamps_ns))


def associate(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
    name: str = "estimate",
) -> tuple[IntArray, IntArray]:
    """Associate the poses of two trajectories by their stamps.

    Each pose of the shorter trajectory is matched to the nearest one of the longer; if two match
    the same one, the nearer keeps it. Trajectories without stamps (`stamps_from="rows"`) are
    associated row by row.

    Parameters
    ----------
    reference, estimate : Trajectory
        With at least one pose each.
    max_difference_ns : int
        Largest difference of associated stamps, nanoseconds.
    name : str
        Of the estimate, for messages.

    Returns
    -------
    tuple of two ndarrays of int64, shape (n,)
        Increasing indices into reference and estimate, n >= 1.

    Raises
    ------
    TrajectoryError
        If nothing can be associated.
    """
    if len(reference) == 0 or len(estimate) == 0:
        empty = "the reference" if len(reference) == 0 else name
        raise TrajectoryError(f"{empty} holds no poses, nothing can be associated")
    if _is_associated_by_row(reference, estimate, name):
        rows = np.arange(len(reference))
        return rows, rows.copy()
    if len(estimate) > len(reference):
        longer, shorter = _nearest(estimate.stamps_ns, reference.stamps_ns, max_difference_ns)
        indices = shorter, longer
    else:
        indices = _nearest(reference.stamps_ns, estimate.stamps_ns, max_difference_ns)
    if len(indices[0]) == 0:
        raise TrajectoryError(
            f"{name} and the reference share no stamps within {max_difference_ns / 1e6:g} ms: "
            f"{name} {_range(estimate)}, reference {_range(reference)}; "
            "give files of one recording and one clock, or --offset auto"
        )
    return indices


def _is_associated_by_row(reference: Trajectory, estimate: Trajectory, name: str) -> bool:
    origins = (reference.stamps_from, estimate.stamps_from)
    if "rows" not in origins:
        return False
    if {*origins} <= {"rows", "times"} and len(reference) == len(estimate):
        return True  # one row per frame in both, whether or not stamps lie beside one of them
    if origins == ("rows", "rows"):
        raise TrajectoryError(
            f"{name} holds {len(estimate)} poses without stamps, the reference {len(reference)}: "
            "row by row they cannot belong together; give files of the same frames, or with stamps"
        )
    bare, stamped = (name, "the reference") if origins[1] == "rows" else ("the reference", name)
    raise TrajectoryError(
        f"{bare} holds rows of poses without stamps and cannot be associated with {stamped}, "
        f"which has stamps ({len(estimate)} poses to {len(reference)} of the reference); "
        "put a times.txt with one stamp in seconds per row beside the poses"
    )


def _nearest(
    longer_ns: IntArray, shorter_ns: IntArray, max_difference_ns: int
) -> tuple[IntArray, IntArray]:
    after = np.clip(np.searchsorted(longer_ns, shorter_ns), 0, len(longer_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(shorter_ns - longer_ns[before]) <= np.abs(longer_ns[after] - shorter_ns)
    nearest = np.where(is_before, before, after)
    differences = np.abs(longer_ns[nearest] - shorter_ns)
    # sorted by pose of the longer one, then by difference: the first of each group keeps it
    order = np.lexsort([differences, nearest])
    is_first = np.diff(nearest[order], prepend=-1) > 0
    kept = np.sort(order[is_first & (differences[order] <= max_difference_ns)])
    return nearest[kept], kept


def _range(trajectory: Trajectory) -> str:
    first, last = (format_stamp(int(trajectory.stamps_ns[i])) for i in (0, -1))
    return f"{first} to {last} s"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Similarity:
    """A similarity transform: p_a = scale * R_a_b @ p_b + t_a_b."""

    T_a_b: FloatArray
    scale: float = 1.0

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """Transform a trajectory, with its covariances if any, from world b to world a."""
        scaled = np.array(trajectory.T_world_frame)
        scaled[:, :3, 3] *= self.scale
        covariances = trajectory.covariances
        if covariances is not None:
            factors = np.array([1.0] * 3 + [self.scale] * 3)
            covariances = covariances * np.outer(factors, factors)
        return replace(trajectory, T_world_frame=scaled, covariances=covariances).moved(self.T_a_b)


def alignment(reference: Trajectory, estimate: Trajectory, mode: AlignMode) -> Similarity:
    """Return the transform that aligns an estimate to its associated reference.

    Parameters
    ----------
    reference, estimate : Trajectory
        Associated: of equal length, at least one pose.
    mode : {"none", "origin", "se3", "sim3"}
        No alignment; first pose to first pose; least squares over the positions by a rigid
        transform; the same with a scale. The last two need no rotations.

    Returns
    -------
    Similarity
        From the world of the estimate to that of the reference.

    Raises
    ------
    ValueError
        If the lengths differ or the mode is unknown.
    TrajectoryError
        If `sim3` finds no positive scale, or `origin` lacks a rotation.

    References
    ----------
    S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", IEEE PAMI 13(4), 1991, doi:10.1109/34.88573.
    """
    if len(reference) != len(estimate) or len(reference) == 0:
        raise ValueError(f"got {len(reference)} reference poses and {len(estimate)} estimates")
    if mode == "none":
        return Similarity(T_a_b=np.eye(4))
    if mode == "origin":
        for name, trajectory in {"reference": reference, "estimate": estimate}.items():
            if not trajectory.has_rotations:
                raise TrajectoryError(
                    f"the {name} holds positions without rotations, its first pose cannot be "
                    "aligned with; align by se3"
                )
        return Similarity(T_a_b=reference.T_world_frame[0] @ se3.invert(estimate.T_world_frame[0]))
    if mode not in ("se3", "sim3"):
        raise ValueError(f"mode must be one of {get_args(AlignMode)}, got {mode!r}")
    return _fit(reference.positions, estimate.positions, is_scaled=mode == "sim3")


def _fit(points_a: FloatArray, points_b: FloatArray, *, is_scaled: bool) -> Similarity:
    mean_a, mean_b = points_a.mean(axis=0), points_b.mean(axis=0)  # eq. 34, 35
    centred_a, centred_b = points_a - mean_a, points_b - mean_b
    R = _best_rotation(centred_a, centred_b)
    scale = 1.0
    if is_scaled:
        square_b = np.sum(centred_b**2)
        scale = float(np.sum(centred_a * (centred_b @ R.T)) / square_b) if square_b > 0 else 0.0
        if scale <= 0:  # eq. 42
            raise TrajectoryError("no scale can be estimated: the trajectories do not move alike")
    return Similarity(T_a_b=se3.make_transform(R, mean_a - scale * R @ mean_b), scale=scale)  # 41


def _best_rotation(vectors_a: FloatArray, vectors_b: FloatArray) -> FloatArray:
    """Return the least-squares R_a_b (eq. 40); any optimum if the vectors lie on a line."""
    if len(vectors_a) == 1:
        return np.eye(3)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Optimal rotation is not uniquely", UserWarning)
        rotation, _ = Rotation.align_vectors(vectors_a, vectors_b)
    return np.asarray(rotation.as_matrix())
