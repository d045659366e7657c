"""Box plots of error, coverage and time, a row per configuration or recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.batch.effects import ERROR, MIN_RUNS, TIME, relative
from gvo.batch.report.values import N_LABEL, Batch, logarithmic_axis, shown
from gvo.types import BoolArray, FloatArray
from gvo.viz.palette import ESTIMATES, REFUSED
from gvo.viz.report.sheets import WIDE, Plot, arrange, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_ROWS = 30
"""Of more only the best and the worst are drawn."""

_N_EACH_END = 10
_MAX_POINTS = 40
_WHISKER = 1.5
_GREY = "#777777"
_COVERAGE = "coverage [%]"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Row:
    """A row of the picture: the runs in it; none make a gap."""

    name: str
    is_in: BoolArray
    is_marked: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Panel:
    """A measure of all runs; those not counted are hollow points, in no box."""

    label: str
    values: FloatArray
    is_counted: BoolArray
    colour: str = _GREY
    is_logarithmic: bool = False
    reference: float | None = None


def box_plot(batch: Batch) -> Plot:
    """Draw a row per configuration, or per recording if there is only one configuration."""
    title = "Errors, coverage and time"
    panels = _panels(batch)
    if not panels:
        return Plot(slug="boxes", title=title, text="Not drawn: no run has an error or a coverage.")
    rows, words = _variant_rows(batch) if batch.is_sweep else _recording_rows(batch)
    if any(panel.reference is not None for panel in panels):
        words += " The relative ATE is that over the median of all runs of its recording."
    if any(np.sum(row.is_in) >= MIN_RUNS for row in rows):
        words += (
            " Boxes hold the middle half of the runs, the line is the median; whiskers reach to "
            f"the farthest run within {_WHISKER} box lengths. Points are runs: all of up to "
            f"{_MAX_POINTS} in a row, of more those beyond the whiskers."
        )
    if np.any(~batch.is_comparable() & ~np.isnan(batch.numbers(ERROR))):
        words += (
            " Hollow points are runs with less than 95 % of the poses of the best run of their "
            "recording: their errors cover the easy part only, and are in no box."
        )
    return Plot(slug="boxes", title=title, text=words, figure=_figure(rows, panels))


def _panels(batch: Batch) -> list[_Panel]:
    is_run = ~batch.is_failed()
    panels = _error_panels(batch) if batch.has_errors else []
    coverages, times_ms = batch.numbers("coverage_percent"), batch.numbers(TIME)
    if not np.all(np.isnan(coverages)):
        panels.append(_Panel(label=_COVERAGE, values=coverages, is_counted=is_run))
    known = times_ms[batch.is_comparable(TIME)]
    if len(known):
        is_wide = bool(known.max() > 10.0 * known.min())
        panels.append(
            _Panel(label="frame [ms]", values=times_ms, is_counted=is_run, is_logarithmic=is_wide)
        )
    return panels


def _error_panels(batch: Batch) -> list[_Panel]:
    looks: dict[str, Any] = {
        "is_counted": batch.is_comparable(),
        "colour": ESTIMATES["smoothed"],
        "is_logarithmic": True,
    }
    panels = [_Panel(label="ATE smoothed [m]", values=batch.numbers(ERROR), **looks)]
    if batch.is_sweep and batch.table["recording"].nunique() > 1:
        ratios = np.asarray(relative(batch.table, ERROR), dtype=np.float64)
        panels.append(_Panel(label="relative ATE [-]", values=ratios, reference=1.0, **looks))
    return panels


def _variant_rows(batch: Batch) -> tuple[list[_Row], str]:
    is_comparable = batch.is_comparable()
    rows = []
    for variant in batch.means.index:
        is_in = (batch.table["variant"] == variant).to_numpy(dtype=np.bool_)
        is_good = is_in & is_comparable
        missing = f" ({np.sum(is_good)} of {np.sum(is_in)})" if np.any(is_good != is_in) else ""
        name = shown(batch.labels[variant], N_LABEL) + missing
        rows.append(_Row(name=name, is_in=is_in, is_marked=variant == batch.default))
    is_kept = [*(batch.means["is_on_front"] | (batch.means.index == batch.default))]
    order = "the most complete first, of these the most accurate"
    if not batch.has_errors:
        order = "the best covered first"
    words = f"A row per configuration, {order}.{batch.label_words}"
    if any(row.is_marked for row in rows):
        words += " The one with the default values is in bold."
    if any(" of " in row.name for row in rows):
        words += (
            " In brackets: how many of its runs can be compared; the others failed or are short."
        )
    return _capped(rows, is_kept, words, "configurations")


def _recording_rows(batch: Batch) -> tuple[list[_Row], str]:
    measure = batch.numbers(ERROR) if batch.has_errors else -batch.numbers("coverage_percent")
    # failed runs are the worst
    order = np.argsort(np.where(np.isnan(measure), np.inf, measure), kind="stable")
    is_run = ~batch.is_failed()
    n_run = int(np.sum(is_run))
    if len(order) > MAX_ROWS:
        order = order[is_run[order]]
    rows = []
    for n in order:
        is_in = np.arange(len(measure)) == n
        failed = "" if is_run[n] else " (failed)"
        name = shown(batch.rows[n].recording, N_LABEL) + failed
        rows.append(_Row(name=name, is_in=is_in))
    sorting = "error" if batch.has_errors else "coverage"
    words = f"A row per recording, sorted by {sorting}, the best first."
    rows, words = _capped(rows, [False] * len(rows), words, "recordings that did not fail")
    return ([_Row(name=f"all {n_run}", is_in=is_run), *rows] if n_run >= MIN_RUNS else rows), words


def _capped(
    rows: list[_Row], is_kept: Sequence[bool], words: str, kind: str
) -> tuple[list[_Row], str]:
    """Keep both ends and some rows between, with gaps; say so."""
    if len(rows) <= MAX_ROWS:
        return rows, words
    chosen = {*range(_N_EACH_END), *range(len(rows) - _N_EACH_END, len(rows))}
    between = [n for n, kept in enumerate(is_kept) if kept and n not in chosen]
    chosen |= {*between[: MAX_ROWS - len(chosen)]}
    found: list[_Row] = []
    n_before = -1
    for n in sorted(chosen):
        if n > n_before + 1:
            name = f"... {n - n_before - 1} more ..."
            found.append(_Row(name=name, is_in=np.zeros_like(rows[n].is_in)))
        found.append(rows[n])
        n_before = n
    also = (
        ", and between them the default and the front of accuracy against time" if between else ""
    )
    words += (
        f" Of the {len(rows)} {kind} the {_N_EACH_END} best and the {_N_EACH_END} worst are "
        f"drawn{also}; the table holds all."
    )
    return found, words


def _figure(rows: Sequence[_Row], panels: Sequence[_Panel]) -> Figure:
    figure = new_figure(WIDE, 0.75 + 0.24 * max(len(rows), 2))
    many: Any = figure.subplots(1, len(panels), sharey=True, squeeze=False)
    for axes, panel in zip(many[0], panels, strict=True):
        for y, row in enumerate(rows):
            _draw_row(axes, y, panel, row)
        _finish(axes, panel, rows)
    first = many[0, 0]
    first.set_yticks(range(len(rows)), [row.name for row in rows])
    first.set_ylim(len(rows) - 0.4, -0.6)
    for label, row in zip(first.get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row.is_marked else "normal")
        if not np.any(row.is_in):
            label.set_color(_GREY)
    n_longest = max((1.2 if row.is_marked else 1.0) * len(row.name) for row in rows)
    arrange(figure, left=0.3 + 0.066 * max(n_longest, 8.0))
    figure.subplots_adjust(wspace=0.1)
    return figure


def _draw_row(axes: Axes, y: float, panel: _Panel, row: _Row) -> None:
    is_there = row.is_in & ~np.isnan(panel.values)
    if panel.is_logarithmic:
        is_there &= panel.values > 0.0
    values = panel.values[is_there & panel.is_counted]
    hollow = panel.values[is_there & ~panel.is_counted][:_MAX_POINTS]
    colour = panel.colour
    points = values
    if len(values) >= MIN_RUNS:
        low, left, middle, right, high = box_of(values, is_logarithmic=panel.is_logarithmic)
        axes.plot([low, high], [y, y], color=colour, lw=1.0, zorder=2.0)
        axes.fill_betweenx([y - 0.3, y + 0.3], left, right, color=colour, alpha=0.35, lw=0)
        axes.plot([middle, middle], [y - 0.3, y + 0.3], color="black", lw=1.4, zorder=4.0)
        if len(values) > _MAX_POINTS:
            points = _thinned(values[(values < low) | (values > high)])
    looks: dict[str, Any] = {"ls": "", "marker": "o", "ms": 3.2, "zorder": 3.0}
    axes.plot(points, np.full(len(points), y), color=colour, mec="none", **looks)
    looks |= {"mfc": "white", "mew": 0.9, "zorder": 5.0}
    axes.plot(hollow, np.full(len(hollow), y), color=REFUSED, **looks)


def box_of(values: FloatArray, *, is_logarithmic: bool) -> FloatArray:
    """Return whisker, quartile, median, quartile and whisker, shape (5,) [1]_.

    References
    ----------
    .. [1] R. McGill, J. W. Tukey, W. A. Larsen, "Variations of box plots", The American
       Statistician 32(1), 1978, doi:10.1080/00031305.1978.10479236.
    """
    from matplotlib.cbook import boxplot_stats

    [box] = boxplot_stats(np.log(values) if is_logarithmic else values, whis=_WHISKER)
    five = np.array([box[name] for name in ("whislo", "q1", "med", "q3", "whishi")])
    return np.exp(five) if is_logarithmic else five


def _thinned(values: FloatArray) -> FloatArray:
    """Return at most `_MAX_POINTS` values, the smallest and the largest among them."""
    if len(values) <= _MAX_POINTS:
        return values
    return np.sort(values)[np.linspace(0, len(values) - 1, _MAX_POINTS).round().astype(np.int64)]


def _finish(axes: Axes, panel: _Panel, rows: Sequence[_Row]) -> None:
    is_drawn = np.any([row.is_in for row in rows], axis=0) & ~np.isnan(panel.values)
    if panel.is_logarithmic:
        drawn = panel.values[is_drawn & (panel.values > 0.0)]
        ends = (float(drawn.min(initial=np.inf)), float(drawn.max(initial=0.0)))
        logarithmic_axis(axes, "x", ends=ends, n_ticks=5)
    else:
        axes.locator_params(axis="x", nbins=4, steps=[1, 2, 5, 10])
    if panel.label == _COVERAGE:
        axes.set_xlim(min(89.0, float(panel.values[is_drawn].min(initial=90.0)) - 3.0), 101.0)
    if panel.reference is not None:
        axes.axvline(panel.reference, color="black", lw=0.8, ls=":")
    axes.set_xlabel(panel.label)
    axes.tick_params(axis="y", length=0)
