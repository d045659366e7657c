"""Trajectory files of many forms read; TUM, KITTI, EuRoC, and covariances as CSV written."""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import cut, exists, plain_floats, text_lines
from gvo.errors import TrajectoryError, write_faults
from gvo.geometry import se3
from gvo.trajectory.forms import TUM, UNITS_NS, Form, Sample, recognise
from gvo.trajectory.trajectory import StampsFrom, Trajectory, format_stamp, parse_stamp
from gvo.types import BoolArray, FloatArray, IntArray

MAX_POSITION_M = 1e12
"""Largest coordinate, metres: a hundred times the distance of the planets."""

MAX_LINES = 3_000_000
"""Of a table: rows of a few bytes take more memory than their text."""

_MAX_NUMBERS = 18_200_000  # of a table: poses of a day at 30 Hz
_BLOCK = 4096  # poses that are made of rows at once, by steps that take several times their memory
_MAX_REASON = 400  # characters
_SAMPLE = 100  # rows by which the form of a file is told
_NUMBER = re.compile(r"[-+.]?\d|nan$")
_SECOND_NS = 1_000_000_000
_TUM_ROW = "stamp tx ty tz qx qy qz qw"
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")

_EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z []"
)

COVARIANCE_HEADER = "stamp_ns," + ",".join(
    f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*np.triu_indices(6), strict=True)
)
"""First line of a covariance file: the upper triangle, row by row."""
EFFECTS = "effects.npy"
"""How errors that all steps share move the raw poses, shape (n, 6, k): a file of numpy."""


def read_trajectory(path: str | Path, *, is_growing: bool = False) -> Trajectory:
    """Read a file of poses in the form of TUM, KITTI, EuRoC or another system (`FORMS`).

    A line that names the columns decides which form it is; else the only system does whose
    columns, separator and stamps fit. A KITTI file holds no stamps. They are read from a
    `times.txt` of as many rows beside it (or `sequences/NN/times.txt` for `poses/NN.txt`);
    without one, row n gets n seconds, and `stamps_from` is "rows". Of successive rows with the
    same stamp the last is kept, see `Trajectory.n_repeated`. Where `NAME_covariance.csv` lies
    beside `NAME.txt`, as in a run's folder, and holds all its stamps, the poses have these
    covariances; `raw.txt` has the effects of shared errors by `effects.npy` beside it.

    Parameters
    ----------
    path : str or Path
        Text; fields are separated by blanks, commas or semicolons, comments start with #.
    is_growing : bool
        A TUM file that is still being written: it may be missing or empty, its rows may be in any
        order, and an incomplete last line is ignored. Poses and covariances may be a line ahead
        of one another: those of both come.

    Returns
    -------
    Trajectory
        T_world_frame of TUM and KITTI files, T_world_body of EuRoC's ground truth and of systems
        with an IMU.

    Raises
    ------
    TrajectoryError
        If the file is missing, empty or malformed, or none or several forms fit; names file and
        line.
    """
    path = Path(path)
    rows = filter(_has_pose, read_rows(path, is_growing=is_growing))
    sample = list(islice(rows, _SAMPLE))
    if not sample and is_growing:
        return Trajectory(stamps_ns=np.empty(0, dtype=np.int64), T_world_frame=np.empty((0, 4, 4)))
    if not sample:
        raise TrajectoryError(f"{path}: holds no poses; expected rows like TUM's: {_TUM_ROW}")
    if is_growing:
        poses = _read(path, chain(sample, rows), TUM, n_columns=8, is_sorted=False)
        return _with_covariances(poses, path, is_growing=True)
    header = list(sample[0].comments)
    if len(sample) > 1 and not any(map(_NUMBER.match, sample[0].fields)):
        header.append(sample.pop(0).text)
    form = _recognise(sample, header)
    n_columns = len(sample[0].fields)
    return _with_covariances(_read(path, chain(sample, rows), form, n_columns=n_columns), path)


def _has_pose(row: Row) -> bool:
    """Tell whether a row is none of those with which NCLT's ground truths begin: a stamp, NaN."""
    return len(row.fields) != 7 or {field.lower() for field in row.fields[1:]} != {"nan"}


def _recognise(rows: Sequence[Row], header: Sequence[str]) -> Form:
    first = rows[0]
    fields = [row.fields for row in rows if len(row.fields) == len(first.fields)]
    text = first.text.strip()
    separator = next((mark for mark in (";", ", ", ",") if mark in text), "")
    separator = ",," if text.endswith(",") else separator
    try:
        return recognise(Sample(fields, separator, header))
    except ValueError as error:
        raise first.error(str(error)) from None


