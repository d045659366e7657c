"""Errors over time and over the path, and drift by the length of segments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.outputs.palette import Style, styles_of
from gvo.outputs.report.measures import Comparison, Drift, drift, drift_lengths
from gvo.outputs.report.sheets import WIDE, Plot, arrange, draw_curve, elapsed, new_figure
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, SHORT_SEGMENTS_M
from gvo.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROW_HEIGHT = 2.1
_MANY = 8


def error_plots(comparisons: Sequence[Comparison], align: str) -> list[Plot]:
    """Return the errors over time and over the distance travelled."""
    first_ns = min(int(c.reference.stamps_ns[0]) for c in comparisons)
    is_by_row = any(c.reference.stamps_from == "rows" for c in comparisons)
    moved = "as they are" if align == "none" else f"aligned by {align.upper()}"
    rotations = (
        " Rotation errors are of the rotation since the first pose."
        if any(c.errors_rad is not None for c in comparisons)
        else " The truth holds no rotations: there are no rotation errors."
    )
    return [
        Plot(
            slug="errors_over_time",
            title="Errors over time",
            text=f"Position errors of the trajectories, {moved}."
            f"{rotations} Good curves are low and smooth; a step is a single bad frame.",
            figure=_curves(
                comparisons,
                lambda c: elapsed(c.reference.stamps_ns, first_ns),
                "row" if is_by_row else "elapsed [s]",
            ),
        ),
        Plot(
            slug="errors_over_distance",
            title="Errors over distance travelled",
            text="The same errors along the true path: a steady slope is drift, in metres per "
            "metre; where the camera stands, the curve must stand too.",
            figure=_curves(
                comparisons, lambda c: c.reference.distances(), "distance travelled [m]"
            ),
        ),
    ]


def _curves(
    comparisons: Sequence[Comparison], abscissa: Callable[[Comparison], FloatArray], label: str
) -> Figure:
    has_rotations = any(c.errors_rad is not None for c in comparisons)
    n_rows = 2 if has_rotations else 1
    figure = new_figure(WIDE, 0.9 + n_rows * _ROW_HEIGHT)
    rows = figure.subplots(n_rows, 1, sharex=True, squeeze=False)[:, 0]
    for c, style in zip(comparisons, styles_of(c.name for c in comparisons), strict=True):
        x, seconds = abscissa(c), c.reference.stamps_ns / 1e9
        text = f"{c.name} (RMSE {c.ate_m:.3g} m)"
        draw_curve(rows[0], x, c.errors_m, style, seconds=seconds, label=text)
        if c.errors_rad is not None:
            draw_curve(rows[1], x, np.rad2deg(c.errors_rad), style, seconds=seconds)
    rows[0].set_ylabel("position error [m]")
    if has_rotations:
        rows[1].set_ylabel("rotation error [deg]")
    for axes in rows:
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.01)
    rows[-1].set_xlabel(label)
    arrange(figure, rows[0])
    figure.align_ylabels(list(rows))
    return figure


def drift_plot(
    comparisons: Sequence[Comparison], *, asked_m: Sequence[float] | None = None
) -> Plot:
    """Return the drift by the length of segments.

    Parameters
    ----------
    comparisons : sequence of Comparison
    asked_m : sequence of float, optional
        Lengths that were asked for, metres; those that suit the path where omitted.
    """
    title = "Drift by length of segment"
    path_m = max(float(c.reference.distances()[-1]) for c in comparisons)
    usual = (KITTI_SEGMENTS_M, SHORT_SEGMENTS_M)
    is_asked = asked_m is not None and tuple(asked_m) not in usual
    lengths = tuple(asked_m) if asked_m is not None and is_asked else drift_lengths(path_m)
    found = [(c.name, drift(c, lengths)) for c in comparisons]
    drifts = [(name, item) for name, item in found if item is not None]
    if not drifts:
        reason = (
            "the truth holds positions without rotations, segments cannot be compared"
            if any(c.errors_rad is None for c in comparisons)
            else f"the path of {path_m:.2g} m is too short for segments"
        )
        return Plot(slug="drift", title=title, text=f"Not drawn: {reason}.")
    origin = (
        "the standard lengths of the KITTI benchmark"
        if lengths == KITTI_SEGMENTS_M
        else "the lengths asked for"
        if is_asked
        else f"round lengths that suit a path of {path_m:.3g} m"
    )
    n_least = int(drifts[0][1].n_segments[-1])
    text = (
        f"Mean error over all segments of a length, as KITTI's devkit takes it; {origin}. "
        "Translation drift falls with the length where noise is random, and is level where a "
        "scale or a direction is wrong; rotation drift should fall as well. The longest point "
        f"is the mean of {n_least} overlapping segments."
    )
    return Plot(slug="drift", title=title, text=text, figure=_drift_figure(found))


def _drift_figure(found: Sequence[tuple[str, Drift | None]]) -> Figure:
    figure = new_figure(WIDE, 3.5)
    panels: Any = figure.subplots(1, 2)
    styles = styles_of(name for name, _ in found)
    for index, ((name, item), style) in enumerate(zip(found, styles, strict=True)):
        if item is None:
            continue
        _draw_drift(panels, name, item, style, marker="osD^vP*X"[index % _MANY])
    panels[0].set(xlabel="length of segment [m]", ylabel="translation error [%]")
    panels[1].set(xlabel="length of segment [m]", ylabel="rotation error [deg/m]")
    for axes in panels:
        axes.set_ylim(0.0, 1.1 * axes.dataLim.y1 or 1.0)
        axes.set_xlim(left=0.0)
    arrange(figure, panels[0])
    figure.subplots_adjust(wspace=0.2)
    return figure


def _draw_drift(panels: Any, name: str, item: Drift, style: Style, *, marker: str) -> None:  # noqa: ANN401
    from gvo.outputs.drawing import plain

    looks = {"color": style.color, "linestyle": style.linestyle, "marker": marker, "ms": 4.5}
    panels[0].plot(item.lengths_m, item.translations_pct, label=plain(name), **looks)
    panels[1].plot(item.lengths_m, item.rotations_deg_per_m, **looks)
