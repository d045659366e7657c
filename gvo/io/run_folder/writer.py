"""The files of a run, written as the run goes."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gvo._text import visible
from gvo.errors import OutputError, write_faults
from gvo.geometry import se3
from gvo.io.run_folder.line_file import append_whole, check_folder, locked, replace_text
from gvo.trajectory.formats import (
    COVARIANCE_HEADER,
    EFFECTS,
    format_covariance_line,
    format_tum_line,
    write_tum,
)
from gvo.trajectory.g2o import format_edge, format_vertex
from gvo.trajectory.trajectory import Trajectory
from gvo.types import (
    Estimate,
    FaultyFrame,
    FloatArray,
    FrameResult,
    InertialState,
    IntArray,
    Optimum,
    Status,
)

SUMMARY = "summary.json"
RIG = "rig.yaml"
LOCK = "run.lock"
PICTURE = "trajectories.png"
REPORT = "report.html"
TRUTH = "ground_truth.txt"
TRUE_POSITIONS = "ground_truth_positions.csv"
POSITIONS_HEADER = ("stamp_ns", "x_m", "y_m", "z_m")
TRAJECTORIES = ("raw", "causal", "smoothed")
"""Those that are written as the run goes."""
GLOBAL = "global"
"""The one that comes at its end."""
GRAPH = "graph.g2o"
LOOPS = "loops.csv"
LOOPS_HEADER = (
    *("stamp_ns", "reference_ns", "n_matches", "n_inliers"),
    *("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("residual", "weight", "reason"),
)
FRAMES_HEADER = (
    *("stamp_ns", "status", "segment"),
    *("n_keypoints", "n_points", "n_matches", "n_inliers", "n_links"),
    "reason",
)
INERTIAL = "inertial.csv"
INERTIAL_HEADER = (
    *("stamp_ns", "is_carried"),
    *(f"v{axis}_mps" for axis in "xyz"),
    *(f"up_{axis}" for axis in "xyz"),
    *(f"gyro_bias_{axis}_radps" for axis in "xyz"),
    *(f"acceleration_bias_{axis}_mps2" for axis in "xyz"),
    *("sigma_v_mps", "sigma_up_rad", "sigma_gyro_bias_radps", "sigma_acceleration_bias_mps2"),
)
EDGES_HEADER = ("stamp_ns", "reference_ns", "kind", "is_accepted", "chi2")
_STAGES = ("read", "extract", "register", "links", "window", "loops")
TIMINGS_HEADER = ("stamp_ns", *(f"{stage}_ms" for stage in _STAGES))

_RIG_HEADER = "# What was learnt of this camera: `gvo run RECORDING --rig FILE` starts from it."

_RESULTS = (
    *(SUMMARY, RIG, "edges.csv", "timings.csv", INERTIAL, PICTURE, REPORT),
    *(TRUTH, TRUE_POSITIONS, EFFECTS, GRAPH, LOOPS, f"{GLOBAL}.txt"),
    "frames.csv",
    *(f"{name}.txt" for name in TRAJECTORIES),
    "explanation.html",
)


def free_folder(recording: str | Path, what: str = "") -> Path:
    """Return a new folder in the working folder: `usual_folder`, numbered where that is taken."""
    return free_path(usual_folder(recording, what))


def usual_folder(recording: str | Path, what: str = "") -> Path:
    """Return `gvo-RECORDING` in the working folder."""
    path = Path(recording)
    path = path if path.name not in ("", "..") else path.resolve()
    name = path.name if path.is_dir() else Path(path.name.removesuffix(".zst")).stem
    return Path(f"gvo-{visible(name)}{what}")


def free_path(path: Path) -> Path:
    """Return the path, or NAME-2, NAME-3, ... where that is taken."""
    suffix = "" if path.is_dir() else path.suffix
    stem = path.name.removesuffix(suffix)
    numbered = (path.with_name(f"{stem}-{n}{suffix}") for n in count(2))
    return next(each for each in chain([path], numbered) if not os.path.lexists(each))


def check_unused(folder: Path, *, force: bool = False) -> None:
    """Refuse a folder that cannot be written, or holds an earlier result; nothing is made.

    Parameters
    ----------
    folder : Path
    force : bool
        Let them be replaced.

    Raises
    ------
    OutputError
        With the way out.
    """
    check_folder(folder)
    there = [name for name in _RESULTS if os.path.lexists(folder / name)]
    if there and not force:
        raise OutputError(
            f"{folder}: holds an earlier result ({there[0]}); give another folder by --out, "
            "or --force to replace it"
        )


@contextmanager
def written_alone(folder: Path, *, force: bool = False) -> Iterator[None]:
    """Lock a run folder, made where it is missing, against other processes.

    Parameters
    ----------
    folder : Path
    force : bool
        Let an earlier run be replaced.

    Raises
    ------
    OutputError
        When it cannot be written, or holds an earlier run, complete or not.
    RunBusyError
        When another process is writing it.
    """
    is_new = not folder.exists()
    busy = f"{folder}: another process is writing this run; wait for its end, or end it"
    with ExitStack() as stack:
        with write_faults(OutputError, folder):
            folder.mkdir(parents=True, exist_ok=True)
            if is_new:
                stack.callback(_remove_empty, folder)
            stack.enter_context(locked(folder / LOCK, busy))
        check_unused(folder, force=force)
        yield


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # of a run that gave something it is not empty
        folder.rmdir()


class RunFolder(AbstractContextManager["RunFolder"]):
    """Trajectories, covariances and the tables of frames, edges, times and IMU, line by line.

    Smoothed poses come in the order in which they leave the window; `close` sorts them by stamp.
    Whatever stops the process, the files hold whole lines; only a power failure can cut one off.

    Parameters
    ----------
    path : Path
        Folder to write into; made where it is missing. Files of an earlier run are replaced, its
        summary and picture removed.
    columns : sequence of str
        Of the table of frames; the first is `stamp_ns`.
    names : sequence of str
        The trajectories that will be written.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        columns: Sequence[str] = FRAMES_HEADER,
        names: Sequence[str] = TRAJECTORIES,
    ) -> None:
        self.path = path
        self._is_writable = True
        self._files: dict[str, io.FileIO] = {}
        self._n_raw = 0
        with ExitStack() as stack, self._refused_on_error(path):
            path.mkdir(parents=True, exist_ok=True)
            covariances = (f"{name}_covariance.csv" for name in (*TRAJECTORIES, GLOBAL))
            for name in (*_RESULTS, *covariances):
                (path / name).unlink(missing_ok=True)
            stack.callback(self._close_files)
            for name in names:
                self._open(f"{name}.txt", "")
                if names is TRAJECTORIES:
                    self._open_covariances(name)
            self._open("frames.csv", _csv_line(columns))
            if columns is FRAMES_HEADER:
                self._open("edges.csv", _csv_line(EDGES_HEADER))
                self._open("timings.csv", _csv_line(TIMINGS_HEADER))
            stack.pop_all()

    @contextmanager
    def _refused_on_error(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._is_writable = False
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error

    def _open(self, name: str, header: str) -> None:
        if name in self._files:
            self._files[name].close()
        path = self.path / name
        path.unlink(missing_ok=True)  # a link there may lead out of the folder
        self._files[name] = io.FileIO(path, "wb")
        append_whole(self._files[name], header.encode())

    def _open_covariances(self, name: str) -> None:
        self._open(f"{name}_covariance.csv", f"{COVARIANCE_HEADER}\n")

    def _write(self, name: str, lines: str) -> None:
        with self._refused_on_error(self.path / name):
            append_whole(self._files[name], lines.encode())

    def add_frame(self, frame: object, result: FrameResult) -> None:
        """Write the result of a frame."""
        row = [getattr(result, name) for name in FRAMES_HEADER]
        self.add_poses(result.raw, result.causal, row)
        self._write("edges.csv", "".join(map(_csv_line, _link_rows(result))))
        times_ms = map(result.stage_ms.get, _STAGES)
        times = ("" if time_ms is None else f"{time_ms:.3f}" for time_ms in times_ms)
        self._write("timings.csv", _csv_line((result.stamp_ns, *times)))
        if result.inertial is not None:
            self._add_inertial(result.inertial, is_carried=result.is_carried)
        self.add_smoothed(result.finished)

    def _add_inertial(self, state: InertialState, *, is_carried: bool) -> None:
        """Write what the IMU tells of a frame; the file begins with the first of them."""
        if INERTIAL not in self._files:
            with self._refused_on_error(self.path / INERTIAL):
                self._open(INERTIAL, _csv_line(INERTIAL_HEADER))
        biases = *state.gyro_bias, *state.acceleration_bias
        values = *state.velocity, *state.up, *biases, state.velocity_sigma, *state.sigmas
        row = (f"{value:.9g}" for value in values)
        self._write(INERTIAL, _csv_line((state.stamp_ns, int(is_carried), *row)))

    def add_poses(self, raw: Estimate, causal: Estimate, row: Sequence[object]) -> None:
        """Write both poses of a frame as it arrives, and its row of the table."""
        self._add_pose("raw", raw)
        self._add_effects(raw.effects)
        self._add_pose("causal", causal)
        self._write("frames.csv", _csv_line(row))

    def add_optimum(self, optimum: Optimum) -> None:
        """Write the global poses, the graph that they are the optimum of, and its loops."""
        self._open(f"{GLOBAL}.txt", "")
        self._open_covariances(GLOBAL)
        for estimate in optimum.estimates:
            self._add_pose(GLOBAL, estimate)
        self._open(GRAPH, "")
        self._write(GRAPH, "".join(f"{line}\n" for line in _graph_lines(optimum)))
        self._open(LOOPS, _csv_line(LOOPS_HEADER))
        self._write(LOOPS, "".join(map(_csv_line, _loop_rows(optimum))))

    def add_trajectory(self, name: str, trajectory: Trajectory) -> None:
        """Write all poses of a trajectory, and their covariances, if any."""
        for row in zip(trajectory.stamps_ns.tolist(), trajectory.T_world_frame, strict=True):
            self._write(f"{name}.txt", f"{format_tum_line(*row)}\n")
        if trajectory.covariances is not None:
            with self._refused_on_error(self.path):
                self._open_covariances(name)
            for row in zip(trajectory.stamps_ns.tolist(), trajectory.covariances, strict=True):
                self._write(f"{name}_covariance.csv", f"{format_covariance_line(*row)}\n")

    def add_rows(self, rows: Iterable[Sequence[object]]) -> None:
        """Write rows of the table of frames."""
        self._write("frames.csv", "".join(map(_csv_line, rows)))

    def add_faulty(self, frame: FaultyFrame) -> None:
        """Write a row for a frame without a pose."""
        row = (frame.stamp_ns, Status.SKIPPED, "", 0, 0, 0, 0, 0, frame.reason)
        self._write("frames.csv", _csv_line(row))

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        """Write smoothed poses that are final."""
        for estimate in estimates:
            self._add_pose("smoothed", estimate)

    def _add_pose(self, name: str, estimate: Estimate) -> None:
        pose = format_tum_line(estimate.stamp_ns, estimate.T_world_frame)
        self._write(f"{name}.txt", f"{pose}\n")
        covariance = format_covariance_line(estimate.stamp_ns, estimate.covariance)
        self._write(f"{name}_covariance.csv", f"{covariance}\n")

    def _add_effects(self, effects: FloatArray | None) -> None:
        """Write how shared errors move a raw pose; the file begins with the first that tells."""
        self._n_raw += 1
        if effects is None and EFFECTS not in self._files:
            return
        with self._refused_on_error(self.path / EFFECTS):
            if effects is not None and EFFECTS not in self._files:
                shape = (self._n_raw - 1, *effects.shape)
                self._open(EFFECTS, "")
                append_whole(self._files[EFFECTS], _npy_header(shape) + bytes(8 * math.prod(shape)))
                self._effects_shape = effects.shape
            row = np.zeros(self._effects_shape) if effects is None else effects
            append_whole(self._files[EFFECTS], row.tobytes())
            self._files[EFFECTS].seek(0)
            self._files[EFFECTS].write(_npy_header((self._n_raw, *self._effects_shape)))

    def frame_stamps_ns(self) -> IntArray:
        """Return the stamps of all frames of the table, shape (n,), also of faulty ones."""
        with (self.path / "frames.csv").open(encoding="utf-8", newline="") as file:
            return np.array([int(row["stamp_ns"]) for row in csv.DictReader(file)], dtype=np.int64)

    def write_truth(self, truth: Trajectory) -> None:
        """Write the true poses that the estimates were compared with.

        Positions without rotations become a table of their own: as poses they would claim more
        than is known.
        """
        if truth.has_rotations:
            write_tum(self.path / TRUTH, truth)
            return
        rows = zip(truth.stamps_ns.tolist(), *truth.positions.T.tolist(), strict=True)
        lines = [_csv_line(POSITIONS_HEADER), *map(_csv_line, rows)]
        path = self.path / TRUE_POSITIONS
        with self._refused_on_error(path):
            path.write_text("".join(lines), encoding="utf-8")

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Replace `summary.json` and `rig.yaml` atomically."""
        with self._refused_on_error(self.path / SUMMARY):
            save_summary(self.path, summary)
            if rig := summary.get("rig"):
                text = yaml.safe_dump(rig, sort_keys=False, default_flow_style=None, width=100)
                replace_text(self.path / RIG, f"{_RIG_HEADER}\n{text}")

    def discard(self) -> None:
        """Remove the files of a run that gave nothing."""
        self._is_writable = False
        for name in (*_RESULTS, *self._files):
            (self.path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Close all files and sort the smoothed poses by stamp."""
        self._close_files()
        if not self._is_writable:
            return
        for name, n_header in (("smoothed.txt", 0), ("smoothed_covariance.csv", 1)):
            if name not in self._files:
                continue
            with self._refused_on_error(self.path / name):
                _sort_lines(self.path / name, n_header=n_header)

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _close_files(self) -> None:
        for file in self._files.values():
            file.close()


def _npy_header(shape: tuple[int, ...]) -> bytes:
    """Return the header of a numpy file of numbers; for any count of rows it is as long."""
    header = io.BytesIO()
    array = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, array)
    return header.getvalue()