def _with_covariances(
    trajectory: Trajectory, path: Path, *, is_growing: bool = False
) -> Trajectory:
    beside = path.with_name(f"{path.stem}_covariance.csv")
    stamps_ns, covariances = read_covariances(beside)
    _, own, rows = np.intersect1d(trajectory.stamps_ns, stamps_ns, return_indices=True)
    if is_growing and beside.is_file():
        trajectory = trajectory.select(own)
    if len(rows) < len(trajectory):
        return trajectory
    trajectory, effects = (
        replace(trajectory, covariances=covariances[rows]),
        path.with_name(EFFECTS),
    )
    if path.stem != "raw" or not effects.is_file():
        return trajectory
    try:
        found = np.load(effects, allow_pickle=False)
        n = min(len(found), len(trajectory)) if is_growing else len(trajectory)
        return replace(trajectory.select(slice(n)), effects=found[:n] if is_growing else found)
    except (OSError, ValueError, TypeError, EOFError) as error:
        raise TrajectoryError(f"{effects}: is damaged: {error}; run again") from error


def read_covariances(path: str | Path) -> tuple[IntArray, FloatArray]:
    """Read the covariances of a run folder, also of a run that goes on.

    Parameters
    ----------
    path : str or Path
        CSV with `COVARIANCE_HEADER` as its first line. It may be missing or empty, and an
        incomplete last line is ignored.

    Returns
    -------
    stamps_ns : ndarray of int64, shape (n,)
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame of the pose.

    Raises
    ------
    TrajectoryError
        If the file is malformed.
    """
    path = Path(path)
    rows = read_rows(path, is_growing=True)
    first = next(rows, None)
    if first is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 6, 6))
    if first.fields != COVARIANCE_HEADER.split(","):
        raise TrajectoryError(f"{path}:1: expected the header {COVARIANCE_HEADER[:32]}...")
    table = read_table(path, rows, slice(1, 22), n_columns=22, unit_ns=1, limit=math.inf)
    return table.stamps_ns, from_upper_triangle(table.values)


def upper_triangle(matrix: FloatArray) -> FloatArray:
    """Return the upper triangle of a matrix (n, n), row by row: 21 numbers of a covariance."""
    return matrix[_upper(len(matrix))]


def from_upper_triangle(numbers: FloatArray) -> FloatArray:
    """Return the symmetric matrices (..., n, n) of upper triangles (..., n (n + 1) / 2)."""
    n = (math.isqrt(8 * numbers.shape[-1] + 1) - 1) // 2
    rows, columns = _upper(n)
    matrices = np.empty((*numbers.shape[:-1], n, n), dtype=numbers.dtype)
    matrices[..., rows, columns] = numbers
    matrices[..., columns, rows] = numbers
    return matrices


@cache
def _upper(n: int) -> tuple[IntArray, IntArray]:
    rows, columns = np.triu_indices(n)
    return rows, columns


def format_tum_line(stamp_ns: int, T_world_frame: FloatArray) -> str:
    """Return one line of a TUM file, without its line end.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds; written as seconds with nine decimals.
    T_world_frame : ndarray of float64, shape (4, 4)
        Metres.

    Returns
    -------
    str
        `stamp tx ty tz qx qy qz qw` with qw >= 0; nine decimals of the position, twelve of the
        quaternion.
    """
    # adding zero turns -0.0 into 0.0
    t = " ".join(f"{round(value, 9) + 0.0:.9f}" for value in T_world_frame[:3, 3].tolist())
    q = " ".join(
        f"{round(value, 12) + 0.0:.12f}" for value in se3.quaternion(T_world_frame[:3, :3])
    )
    return f"{format_stamp(stamp_ns)} {t} {q}"


