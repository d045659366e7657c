"""The page of a batch: head, plots, and the table of all runs, the worst first."""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote, urlsplit

import numpy as np
from markupsafe import Markup

from gvo._text import html_text, number_text, visible
from gvo.batch.effects import ERROR, relative, swept
from gvo.batch.report.plots import box_plot, effect_sheets, front_sheet
from gvo.batch.report.values import Batch
from gvo.batch.tasks import BatchRow
from gvo.io.run_folder.writer import REPORT
from gvo.types import FloatArray
from gvo.viz.figures import style, write_plots
from gvo.viz.pages import part, write_page

_MAX_LISTED = 20
_SCHEMES = ("http", "https")
_ATE = "ATE smoothed [m]"
_RANKS = {"failed": 0, "partly": 1, "complete": 2}
_COLUMNS: tuple[tuple[str, Callable[[BatchRow], float | None], str], ...] = (
    ("frames", lambda row: row.frames, "d"),
    ("coverage [%]", lambda row: row.coverage_percent, ".1f"),
    ("segments", lambda row: row.segments, "d"),
    ("ATE raw [m]", lambda row: row.ate_raw_m, ".4g"),
    (_ATE, lambda row: row.ate_smoothed_m, ".4g"),
    ("ATE global [m]", lambda row: row.ate_global_m, ".4g"),
    ("RPE [m]", lambda row: row.rpe_smoothed_m, ".4g"),
    ("RPE [deg]", lambda row: row.rpe_smoothed_deg, ".4g"),
    ("t_err [%]", lambda row: row.t_smoothed_percent, ".4g"),
    ("r_err [deg/100 m]", lambda row: row.r_smoothed_deg_per_100m, ".4g"),
    ("frame [ms]", lambda row: row.frame_ms, ".1f"),
    ("run [s]", lambda row: row.run_s, ".1f"),
)


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
    batch = Batch(rows)
    with style(), warnings.catch_warnings():
        # the page takes its fonts from the reader's machine
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        sheets = [(box_plot(batch), ""), *effect_sheets(batch)]
        if batch.is_sweep:
            sheets.append(front_sheet(batch))
        # Each plot with the table below it.
        body = [
            *_head(batch, title, note),
            *(each for plot, table in sheets for each in (part("section", plot), table)),
            _runs_html(batch, path.parent),
        ]
        write_page(path, "batch.html", title=title, parts=map(Markup, body))
        if plots is not None:
            write_plots([plot for plot, _ in sheets], plots)


def _head(batch: Batch, title: str, note: str) -> list[str]:
    parts = [
        f"<h1>{html_text(title)}</h1>",
        f"<p>{html_text(note)}</p>" if note else "",
        part("listed", "Failed", _failures(batch), "warnings"),
        part("facts", _facts(batch)),
        '<p class="note"><a href="#runs">All runs, the worst first</a></p>',
    ]
    return [part for part in parts if part]


def _failures(batch: Batch) -> list[str]:
    """Return the reasons of failed runs with their numbers, the commonest first."""
    reasons = Counter(visible(row.reason) for row in batch.rows if row.status == "failed")
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
        "Swept": ", ".join(map(visible, swept(batch.table))),
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


def _runs_html(batch: Batch, folder: Path) -> str:
    """Return the section with the table of all runs; links are relative to the page's folder."""
    over_best = np.asarray(relative(batch.table, ERROR, to="min"), dtype=np.float64)
    errors = over_best if batch.is_sweep else batch.numbers(ERROR)
    order = sorted(range(len(batch.rows)), key=lambda n: _rank(batch.rows[n], float(errors[n])))
    rows = [batch.rows[n] for n in order]
    columns = dict(_number_columns(rows, over_best[order] if batch.is_sweep else None))
    header = ["recording", *(["configuration"] if batch.is_sweep else []), "status"]
    head = "".join(f"<th>{name}</th>" for name in header)
    head += "".join(f'<th class="number">{name}</th>' for name in columns)
    lines = zip(*columns.values(), strict=True) if columns else [() for _ in rows]
    body = "\n".join(
        f"<tr><td>{_linked(row, folder)}</td>"
        + (f"<td>{_name(row.variant)}</td>" if batch.is_sweep else "")
        + f"{_outcome(row, numbers)}</tr>"
        for row, numbers in zip(rows, lines, strict=True)
    )
    return (
        f'<section id="runs">\n<h2>All runs</h2>\n<p class="note">{_words(batch)}</p>\n'
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table>'
        "</div>\n</section>"
    )


def _words(batch: Batch) -> str:
    measure = "the ATE over the best one of the recording" if batch.is_sweep else "the smoothed ATE"
    return (
        "Failed runs first, then incomplete ones, the least covered first, then the others by "
        f"{measure if batch.has_errors else 'their coverage'}, the worst first. A name leads to "
        "the report of the run."
    )


def _rank(row: BatchRow, error: float) -> tuple[float | str, ...]:
    """Return a key that sorts the worst to the top."""
    coverage = math.inf if row.coverage_percent is None else row.coverage_percent
    by_error = math.inf if math.isnan(error) else -error
    by_status = (coverage, by_error) if row.status == "partly" else (by_error, coverage)
    return _RANKS[row.status], *by_status, -(row.frame_ms or 0.0), row.recording, row.variant


def _number_columns(
    rows: Sequence[BatchRow], over_best: FloatArray | None
) -> Iterator[tuple[str, list[str]]]:
    """Yield the columns that have any number."""
    for name, value, form in _COLUMNS:
        values = [value(row) for row in rows]
        if any(each is not None for each in values):
            yield name, [number_text(each, form) for each in values]
        if name == _ATE and over_best is not None and not np.all(np.isnan(over_best)):
            yield "over the best", [number_text(float(ratio), ".3f") for ratio in over_best]


def _outcome(row: BatchRow, numbers: Sequence[str]) -> str:
    """Return the cells of the status and of the numbers; of a failed run the reason."""
    reason = html_text(row.reason)
    if row.status == "failed":
        return f'<td>failed</td><td colspan="{max(1, len(numbers))}">{reason}</td>'
    status = f'{row.status}<div class="note">{reason}</div>' if reason else row.status
    return f"<td>{status}</td>" + "".join(f'<td class="number">{each}</td>' for each in numbers)


def _name(text: str) -> str:
    # may break where a parameter ends
    return html_text(text).replace(",", ",<wbr>")


def _linked(row: BatchRow, folder: Path) -> str:
    name, address = _name(row.recording), run_address(row.folder, folder)
    return f'<a href="{html_text(address)}">{name}</a>' if address else name


def run_address(run: str, folder: Path) -> str:
    """Return the address of the report of a run, or of its folder if it has none.

    Parameters
    ----------
    run : str
        Folder of the run, relative to `folder`, or a URL.
    folder : Path
        Of the page.

    Returns
    -------
    str
        Percent-encoded; empty if neither exists.
    """
    if "://" in run:
        return run if urlsplit(run).scheme in _SCHEMES else ""
    # Path.exists raises if the name is too long
    found = next((at for at in (f"{run}/{REPORT}", run) if os.path.exists(folder / at)), None)  # noqa: PTH110
    if found is None:
        return ""
    path = Path(found)
    if path.is_absolute():
        return path.as_uri()
    # the colon is encoded too: what is before it would be a scheme
    return quote(path.as_posix(), errors="surrogateescape")
