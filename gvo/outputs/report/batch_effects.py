"""What a sweep tells: marginal means of each parameter's values, and how much it explains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gvo.outputs.report.batch_axes import logarithmic_axis
from gvo.outputs.report.batch_values import (
    Batch,
    number_text,
    printable,
    shown,
    value_text,
)
from gvo.parameter_effects import ParameterEffect, ValueEffect, parameter_effects
from gvo.viz.palette import ESTIMATES, REFUSED
from gvo.viz.report.page import table_html
from gvo.viz.report.sheets import WIDE, Plot, arrange, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PARAMETERS = 12
"""With more only those that explain most are drawn."""

_N_COLUMNS = 4
_N_TITLE = 30
_N_NAME = 44
_N_LETTERS = 130
_LEAST_LETTERS = 5
_MAX_REACH = 4.0
_COLOURS = {"error": ESTIMATES["smoothed"], "time": "#777777"}
_HEADER = (
    "parameter",
    "value",
    "error",
    "95 % interval",
    "time",
    "95 % interval",
    "compared",
    "set aside",
    "failed",
)
_SHARE_HEADER = ("parameter", "explains [%]", "by chance [%]", "worst over best", "recordings")


def effect_sheets(batch: Batch) -> list[tuple[Plot, str]]:
    """Return plots, each with the table below it: importance, errors and times by value."""
    errors = parameter_effects(batch.runs, batch.errors_m)
    times = parameter_effects(batch.runs, batch.times_ms)
    kind = "error" if batch.has_errors else "time"
    main = errors if batch.has_errors else times
    return [
        (_importance_plot(main, kind), _share_table(main)),
        *([(_values_plot(errors, "error", batch), "")] if batch.has_errors else []),
        (_values_plot(times, "time", batch), _values_table(main, errors, times)),
    ]


def _importance_plot(effects: Sequence[ParameterEffect], kind: str) -> Plot:
    title = f"What matters for the {kind}"
    told = [effect for effect in effects if effect.share is not None]
    if not told:
        return Plot(slug="importance", title=title, text=f"Not drawn: {_untold_words(effects)}")
    words = (
        f"Share of the variance of the {kind} (of its logarithm, about the mean of each recording) "
        "that each parameter explains alone, by eta squared: 100 % where nothing else changes "
        "it. The tick is what a parameter without any effect would explain by chance. The rest is "
        "interactions, of parameters with each other and with recordings."
    )
    if len(told) < len(effects):
        words += f" Not drawn: {_untold_words(effects)}"
    figure = _importance_figure(told[:MAX_PARAMETERS], _rest(told), _COLOURS[kind])
    return Plot(slug="importance", title=title, text=words, figure=figure)


def _untold_words(effects: Sequence[ParameterEffect]) -> str:
    names = ", ".join(effect.name for effect in effects if effect.share is None)
    return (
        f"{printable(names)}: no two values can be told apart, as no recording has comparable runs "
        "of both, or the values changed only together with those of another parameter."
    )


def _rest(told: Sequence[ParameterEffect]) -> float:
    return max(0.0, 1.0 - math.fsum(effect.share or 0.0 for effect in told))


def _importance_figure(told: Sequence[ParameterEffect], rest: float, colour: str) -> Figure:
    names = [*(shown(effect.name, _N_NAME) for effect in told), "rest"]
    shares = [100.0 * (effect.share or 0.0) for effect in told]
    figure = new_figure(WIDE, 0.7 + 0.3 * len(names))
    axes = figure.subplots()
    axes.barh(range(len(told)), shares, height=0.62, color=colour)
    axes.barh(len(told), 100.0 * rest, height=0.62, color="#cccccc")
    for y, effect in enumerate(told):
        chance = 100.0 * (effect.chance_share or 0.0)
        label = "explained by chance" if y == 0 else "_"
        axes.plot([chance, chance], [y - 0.38, y + 0.38], color="black", lw=1.6, label=label)
    for y, share in enumerate([*shares, 100.0 * rest]):
        reach = max(share, 100.0 * (told[y].chance_share or 0.0) if y < len(told) else 0.0)
        axes.text(reach + 0.8, y, f"{share:.1f} %", va="center")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(0.0, 108.0)
    axes.set_xticks(range(0, 101, 20))
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("share of the variance [%]")
    arrange(figure, axes, left=0.4 + 0.07 * max(map(len, names)))
    return figure


def _values_plot(effects: Sequence[ParameterEffect], kind: str, batch: Batch) -> Plot:
    slug, title = f"{kind}_by_value", f"{kind.capitalize()} by value of each parameter"
    told = [effect for effect in effects if effect.share is not None]
    if not told:
        return Plot(slug=slug, title=title, text=f"Not drawn: {_untold_words(effects)}")
    words = [
        f"Marginal mean of the {kind} at each value, the other parameters alike, over that of all "
        "values; compared within recordings only. 0.5 is half as much."
    ]
    if len(set(batch.runs.recordings)) > 1:
        words.append(
            "Bars are 95 % intervals (Student's) over the recordings; what reaches over "
            f"{_MAX_REACH:g} times beyond all means is cut."
        )
    else:
        words.append("There is one recording: nothing tells how far its means hold for others.")
    if any(each.n_failed for effect in told for each in effect.values):
        words.append(
            "Red are the runs that failed: they are in no mean, and a value with more of them is "
            "worse than its mean."
        )
    if len(told) > MAX_PARAMETERS:
        words.append(f"Drawn are the {MAX_PARAMETERS} parameters that explain most.")
    figure = _values_figure(told[:MAX_PARAMETERS], kind, _COLOURS[kind])
    return Plot(slug=slug, title=title, text=" ".join(words), figure=figure)


def _values_figure(told: Sequence[ParameterEffect], kind: str, colour: str) -> Figure:
    n_columns = min(_N_COLUMNS, max(len(told), 2))
    n_rows = -(-len(told) // n_columns)
    figure = new_figure(WIDE, 0.6 + 2.2 * n_rows)
    panels: Any = figure.subplots(n_rows, n_columns, sharey=True, squeeze=False)
    for axes, effect in zip(panels.flat, told, strict=False):
        _draw_values(axes, effect, colour, _N_LETTERS // n_columns)
    for axes in panels.flat[len(told) :]:
        axes.set_axis_off()
    ends = _ends([each for effect in told for each in effect.values])
    for row in panels:
        logarithmic_axis(row[0], "y", ends=ends, n_ticks=9)
        row[0].set_ylabel(f"{kind} over the mean [-]")
    arrange(figure)
    figure.subplots_adjust(wspace=0.08, hspace=0.35, top=1.0 - 0.3 / (0.6 + 2.2 * n_rows))
    return figure


def _ends(drawn: Sequence[ValueEffect]) -> tuple[float, float]:
    """Return the least and the largest number to be seen, with room for the words on top."""
    ratios = [each.ratio for each in drawn if each.ratio is not None]
    least, most = min(ratios) / _MAX_REACH, max(ratios) * _MAX_REACH
    low = max(least, min(each.low or each.ratio or most for each in drawn))
    high = min(most, max(each.high or each.ratio or least for each in drawn))
    has_words = any(each.n_failed for each in drawn)
    return low, high * (max(high / low, 1.2) ** 0.15 if has_words else 1.0)


def _draw_values(axes: Axes, effect: ParameterEffect, colour: str, n_letters: int) -> None:
    told = [(x, each) for x, each in enumerate(effect.values) if each.ratio is not None]
    xs, ratios = [x for x, _ in told], [each.ratio or math.nan for _, each in told]
    is_number = all(type(each.value) in (int, float) for each in effect.values)
    axes.axhline(1.0, color="black", lw=0.8, ls=":")
    axes.plot(xs, ratios, color=colour, ls="-" if is_number else "", lw=1.0, marker="o", ms=5.0)
    for x, each in told:
        if each.low is not None and each.high is not None:
            axes.plot([x, x], [each.low, each.high], color=colour, lw=1.6, marker="_", ms=6.0)
    for x, each in enumerate(effect.values):
        if each.n_failed:
            words = f"{each.n_failed} failed" if len(effect.values) < 5 else str(each.n_failed)
            place = axes.get_xaxis_transform()
            axes.text(x, 0.98, words, color=REFUSED, ha="center", va="top", transform=place)
    step, texts = _tick_texts([each.value for each in effect.values], n_letters, is_number)
    axes.set_xticks(range(0, len(texts), step), texts[::step])
    axes.set_xlim(-0.5, len(effect.values) - 0.5)
    axes.set_title(shown(effect.name, _N_TITLE))


def _tick_texts(values: Sequence[object], n_letters: int, is_number: bool) -> tuple[int, list[str]]:
    """Return the texts below a panel as wide as some letters, and that only each n-th fits."""
    if is_number:
        texts = [f"{each:.3g}" if isinstance(each, float) else value_text(each) for each in values]
        return -(-len(texts) * (max(map(len, texts)) + 1) // n_letters), texts
    n_most = max(_LEAST_LETTERS, n_letters // len(values) - 1)
    step = -(-len(values) * _LEAST_LETTERS // n_letters)
    return step, [shown(value_text(value), n_most) for value in values]


def _share_table(effects: Sequence[ParameterEffect]) -> str:
    told = [effect for effect in effects if effect.share is not None]
    return table_html(_SHARE_HEADER, map(_share_row, told)) if told else ""


def _share_row(effect: ParameterEffect) -> list[str]:
    shares = (effect.share, effect.chance_share)
    percents = [None if share is None else 100.0 * share for share in shares]
    numbers = [number_text(percent, ".1f") for percent in percents]
    name, span = printable(effect.name), number_text(effect.span, ".3f")
    return [name, *numbers, span, str(effect.n_recordings)]


def _values_table(
    main: Sequence[ParameterEffect],
    errors: Sequence[ParameterEffect],
    times: Sequence[ParameterEffect],
) -> str:
    """Return the table of all values, the parameters in the order of their importance."""
    by_name = [{effect.name: effect.values for effect in effects} for effects in (errors, times)]
    rows = []
    for effect in main:
        for n, each in enumerate(effect.values):
            name = printable(effect.name) if n == 0 else ""
            numbers = [text for values in by_name for text in _ratio_texts(values[effect.name][n])]
            counts = [str(count) for count in (each.n_compared, each.n_set_aside, each.n_failed)]
            rows.append([name, value_text(each.value), *numbers, *counts])
    return table_html(_HEADER, rows)


def _ratio_texts(each: ValueEffect) -> list[str]:
    ends = [
        number_text(end, ".3f" if end and end < 100.0 else ".1e") for end in (each.low, each.high)
    ]
    return [number_text(each.ratio, ".3f"), "-" if each.low is None else " to ".join(ends)]
