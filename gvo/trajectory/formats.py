"""Trajectory files: TUM, KITTI and EuRoC, and covariances as CSV, read and written."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gvo._text import cut, exists, plain_number, read_text
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.trajectory import StampsFrom, Trajectory, format_stamp, parse_stamp
from gvo.types import BoolArray, FloatArray, IntArray

MAX_POSITION_M = 1e12
"""Largest coordinate, metres: a hundred times the distance of the planets."""

_MAX_REASON = 300  # characters
_FORMATS = (
    "8 columns (TUM: stamp tx ty tz qx qy qz qw), 12 (KITTI: the first three rows of the pose) "
    "or 17 (EuRoC state)"
)
_SCALAR_FIRST = re.compile(r"q\w*w\b.*q\w*x\b")
_MAX_HEADER = 2000  # characters; the search takes the square of it
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
# rounding of published files: four decimals in TUM's ground truths, seven digits in KITTI's
_ROUNDING = 1e-2

_EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z []"
)

COVARIANCE_HEADER = "stamp_ns," + ",".join(
    f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*np.triu_indices(6), strict=True)
)
"""First line of a covariance file: the upper triangle, row by row."""


def read_trajectory(path: str | Path, *, is_growing: bool = False) -> Trajectory:
    """Read poses from a TUM, KITTI or EuRoC file, recognised by its columns and header.

    A KITTI file holds no stamps. They are read from a `times.txt` of as many rows beside it (or
    `sequences/NN/times.txt` for `poses/NN.txt`); without one, row n gets n seconds, and
    `stamps_from` is "rows". Of successive rows of a TUM file with the same stamp the last is
    kept, see `Trajectory.n_repeated`. Where `NAME_covariance.csv` lies beside `NAME.txt`, as in a
    run's folder, and holds all its stamps, the poses have these covariances.

    Parameters
    ----------
    path : str or Path
        Text; fields are separated by blanks or commas, comments start with #.
    is_growing : bool
        A TUM file that is still being written: it may be missing or empty, its rows may be in any
        order, and an incomplete last line is ignored.

    Returns
    -------
    Trajectory
        T_world_frame of TUM and KITTI files, T_world_body of EuRoC's ground truth.

    Raises
    ------
    TrajectoryError
        If the file is missing, empty or malformed; names file and line.
    """
    path = Path(path)
    header, rows = read_rows(path, of="poses", is_growing=is_growing)
    if is_growing:
        return _read_growing(rows)
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses; expected rows of {_FORMATS}")
    return _with_covariances(_parse(path, header, rows), path)


def _parse(path: Path, header: str, rows: list[Row]) -> Trajectory:
    n_columns = len(rows[0].fields)
    if n_columns == 17 or (n_columns >= 8 and _SCALAR_FIRST.search(header[:_MAX_HEADER])):
        return _read_euroc(rows)
    if n_columns == 12:
        return _read_kitti(path, rows)
    if n_columns == 8:
        return _read_tum(rows)
    raise rows[0].error(f"expected {_FORMATS}, got {n_columns}")


def _with_covariances(trajectory: Trajectory, path: Path) -> Trajectory:
    beside = path.with_name(f"{path.stem}_covariance.csv")
    stamps_ns, covariances = read_covariances(beside, is_growing=True)
    _, _, rows = np.intersect1d(trajectory.stamps_ns, stamps_ns, return_indices=True)
    is_whole = len(rows) == len(trajectory)
    return replace(trajectory, covariances=covariances[rows]) if is_whole else trajectory


def read_covariances(path: str | Path, *, is_growing: bool = False) -> tuple[IntArray, FloatArray]:
    """Read the covariances of a run folder, or what `write_covariances` wrote.

    Parameters
    ----------
    path : str or Path
        CSV with `COVARIANCE_HEADER` as its first line.
    is_growing : bool
        It is still being written: it may be missing or empty, and an incomplete last line is
        ignored.

    Returns
    -------
    stamps_ns : ndarray of int64, shape (n,)
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the frame of the pose.

    Raises
    ------
    TrajectoryError
        If the file is missing or malformed.
    """
    path = Path(path)
    _, rows = read_rows(path, of="covariances", is_growing=is_growing)
    if is_growing and not rows:
        return np.empty(0, dtype=np.int64), np.empty((0, 6, 6))
    if not rows or rows[0].fields != COVARIANCE_HEADER.split(","):
        raise TrajectoryError(f"{path}:1: expected the header {COVARIANCE_HEADER[:32]}...")
    values = read_numbers(rows[1:], slice(1, None), n_columns=22, limit=math.inf)
    return read_stamps(rows[1:], unit_ns=1), from_upper_triangle(values)


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
    _check_rotations(trajectory)
    poses = zip(trajectory.stamps_ns, trajectory.T_world_frame, strict=True)
    _write_lines(path, (format_tum_line(int(stamp_ns), T) for stamp_ns, T in poses))


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
    _check_rotations(trajectory)
    rows = trajectory.T_world_frame[:, :3].reshape(-1, 12)
    _write_lines(path, (" ".join(f"{value:.12e}" for value in row) for row in rows))


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
    _check_rotations(trajectory)
    quaternions_xyzw = Rotation.from_matrix(trajectory.T_world_frame[:, :3, :3]).as_quat()
    rows = zip(trajectory.stamps_ns, trajectory.positions, quaternions_xyzw, strict=True)
    lines = (
        ",".join([str(int(stamp_ns)), *(repr(float(x)) for x in (*t, w, *xyz))])
        for stamp_ns, t, (*xyz, w) in rows
    )
    _write_lines(path, [_EUROC_HEADER, *lines])


def write_covariances(path: str | Path, trajectory: Trajectory) -> None:
    """Write the covariances of a trajectory as CSV, a header and a line per pose, without loss.

    Parameters
    ----------
    path : str or Path
        Overwritten if it exists.
    trajectory : Trajectory
        With covariances.

    Raises
    ------
    ValueError
        If it holds none.
    TrajectoryError
        If the file cannot be written.
    """
    if trajectory.covariances is None:
        raise ValueError("the trajectory holds no covariances")
    values = zip(trajectory.stamps_ns, trajectory.covariances, strict=True)
    lines = (format_covariance_line(int(stamp_ns), C) for stamp_ns, C in values)
    _write_lines(path, [COVARIANCE_HEADER, *lines])


def _check_rotations(trajectory: Trajectory) -> None:
    if not trajectory.has_rotations:
        raise ValueError("a file of poses cannot hold positions without rotations")


def _write_lines(path: str | Path, lines: Iterable[str]) -> None:
    try:
        with Path(path).open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(f"{line}\n" for line in lines)
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be written: {error.strerror}") from error


def _read_growing(rows: list[Row]) -> Trajectory:
    if not rows:
        return Trajectory(stamps_ns=np.empty(0, dtype=np.int64), T_world_frame=np.empty((0, 4, 4)))
    return _read_tum(rows, is_sorted=False)


def _read_tum(rows: list[Row], *, is_sorted: bool = True) -> Trajectory:
    values = read_numbers(rows, slice(1, 8), n_columns=8)
    stamps_ns = read_stamps(rows, unit_ns=1_000_000_000)
    if not is_sorted:
        order = np.argsort(stamps_ns, kind="stable")
        rows, values, stamps_ns = [rows[n] for n in order], values[order], stamps_ns[order]
    # TUM's own ground truths repeat stamps, rounded to 0.1 ms; their tools keep the last row
    is_last = np.diff(stamps_ns, append=stamps_ns[-1] + 1) != 0
    rows = [row for row, is_kept in zip(rows, is_last, strict=True) if is_kept]
    values = values[is_last]
    R = _rotations_of_quaternions(rows, values[:, 3:])
    return Trajectory(
        stamps_ns=check_increasing(rows, stamps_ns[is_last]),
        T_world_frame=se3.make_transform(R, values[:, :3]),
        n_repeated=int(np.count_nonzero(~is_last)),
    )


def _read_euroc(rows: list[Row]) -> Trajectory:
    values = read_numbers(rows, slice(1, 8), n_columns=len(rows[0].fields))
    stamps_ns = check_increasing(rows, read_stamps(rows, unit_ns=1))
    R = _rotations_of_quaternions(rows, values[:, [4, 5, 6, 3]])
    return Trajectory(stamps_ns=stamps_ns, T_world_frame=se3.make_transform(R, values[:, :3]))


def _read_kitti(path: Path, rows: list[Row]) -> Trajectory:
    P = read_numbers(rows, slice(0, 12), n_columns=12).reshape(-1, 3, 4)
    M = P[:, :, :3]
    is_wrong = ~se3.is_rotation(M, tolerance=_ROUNDING)
    refuse(rows, is_wrong, "the first three columns of the pose are no rotation")
    stamps_ns, stamps_from = _kitti_stamps(path, len(rows))
    return Trajectory(
        stamps_ns=stamps_ns,
        T_world_frame=se3.make_transform(se3.nearest_rotation(M), P[:, :, 3]),
        stamps_from=stamps_from,
    )


def _kitti_stamps(path: Path, n_rows: int) -> tuple[IntArray, StampsFrom]:
    beside = path.parent / "times.txt"
    official = path.parent.parent / "sequences" / path.stem / "times.txt"
    for times in (beside, official):
        if times.is_file():
            _, rows = read_rows(times, of="stamps")
            if len(rows) == n_rows:
                return check_increasing(rows, read_stamps(rows, unit_ns=1_000_000_000)), "times"
    return np.arange(n_rows, dtype=np.int64) * 1_000_000_000, "rows"


def _rotations_of_quaternions(rows: list[Row], quaternions_xyzw: FloatArray) -> FloatArray:
    norms = np.linalg.norm(quaternions_xyzw, axis=1)
    refuse(rows, np.abs(norms - 1.0) > _ROUNDING, "the quaternion is not of length one")
    return np.asarray(Rotation.from_quat(quaternions_xyzw).as_matrix())


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The fields of one line of a file.

    Parameters
    ----------
    path : Path
        The file.
    number : int
        Line number, from one.
    fields : list of str
        At least one.
    """

    path: Path
    number: int
    fields: list[str]

    def error(self, text: str) -> TrajectoryError:
        """Return an error with this text that names file and line."""
        return TrajectoryError(f"{self.path}:{self.number}: {cut(text, _MAX_REASON)}")


