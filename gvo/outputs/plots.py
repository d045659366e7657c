"""Pictures of trajectories: the view from above and the errors over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvo.errors import ConfigurationError
from gvo.outputs.drawing import METADATA, broken, ground_plane, plain, save_figure
from gvo.outputs.palette import REFERENCE_STYLE, Style, styles_of
from gvo.trajectory.alignment import AlignMode, alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE_INCHES = (11.0, 5.5)
_LEGEND_CHARACTERS = 135


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Curve:
    """An estimate in the world of the picture, with its errors where there is a reference."""

    label: str
    trajectory: Trajectory
    stamps_ns: IntArray
    errors_m: FloatArray


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
        Ends in .png, .pdf or .svg.
    reference : Trajectory or None
        Without one the positions are drawn over time in place of the errors.
    estimates : mapping of str to Trajectory
        By name, at least one; "raw", "causal" and "smoothed" have colours of their own.
    align : {"none", "origin", "se3", "sim3"}
        What moves each estimate onto the reference.

    Raises
    ------
    ConfigurationError
        Where the file name ends otherwise.
    TrajectoryError
        Where an estimate has nothing in common with the reference, or the file cannot be
        written.
    ValueError
        Where there is no estimate, or one without poses.
    """
    path = Path(path)
    if path.suffix.lower() not in METADATA:
        raise ConfigurationError(
            f"{path}: the plot's file name ends in {path.suffix!r}, "
            f"expected one of {', '.join(METADATA)}"
        )
    if not estimates or any(len(estimate) == 0 for estimate in estimates.values()):
        raise ValueError("expected at least one estimate, and poses in each")
    styles = styles_of(estimates)
    if reference is None:
        figure = _figure_of_positions(estimates, styles)
    else:
        figure = _figure_of_errors(reference, estimates, styles, align)
    save_figure(figure, path)


def _figure_of_errors(
    reference: Trajectory,
    estimates: Mapping[str, Trajectory],
    styles: Sequence[Style],
    align: AlignMode,
) -> Figure:
    curves = [_aligned(reference, name, estimate, align) for name, estimate in estimates.items()]
    first_ns = min(int(curve.stamps_ns[0]) for curve in curves)
    last_ns = max(int(curve.stamps_ns[-1]) for curve in curves)
    shown = _around(reference, first_ns, last_ns)
    figure = _new_figure()
    view, errors = figure.subplots(1, 2)
    plane = ground_plane(reference)
    _draw_path(view, shown, plane, REFERENCE_STYLE, "reference")
    for curve, style in zip(curves, styles, strict=True):
        _draw_path(view, curve.trajectory, plane, style, curve.label)
        _draw(errors, _elapsed(curve.stamps_ns, shown), curve.errors_m, style)
    _finish_view(view, shown, plane)
    errors.set(xlabel=_stamp_label(shown), ylabel=f"position error [m], alignment: {align}")
    errors.set_ylim(bottom=0.0)
    errors.grid(alpha=0.3)
    _add_legend(figure, view)
    return figure


def _figure_of_positions(estimates: Mapping[str, Trajectory], styles: Sequence[Style]) -> Figure:
    start = min(estimates.values(), key=lambda estimate: int(estimate.stamps_ns[0]))
    figure = _new_figure()
    axes = figure.subplot_mosaic([["view", axis] for axis in "xyz"])
    view, panels = axes["view"], [axes[axis] for axis in "xyz"]
    for (name, estimate), style in zip(estimates.items(), styles, strict=True):
        _draw_path(view, estimate, (0, 2), style, plain(name))
        elapsed = _elapsed(estimate.stamps_ns, start)
        for axis, panel in enumerate(panels):
            _draw(panel, elapsed, estimate.positions[:, axis], style)
    _finish_view(view, start, (0, 2))
    for letter, panel in zip("xyz", panels, strict=True):
        panel.set_ylabel(f"{letter} [m]")
        panel.tick_params(labelbottom=letter == "z")
        panel.grid(alpha=0.3)
    figure.align_ylabels(panels)
    panels[-1].set_xlabel(_stamp_label(start))
    _add_legend(figure, view)
    return figure


def _aligned(reference: Trajectory, name: str, estimate: Trajectory, align: AlignMode) -> _Curve:
    ref, est = pair(reference, estimate, name=name)
    similarity = alignment(ref, est, align)
    moved = similarity.apply(estimate)
    errors_m = np.linalg.norm(ref.positions - similarity.apply(est).positions, axis=1)
    rmse = np.sqrt(np.mean(errors_m**2))
    label = f"{plain(name)} (ATE {rmse:.3g} m)"
    return _Curve(label=label, trajectory=moved, stamps_ns=ref.stamps_ns, errors_m=errors_m)


def _around(reference: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    """Return the part of the reference from the pose at or before the first stamp to the last."""
    start = int(np.searchsorted(reference.stamps_ns, first_ns, side="right")) - 1
    end = int(np.searchsorted(reference.stamps_ns, last_ns))
    return reference.select(slice(max(start, 0), end + 1))


def _new_figure() -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=_SIZE_INCHES, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06))


def _draw_path(
    view: Axes, trajectory: Trajectory, plane: tuple[int, int], style: Style, label: str
) -> None:
    horizontal, vertical = broken(trajectory.stamps_ns / 1e9, trajectory.positions[:, plane]).T
    view.plot(horizontal, vertical, label=label, **asdict(style))


def _draw(axes: Axes, elapsed: FloatArray, values: FloatArray, style: Style) -> None:
    axes.plot(*broken(elapsed, np.column_stack([elapsed, values])).T, **asdict(style))


def _finish_view(view: Axes, start: Trajectory, plane: tuple[int, int]) -> None:
    view.plot(
        *start.positions[:1, plane].T, "o", mfc="white", mec="black", zorder=4.0, label="start"
    )
    horizontal, vertical = ("xyz"[axis] for axis in plane)
    view.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]")
    view.set_aspect("equal", adjustable="datalim")
    view.ticklabel_format(useOffset=False)
    view.grid(alpha=0.3)


def _elapsed(stamps_ns: IntArray, start: Trajectory) -> FloatArray:
    return np.asarray((stamps_ns - start.stamps_ns[0]) / 1e9)


def _stamp_label(trajectory: Trajectory) -> str:
    # made-up stamps are a second a row
    return "row" if trajectory.stamps_from == "rows" else "elapsed [s]"


def _add_legend(figure: Figure, view: Axes) -> None:
    handles, labels = view.get_legend_handles_labels()
    n_fitting = max(1, _LEGEND_CHARACTERS // (max(map(len, labels)) + 8))
    n_rows = math.ceil(len(labels) / n_fitting)
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=math.ceil(len(labels) / n_rows),
        frameon=False,
    )