def format_covariance_line(stamp_ns: int, covariance: FloatArray) -> str:
    """Return one line of a covariance file, without its line end and without loss.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.
    covariance : ndarray of float64, shape (6, 6)
        Of (rx, ry, rz, tx, ty, tz); the upper triangle is written.
    """
    return ",".join([str(int(stamp_ns)), *map(repr, upper_triangle(covariance).tolist())])


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write stamps and poses as a TUM file.

    Parameters
    ----------
    path : str or Path
        Overwritten if it exists.
    trajectory : Trajectory
        Its covariances are not written.

    Raises
    ------
    ValueError
        If it holds positions without rotations.
    TrajectoryError
        If the file cannot be written.
    """
    poses = zip(trajectory.stamps_ns, trajectory.T_world_frame, strict=True)
    _write_lines(path, trajectory, (format_tum_line(int(stamp_ns), T) for stamp_ns, T in poses))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write poses, without their stamps, as a KITTI file.

    Parameters
    ----------
    path : str or Path
        Overwritten if it exists.
    trajectory : Trajectory
        Its stamps and covariances are not written.

    Raises
    ------
    ValueError
        If it holds positions without rotations.
    TrajectoryError
        If the file cannot be written.
    """
    rows = trajectory.T_world_frame[:, :3].reshape(-1, 12)
    _write_lines(path, trajectory, (" ".join(f"{value:.12e}" for value in row) for row in rows))


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write stamps and poses as the ground truth of an EuRoC folder, without loss.

    Parameters
    ----------
    path : str or Path
        File to write.
    trajectory : Trajectory
        Of the body.

    Raises
    ------
    ValueError
        If it holds positions without rotations.
    TrajectoryError
        If the file cannot be written.
    """
    quaternions_xyzw = Rotation.from_matrix(trajectory.T_world_frame[:, :3, :3]).as_quat()
    rows = zip(trajectory.stamps_ns, trajectory.positions, quaternions_xyzw, strict=True)
    lines = (
        ",".join([str(int(stamp_ns)), *(repr(float(x)) for x in (*t, w, *xyz))])
        for stamp_ns, t, (*xyz, w) in rows
    )
    _write_lines(path, trajectory, [_EUROC_HEADER, *lines])


def _write_lines(path: str | Path, trajectory: Trajectory, lines: Iterable[str]) -> None:
    if not trajectory.has_rotations:
        raise ValueError("a file of poses cannot hold positions without rotations")
    with (
        write_faults(TrajectoryError, path),
        Path(path).open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.writelines(f"{line}\n" for line in lines)


def _read(
    path: Path, rows: Iterable[Row], form: Form, *, n_columns: int, is_sorted: bool = True
) -> Trajectory:
    columns = slice(min(form.columns), max(form.columns) + 1)
    unit_ns = UNITS_NS.get(form.stamps)
    stamp = form.names.index("stamp") if unit_ns else 0
    table = read_table(path, rows, columns, n_columns=n_columns, unit_ns=unit_ns, stamp=stamp)
    if not is_sorted:
        table = table.take(np.argsort(table.stamps_ns, kind="stable"))
    n_rows = len(table.numbers)
    stamps_from: StampsFrom = "file"
    if unit_ns:
        # TUM's own ground truths repeat stamps, rounded to 0.1 ms; their tools keep the last row
        table = table.take(np.diff(table.stamps_ns, append=table.stamps_ns[-1] + 1) != 0)
        stamps_ns = check_increasing(table)
    else:
        stamps_ns = np.arange(n_rows, dtype=np.int64) * _SECOND_NS
    if form.stamps in ("index", "none"):
        stamps_ns, stamps_from = _kitti_stamps(path, stamps_ns)
    return Trajectory(
        stamps_ns=stamps_ns,
        T_world_frame=_poses(table, partial(_transforms, form)),
        stamps_from=stamps_from,
        n_repeated=n_rows - len(table.numbers),
    )


def _kitti_stamps(path: Path, rows_ns: IntArray) -> tuple[IntArray, StampsFrom]:
    beside = path.parent / "times.txt"
    official = path.parent.parent / "sequences" / path.stem / "times.txt"
    for times in (beside, official):
        if times.is_file():
            table = read_table(times, read_rows(times), slice(0), unit_ns=_SECOND_NS)
            if len(table.stamps_ns) == len(rows_ns):
                return check_increasing(table), "times"
    return rows_ns, "rows"


def _poses(table: Table, convert: Callable[[Table], FloatArray]) -> FloatArray:
    T = np.empty((len(table.numbers), 4, 4))
    for rows in (slice(first, first + _BLOCK) for first in range(0, len(T), _BLOCK)):
        T[rows] = convert(table.take(rows))
    return T


def _transforms(form: Form, table: Table) -> FloatArray:
    pose = table.values[:, np.array(form.columns) - min(form.columns)]
    t, rotations = pose[:, :3], pose[:, 3:]
    table.refuse(~form.is_rotation(rotations), form.fault)
    if rotations.shape[1] == 9:
        return se3.make_transform(se3.nearest_rotation(rotations.reshape(-1, 3, 3)), t)
    is_quaternion = rotations.shape[1] == 4
    R = Rotation.from_quat(rotations) if is_quaternion else Rotation.from_euler("xyz", rotations)
    return se3.make_transform(np.asarray(R.as_matrix()), t)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The fields of one line of a file."""

    path: Path
    number: int
    text: str
    fields: list[str]
    comments: list[str]

    def error(self, text: str) -> TrajectoryError:
        """Return an error with this text that names file and line."""
        return TrajectoryError(f"{self.path}:{self.number}: {cut(text, _MAX_REASON)}")