def save_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Replace `summary.json` of a run folder atomically."""
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    replace_text(folder / SUMMARY, text)


def _link_rows(result: FrameResult) -> Iterator[Sequence[object]]:
    for link in result.links:
        chi2 = "" if link.chi2 is None else f"{link.chi2:.6g}"
        yield result.stamp_ns, link.reference_ns, link.kind, int(link.is_accepted), chi2


def _graph_lines(optimum: Optimum) -> Iterator[str]:
    """Yield the frames, numbered, with their stamps as comments, and the edges between them."""
    numbers = {stamp_ns: number for number, stamp_ns in enumerate(optimum.frames_ns)}
    for estimate in optimum.estimates:
        number = numbers.get(estimate.stamp_ns)
        if number is not None:
            yield f"{format_vertex(number, estimate.T_world_frame)}  # {estimate.stamp_ns}"
    loops = (
        (loop.stamp_ns, loop.edge)
        for loop in optimum.loops
        if not loop.reason and {loop.stamp_ns, loop.reference_ns} <= numbers.keys()
    )
    for stamp_ns, edge in chain(optimum.edges, loops):
        ends = numbers[int(edge.reference_id)], numbers[stamp_ns]  # type: ignore[call-overload]
        yield format_edge(*ends, edge.T_reference_frame, edge.covariance)


def _loop_rows(optimum: Optimum) -> Iterator[Sequence[object]]:
    for loop, residual in zip(optimum.loops, optimum.residuals.tolist(), strict=True):
        T = loop.T_reference_frame
        pose = (*T[:3, 3].tolist(), *se3.quaternions(T[:3, :3]).tolist())
        yield (
            *(loop.stamp_ns, loop.reference_ns, loop.n_matches, loop.n_inliers),
            *(f"{value:.9g}" for value in pose),
            *(f"{residual:.4g}", 0 if loop.reason else 1, loop.reason),
        )


def _sort_lines(path: Path, *, n_header: int) -> None:
    """Sort the lines of a file by their stamp, the number at their start."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    header, body = lines[:n_header], lines[n_header:]
    ordered = sorted(body, key=_stamp_digits)
    if ordered != body:
        replace_text(path, "".join(header + ordered))


def _stamp_digits(line: str) -> int:
    # Seconds with nine decimals, or nanoseconds: without the point both are nanoseconds.
    return int(line.replace(",", " ").split(" ", 1)[0].replace(".", ""))


def _csv_line(row: Iterable[object]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(row)
    return buffer.getvalue()
