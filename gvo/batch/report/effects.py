"""What a sweep tells: medians at each value of its parameters, and accuracy against time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd
from pandas.api.types import is_bool_dtype, is_numeric_dtype

from gvo._text import number_text, visible
from gvo.batch.effects import COUNTS, span, value_medians
from gvo.batch.report.values import N_LABEL, Batch, logarithmic_axis, shown, value_text
from gvo.viz.palette import ESTIMATES, REFUSED
from gvo.viz.report.page import table_html
from gvo.viz.report.sheets import WIDE, Plot, arrange, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PARAMETERS = 12
"""Of more only those with the largest ratios of medians are drawn."""

_N_COLUMNS = 4
_N_TITLE = 30
_N_LETTERS = 130
_LEAST_LETTERS = 5
_GREY = "#777777"
_COLOURS = {"error": ESTIMATES["smoothed"], "time": _GREY}
_VALUES_HEADER = ("parameter", "value", "error", "quartiles", "time", "quartiles", *COUNTS)
_MAX_NAMES = 16
_FRONT = "Accuracy against time"
_FRONT_HEADER = ("configuration", "number", "error", "time", "recordings")


def effect_sheets(batch: Batch) -> list[tuple[Plot, str]]:
    """Return the plots of errors and times by value of each parameter, the table below them."""
    effects = value_medians(batch.table)
    if not effects:
        return []
    kinds = ["error", "time"] if batch.has_errors else ["time"]
    tables = [""] * (len(kinds) - 1) + [table_html(_VALUES_HEADER, _value_rows(effects))]
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
    figure = new_figure(WIDE, 0.6 + 2.2 * n_rows)
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
    arrange(figure)
    figure.subplots_adjust(wspace=0.08, hspace=0.35, top=1.0 - 0.3 / (0.6 + 2.2 * n_rows))
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
    return plot, table_html(_FRONT_HEADER, rows)


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
    figure = new_figure(WIDE, 4.6)
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
    arrange(figure, axes)
    figure.subplots_adjust(right=0.66)
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
