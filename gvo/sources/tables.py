"""Text tables of recordings: rows of fields, stamps exact to the nanosecond."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

from gvo.errors import RecordingError

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


def parse_seconds(text: str, where: str) -> int:
    """Return nanoseconds of decimal seconds, without passing through a float.

    Raises
    ------
    RecordingError
        When the text is no finite number.

    Examples
    --------
    >>> parse_seconds("1305031102.175304", "rgb.txt")
    1305031102175304000
    """
    return _nanoseconds(text, 10**9, where)


def parse_nanoseconds(text: str, where: str) -> int:
    """Return the nanoseconds that a text says; `RecordingError` when it is no finite number."""
    return _nanoseconds(text, 1, where)


def _nanoseconds(text: str, factor: int, where: str) -> int:
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise RecordingError(f"{where}: {text!r} is no stamp") from error
    if not value.is_finite() or abs(value) * factor >= 2**63:
        raise RecordingError(f"{where}: {text!r} is no stamp")
    return int((value * factor).to_integral_value())


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: the file is missing") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is no text file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
