"""Box plots of errors and times; what a sweep tells: medians by value, accuracy against time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cbook import boxplot_stats
from matplotlib.figure import Figure
from pandas.api.types import is_bool_dtype, is_numeric_dtype

from gvo._text import number_text, visible
from gvo.batch.effects import COUNTS, ERROR, MIN_RUNS, TIME, relative, span, value_medians
from gvo.batch.report.values import N_LABEL, Batch, logarithmic_axis, shown, value_text
from gvo.types import BoolArray, FloatArray
from gvo.viz.figures import Plot, evenly, legend_above, new_figure
from gvo.viz.pages import part
from gvo.viz.palette import ESTIMATES, REFUSED

MAX_ROWS = 30
"""Of more only the best and the worst are drawn."""

_N_EACH_END = 10
_MAX_POINTS = 40
_WHISKER = 1.5
_GREY = "#777777"
_COVERAGE = "coverage [%]"
MAX_PARAMETERS = 12
"""Of more only those with the largest ratios of medians are drawn."""
_N_COLUMNS = 4
_N_TITLE = 30
_N_LETTERS = 130
_LEAST_LETTERS = 5
_COLOURS = {"error": ESTIMATES["smoothed"], "time": _GREY}
_VALUES_HEADER = ("parameter", "value", "error", "quartiles", "time", "quartiles", *COUNTS)
_MAX_NAMES = 16
_FRONT = "Accuracy against time"
_FRONT_HEADER = ("configuration", "number", "error", "time", "recordings")


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
    figure = new_figure(0.75 + 0.24 * max(len(rows), 2))
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
            beyond = np.sort(values[(values < low) | (values > high)])
            points = beyond[evenly(len(beyond), _MAX_POINTS)]
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
    [box] = boxplot_stats(np.log(values) if is_logarithmic else values, whis=_WHISKER)
    five = np.array([box[name] for name in ("whislo", "q1", "med", "q3", "whishi")])
    return np.exp(five) if is_logarithmic else five


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


def effect_sheets(batch: Batch) -> list[tuple[Plot, str]]:
    """Return the plots of errors and times by value of each parameter, the table below them."""
    effects = value_medians(batch.table)
    if not effects:
        return []
    kinds = ["error", "time"] if batch.has_errors else ["time"]
    tables = [""] * (len(kinds) - 1) + [part("table", _VALUES_HEADER, _value_rows(effects))]
    return [(_values_plot(effects, kind), table) for kind, table in zip(kinds, tables, strict=True)]


def _values_plot(effects: Mapping[str, pd.DataFrame], kind: str) -> Plot:
    slug, title = f"{kind}_by_value", f"{kind.capitalize()} by value of each parameter"
    told = {name: effect for name, effect in effects.items() if span(effect, kind)}
    if not told:
        return Plot(slug=slug, title=title, text=f"Not drawn: no run has a comparable {kind}.")
    words = (
        f"Medians of the {kind} at each value, each run relative to the median of its recording, "
        "all other parameters mixed."
    )
    if any(effect[kind, "low"].notna().any() for effect in told.values()):
        words += " Bars hold the middle half of the runs."
    if any(effect["runs", "failed"].any() for effect in told.values()):
        words += (
            " Failed runs (red) are in no median: a value with more of them is worse than it looks."
        )
    if len(told) > MAX_PARAMETERS:
        words += f" Drawn are the {MAX_PARAMETERS} parameters that change most."
    drawn = dict([*told.items()][:MAX_PARAMETERS])
    return Plot(slug=slug, title=title, text=words, figure=_values_figure(drawn, kind))


def _values_figure(told: Mapping[str, pd.DataFrame], kind: str) -> Figure:
    n_columns = min(_N_COLUMNS, max(len(told), 2))
    n_rows = -(-len(told) // n_columns)
    figure = new_figure(0.6 + 2.2 * n_rows)
    panels: Any = figure.subplots(n_rows, n_columns, sharey=True, squeeze=False)
    for axes, (name, effect) in zip(panels.flat, told.items(), strict=False):
        _draw_values(axes, effect, kind, _N_LETTERS // n_columns)
        axes.set_title(shown(name, _N_TITLE))
    for axes in panels.flat[len(told) :]:
        axes.set_axis_off()
    low = min(float(effect[kind].min().min()) for effect in told.values())
    high = max(float(effect[kind].max().max()) for effect in told.values())
    if any(effect["runs", "failed"].any() for effect in told.values()):
        high *= max(high / low, 1.2) ** 0.15  # room for the words on top
    for row in panels:
        logarithmic_axis(row[0], "y", ends=(low, high), n_ticks=9)
        row[0].set_ylabel(f"{kind} over the median [-]")
    return figure


def _draw_values(axes: Axes, effect: pd.DataFrame, kind: str, n_letters: int) -> None:
    is_number = is_numeric_dtype(effect.index) and not is_bool_dtype(effect.index)
    is_number &= not effect.index.hasnans
    low, median, high = effect[kind].to_numpy().T
    looks: dict[str, Any] = {"color": _COLOURS[kind], "lw": 1.0, "elinewidth": 1.6, "capsize": 2.5}
    axes.axhline(1.0, color="black", lw=0.8, ls=":")
    ends, style = [median - low, high - median], "o-" if is_number else "o"
    axes.errorbar(range(len(effect)), median, ends, fmt=style, ms=5.0, **looks)
    for x, n_failed in enumerate(effect["runs", "failed"]):
        if n_failed:
            words = f"{n_failed} failed" if len(effect) < 5 else str(n_failed)
            place = axes.get_xaxis_transform()
            axes.text(x, 0.98, words, color=REFUSED, ha="center", va="top", transform=place)
    texts = _tick_texts([*effect.index], n_letters, is_number)
    step = -(-len(texts) * (max(map(len, texts)) + 1) // n_letters)
    axes.set_xticks(range(0, len(texts), step), texts[::step])
    axes.set_xlim(-0.5, len(effect) - 0.5)


def _tick_texts(values: Sequence[object], n_letters: int, is_number: bool) -> list[str]:
    """Return texts for an axis as wide as `n_letters`; names are cut to fit."""
    if is_number:
        return [f"{each:.3g}" if isinstance(each, float) else value_text(each) for each in values]
    n_most = max(_LEAST_LETTERS, n_letters // len(values) - 1)
    return [shown(value_text(value), n_most) for value in values]


def _value_rows(effects: Mapping[str, pd.DataFrame]) -> Iterator[list[str]]:
    for parameter, effect in effects.items():
        name = visible(parameter)
        for value, row in effect.iterrows():
            numbers = [text for kind in _COLOURS for text in _quartile_texts(row[kind])]
            counts = [str(int(row["runs", kind])) for kind in COUNTS]
            yield [name, value_text(value), *numbers, *counts]
            name = ""


def _quartile_texts(quartiles: pd.Series[float]) -> list[str]:
    low, median, high = (number_text(number, ".3f") for number in quartiles)
    return [median, "-" if low == "-" else f"{low} to {high}"]


def front_sheet(batch: Batch) -> tuple[Plot, str]:
    """Return the plot and the table of the Pareto front."""
    placed = batch.means.dropna(subset=["error", "time"])
    front = placed[placed["is_on_front"]].sort_values("time")
    if front.empty:
        why = (
            "no recording was completed by all configurations that completed most."
            if batch.means["is_candidate"].any()
            else "no run has both an error and a time."
        )
        return Plot(slug="front", title=_FRONT, text=f"Not drawn: {why}"), ""
    words, figure = _front_words(batch, placed), _front_figure(batch, placed, front)
    plot = Plot(slug="front", title=_FRONT, text=words, figure=figure)
    rows = [
        [
            visible(str(name)),
            str(number),
            *(number_text(mean[kind], ".3f") for kind in ("error", "time")),
            f"{mean['n_compared']} of {mean['n_recordings']}",
        ]
        for number, (name, mean) in enumerate(front.iterrows(), start=1)
    ]
    return plot, part("table", _FRONT_HEADER, rows)


def _front_words(batch: Batch, placed: pd.DataFrame) -> str:
    n_candidates = placed["is_candidate"].sum()
    n_done, n_all = placed["n_compared"].max(), placed["n_recordings"].max()
    words = (
        "Geometric means of the smoothed ATE and of the time of a frame, over those of the mean "
        "configuration. Below and to the left is better; no configuration is both more accurate "
        f"and faster than one on the line. {n_candidates} of {len(batch.means)} configurations "
    )
    words += (
        f"have a comparable run of each of the {n_done} recordings."
        if n_done == n_all
        else f"have a comparable run of {n_done} of the {n_all} recordings, which is the most; "
        "compared are the recordings that they share."
    )
    if n_candidates < len(placed):
        words += (
            " Hollow points lack runs of some of them: they are placed by the others, and are not "
            "on the front, as failing on hard recordings would make them look better."
        )
    return words + batch.label_words


def _front_figure(batch: Batch, placed: pd.DataFrame, front: pd.DataFrame) -> Figure:
    figure = new_figure(4.6)
    axes = figure.subplots()
    is_candidate, is_on_front = placed["is_candidate"], placed["is_on_front"]
    _draw(axes, placed[~is_candidate], "incomplete", color=_GREY, mfc="none")
    others = placed[is_candidate & ~is_on_front]
    _draw(axes, others, "complete", color=_GREY, mec="none", alpha=0.7)
    # the stairs above and right of which all others lie
    looks: dict[str, Any] = {"color": ESTIMATES["smoothed"], "zorder": 3.0}
    _draw(axes, front, "front", ms=6.0, ls="-", lw=1.4, drawstyle="steps-post", **looks)
    for number, (x, y) in enumerate(front[["time", "error"]].to_numpy(), start=1):
        looks = {"textcoords": "offset points", "ha": "right", "va": "top"}
        axes.annotate(str(number), (x, y), (-5, -4), **looks)
    default = placed[placed.index == batch.default]
    _draw(axes, default, "default values", color="black", mfc="none", ms=12.0)
    (left, low), (right, high) = placed[["time", "error"]].agg(["min", "max"]).to_numpy()
    logarithmic_axis(axes, "x", ends=(left, right), n_ticks=8)
    logarithmic_axis(axes, "y", ends=(low, high), n_ticks=8)
    axes.set(xlabel="time over the mean [-]", ylabel="error over the mean [-]")
    legend_above(figure, axes)
    _write_names(axes, [shown(batch.labels[name], N_LABEL) for name in front.index])
    return figure


def _draw(axes: Axes, means: pd.DataFrame, label: str, **looks: Any) -> None:  # noqa: ANN401
    if len(means):
        looks = {"ls": "", "marker": "o", "ms": 5.0, "label": label, **looks}
        axes.plot(means["time"], means["error"], **looks)


def _write_names(axes: Axes, names: Sequence[str]) -> None:
    lines = [f"{number}: {name}" for number, name in enumerate(names, start=1)]
    if len(lines) > _MAX_NAMES:
        lines = [*lines[:_MAX_NAMES], f"... {len(lines) - _MAX_NAMES} more in the table"]
    text = "\n".join(["on the front, the fastest first", *lines])
    axes.text(1.03, 1.0, text, linespacing=1.5, transform=axes.transAxes, va="top", ha="left")
