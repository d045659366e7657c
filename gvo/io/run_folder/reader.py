"""A run folder read back, also of a run that still goes on or was interrupted."""

from __future__ import annotations

import csv
import json
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from gvo._text import read_text, text_lines
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.run_folder.writer import GLOBAL, LOOPS, TRAJECTORIES, TRUE_POSITIONS, TRUTH
from gvo.trajectory.formats import MAX_LINES, MAX_POSITION_M, read_covariances, read_trajectory
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from gvo.types import BoolArray, FloatArray, IntArray

COUNTS = ("keypoints", "points", "matches", "inliers", "links", "edges", "rejected")
"""What `frames.csv` may count, as columns `n_...`."""

MAX_SUMMARY_BYTES = 1 << 24
"""Of `summary.json`: nested lists of two bytes take thirty times their memory."""

_ROUNDING = 1e-2
_EXPECTED = "expected a folder that gvo run or gvo smooth wrote"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTable:
    """What `frames.csv` holds.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Of all frames, also of skipped ones, nanoseconds.
    statuses : tuple of str
        "ok", "coasting", "lost", "resumed" or "skipped".
    counts : dict of str to ndarray of int64, shape (n,)
        By the names of `COUNTS`; those that the table has.
    reasons : tuple of str
        Why a frame is not ok; empty if it is.
    """

    stamps_ns: IntArray
    statuses: tuple[str, ...]
    counts: dict[str, IntArray]
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeTable:
    """What `edges.csv` holds, a row per edge.

    Parameters
    ----------
    stamps_ns, reference_ns : ndarray of int64, shape (m,)
        Stamps of the two frames, nanoseconds.
    kinds : ndarray of str, shape (m,)
        "step", "keyframe" or "depth".
    is_accepted : ndarray of bool, shape (m,)
    chi2 : ndarray of float64, shape (m,)
        NaN where it is not known.
    """

    stamps_ns: IntArray
    reference_ns: IntArray
    kinds: np.ndarray[tuple[int], np.dtype[np.str_]]
    is_accepted: BoolArray
    chi2: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimingTable:
    """What `timings.csv` holds.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (k,)
        Nanoseconds.
    stages_ms : dict of str to ndarray of float64, shape (k,)
        Milliseconds by stage; NaN where a frame did not reach it.
    """

    stamps_ns: IntArray
    stages_ms: dict[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopTable:
    """What `loops.csv` holds, a row per loop.

    Parameters
    ----------
    stamps_ns, reference_ns : ndarray of int64, shape (m,)
        Stamps of the two frames, nanoseconds.
    n_inliers : ndarray of int64, shape (m,)
    residuals : ndarray of float64, shape (m,)
        Norms of the whitened residuals.
    reasons : tuple of str
        Why a loop does not count; empty where it does.
    """

    stamps_ns: IntArray
    reference_ns: IntArray
    n_inliers: IntArray
    residuals: FloatArray
    reasons: tuple[str, ...]

    def lines_on(self, trajectory: Trajectory) -> dict[str, FloatArray]:
        """Return the lines between both ends, shape (n, 2, 3), metres, without what has no pose.

        By "loops" and "refused loops".
        """
        ends_ns = np.stack([self.reference_ns, self.stamps_ns], axis=1)
        is_there = np.isin(ends_ns, trajectory.stamps_ns).all(axis=1)
        is_refused = np.array([bool(reason) for reason in self.reasons], dtype=np.bool_)
        lines = {}
        for name, is_such in (("loops", ~is_refused), ("refused loops", is_refused)):
            rows = np.searchsorted(trajectory.stamps_ns, ends_ns[is_there & is_such])
            lines[name] = trajectory.positions[rows]
        return lines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """A run folder.

    Parameters
    ----------
    folder : Path
    summary : dict
        As in `summary.json`; empty where there is none yet. Of a run that goes on or was
        interrupted that of a few seconds before.
    frames : FrameTable
    edges : EdgeTable or None
        None where the folder holds no such table, as that of `gvo smooth`.
    timings : TimingTable or None
        Likewise.
    loops : LoopTable or None
        None where no global poses were written.
    trajectories : dict of str to Trajectory
        "raw", "causal" and "smoothed", with covariances where the run computed them; may be
        empty, as "causal" where all was optimized at once. "global" where there is one.
    truth : Trajectory or None
        What the estimates were compared with: poses, or positions of the measured point.
    """

    folder: Path
    summary: dict[str, Any]
    frames: FrameTable
    edges: EdgeTable | None
    timings: TimingTable | None
    loops: LoopTable | None
    trajectories: dict[str, Trajectory]
    truth: Trajectory | None

    @property
    def name(self) -> str:
        """The recording's name; the folder's, where the run has not ended."""
        return str(self.summary.get("recording") or self.folder.resolve().name)

    @property
    def is_finished(self) -> bool:
        """Tell whether the run came to its end."""
        return bool(self.summary) and self.summary.get("state", "complete") == "complete"

    def comparable(self) -> dict[str, Trajectory]:
        """Return the trajectories that hold poses, moved to the point that the truth is of."""
        filled = {name: t for name, t in self.trajectories.items() if len(t) > 0}
        T_base_truth = self.summary.get("T_base_truth")
        if self.truth is None or T_base_truth is None:
            return filled
        T = np.array(T_base_truth, dtype=np.float64)
        if np.array_equal(T, np.eye(4)):
            return filled
        return {name: trajectory.transformed(T) for name, trajectory in filled.items()}


def read_run(folder: str | Path) -> RunRecord:
    """Read a run folder, as far as it was written.

    A run that goes on or was interrupted has no summary, and its last lines may be cut off:
    they are left out. Smoothed poses may come in any order.

    Parameters
    ----------
    folder : str or Path
        That `gvo run` or `gvo smooth` wrote.

    Returns
    -------
    RunRecord

    Raises
    ------
    RecordingError
        When it is no run folder, or a table or the summary is damaged.
    TrajectoryError
        When a file of poses or covariances is damaged.
    """
    folder = Path(folder)
    needed = ["frames.csv", "raw.txt", "smoothed.txt"]
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise RecordingError(f"{folder}: is no run folder: no {missing[0]}; {_EXPECTED}")
    summary = _read_summary(folder / "summary.json")
    trajectories = {name: _read_estimate(folder, name) for name in trajectory_names(folder)}
    return RunRecord(
        folder=folder,
        summary=summary,
        frames=_read_frames(folder / "frames.csv"),
        edges=_read_edges(folder / "edges.csv"),
        timings=_read_timings(folder / "timings.csv"),
        loops=_read_loops(folder / LOOPS),
        trajectories=trajectories,
        truth=_read_truth(folder, summary),
    )


def trajectory_names(folder: Path) -> list[str]:
    """Return the names of the trajectories of a run: the global one where there is one."""
    return [*TRAJECTORIES, *([GLOBAL] if (folder / f"{GLOBAL}.txt").is_file() else [])]


def _read_summary(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        summary = json.loads(read_text(path, max_bytes=MAX_SUMMARY_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: is damaged: {error}; run again") from error
    if not isinstance(summary, dict):
        raise RecordingError(f"{path}: holds no object; {_EXPECTED}")
    fault = _transform_fault(summary.get("T_base_truth"))
    if fault:
        raise RecordingError(f"{path}: T_base_truth {fault}; run again")
    return summary


def _transform_fault(value: object) -> str:
    """Say why a value of a summary is no rigid transform; empty if it is one, or None."""
    if value is None:
        return ""
    try:
        T = np.array(cast(ArrayLike, value), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return "holds no numbers"
    if np.any(np.abs(T) > MAX_POSITION_M):
        return f"holds a number beyond {MAX_POSITION_M:g}"
    return se3.transform_fault(T, tolerance=_ROUNDING)


def _columns(path: Path, required: Sequence[str]) -> dict[str, Any] | None:
    """Return the columns of a table by name, numbers as arrays; None where it is missing or empty.

    An unfinished last line is left out.
    """
    if not path.is_file():
        return None
    lines = text_lines(path, RecordingError, max_lines=MAX_LINES)
    reader = csv.reader((line for _, line in lines if line.endswith("\n")), strict=True)
    try:
        names = next(reader, None)
        return None if names is None else _read_columns(path, names, reader, required)
    except csv.Error as error:
        raise RecordingError(f"{path}:{reader.line_num}: {error}; {_EXPECTED}") from error


def _read_columns(
    path: Path, names: list[str], rows: Iterable[list[str]], required: Sequence[str]
) -> dict[str, Any]:
    columns = {name: _empty_column(name) for name in names}
    absent = [name for name in required if name not in columns]
    if absent or len(columns) < len(names):
        fault = f"no column {absent[0]}" if absent else "two columns of one name"
        raise RecordingError(f"{path}:1: {fault}; {_EXPECTED}")
    name = ""
    try:
        for number, row in enumerate(filter(None, rows), start=2):
            if len(row) != len(names):
                raise RecordingError(f"{path}:{number}: expected {len(names)} fields")
            for name, value in zip(names, row, strict=True):
                values, convert = columns[name]
                values.append(convert(value))
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: {name}: {error}; {_EXPECTED}") from error
    held = {name: values for name, (values, _) in columns.items()}
    return {key: each if isinstance(each, list) else np.array(each) for key, each in held.items()}


def _empty_column(name: str) -> tuple[Any, Callable[[str], Any]]:
    """Return what holds the values of a column, and what makes them of text."""
    if name in ("status", "kind", "reason"):
        known: dict[str, str] = {}
        return [], lambda text: known.setdefault(text, text)
    if name in ("stamp_ns", "reference_ns", "is_accepted") or name.startswith("n_"):
        return array("q"), int
    if name in ("chi2", "residual") or name.endswith(("_ms", "_m")):
        return array("d"), lambda text: float(text or "nan")
    return deque(maxlen=0), str  # it is not kept


def _read_frames(path: Path) -> FrameTable:
    columns = _columns(path, ("stamp_ns", "status", "reason"))
    if columns is None:
        return FrameTable(stamps_ns=np.empty(0, dtype=np.int64), statuses=(), counts={}, reasons=())
    counted = COUNTS if len(columns["stamp_ns"]) else ()
    return FrameTable(
        stamps_ns=columns["stamp_ns"],
        statuses=tuple(columns["status"]),
        counts={name: columns[f"n_{name}"] for name in counted if f"n_{name}" in columns},
        reasons=tuple(columns["reason"]),
    )


def _read_edges(path: Path) -> EdgeTable | None:
    columns = _columns(path, ("stamp_ns", "reference_ns", "kind", "is_accepted", "chi2"))
    if columns is None:
        return None
    return EdgeTable(
        stamps_ns=columns["stamp_ns"],
        reference_ns=columns["reference_ns"],
        kinds=np.array(columns["kind"], dtype=np.str_),
        is_accepted=columns["is_accepted"].astype(np.bool_),
        chi2=columns["chi2"],
    )


def _read_timings(path: Path) -> TimingTable | None:
    columns = _columns(path, ("stamp_ns",))
    if columns is None:
        return None
    timed = [name for name in columns if name.endswith("_ms") and len(columns["stamp_ns"])]
    return TimingTable(
        stamps_ns=columns["stamp_ns"],
        stages_ms={name.removesuffix("_ms"): columns[name] for name in timed},
    )


def _read_loops(path: Path) -> LoopTable | None:
    columns = _columns(path, ("stamp_ns", "reference_ns", "n_inliers", "residual", "reason"))
    if columns is None:
        return None
    return LoopTable(
        stamps_ns=columns["stamp_ns"],
        reference_ns=columns["reference_ns"],
        n_inliers=columns["n_inliers"],
        residuals=columns["residual"],
        reasons=tuple(columns["reason"]),
    )


def _read_estimate(folder: Path, name: str) -> Trajectory:
    """Read poses and covariances; in the middle of a run either may be a line ahead."""
    if not (folder / f"{name}.txt").is_file():
        return Trajectory.of([])
    poses = read_trajectory(folder / f"{name}.txt", is_growing=True)
    path = folder / f"{name}_covariance.csv"
    if not path.is_file():
        return replace(poses, covariances=None)
    stamps_ns, covariances = read_covariances(path, is_growing=True)
    _, first, second = np.intersect1d(poses.stamps_ns, stamps_ns, return_indices=True)
    return replace(poses.select(first), covariances=covariances[second])


def _read_truth(folder: Path, summary: dict[str, Any]) -> Trajectory | None:
    truth: Trajectory | None = None
    if (folder / TRUTH).is_file():
        truth = read_trajectory(folder / TRUTH)
    elif (folder / TRUE_POSITIONS).is_file():
        truth = _read_positions(folder / TRUE_POSITIONS)
    origin = summary.get("ground_truth_stamps_from")
    if truth is not None and origin in get_args(StampsFrom):
        return replace(truth, stamps_from=cast(StampsFrom, origin))
    return truth


def _read_positions(path: Path) -> Trajectory:
    columns = _columns(path, ("stamp_ns", "x_m", "y_m", "z_m"))
    if columns is None:
        return Trajectory.of([])
    try:
        positions = np.column_stack([columns[f"{axis}_m"] for axis in "xyz"])
        return Trajectory.of_positions(columns["stamp_ns"], positions)
    except ValueError as error:
        raise TrajectoryError(f"{path}: {error}; run again") from error


# A camera that keeps within a box of this diagonal is at rest, metres.
_REST_M = 0.05
# Sigmas that are right within this factor fit.
_FIT_FACTOR = 2.0
# What was learnt of a camera is told from here on, and where it is more than three sigmas.
_OFFSET_PX = 0.1
_READOUT_MS = 5.0


def verdict(summary: Mapping[str, Any]) -> str:
    """Say in plain words how far a run came, how good it is, and what is worth a look.

    Parameters
    ----------
    summary : mapping
        As `summary.json` holds it, also of a run that has not ended.
    """
    parts = [_how_far(summary), _how_good(summary), _how_sure(summary)]
    looks = [*_looks_at_frames(summary), *_looks_at_camera(summary.get("rig_offsets") or {})]
    text = "; ".join(part for part in parts if part)
    return f"{text}. Worth a look: {'; '.join(looks)}." if looks else f"{text}."


def _how_far(summary: Mapping[str, Any]) -> str:
    n, n_tracked = summary.get("frames", 0), summary.get("tracked", 0)
    path_m, extent_m = summary.get("path_m"), summary.get("extent_m")
    way = f"{n} frames"
    if path_m is not None:
        way = f"{path_m:.2g} m in {n} frames" if path_m < 10.0 else f"{path_m:.0f} m in {n} frames"
    if extent_m is not None and extent_m < _REST_M and n_tracked > 1:
        way = f"at rest, within {extent_m:.2g} m, in {n} frames"
    if summary.get("state", "complete") != "complete":
        way = f"{way} so far"
    counts = summary.get("status_counts", {})
    words = {"coasting": "bridged", "lost": "lost", "skipped": "faulty"}
    others = [f"{counts[key]} {word}" for key, word in words.items() if counts.get(key)]
    tracked = "all tracked" if n_tracked == n > 0 else f"{n_tracked or 'none'} tracked"
    return ", ".join([way, tracked, *others, *_segment_words(summary.get("segments", ()))])


def _segment_words(segments: Sequence[Mapping[str, Any]]) -> list[str]:
    if len(segments) < 2:
        return []
    n_joined = sum(segment.get("joined_to") is not None for segment in segments)
    return [f"in {len(segments)} segments, {n_joined} of them joined to another"]


def _how_good(summary: Mapping[str, Any]) -> str:
    errors = {row["name"]: row for row in summary.get("errors", ())}
    loops = (summary.get(GLOBAL) or {}).get("loops") or {}
    is_closed = GLOBAL in errors and loops.get("counted", 0) > 0
    best = errors.get(GLOBAL if is_closed else "smoothed")
    if best is not None:
        n, n_true = summary["frames"], best["n"]
        where = "" if n_true >= 0.9 * n else f", known of {n_true} frames"
        how = " with loops closed" if is_closed else ""
        return f"{best['ate_m']:.2g} m from the truth{how}{where}"
    if any(str(each).startswith("not compared") for each in summary.get("warnings", ())):
        return "not compared with the truth"
    is_over = summary.get("state", "complete") == "complete"
    return "no truth to compare with" if is_over else ""


def loop_words(summary: Mapping[str, Any]) -> str:
    """Say how many loops were closed, and why others were not; empty without global poses.

    Parameters
    ----------
    summary : mapping
        As `summary.json` holds it.
    """
    loops = (summary.get(GLOBAL) or {}).get("loops")
    if loops is None:
        return ""
    n, refused = loops["counted"], loops["refused"]
    words = f"{n or 'no'} loop{'s' if n > 1 else ''} {'closed' if loops['found'] else 'found'}"
    if refused:
        reasons = ", ".join(f"{count}: {reason}" for reason, count in refused.items())
        words += f", {sum(refused.values())} refused ({reasons})"
    return words if n else f"{words}; global is the batch optimum of the same edges"


def _how_sure(summary: Mapping[str, Any]) -> str:
    rows = summary.get("covariances")
    if not rows:
        return ""
    row = rows[0]
    factor, span = row["nees"] ** 0.5, row["motion"].partition(" ")[2]
    if factor < 1.0 / _FIT_FACTOR and row["nees"] < row["nees_low"]:
        return f"covariances too large, {1.0 / factor:.2g} times in sigma"
    if factor <= _FIT_FACTOR or row["nees"] <= row["nees_high"]:
        return "covariances fit"
    # Noise of the true poses is as large from frame to frame; errors of a motion add up.
    jump_m = summary.get("truth_jump_m") or 0.0
    if jump_m > 0.5 * row["error_m"]:
        return f"covariances cannot be judged, the truth jumps by {jump_m:.2g} m between frames"
    return (
        f"covariances too small, {factor:.2g} times in sigma, unless the truth itself is off by "
        f"{row['error_m']:.2g} m and {row['error_deg']:.2g} deg {span}"
    )


def _looks_at_frames(summary: Mapping[str, Any]) -> list[str]:
    counts = summary.get("status_counts", {})
    is_bad = any(counts.get(key) for key in ("coasting", "lost", "skipped"))
    return ["frames.csv, which says why frames are not tracked"] if is_bad else []


def _looks_at_camera(offsets: Mapping[str, Any]) -> list[str]:
    found = []
    disparity, row = offsets.get("disparity_px") or 0.0, offsets.get("row_px") or 0.0
    sigma, readout = offsets.get("disparity_sigma_px") or 0.0, offsets.get("readout_ms") or 0.0
    if abs(disparity) > max(_OFFSET_PX, 3.0 * sigma):
        size = "large" if disparity > 0.0 else "small"
        found.append(f"the calibration, disparities are {abs(disparity):.2g} px too {size}")
    if abs(row) > 2.0 * _OFFSET_PX:
        found.append(f"the rectification, rows of the right image are off by {abs(row):.2g} px")
    sigma = offsets.get("readout_sigma_ms") or 0.0
    if sigma and abs(readout) > max(_READOUT_MS, 3.0 * sigma):
        found.append(f"a rolling shutter, rows are read out over {readout:.2g} ms")
    return [f"{each} (learnt and corrected)" for each in found]
