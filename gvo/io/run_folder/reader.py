"""A run folder read back, also of a run that still goes on or was interrupted."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from gvo._text import read_text
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.run_folder.writer import TRAJECTORIES, TRUE_POSITIONS, TRUTH
from gvo.trajectory.formats import MAX_POSITION_M, read_covariances, read_trajectory
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from gvo.types import BoolArray, FloatArray, IntArray

COUNTS = ("keypoints", "points", "matches", "inliers", "links", "edges", "rejected")
"""What `frames.csv` may count, as columns `n_...`."""

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
        "step", "keyframe", "depth" or "standstill".
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
    trajectories : dict of str to Trajectory
        "raw", "causal" and "smoothed", with covariances; may be empty.
    truth : Trajectory or None
        What the estimates were compared with: poses, or positions of the measured point.
    """

    folder: Path
    summary: dict[str, Any]
    frames: FrameTable
    edges: EdgeTable | None
    timings: TimingTable | None
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
    needed = ["frames.csv", *(f"{name}.txt" for name in TRAJECTORIES)]
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise RecordingError(f"{folder}: is no run folder: no {missing[0]}; {_EXPECTED}")
    summary = _read_summary(folder / "summary.json")
    trajectories = {name: _read_estimate(folder, name) for name in TRAJECTORIES}
    return RunRecord(
        folder=folder,
        summary=summary,
        frames=_read_frames(folder / "frames.csv"),
        edges=_read_edges(folder / "edges.csv"),
        timings=_read_timings(folder / "timings.csv"),
        trajectories=trajectories,
        truth=_read_truth(folder, summary),
    )


def _read_summary(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        summary = json.loads(read_text(path))
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


def _whole_lines(path: Path) -> list[str]:
    """Return the whole lines of a file: an unfinished last one is left out."""
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    return text[: text.rfind("\n") + 1].splitlines()


def _rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]] | None:
    """Return the rows of a table; None where the file is missing or empty."""
    lines = _whole_lines(path) if path.is_file() else []
    if not lines:
        return None
    reader = csv.DictReader(lines, strict=True)
    try:
        absent = [name for name in columns if name not in (reader.fieldnames or ())]
        rows = [] if absent else list(reader)
    except csv.Error as error:
        raise RecordingError(f"{path}:{reader.line_num}: {error}; {_EXPECTED}") from error
    if absent:
        raise RecordingError(f"{path}:1: no column {absent[0]}; {_EXPECTED}")
    for number, row in enumerate(rows, start=2):
        if None in row.values() or None in row:
            raise RecordingError(f"{path}:{number}: expected {len(reader.fieldnames or ())} fields")
    return rows


def _integers(path: Path, rows: list[dict[str, str]], column: str) -> IntArray:
    try:
        return np.array([int(row[column]) for row in rows], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: {column}: {error}; {_EXPECTED}") from error


def _floats(path: Path, rows: list[dict[str, str]], column: str) -> FloatArray:
    try:
        return np.array([float(row[column] or "nan") for row in rows], dtype=np.float64)
    except ValueError as error:
        raise RecordingError(f"{path}: {column}: {error}; {_EXPECTED}") from error


def _read_frames(path: Path) -> FrameTable:
    rows = _rows(path, ("stamp_ns", "status", "reason")) or []
    present = [name for name in COUNTS if rows and f"n_{name}" in rows[0]]
    return FrameTable(
        stamps_ns=_integers(path, rows, "stamp_ns"),
        statuses=tuple(row["status"] for row in rows),
        counts={name: _integers(path, rows, f"n_{name}") for name in present},
        reasons=tuple(row["reason"] for row in rows),
    )


def _read_edges(path: Path) -> EdgeTable | None:
    rows = _rows(path, ("stamp_ns", "reference_ns", "kind", "is_accepted", "chi2"))
    if rows is None:
        return None
    return EdgeTable(
        stamps_ns=_integers(path, rows, "stamp_ns"),
        reference_ns=_integers(path, rows, "reference_ns"),
        kinds=np.array([row["kind"] for row in rows], dtype=np.str_),
        is_accepted=_integers(path, rows, "is_accepted").astype(np.bool_),
        chi2=_floats(path, rows, "chi2"),
    )


def _read_timings(path: Path) -> TimingTable | None:
    rows = _rows(path, ("stamp_ns",))
    if rows is None:
        return None
    columns = [name for name in (rows[0] if rows else ()) if name.endswith("_ms")]
    return TimingTable(
        stamps_ns=_integers(path, rows, "stamp_ns"),
        stages_ms={name.removesuffix("_ms"): _floats(path, rows, name) for name in columns},
    )


def _read_estimate(folder: Path, name: str) -> Trajectory:
    """Read poses and covariances; in the middle of a run either may be a line ahead."""
    poses = read_trajectory(folder / f"{name}.txt", is_growing=True)
    path = folder / f"{name}_covariance.csv"
    stamps_ns, covariances = read_covariances(path, is_growing=True)
    _, first, second = np.intersect1d(poses.stamps_ns, stamps_ns, return_indices=True)
    return replace(poses.select(first), covariances=covariances[second])


def _read_truth(folder: Path, summary: dict[str, Any]) -> Trajectory | None:
    truth: Trajectory | None = None
    if (folder / TRUTH).is_file():
        truth = read_trajectory(folder / TRUTH)
    elif (folder / TRUE_POSITIONS).is_file():
        path = folder / TRUE_POSITIONS
        rows = _rows(path, ("stamp_ns", "x_m", "y_m", "z_m")) or []
        positions = np.column_stack([_floats(path, rows, f"{axis}_m") for axis in "xyz"])
        truth = _positions(path, _integers(path, rows, "stamp_ns"), positions)
    origin = summary.get("ground_truth_stamps_from")
    if truth is not None and origin in get_args(StampsFrom):
        return replace(truth, stamps_from=cast(StampsFrom, origin))
    return truth


def _positions(path: Path, stamps_ns: IntArray, positions: FloatArray) -> Trajectory:
    try:
        return Trajectory.of_positions(stamps_ns, positions)
    except ValueError as error:
        raise TrajectoryError(f"{path}: {error}; run again") from error
