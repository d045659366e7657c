"""The report of a batch: box plots of errors and times, medians, and a table of all runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from gvo._text import cut, number_text
from gvo.batch.results import outcome
from gvo.io.run_folder.writer import REPORT
from gvo.viz.figures import WIDE, Plot, new_figure, plain, style
from gvo.viz.pages import write_page
from gvo.viz.palette import ESTIMATES

_ERROR, _RELATIVE, _TIME = "ate_smoothed_m", "relative ATE", "frame_ms"
_PANELS = {_ERROR: "ATE smoothed [m]", _RELATIVE: "relative ATE [-]", _TIME: "frame [ms]"}
_MAX_ROWS = 40
_MAX_NAME = 48
_MAX_REASONS = 20
# A run with fewer poses than this share of the best run of its recording is not compared: it may
# have lost the camera where the recording is hard.
_MIN_SHARE_OF_POSES = 0.95
_RANKS = {"failed": 0, "partly": 1, "complete": 2}
_COLUMNS = {
    "frames": ("frames", ".0f"),
    "coverage_percent": ("coverage [%]", ".1f"),
    "segments": ("segments", ".0f"),
    "ate_raw_m": ("ATE raw [m]", ".4g"),
    _ERROR: ("ATE smoothed [m]", ".4g"),
    "ate_global_m": ("ATE global [m]", ".4g"),
    "rpe_smoothed_m": ("RPE [m]", ".4g"),
    "rpe_smoothed_deg": ("RPE [deg]", ".4g"),
    "t_smoothed_percent": ("t_err [%]", ".4g"),
    "r_smoothed_deg_per_100m": ("r_err [deg/100 m]", ".4g"),
    _TIME: ("frame [ms]", ".1f"),
    "run_s": ("run [s]", ".1f"),
}


def write_batch_report(folder: Path, table: pd.DataFrame, *, note: str = "") -> None:
    """Write `report.html` into the folder of a batch; equal tables give equal files.

    Parameters
    ----------
    folder : Path
        Of the batch; the folders of its runs are relative to it.
    table : DataFrame
        As `results.csv` holds it, with at least one row.
    note : str
        A sentence below the title.
    """
    table = _compared(table)
    is_sweep = table["variant"].nunique() > 1
    with style():
        write_page(
            folder / REPORT,
            "batch.html",
            title=folder.name,
            note=note,
            reasons=_reasons(table),
            facts=_facts(table),
            plot=_box_plots(table, "variant" if is_sweep else "recording"),
            medians=_medians(table) if is_sweep else None,
            header=["recording", "configuration", "status", *_known_columns(table).values()],
            runs=_runs(table, folder),
        )


def _compared(table: pd.DataFrame) -> pd.DataFrame:
    """Add the error of each run over the median of its recording; NaN where it is not compared."""
    n_poses = (table["frames"] * table["coverage_percent"]).astype("float64")
    most = n_poses.groupby(table["recording"]).transform("max")
    errors = table[_ERROR].where(n_poses >= _MIN_SHARE_OF_POSES * most)
    medians = errors.groupby(table["recording"]).transform("median")
    return table.assign(**{_RELATIVE: errors / medians})


def _reasons(table: pd.DataFrame) -> list[str]:
    """Return why runs failed, the commonest reason first."""
    reasons = table["reason"][table["status"] == "failed"].value_counts()
    lines = [f"{n} x {reason}" for reason, n in reasons[:_MAX_REASONS].items()]
    n_others = len(reasons) - len(lines)
    return [*lines, f"{n_others} other reasons: see the table"] if n_others else lines


def _facts(table: pd.DataFrame) -> dict[str, str]:
    seconds = table["run_s"].sum()
    return {
        "Recordings": str(table["recording"].nunique()),
        "Configurations": str(table["variant"].nunique()),
        "Swept": ", ".join(name for name in table.columns if "." in name),
        "Runs": f"{len(table)}: {outcome(table)[0]}",
        "Found finished": str(table["is_found"].sum() or ""),
        "Frames": str(table["frames"].sum()),
        "Time of all runs": f"{seconds:.0f} s" if seconds else "",
        "Version": ", ".join(sorted({f"gvo {each}" for each in table["gvo_version"] if each})),
    }


def _box_plots(table: pd.DataFrame, rows: str) -> Plot:
    """Draw a row per configuration or recording, a panel per measure."""
    names = [name for name in _PANELS if table[name].notna().any()]
    if rows == "recording" or table["recording"].nunique() == 1:
        names = [name for name in names if name != _RELATIVE]
    title = "Errors and times"
    if not names:
        return Plot(slug="boxes", title=title, text="Not drawn: no run has an error or a time.")
    groups = table.groupby(rows, sort=False)
    order = groups[_RELATIVE if rows == "variant" else _ERROR].median().sort_values().index
    shown = order[:_MAX_ROWS]
    figure = new_figure(0.8 + 0.26 * len(shown), WIDE)
    panels: Any = figure.subplots(1, len(names), sharey=True, squeeze=False)
    for axes, name in zip(panels[0], names, strict=True):
        values = [table[name][table[rows] == row].dropna().to_numpy("float64") for row in shown]
        _draw_boxes(axes, values, colour="#777777" if name == _TIME else ESTIMATES["smoothed"])
        axes.set_xlabel(_PANELS[name])
        if name != _TIME and min((v.min() for v in values if len(v)), default=0.0) > 0.0:
            axes.set_xscale("log")
    labels = [plain(cut(str(row), _MAX_NAME)) for row in shown]
    panels[0, 0].set_yticks(range(len(shown)), labels)
    panels[0, 0].invert_yaxis()
    facts = {
        "rows": "configuration" if rows == "variant" else "recording",
        "is_relative": _RELATIVE in names,
        "n_drawn": len(shown),
        "n": len(order),
    }
    return Plot(slug="boxes", title=title, facts=facts, figure=figure)


def _draw_boxes(axes: Axes, values: Sequence[Any], *, colour: str) -> None:
    line = {"color": colour}
    lines = {f"{part}props": line for part in ("box", "whisker", "cap", "median")}
    for y, each in enumerate(values):
        if len(each) > 2:
            options: dict[str, Any] = {"orientation": "horizontal", "widths": 0.6, **lines}
            axes.boxplot(each, positions=[y], showfliers=False, manage_ticks=False, **options)
        axes.plot(each, np.full(len(each), y), "o", color=colour, ms=3.5, alpha=0.7)


def _medians(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the medians of each configuration, the most accurate first."""
    runs = table.assign(is_failed=table["status"] == "failed").groupby("variant", sort=False)
    found = runs.agg(
        error=(_RELATIVE, "median"),
        frame_ms=(_TIME, "median"),
        n_compared=(_RELATIVE, "count"),
        n_failed=("is_failed", "sum"),
    ).sort_values("error", kind="stable")
    header = ["configuration", _RELATIVE, "frame [ms]", "compared runs", "failed runs"]
    return header, [
        [str(name), number_text(error, ".3f"), number_text(frame_ms, ".1f"), str(n), str(n_failed)]
        for name, error, frame_ms, n, n_failed in found.itertuples()
    ]


def _known_columns(table: pd.DataFrame) -> dict[str, str]:
    return {name: title for name, (title, _) in _COLUMNS.items() if table[name].notna().any()}


def _runs(table: pd.DataFrame, folder: Path) -> list[dict[str, Any]]:
    """Return the rows of the table of all runs: failed ones first, then the largest errors."""
    keys = table.assign(rank=table["status"].map(_RANKS), error=-table[_ERROR])
    order = keys.sort_values(["rank", "error"], kind="stable").index
    runs = []
    for index in order:
        row = table.loc[index]
        page = Path(row["folder"], REPORT)
        runs.append(
            {
                **row,
                "link": quote(page.as_posix()) if (folder / page).exists() else "",
                "numbers": [
                    number_text(None if pd.isna(row[name]) else row[name], _COLUMNS[name][1])
                    for name in _known_columns(table)
                ],
            }
        )
    return runs
