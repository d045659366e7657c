"""The page of a batch: head, plots, tables."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path

from gvo.batch.effects import ERROR, swept
from gvo.batch.report.boxes import box_plot
from gvo.batch.report.effects import effect_sheets, front_sheet
from gvo.batch.report.table import runs_html
from gvo.batch.report.values import Batch, printable
from gvo.batch.rows import BatchRow
from gvo.viz.report.page import facts_html, list_html, plots_html, write_page
from gvo.viz.report.sheets import Plot, settings, write_plots

_MAX_LISTED = 20


def write_batch_report(
    path: Path, rows: Sequence[BatchRow], *, title: str, note: str = "", plots: Path | None = None
) -> None:
    """Write the report of a batch; equal input gives equal files.

    Parameters
    ----------
    path : Path
        The page, replaced where it exists. The folders of the rows are relative to its own.
    rows : sequence of BatchRow
        At least one, in any order.
    title : str
    note : str
        A sentence below the title.
    plots : Path, optional
        Folder for each plot as PNG and PDF.

    Raises
    ------
    ConfigurationError
        When the page or the folder cannot be written.
    TrajectoryError
        When a plot cannot be written.
    ValueError
        Where there is no row.
    """
    if not rows:
        raise ValueError("expected at least one row")
    batch = Batch.of(rows)
    with settings(), warnings.catch_warnings():
        # the page takes its fonts from the reader's machine
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        sheets = _sheets(batch)
        body = [
            *_head(batch, title, note),
            *(part for plot, table in sheets for part in (*plots_html([plot]), table)),
            runs_html(batch, path.parent),
        ]
        write_page(path, printable(title), body)
        if plots is not None:
            write_plots([plot for plot, _ in sheets], plots)


def _sheets(batch: Batch) -> list[tuple[Plot, str]]:
    """Return the plots, each with the table below it."""
    sheets = [(box_plot(batch), "")]
    sheets += effect_sheets(batch)
    if batch.is_sweep:
        sheets.append(front_sheet(batch))
    return sheets


def _head(batch: Batch, title: str, note: str) -> list[str]:
    parts = [
        f"<h1>{escape(printable(title))}</h1>",
        f"<p>{escape(printable(note))}</p>" if note else "",
        list_html("Failed", _failures(batch), kind="warnings"),
        facts_html(_facts(batch)),
        '<p class="note"><a href="#runs">All runs, the worst first</a></p>',
    ]
    return [part for part in parts if part]


def _failures(batch: Batch) -> list[str]:
    """Return the reasons of failed runs with their numbers, the commonest first."""
    reasons = Counter(printable(row.reason) for row in batch.rows if row.status == "failed")
    lines = [
        f"{n} {'run' if n == 1 else 'runs'}: {reason or 'no reason was given'}"
        for reason, n in reasons.most_common(_MAX_LISTED)
    ]
    if len(reasons) > _MAX_LISTED:
        lines.append(f"{len(reasons) - _MAX_LISTED} other reasons: see the table")
    return lines


def _facts(batch: Batch) -> dict[str, str]:
    rows = batch.rows
    statuses = Counter(row.status for row in rows)
    seconds = [row.run_s for row in rows if row.run_s is not None]
    n_true = int(batch.is_comparable(ERROR).sum())
    n_found = sum(row.is_found for row in rows)
    return {
        "Recordings": str(len({row.recording for row in rows})),
        "Configurations": str(len(batch.means)),
        "Swept": ", ".join(map(printable, swept(batch.table))),
        "Runs": f"{len(rows)}: {statuses['complete']} complete, {statuses['partly']} partly, "
        f"{statuses['failed']} failed",
        "Found finished": str(n_found) if n_found else "",
        "Frames": str(sum(row.frames or 0 for row in rows)),
        "Ground truth": f"{n_true} runs have comparable errors"
        if n_true
        else "no run has an error",
        "Time of all runs": f"{sum(seconds):.0f} s" if seconds else "",
        "Version": ", ".join(sorted({f"gvo {r.gvo_version}" for r in rows if r.gvo_version})),
    }
