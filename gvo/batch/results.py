"""The table of a batch, as a DataFrame and as files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import get_args, get_type_hints

import pandas as pd
import pyarrow  # type: ignore[import-untyped]  # noqa: F401 - pandas would miss it too late

from gvo.batch.tasks import BatchRow, RunStatus, Value
from gvo.errors import OutputError, write_faults
from gvo.io.run_folder.line_file import replace_bytes

CSV = "results.csv"
PARQUET = "results.parquet"
# Of 64 bits.
_MAX_INT = 1 << 63
_FIRST = ("recording", "variant", "status", "reason")
_DTYPES: dict[object, str] = {int | None: "Int64", float | None: "float64"}


def to_frame(rows: Sequence[BatchRow]) -> pd.DataFrame:
    """Return rows as a table.

    Recording, configuration, status and reason come first, then the parameters in which
    configurations differ, by `section.key`, then the rest. Integers are `Int64`, None is missing.
    """
    keys = list(dict.fromkeys(key for row in rows for key in row.parameters))
    records = [asdict(row) for row in rows]
    names = [name for name in BatchRow.__slots__ if name not in (*_FIRST, "parameters")]
    columns = {name: [_text(record[name]) for record in records] for name in (*_FIRST, *names)}
    frame = pd.DataFrame(columns, columns=[*_FIRST, *names])
    hints = get_type_hints(BatchRow)
    frame = frame.astype({name: _DTYPES[hints[name]] for name in names if hints[name] in _DTYPES})
    for place, key in enumerate(keys, start=len(_FIRST)):
        frame.insert(place, key, _column([row.parameters.get(key) for row in rows]))
    return frame


def outcome(table: pd.DataFrame) -> tuple[dict[str, int], list[str]]:
    """Return the number of runs of each status that occurs, and why runs are not complete."""
    counts = {status: int((table["status"] == status).sum()) for status in get_args(RunStatus)}
    unfinished = table[table["status"] != "complete"]
    reasons = [f"{row.folder}: {row.status}: {row.reason}" for row in unfinished.itertuples()]
    return {status: n for status, n in counts.items() if n}, reasons


def write_results(frame: pd.DataFrame, folder: Path) -> None:
    """Write `results.csv` and `results.parquet`, each replaced at once.

    Raises
    ------
    OutputError
        If one cannot be written; the earlier file stays.
    """
    contents = {
        CSV: frame.to_csv(index=False, lineterminator="\n").encode(),
        PARQUET: frame.to_parquet(index=False),
    }
    for name, content in contents.items():
        with write_faults(OutputError, folder / name):
            replace_bytes(folder / name, content)


def _text(value: Value) -> Value:
    """Escape what cannot be encoded: names of files may hold lone surrogates."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def _column(values: Sequence[Value]) -> pd.Series:
    """Return the values of a parameter; mixed types as JSON texts."""
    kinds = {type(value) for value in values if value is not None}
    is_small = all(abs(value) < _MAX_INT for value in values if type(value) is int)
    if kinds == {int} and is_small:
        return pd.Series(values, dtype="Int64")
    if float in kinds and kinds <= {int, float}:
        return pd.Series([None if v is None else float(v) for v in values], dtype="float64")
    if len(kinds) == 1 and kinds <= {bool, str}:
        return pd.Series(list(map(_text, values)), dtype="boolean" if bool in kinds else "string")
    return pd.Series([json.dumps(value) for value in values], dtype="string")
