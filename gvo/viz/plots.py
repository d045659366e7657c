"""Trajectories and errors with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz import figures
from gvo.viz.figures import HOLLOW, broken
from gvo.viz.measures import compare
from gvo.viz.names import check_suffix
from gvo.viz.palette import REFERENCE_STYLE, Style, styles_of

_FLAT = 0.05  # extent of a flat axis, relative to another
_DOWN = 0.8  # cosine, on the mean, of the camera's y axis and that of a world whose y points down
_HEIGHT_INCHES = 5.5


def plot_trajectories(
    path: str | Path,
    reference: Trajectory | None,
    estimates: Mapping[str, Trajectory],
    *,
    align: AlignMode = "se3",
) -> None:
    """Draw trajectories from above, and their errors (or positions) over time.

    Equal input gives equal files.

    Parameters
    ----------
    path : str or Path
        With suffix .png, .pdf or .svg.
    reference : Trajectory or None
        Without one, positions over time are drawn instead of errors.
    estimates : mapping of str to Trajectory
        By name, at least one; "raw", "causal", "smoothed" and "global" have fixed colours.
    align : {"none", "origin", "se3", "sim3"}
        Alignment of each estimate with the reference.

    Raises
    ------
    ConfigurationError
        When the file name has another suffix.
    TrajectoryError
        When an estimate and the reference have no pose in common, or the file cannot be written.
    ValueError
        When there is no estimate, or one without poses.
    """
    path = Path(path)
    check_suffix(path)
    if not estimates or any(len(estimate) == 0 for estimate in estimates.values()):
        raise ValueError("expected at least one estimate, and poses in each")
    with figures.style():
        if reference is None:
            figure = _figure_of_positions(estimates)
        else:
            figure = _figure_of_errors(reference, estimates, align)
        figures.save_figure(figure, path)


def _figure_of_errors(
    reference: Trajectory, estimates: Mapping[str, Trajectory], align: AlignMode
) -> Figure:
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


def _figure_of_positions(estimates: Mapping[str, Trajectory]) -> Figure:
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
    figure.align_ylabels(panels)
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


def is_of_camera(reference: Trajectory) -> bool:
    """Tell whether the world has camera axes: x right, y down, z forward.

    True if the first pose is the identity, or y of the camera points along y of the world mostly,
    and the path is not flat along z, as that of a robot with z up is. Positions without rotations
    do not tell.
    """
    if len(reference) == 0 or not reference.has_rotations:
        return False
    extents = np.ptp(reference.positions, axis=0)
    T = reference.T_world_frame
    is_down = np.allclose(T[0], np.eye(4), atol=1e-3) or T[:, 1, 1].mean() > _DOWN
    return bool(is_down and extents[2] >= _FLAT * extents[1])


def ground_plane(reference: Trajectory) -> tuple[int, int]:
    """Return the horizontal axes: x and z with camera axes, else x and y, z up."""
    return (0, 2) if is_of_camera(reference) else (0, 1)
