"""The figure of `plot_trajectories`: paths from above, errors or positions over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gvo.io.run_folder.reader import Table, loop_ends
from gvo.trajectory.evaluation import evaluate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.figures import draw_curve, elapsed, legend_below, new_figure
from gvo.viz.measures import truth_around
from gvo.viz.palette import REFERENCE_STYLE, styles_of
from gvo.viz.plots import ground_plane
from gvo.viz.report.paths import Line, draw_lines, lines_of, loop_lines

_HEIGHT_INCHES = 5.5
POSITIONS = ("x [m]", "y [m]", "z [m]")
ANGLES = ("roll [deg]", "pitch [deg]", "yaw [deg]")


def figure_of_errors(
    reference: Trajectory,
    estimates: Mapping[str, Trajectory],
    loops: Table | None = None,
    **options: Any,  # noqa: ANN401 - of `evaluate`
) -> Figure:
    """Draw estimates aligned with a reference, their errors, and the loops of the last one."""
    compared = [evaluate(reference, e, name=name, **options) for name, e in estimates.items()]
    shown = truth_around(reference, compared)
    figure = new_figure(_HEIGHT_INCHES)
    view, errors = figure.subplots(1, 2)
    largest_m = max(float(c.errors_m.max()) for c in compared)
    unit, scale = ("mm", 1e3) if largest_m < 1.0 else ("m", 1.0)
    labelled = {f"{c.name} (ATE {scale * c.ate_m:.3g} {unit})": c.trajectory for c in compared}
    lines = lines_of(shown, labelled)
    ends = {} if not loops else loop_ends(loops, compared[-1].trajectory)
    marks = loop_lines({name: ends[name] for name in ends if name == "loops"})
    _draw_view(view, figure, [*lines, *marks], reference)
    for c, line in zip(compared, lines[1:], strict=True):
        elapsed_s = elapsed(c.reference.stamps_ns, int(shown.stamps_ns[0]))
        draw_curve(errors, elapsed_s, scale * c.errors_m, line.style)
    words = f"position error [{unit}], alignment: {options['align']}"
    errors.set(xlabel=stamp_label(shown), ylabel=words, ylim=(0.0, None))
    return figure


def figure_of_positions(estimates: Mapping[str, Trajectory]) -> Figure:
    """Draw estimates, and their positions over time."""
    figure = new_figure(_HEIGHT_INCHES)
    axes = figure.subplot_mosaic([["view", axis] for axis in "xyz"])
    _draw_view(axes["view"], figure, lines_of(None, estimates), next(iter(estimates.values())))
    draw_values([axes[axis] for axis in "xyz"], None, estimates, POSITIONS)
    return figure


def draw_values(
    panels: Sequence[Axes],
    reference: Trajectory | None,
    estimates: Mapping[str, Trajectory],
    labels: Sequence[str],
    values: Callable[[Trajectory], FloatArray] = lambda trajectory: trajectory.positions,
) -> None:
    """Draw values, shape (n, k), of trajectories over time, a panel for each of the k labels."""
    shown = [] if reference is None else [("truth", reference, REFERENCE_STYLE)]
    styles = styles_of(estimates)
    shown += [(*item, style) for item, style in zip(estimates.items(), styles, strict=True)]
    first_ns = min(int(trajectory.stamps_ns[0]) for _, trajectory, _ in shown)
    for name, trajectory, style in shown:
        elapsed_s = elapsed(trajectory.stamps_ns, first_ns)
        for panel, column in zip(panels, values(trajectory).T, strict=True):
            draw_curve(panel, elapsed_s, column, style, label=name)
    for panel, label in zip(panels, labels, strict=True):
        panel.set_ylabel(label)
        panel.tick_params(labelbottom=panel is panels[-1])
    panels[-1].set_xlabel(stamp_label(shown[0][1]))


def _draw_view(view: Axes, figure: Figure, lines: Sequence[Line], reference: Trajectory) -> None:
    plane = ground_plane(reference)
    draw_lines(view, lines, plane)
    horizontal, vertical = ("xyz"[axis] for axis in plane)
    view.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]")
    view.set_aspect("equal", adjustable="datalim")
    legend_below(figure, view)


def stamp_label(trajectory: Trajectory) -> str:
    """Return the label of an axis of time: poses without stamps are one second apart."""
    return "row" if trajectory.stamps_from == "rows" else "elapsed [s]"
