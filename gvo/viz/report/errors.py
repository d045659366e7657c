"""Errors over time and distance, drift, and consistency with the covariances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, SHORT_SEGMENTS_M, Consistency
from gvo.types import FloatArray
from gvo.viz.palette import ESTIMATES, Style, styles_of
from gvo.viz.plots import plain
from gvo.viz.report.measures import Comparison, Drift, drift, drift_lengths
from gvo.viz.report.sheets import (
    WIDE,
    Plot,
    arrange,
    draw_curve,
    elapsed,
    kept_of_curve,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROW_HEIGHT = 2.1
_N_COLUMNS = 350
_SIGMAS = 3.0
_FLOOR = 0.01  # of the logarithmic axis
_RAW = Style(color=ESTIMATES["raw"], linewidth=1.1, zorder=3.0)
_ALIGNED = {
    "none": "without alignment",
    "origin": "with the first poses aligned",
    "se3": "after SE(3) alignment",
    "sim3": "after Sim(3) alignment",
}
# index into errors, letter and unit: translations in the upper row, rotations below
_PANELS = (
    *((3, "x", "m"), (4, "y", "m"), (5, "z", "m")),
    *((0, "x", "deg"), (1, "y", "deg"), (2, "z", "deg")),
)


def error_plots(comparisons: Sequence[Comparison], align: AlignMode) -> list[Plot]:
    """Return the errors over time and over the distance travelled."""
    rotations = (
        "Rotation errors are those of the rotation since the first pose."
        if any(c.errors_rad is not None for c in comparisons)
        else "The ground truth holds no rotations: there are no rotation errors."
    )
    return [
        Plot(
            slug="errors_over_time",
            text=f"Position errors {_ALIGNED[align]}. {rotations} "
            "Good curves are low and smooth; a step is a single bad frame.",
            figure=_curves_over_time(comparisons),
        ),
        Plot(
            slug="errors_over_distance",
            text="The same errors over the distance along the true path: a steady slope is drift "
            "in metres per metre; while the camera stands still, so must the curve.",
            figure=_curves(
                comparisons, lambda c: c.reference.distances(), "distance travelled [m]"
            ),
        ),
    ]


def _curves_over_time(comparisons: Sequence[Comparison]) -> Figure:
    first_ns = min(int(c.reference.stamps_ns[0]) for c in comparisons)
    is_by_row = any(c.reference.stamps_from == "rows" for c in comparisons)
    label = "row" if is_by_row else "elapsed [s]"
    return _curves(comparisons, lambda c: elapsed(c.reference.stamps_ns, first_ns), label)


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
        Lengths asked for, metres; lengths that suit the path where omitted.
    """
    path_m = max(float(c.reference.distances()[-1]) for c in comparisons)
    is_asked = asked_m is not None and tuple(asked_m) not in (KITTI_SEGMENTS_M, SHORT_SEGMENTS_M)
    lengths = tuple(asked_m) if asked_m is not None and is_asked else drift_lengths(path_m)
    found = [(c.name, drift(c, lengths)) for c in comparisons]
    n_segments = next((int(item.n_segments[-1]) for _, item in found if item is not None), None)
    if n_segments is None:
        reason = (
            "the ground truth holds no rotations, which segments are compared by"
            if any(c.errors_rad is None for c in comparisons)
            else f"the path of {path_m:.2g} m is too short for segments"
        )
        return Plot(slug="drift", text=f"Not drawn: {reason}.")
    origin = "the lengths asked for" if is_asked else f"round lengths for a path of {path_m:.3g} m"
    if lengths == KITTI_SEGMENTS_M:
        origin = "the standard lengths of the KITTI benchmark"
    return Plot(
        slug="drift",
        text=f"Mean error over all segments of a length, as in KITTI's devkit; {origin}. "
        "Translation drift falls with the length where errors are random, and stays level where "
        "scale or heading is biased; rotation drift should fall as well. The longest length is "
        f"the mean of {n_segments} overlapping segments.",
        figure=_drift_figure(found),
    )


def _drift_figure(found: Sequence[tuple[str, Drift | None]]) -> Figure:
    figure = new_figure(WIDE, 3.5)
    panels: Any = figure.subplots(1, 2)
    styles = styles_of(name for name, _ in found)
    for (name, item), style, marker in zip(found, styles, cycle("osD^vP*X"), strict=False):
        if item is not None:
            _draw_drift(panels, name, item, style, marker=marker)
    panels[0].set(xlabel="length of segment [m]", ylabel="translation error [%]")
    panels[1].set(xlabel="length of segment [m]", ylabel="rotation error [deg/m]")
    for axes in panels:
        axes.set_ylim(0.0, 1.1 * axes.dataLim.y1 or 1.0)
        axes.set_xlim(left=0.0)
    arrange(figure, panels[0])
    figure.subplots_adjust(wspace=0.2)
    return figure


def _draw_drift(panels: Any, name: str, item: Drift, style: Style, *, marker: str) -> None:  # noqa: ANN401
    looks = {"color": style.color, "linestyle": style.linestyle, "marker": marker, "ms": 4.5}
    panels[0].plot(item.lengths_m, item.translations_pct, label=plain(name), **looks)
    panels[1].plot(item.lengths_m, item.rotations_deg_per_m, **looks)


def covariance_plot(item: Consistency, first_ns: int) -> Plot:
    """Return errors of motions with their 3-sigma bands.

    Parameters
    ----------
    item : Consistency
        Of the raw chain over a second.
    first_ns : int
        Stamp of elapsed time zero.
    """
    inside = 100.0 * np.mean(np.abs(item.errors) <= _SIGMAS * item.sigmas, axis=0)
    return Plot(
        slug="covariance",
        text=f"Errors of the motion, {item.name}, along the axes of its last pose, with the "
        f"stated 3-sigma bands; nothing is aligned. Inside are {inside[3:].mean():.1f} % of the "
        f"position and {inside[:3].mean():.1f} % of the rotation errors; 99.7 % where the "
        "covariances fit and the truth is exact. Noise of the true poses counts as error.",
        figure=_bands(item, first_ns),
    )


def _bands(item: Consistency, first_ns: int) -> Figure:
    figure = new_figure(WIDE, 5.2)
    panels: Any = figure.subplots(2, 3, sharex=True)
    x = elapsed(item.end_ns, first_ns)
    for panel, (index, letter, unit) in zip(panels.flat, _PANELS, strict=True):
        factor = 1.0 if unit == "m" else float(np.rad2deg(1.0))
        _draw_band(panel, x, _SIGMAS * factor * item.sigmas[:, index])
        y = factor * item.errors[:, index]
        draw_curve(panel, x, y, _RAW, label=item.name, n_columns=_N_COLUMNS)
        kind = "position" if unit == "m" else "rotation"
        panel.set_ylabel(f"{kind} {letter} [{unit}]")
    for panel in panels[-1]:
        panel.set_xlabel("elapsed [s]")
    arrange(figure, panels[0, 0])
    figure.subplots_adjust(wspace=0.4, hspace=0.1)
    figure.align_ylabels()
    return figure


def _draw_band(axes: Any, x: FloatArray, reach: FloatArray) -> None:  # noqa: ANN401
    kept = kept_of_curve(x, reach, n_columns=_N_COLUMNS)
    x, reach = x[kept], reach[kept]
    label = "\u00b13 sigma"
    if len(x) == 1:  # a band of one pose has no area
        axes.plot([x[0], x[0]], [-reach[0], reach[0]], color=_RAW.color, marker="_", label=label)
    else:
        axes.fill_between(x, -reach, reach, color=_RAW.color, alpha=0.2, lw=0, label=label)