def read_rows(path: Path, *, is_growing: bool = False) -> Iterator[Row]:
    """Yield the rows of a text file, separated by blanks, commas or semicolons.

    Parameters
    ----------
    path : Path
        Text file.
    is_growing : bool
        It may be missing, and an incomplete last line is ignored.

    Yields
    ------
    Row
        Lines with at least one field, with the comments (#) since the row before.

    Raises
    ------
    TrajectoryError
        If the file cannot be read.
    """
    if is_growing and not exists(path):
        return
    comments: list[str] = []
    for number, line in text_lines(path, TrajectoryError, max_lines=MAX_LINES):
        text, mark, comment = line.rstrip("\n").partition("#")
        fields = text.replace(";" if ";" in text else ",", " ").split()
        if mark:
            comments.append(comment)
        if fields and not (is_growing and line[-1] != "\n"):
            yield Row(path=path, number=number, text=text, fields=fields, comments=comments)
            comments = []


class Table(NamedTuple):
    """Rows of a text file as numbers, which take a few times their text.

    Parameters
    ----------
    path : Path
        The file.
    numbers : ndarray of int64, shape (n,)
        Line numbers, from one.
    stamps_ns : ndarray of int64, shape (n,)
        Zero where the rows hold none.
    values : ndarray of float64, shape (n, k)
        Finite numbers of some columns.
    """

    path: Path
    numbers: IntArray
    stamps_ns: IntArray
    values: FloatArray

    def take(self, rows: IntArray | BoolArray | slice) -> Table:
        """Return some of the rows."""
        return Table(self.path, self.numbers[rows], self.stamps_ns[rows], self.values[rows])

    def refuse(self, is_wrong: BoolArray, text: str) -> None:
        """Raise `TrajectoryError` for the first row of a mask, shape (n,), if any."""
        if np.any(is_wrong):
            raise TrajectoryError(f"{self.path}:{self.numbers[np.argmax(is_wrong)]}: {text}")


def read_table(
    path: Path,
    rows: Iterable[Row],
    columns: slice,
    *,
    n_columns: int | None = None,
    unit_ns: int | None = None,
    stamp: int = 0,
    limit: float = MAX_POSITION_M,
) -> Table:
    """Return rows as numbers."""
    numbers, stamps_ns, values = array("q"), array("q"), array("d")
    for row in rows:
        if n_columns not in (None, len(row.fields)):
            raise row.error(
                f"expected {n_columns} columns, got {len(row.fields)}; remove or complete the row"
            )
        try:
            values.extend(plain_floats(row.fields[columns]))
            stamps_ns.append(parse_stamp(row.fields[stamp], unit_ns=unit_ns) if unit_ns else 0)
        except ValueError as error:
            raise row.error(f"{error}; expected {len(row.fields)} numbers") from None
        numbers.append(row.number)
        if len(values) > _MAX_NUMBERS:
            raise row.error(f"the table holds more than {_MAX_NUMBERS} numbers")
    table = Table(
        path,
        np.frombuffer(numbers, dtype=np.int64),
        np.frombuffer(stamps_ns, dtype=np.int64),
        np.frombuffer(values).reshape(len(numbers), len(range(columns.stop)[columns])),
    )
    is_broken = np.any(~np.isfinite(table.values), axis=1)
    table.refuse(is_broken, "a number is not finite; remove the row")
    is_absurd = np.any((table.values > limit) | (table.values < -limit), axis=1)
    table.refuse(is_absurd, f"a number is beyond {limit:g}; remove the row")
    return table


def check_increasing(table: Table) -> IntArray:
    """Return the stamps; raise `TrajectoryError` if they do not increase strictly."""
    is_fall = np.append(False, np.diff(table.stamps_ns) <= 0)
    if np.any(is_fall):
        n = int(np.argmax(is_fall))
        before, stamp = (format_stamp(each) for each in table.stamps_ns[n - 1 : n + 1].tolist())
        table.refuse(
            is_fall,
            f"the stamp {stamp} is not after {before} of line {table.numbers[n - 1]}; sort the "
            "rows and remove repeated ones",
        )
    return table.stamps_ns
