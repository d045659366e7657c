"""Rows of a table of runs."""

from typing import Any

from gvo.batch.tasks import BatchRow

_NAMED = {"recording": "a", "variant": "default", "source": "/a.bag", "folder": "a"}


def complete(**values: Any) -> BatchRow:
    """Return the row of a complete run, with some of its values given."""
    measured = {"sensor": "stereo", "frames": 100, "coverage_percent": 100.0, "segments": 1}
    return BatchRow(status="complete", **{**_NAMED, **measured, **values})


def failed(row: BatchRow | None = None, reason: str = "does not exist", **values: Any) -> BatchRow:
    named = {name: getattr(row, name) for name in (*_NAMED, "parameters")} if row else _NAMED
    return BatchRow(status="failed", reason=reason, **{**named, **values})