def read_rows(path: Path, *, of: str, is_growing: bool = False) -> tuple[str, list[Row]]:
    """Read the fields of a text file, separated by blanks or commas; comments start with #.

    Parameters
    ----------
    path : Path
        Text file.
    of : str
        What its rows hold, in the plural, for messages.
    is_growing : bool
        It may be missing, and an incomplete last line is ignored.

    Returns
    -------
    header : str
        The comments before the first row.
    rows : list of Row
        Lines with at least one field.

    Raises
    ------
    TrajectoryError
        If the file cannot be read.
    """
    if is_growing and not exists(path):
        return "", []
    try:
        content = read_text(path, encoding="utf-8-sig")
    except OSError as error:
        raise TrajectoryError(
            f"{path}: cannot be read: {error.strerror}; give a file of {of}"
        ) from error
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"{path}: is no text; expected rows of {of}") from error
    if is_growing:
        content = content[: content.rfind("\n") + 1]
    header: list[str] = []
    rows: list[Row] = []
    for number, line in enumerate(content.splitlines(), start=1):
        text, mark, comment = line.partition("#")
        fields = text.replace(",", " ").split()
        if mark and not rows:
            header.append(comment)
        if fields:
            rows.append(Row(path=path, number=number, fields=fields))
    return " ".join(header), rows


