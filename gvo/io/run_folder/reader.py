"""A run folder read back, also of a run that still goes on or was interrupted."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias, cast, get_args

import numpy as np
from numpy.typing import NDArray

from gvo._text import exists, read_text, text_lines
from gvo.errors import RecordingError, TrajectoryError
from gvo.geometry import se3
from gvo.io.run_folder.verdict import imu_words, nees_table, reference_words
from gvo.io.run_folder.writer import (
    GLOBAL,
    INERTIAL_HEADER,
    POSITIONS_HEADER,
    TRAJECTORIES,
    TRUE_POSITIONS,
    TRUTH,
)
from gvo.trajectory.evaluation import SMOOTHED_GLOBAL
from gvo.trajectory.formats import MAX_LINES, MAX_POSITION_M, read_trajectory
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from gvo.types import FloatArray

MAX_SUMMARY_BYTES = 1 << 24
"""Of `summary.json`: nested lists of two bytes take thirty times their memory."""

_ROUNDING = 1e-2
_REQUIRED = {
    "frames": ("stamp_ns", "status", "reason"),
    "edges": ("stamp_ns", "reference_ns", "kind", "is_accepted", "chi2"),
    "timings": ("stamp_ns",),
    "loops": ("stamp_ns", "reference_ns", "n_inliers", "residual", "reason"),
    "inertial": INERTIAL_HEADER,
}
_EXPECTED = "expected a folder that gvo run or gvo smooth wrote"


Table: TypeAlias = dict[str, NDArray[Any]]
"""Columns of a table by their names in the file: numbers, truth values, or texts as objects."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """A run folder.

    Parameters
    ----------
    folder : Path
    summary : dict
        As in `summary.json`; empty where there is none yet. Of a run that goes on or was
        interrupted that of a few seconds before.
    frames : Table
        Of `frames.csv`: `stamp_ns`, `status` and `reason` (why a frame is not ok, else empty) of
        all frames, also of skipped ones, and counts `n_...`.
    edges : Table
        Of `edges.csv`: `stamp_ns`, `reference_ns`, `kind`, `is_accepted`, `chi2` (NaN where it is
        not known). Empty where the folder holds no such file, as that of `gvo smooth`.
    timings : Table
        Of `timings.csv`: `stamp_ns` and `STAGE_ms`, NaN where a frame did not reach it. Likewise.
    loops : Table
        Of `loops.csv`: `stamp_ns`, `reference_ns`, `n_inliers`, `residual` (norm of the whitened
        one) and `reason` (why it does not count, else empty). Empty without global poses.
    inertial : Table
        Of `inertial.csv`: `stamp_ns`, `is_carried`, and numbers by the names there. Empty without
        an IMU, and until it has started.
    trajectories : dict of str to Trajectory
        "raw", "causal" and "smoothed", with covariances where the run computed them; may be
        empty, as "causal" where all was optimized at once. "global" where there is one.
    truth : Trajectory or None
        What the estimates were compared with: poses, or positions of the measured point.
    """

    folder: Path
    summary: dict[str, Any]
    frames: Table
    edges: Table
    timings: Table
    loops: Table
    inertial: Table
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
        """Return the trajectories that hold poses, moved to the point that the truth is of.

        Without a loop the global one equals the smoothed one, and both are one.
        """
        filled = {name: t for name, t in self.trajectories.items() if len(t) > 0}
        smoothed, best = filled.get("smoothed"), filled.get(GLOBAL)
        if smoothed and best and np.array_equal(smoothed.T_world_frame, best.T_world_frame):
            del filled["smoothed"], filled[GLOBAL]
            filled[SMOOTHED_GLOBAL] = best
        T_base_truth = self.summary.get("T_base_truth")
        if self.truth is None or T_base_truth is None:
            return filled
        T = np.array(T_base_truth, dtype=np.float64)
        if np.array_equal(T, np.eye(4)):
            return filled
        return {name: trajectory.transformed(T) for name, trajectory in filled.items()}


def loop_ends(loops: Table, trajectory: Trajectory) -> dict[str, FloatArray]:
    """Return the lines between both ends of loops, shape (n, 2, 3), metres, where both have poses.

    By "loops" and "refused loops".
    """
    ends_ns = np.stack([loops["reference_ns"], loops["stamp_ns"]], axis=1)
    is_there = np.isin(ends_ns, trajectory.stamps_ns).all(axis=1)
    is_refused = loops["reason"].astype(np.bool_)
    lines = {}
    for name, is_such in (("loops", ~is_refused), ("refused loops", is_refused)):
        rows = np.searchsorted(trajectory.stamps_ns, ends_ns[is_there & is_such])
        lines[name] = trajectory.positions[rows]
    return lines


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
        raise RecordingError(f"{folder}: is not a run folder: {missing[0]} is missing; {_EXPECTED}")
    summary = read_summary(folder)
    tables = {name: _read_table(folder / f"{name}.csv", _REQUIRED[name]) for name in _REQUIRED}
    return RunRecord(
        folder=folder,
        summary=summary,
        frames=tables["frames"] or {n: np.empty(0, dtype=_dtype(n)) for n in _REQUIRED["frames"]},
        edges=tables["edges"],
        timings=tables["timings"],
        loops=tables["loops"],
        inertial=tables["inertial"],
        trajectories=read_estimates(folder, is_growing=True),
        truth=_read_truth(folder, summary),
    )


def read_estimates(folder: Path, *, is_growing: bool = False) -> dict[str, Trajectory]:
    """Read the trajectories of a run, the global one where there is one, as `read_trajectory`."""
    names = [*TRAJECTORIES, *([GLOBAL] if (folder / f"{GLOBAL}.txt").is_file() else [])]
    return {name: read_trajectory(folder / f"{name}.txt", is_growing=is_growing) for name in names}


def pose_files(path: str) -> list[str]:
    """Return the trajectories in a run folder; where it is none, the path itself."""
    folder = Path(path)
    files = [folder / f"{name}.txt" for name in (*TRAJECTORIES, GLOBAL)]
    is_run = exists(folder / "frames.csv")
    return [str(file) for file in files if file.is_file()] if is_run else [path]


def read_summary(folder: Path) -> dict[str, Any]:
    """Read the summary in a run folder; empty where there is none."""
    path = folder / "summary.json"
    if not path.is_file():
        return {}
    try:
        summary = json.loads(read_text(path, max_bytes=MAX_SUMMARY_BYTES))
        if not isinstance(summary, dict):
            raise RecordingError(f"{path}: holds no object; {_EXPECTED}")
        nees_table(summary.get("nees") or {})
        reference_words(summary.get("reference"))
        imu_words(summary)
    except (OSError, ValueError, RecursionError, AttributeError, LookupError, TypeError) as error:
        raise RecordingError(f"{path}: is damaged: {error}; run again") from error
    fault = _transform_fault(summary.get("T_base_truth"))
    if fault:
        raise RecordingError(f"{path}: T_base_truth {fault}; run again")
    return summary


def _transform_fault(value: Any) -> str:  # noqa: ANN401 - of a file
    """Say why a value of a summary is no rigid transform; empty if it is one, or None."""
    if value is None:
        return ""
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return "holds no numbers"
    if np.any(np.abs(T) > MAX_POSITION_M):
        return f"holds a number beyond {MAX_POSITION_M:g}"
    return se3.transform_fault(T, tolerance=_ROUNDING)


def _read_table(path: Path, required: Sequence[str]) -> Table:
    """Return the columns of a table, without an unfinished last line; empty where it is missing."""
    if not path.is_file():
        return {}
    numbered = text_lines(path, RecordingError, max_lines=MAX_LINES)
    lines = (line for _, line in numbered if line.endswith("\n") and line.strip())
    names = next(lines, "").strip().split(",")
    if names == [""]:
        return {}
    absent = [name for name in required if name not in names]
    if absent or len(set(names)) < len(names):
        fault = f"no column {absent[0]}" if absent else "two columns of one name"
        raise RecordingError(f"{path}:1: {fault}; {_EXPECTED}")
    dtypes = {name: dtype for name in names if (dtype := _dtype(name)) is not None}
    columns = [names.index(name) for name in dtypes]
    first = next(lines, None)
    if first is None:
        return {name: np.empty(0, dtype=dtype) for name, dtype in dtypes.items()}
    try:
        rows = np.loadtxt(
            chain([first], lines),
            dtype=[*dtypes.items()],
            delimiter=",",
            quotechar='"',
            comments=None,
            usecols=columns,
            converters={
                n: _CONVERTERS[dtype] for n, dtype in zip(columns, dtypes.values(), strict=True)
            },
            encoding="utf-8",
            ndmin=1,
        )
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: {error}; {_EXPECTED}") from error
    return {name: rows[name] for name in dtypes}


def _dtype(name: str) -> type | None:
    """Return what a column of this name holds; None for those that nobody reads."""
    if name in ("status", "kind", "reason"):
        return np.object_
    if name in ("is_accepted", "is_carried"):
        return np.bool_
    if name in ("stamp_ns", "reference_ns") or name.startswith("n_"):
        return np.int64
    is_number = name in ("chi2", "residual", *INERTIAL_HEADER) or name.endswith(("_ms", "_m"))
    return np.float64 if is_number else None


_CONVERTERS: dict[type, Callable[[str], object]] = {
    np.object_: sys.intern,
    np.bool_: int,
    np.int64: int,
    np.float64: lambda text: float(text or "nan"),
}


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
    columns = _read_table(path, POSITIONS_HEADER)
    if not columns:
        return Trajectory.of([])
    try:
        positions = np.column_stack([columns[f"{axis}_m"] for axis in "xyz"])
        return Trajectory.of_positions(columns["stamp_ns"], positions)
    except ValueError as error:
        raise TrajectoryError(f"{path}: {error}; run again") from error
