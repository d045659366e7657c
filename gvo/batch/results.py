"""The table of a batch, as a DataFrame and as a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pandas as pd

from gvo.batch.tasks import BatchRow, RunStatus
from gvo.errors import OutputError, write_faults
from gvo.io.run_folder.line_file import replace_bytes

CSV = "results.csv"
_FIRST = ("recording", "variant", "status", "reason")


def to_frame(rows: Sequence[BatchRow]) -> pd.DataFrame:
    """Return rows as a table.

    Recording, configuration, status and reason come first, then the parameters in which
    configurations differ, by `section.key`, then the rest. Integers are `Int64`; None is missing.
    """
    keys = list(dict.fromkeys(key for row in rows for key in row.parameters))
    names = [name for name in BatchRow.__slots__ if name not in (*_FIRST, "parameters")]
    records = [{name: _text(value) for name, value in asdict(row).items()} for row in rows]
    frame = pd.DataFrame(records, columns=[*_FIRST, *names])
    hints = get_type_hints(BatchRow)
    frame = frame.astype({name: "Int64" for name in names if hints[name] == int | None})
    frame = frame.astype({name: "float64" for name in names if hints[name] == float | None})
    for place, key in enumerate(keys, start=len(_FIRST)):
        values = pd.Series([_text(row.parameters.get(key)) for row in rows], dtype="object")
        frame.insert(place, key, values.convert_dtypes())
    return frame


def outcome(table: pd.DataFrame) -> tuple[str, list[str]]:
    """Return as text how many runs have which status, and why each is not complete."""
    counts = [(int((table["status"] == status).sum()), status) for status in get_args(RunStatus)]
    unfinished = table[table["status"] != "complete"]
    reasons = [f"{row.folder}: {row.status}: {row.reason}" for row in unfinished.itertuples()]
    return ", ".join(f"{n} {status}" for n, status in counts if n), reasons


def write_results(frame: pd.DataFrame, folder: Path) -> None:
    """Write `results.csv`, replaced at once; if that fails, the earlier file stays."""
    content = frame.to_csv(index=False, lineterminator="\n").encode()
    with write_faults(OutputError, folder / CSV):
        replace_bytes(folder / CSV, content)


def _text(value: Any) -> Any:  # noqa: ANN401 - of any field
    """Escape what UTF-8 does not have: names of files may hold lone surrogates."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value