def read_numbers(
    rows: list[Row], columns: slice, *, n_columns: int, limit: float = MAX_POSITION_M
) -> FloatArray:
    """Return some columns of rows as numbers.

    Parameters
    ----------
    rows : list of Row
        Of one file.
    columns : slice
        Which to return.
    n_columns : int
        Required in each row.
    limit : float
        Of the absolute values.

    Returns
    -------
    ndarray of float64, shape (len(rows), k)
        Finite numbers.

    Raises
    ------
    TrajectoryError
        If a row has more or fewer columns, or a number is not finite; names the line.
    """
    values = []
    for row in rows:
        if len(row.fields) != n_columns:
            raise row.error(
                f"expected {n_columns} columns, got {len(row.fields)}; remove or complete the row"
            )
        try:
            values.append([float(plain_number(field)) for field in row.fields[columns]])
        except ValueError as error:
            raise row.error(f"{error}; expected {n_columns} numbers") from None
    array = np.array(values).reshape(len(rows), len(range(n_columns)[columns]))
    refuse(rows, ~np.isfinite(array).all(axis=1), "a number is not finite; remove the row")
    is_absurd = (np.abs(array) > limit).any(axis=1)
    refuse(rows, is_absurd, f"a number is beyond {limit:g}; remove the row")
    return array


def read_stamps(rows: list[Row], *, unit_ns: int) -> IntArray:
    """Return the first column in nanoseconds, without loss (decimal arithmetic).

    Parameters
    ----------
    rows : list of Row
        Of one file.
    unit_ns : int
        Nanoseconds of a unit: 1_000_000_000 for seconds, 1 for nanoseconds.

    Returns
    -------
    ndarray of int64, shape (len(rows),)

    Raises
    ------
    TrajectoryError
        If a stamp is no number or out of range; names the line.
    """
    return np.array([_stamp(row, unit_ns) for row in rows], dtype=np.int64)


def _stamp(row: Row, unit_ns: int) -> int:
    try:
        return parse_stamp(row.fields[0], unit_ns=unit_ns)
    except ValueError as error:
        raise row.error(str(error)) from None


def check_increasing(rows: list[Row], stamps_ns: IntArray) -> IntArray:
    """Return the stamps; raise `TrajectoryError` if they do not increase strictly."""
    falls = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(falls) > 0:
        before, row = rows[falls[0]], rows[falls[0] + 1]
        raise row.error(
            f"the stamp {row.fields[0]} is not after {before.fields[0]} of line {before.number}; "
            "sort the rows and remove repeated ones"
        )
    return stamps_ns


def refuse(rows: list[Row], is_wrong: BoolArray, text: str) -> None:
    """Raise `TrajectoryError` for the first row of a mask, shape (len(rows),), if any."""
    if np.any(is_wrong):
        raise rows[int(np.argmax(is_wrong))].error(text)
