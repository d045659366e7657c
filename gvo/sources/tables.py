"""Text tables of recordings: rows of fields, stamps exact to the nanosecond."""

from __future__ import annotations

from pathlib import Path

from gvo.bounded_text import cut, read_text
from gvo.errors import RecordingError
from gvo.trajectory.trajectory import parse_stamp

_MAX_REASON = 300  # characters
_Row = tuple[int, list[str]]


def read_rows(path: Path, *, n_fields: int, separator: str | None = None) -> list[_Row]:
    """Read the rows of a table, without comments and empty lines.

    Parameters
    ----------
    path : Path
        Text file.
    n_fields : int
        Fields a row must hold at least.
    separator : str, optional
        Between the fields; white space when None.

    Returns
    -------
    list of (int, list of str)
        Line number, counted from one, and fields.

    Raises
    ------
    RecordingError
        When the file cannot be read, holds no row, or a row is too short.
    """
    rows = []
    for number, line in enumerate(_read_lines(path), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        fields = [field.strip() for field in text.split(separator)]
        if len(fields) < n_fields:
            raise RecordingError(
                f"{path}, line {number}: expected {n_fields} fields, got {len(fields)}"
            )
        rows.append((number, fields))
    if not rows:
        raise RecordingError(f"{path}: holds no rows")
    return rows


def read_stamp(text: str, where: str, *, unit_ns: int) -> int:
    """Return the nanoseconds that a field of a table says, without loss.

    Parameters
    ----------
    text : str
        A decimal number.
    where : str
        File and line, for the message.
    unit_ns : int
        Nanoseconds of its unit: 1_000_000_000 for seconds, 1 for nanoseconds.

    Raises
    ------
    RecordingError
        When the text is no number, or out of range.
    """
    try:
        return parse_stamp(text, unit_ns=unit_ns)
    except ValueError as error:
        raise RecordingError(f"{where}: {cut(str(error), _MAX_REASON)}") from None


def _read_lines(path: Path) -> list[str]:
    try:
        return read_text(path, encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is no text file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
