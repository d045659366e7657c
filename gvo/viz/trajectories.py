"""The figure of `plot_trajectories`: paths from above, errors or positions over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz import figures
from gvo.viz.figures import HOLLOW, broken
from gvo.viz.measures import compare
from gvo.viz.palette import REFERENCE_STYLE, Style, styles_of
from gvo.viz.plots import ground_plane

_HEIGHT_INCHES = 5.5


def figure_of_errors(
    reference: Trajectory, estimates: Mapping[str, Trajectory], align: AlignMode
) -> Figure:
    """Draw estimates aligned with a reference, and their errors."""
    compared = [compare(reference, e, name=name, align=align) for name, e in estimates.items()]
    first_ns = min(int(each.reference.stamps_ns[0]) for each in compared)
    last_ns = max(int(each.reference.stamps_ns[-1]) for each in compared)
    shown = _around(reference, first_ns, last_ns)
    figure = figures.new_figure(_HEIGHT_INCHES)
    view, errors = figure.subplots(1, 2)
    plane = ground_plane(reference)
    _draw_path(view, shown, plane, REFERENCE_STYLE, "reference")
    for each, style in zip(compared, styles_of(estimates), strict=True):
        label = f"{figures.plain(each.name)} (ATE {each.ate_m:.3g} m)"
        _draw_path(view, each.trajectory, plane, style, label)
        elapsed_s = figures.elapsed(each.reference.stamps_ns, int(shown.stamps_ns[0]))
        _draw_values(errors, elapsed_s, each.errors_m, style)
    _mark_start(view, shown, plane)
    words = f"position error [m], alignment: {align}"
    errors.set(xlabel=_stamp_label(shown), ylabel=words, ylim=(0.0, None))
    figures.legend_below(figure, view)
    return figure


def figure_of_positions(estimates: Mapping[str, Trajectory]) -> Figure:
    """Draw estimates, and their positions over time."""
    start = min(estimates.values(), key=lambda estimate: int(estimate.stamps_ns[0]))
    plane = ground_plane(next(iter(estimates.values())))
    figure = figures.new_figure(_HEIGHT_INCHES)
    axes = figure.subplot_mosaic([["view", axis] for axis in "xyz"])
    view, panels = axes["view"], [axes[axis] for axis in "xyz"]
    for (name, estimate), style in zip(estimates.items(), styles_of(estimates), strict=True):
        _draw_path(view, estimate, plane, style, figures.plain(name))
        elapsed_s = figures.elapsed(estimate.stamps_ns, int(start.stamps_ns[0]))
        for axis, panel in enumerate(panels):
            _draw_values(panel, elapsed_s, estimate.positions[:, axis], style)
    _mark_start(view, start, plane)
    for letter, panel in zip("xyz", panels, strict=True):
        panel.set_ylabel(f"{letter} [m]")
        panel.tick_params(labelbottom=letter == "z")
    panels[-1].set_xlabel(_stamp_label(start))
    figures.legend_below(figure, view)
    return figure


def _around(reference: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    """Return the reference from its last pose before the first stamp to the last stamp."""
    start = int(np.searchsorted(reference.stamps_ns, first_ns, side="right")) - 1
    end = int(np.searchsorted(reference.stamps_ns, last_ns))
    return reference.select(slice(max(start, 0), end + 1))


def _draw_path(
    view: Axes, trajectory: Trajectory, plane: tuple[int, int], style: Style, label: str
) -> None:
    points = broken(trajectory.stamps_ns / 1e9, trajectory.positions[:, plane])
    view.plot(*points.T, label=label, **asdict(style))


def _draw_values(axes: Axes, elapsed: FloatArray, values: FloatArray, style: Style) -> None:
    axes.plot(*broken(elapsed, np.column_stack([elapsed, values])).T, **asdict(style))


def _mark_start(view: Axes, start: Trajectory, plane: tuple[int, int]) -> None:
    view.plot(*start.positions[:1, plane].T, "o", label="start", **HOLLOW)
    horizontal, vertical = ("xyz"[axis] for axis in plane)
    view.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]")
    view.set_aspect("equal", adjustable="datalim")


def _stamp_label(trajectory: Trajectory) -> str:
    # poses without stamps are one second apart
    return "row" if trajectory.stamps_from == "rows" else "elapsed [s]"
