"""Rows of numbers in text files, with errors that name the line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvo.bounded_text import cut, read_text
from gvo.errors import TrajectoryError
from gvo.trajectory import parse_stamp
from gvo.types import BoolArray, FloatArray, IntArray

MAX_POSITION_M = 1e12
"""Metres: a hundred times as far as the planets; farther, and squares would overflow."""

_MAX_REASON = 300  # characters


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The fields of one line of a file.

    Parameters
    ----------
    path : Path
        The file.
    number : int
        Of the line, counted from one.
    fields : list of str
        At least one.
    """

    path: Path
    number: int
    fields: list[str]

    def error(self, text: str) -> TrajectoryError:
        """Return an error of this text that names the line."""
        return TrajectoryError(f"{self.path}:{self.number}: {cut(text, _MAX_REASON)}")


def read_rows(path: Path, *, of: str) -> tuple[str, list[Row]]:
    """Read the fields of a text file, separated by blanks or commas; comments start with #.

    Parameters
    ----------
    path : Path
        Text file.
    of : str
        What its rows hold, in the plural, for messages.

    Returns
    -------
    header : str
        The comments before the first row.
    rows : list of Row
        Lines that hold anything.

    Raises
    ------
    TrajectoryError
        When the file cannot be read.
    """
    try:
        lines = read_text(path, encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise TrajectoryError(
            f"{path}: cannot be read: {error.strerror}; give a file of {of}"
        ) from error
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"{path}: is no text; expected rows of {of}") from error
    header: list[str] = []
    rows: list[Row] = []
    for number, line in enumerate(lines, start=1):
        text, mark, comment = line.partition("#")
        fields = text.replace(",", " ").split()
        if mark and not rows:
            header.append(comment)
        if fields:
            rows.append(Row(path=path, number=number, fields=fields))
    return " ".join(header), rows


def read_numbers(rows: list[Row], columns: slice, *, n_columns: int) -> FloatArray:
    """Return some columns of rows that all have the same number of them.

    Parameters
    ----------
    rows : list of Row
        Of one file.
    columns : slice
        Which to return.
    n_columns : int
        How many each row must have.

    Returns
    -------
    ndarray of float64, shape (len(rows), k)
        Finite numbers.

    Raises
    ------
    TrajectoryError
        Naming the row that has more or fewer, or something else than a finite number.
    """
    values = []
    for row in rows:
        if len(row.fields) != n_columns:
            raise row.error(
                f"expected {n_columns} columns, got {len(row.fields)}; remove or complete the row"
            )
        try:
            values.append([float(field) for field in row.fields[columns]])
        except ValueError as error:
            raise row.error(f"{error}; expected {n_columns} numbers") from None
    array = np.array(values).reshape(len(rows), len(range(n_columns)[columns]))
    refuse(rows, ~np.isfinite(array).all(axis=1), "a number is not finite; remove the row")
    is_absurd = (np.abs(array) > MAX_POSITION_M).any(axis=1)
    refuse(rows, is_absurd, f"a number is beyond {MAX_POSITION_M:g}; remove the row")
    return array


def read_stamps(rows: list[Row], *, unit_ns: int) -> IntArray:
    """Return the first column in nanoseconds, in decimal arithmetic: without loss.

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
        Naming the row whose stamp is no number or out of range.
    """
    return np.array([_stamp(row, unit_ns) for row in rows], dtype=np.int64)


def _stamp(row: Row, unit_ns: int) -> int:
    try:
        return parse_stamp(row.fields[0], unit_ns=unit_ns)
    except ValueError as error:
        raise row.error(str(error)) from None


def check_increasing(rows: list[Row], stamps_ns: IntArray) -> IntArray:
    """Return stamps, shape (len(rows),), nanoseconds; refuse those that do not increase strictly.

    Raises
    ------
    TrajectoryError
        Naming the first row whose stamp is not after that of the row before.
    """
    falls = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(falls) > 0:
        before, row = rows[falls[0]], rows[falls[0] + 1]
        raise row.error(
            f"the stamp {row.fields[0]} is not after {before.fields[0]} of line {before.number}; "
            "sort the rows and remove repeated ones"
        )
    return stamps_ns


def refuse(rows: list[Row], is_wrong: BoolArray, text: str) -> None:
    """Raise `TrajectoryError` of the first row of a mask, shape (len(rows),), if there is one."""
    if np.any(is_wrong):
        raise rows[int(np.argmax(is_wrong))].error(text)
