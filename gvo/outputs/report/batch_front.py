"""The front of accuracy against time: the configurations that no other beats in both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gvo.outputs.report.batch_axes import logarithmic_axis
from gvo.outputs.report.batch_values import N_LABEL, Batch, number_text, printable, shown
from gvo.parameter_effects import VariantMean
from gvo.viz.palette import ESTIMATES
from gvo.viz.report.page import table_html
from gvo.viz.report.sheets import WIDE, Plot, arrange, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TITLE = "Accuracy against time"
_GREY = "#777777"
_MAX_NAMES = 16
_HEADER = ("configuration", "number", "error", "time", "recordings")


def front_sheet(batch: Batch) -> tuple[Plot, str]:
    """Return the plot and the table of the front."""
    placed = [m for m in batch.means if m.error_ratio is not None and m.time_ratio is not None]
    front = sorted((m for m in placed if m.is_on_front), key=lambda m: m.time_ratio or 0.0)
    if not front:
        why = (
            "no recording was completed by all configurations that completed most."
            if batch.has_errors and batch.has_times
            else "no run has both an error and a time."
        )
        return Plot(slug="front", title=_TITLE, text=f"Not drawn: {why}"), ""
    plot = Plot(
        slug="front", title=_TITLE, text=_words(batch, placed), figure=_figure(batch, placed, front)
    )
    rows = [
        [
            printable(mean.name),
            str(number),
            number_text(mean.error_ratio, ".3f"),
            number_text(mean.time_ratio, ".3f"),
            f"{mean.n_compared} of {mean.n_recordings}",
        ]
        for number, mean in enumerate(front, start=1)
    ]
    return plot, table_html(_HEADER, rows)


def _words(batch: Batch, placed: Sequence[VariantMean]) -> str:
    n_candidates = sum(mean.is_candidate for mean in placed)
    n_done, n_all = placed[0].n_compared, placed[0].n_recordings
    words = (
        "Geometric means of the smoothed ATE and of the time of a frame, over those of the mean "
        "configuration. Below and to the left is better; no configuration is both more accurate "
        f"and faster than one on the line. {n_candidates} of {len(batch.means)} configurations "
    )
    words += (
        f"have a comparable run of each of the {n_all} recordings."
        if n_done == n_all
        else f"have a comparable run of {n_done} of the {n_all} recordings, which is the most; "
        "compared are the recordings that they share."
    )
    if any(not mean.is_candidate for mean in placed):
        words += (
            " Hollow points lack runs of some: they are placed by the others, and are not on the "
            "front, as what they failed at would count for them."
        )
    return words + batch.label_words


def _figure(batch: Batch, placed: Sequence[VariantMean], front: Sequence[VariantMean]) -> Figure:
    figure = new_figure(WIDE, 4.6)
    axes = figure.subplots()
    others = [mean for mean in placed if mean.is_candidate and not mean.is_on_front]
    partial = [mean for mean in placed if not mean.is_candidate]
    _draw(axes, partial, "incomplete", color=_GREY, mfc="none")
    _draw(axes, others, "complete", color=_GREY, mec="none", alpha=0.7)
    _draw_front(axes, front)
    _draw(
        axes,
        [mean for mean in placed if mean.name == batch.default],
        "default values",
        color="black",
        mfc="none",
        ms=12.0,
    )
    logarithmic_axis(axes, "x", ends=_ends([mean.time_ratio for mean in placed]), n_ticks=8)
    logarithmic_axis(axes, "y", ends=_ends([mean.error_ratio for mean in placed]), n_ticks=8)
    axes.set(xlabel="time over the mean [-]", ylabel="error over the mean [-]")
    arrange(figure, axes)
    figure.subplots_adjust(right=0.66)
    _write_names(axes, [shown(batch.labels[mean.name], N_LABEL) for mean in front])
    return figure


def _ends(values: Sequence[float | None]) -> tuple[float, float]:
    known = [value for value in values if value is not None]
    return min(known), max(known)


def _draw(axes: Axes, means: Sequence[VariantMean], label: str, **looks: Any) -> None:  # noqa: ANN401
    if means:
        xs, ys = _points(means)
        axes.plot(xs, ys, **{"ls": "", "marker": "o", "ms": 5.0, "label": label, **looks})


def _points(means: Sequence[VariantMean]) -> tuple[list[float], list[float]]:
    return [mean.time_ratio or 0.0 for mean in means], [mean.error_ratio or 0.0 for mean in means]


def _draw_front(axes: Axes, front: Sequence[VariantMean]) -> None:
    """Draw the stairs above and right of which all others lie, with numbered corners."""
    xs, ys = _points(front)
    looks: dict[str, Any] = {"color": ESTIMATES["smoothed"], "zorder": 3.0}
    axes.plot(xs, ys, drawstyle="steps-post", lw=1.4, **looks)
    axes.plot(xs, ys, ls="", marker="o", ms=6.0, label="front", **looks)
    for number, (x, y) in enumerate(zip(xs, ys, strict=True), start=1):
        axes.annotate(
            str(number), (x, y), (-5, -4), textcoords="offset points", ha="right", va="top"
        )


def _write_names(axes: Axes, names: Sequence[str]) -> None:
    lines = [f"{number}: {name}" for number, name in enumerate(names, start=1)]
    if len(lines) > _MAX_NAMES:
        lines = [*lines[:_MAX_NAMES], f"... {len(lines) - _MAX_NAMES} more in the table"]
    place: dict[str, Any] = {"transform": axes.transAxes, "va": "top", "ha": "left"}
    axes.text(1.03, 1.0, "on the front, the fastest first", color=_GREY, **place)
    axes.text(1.03, 0.94, "\n".join(lines), linespacing=1.5, **place)
