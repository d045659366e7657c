"""Trajectories and errors with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvo.errors import ConfigurationError, RecordingError, TrajectoryError
from gvo.trajectory.alignment import AlignMode, alignment, pair
from gvo.trajectory.round_trip import RoundTripError
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.palette import ESTIMATES, OTHERS, REFERENCE_STYLE, Style, styles_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# equal input gives equal files: no dates, no versions
METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None},
}
"""By the ends of the names of files that can be drawn."""

_FLAT = 0.05
# a line ends where the next pose is later than so many median steps
_GAP = 10.0
_SIZE_INCHES = (11.0, 5.5)
_LEGEND_CHARACTERS = 135
_VIEW_SIZE_INCHES = (11.0, 6.2)
_MAX_POINTS = 4000


def gaps_before(seconds: FloatArray) -> IntArray:
    """Return the indices, shape (m,), before which poses are missing: lines end there.

    Parameters
    ----------
    seconds : ndarray of float64, shape (n,)
        Increasing.
    """
    steps = np.diff(seconds)
    if len(steps) == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(np.flatnonzero(steps > _GAP * np.median(steps)) + 1, dtype=np.int64)


def broken(seconds: FloatArray, points: FloatArray) -> FloatArray:
    """Return the points, shape (n, k), with rows of NaN where poses are missing."""
    return np.insert(points, gaps_before(seconds), np.nan, axis=0)


def is_of_camera(reference: Trajectory) -> bool:
    """Tell whether the world is that of a camera: x right, y down, z forward.

    A world that begins with the identity is, unless it is as flat along z as that of a robot with
    z upwards. Positions without rotations begin no world of a camera.
    """
    if len(reference) == 0 or not reference.has_rotations:
        return False
    extents = np.ptp(reference.positions, axis=0)
    begins = np.allclose(reference.T_world_cam[0], np.eye(4), atol=1e-3)
    return bool(begins and extents[2] >= _FLAT * extents[1])


def ground_plane(reference: Trajectory) -> tuple[int, int]:
    """Return the axes to look at: x and z of a camera's world, else the two of most motion."""
    if is_of_camera(reference):
        return 0, 2
    extents = np.ptp(reference.positions, axis=0)
    least = 2 - int(np.argmin(extents[::-1]))  # of equal ones the last, as z in most worlds
    horizontal, vertical = (axis for axis in range(3) if axis != least)
    return horizontal, vertical


def plain(name: str) -> str:
    """Return a name without what a legend takes for markup: dollars, a leading underscore."""
    text = name.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure; equal figures give equal files.

    Raises
    ------
    TrajectoryError
        Where the file cannot be written.
    """
    from matplotlib import rc_context

    suffix = path.suffix.lower()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # the salt of the ids in SVG is random by default; the setting ends with the block
        with rc_context({"svg.hashsalt": "gvo"}):
            figure.savefig(path, format=suffix[1:], dpi=150, metadata=METADATA[suffix])
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be written: {error.strerror}") from error


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


def plot_round_trip(path: str | Path, errors: Mapping[str, RoundTripError]) -> None:
    """Draw a round trip from above, forward solid and backward dashed, and its errors by frame.

    The world is that of the first camera: x to the right, z ahead. Equal input gives equal files.

    Parameters
    ----------
    path : str or Path
        PNG file.
    errors : mapping of str to RoundTripError
        By the names of the trajectories, at least one; "raw", "causal" and "smoothed" have
        colours of their own.

    Raises
    ------
    RecordingError
        Where the file cannot be written.
    ValueError
        Where there is no trajectory.
    """
    if not errors:
        raise ValueError("expected at least one trajectory")
    figure = _draw_round_trip(errors)
    try:
        figure.savefig(path, format="png", dpi=150, metadata={"Software": None})
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def _draw_round_trip(errors: Mapping[str, RoundTripError]) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(
        figsize=_VIEW_SIZE_INCHES, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
    )
    axes = figure.subplot_mosaic(
        [["view", "end", "metres"], ["view", "end", "degrees"]], width_ratios=[1.15, 1.0, 1.15]
    )
    for name, error in errors.items():
        colour = ESTIMATES.get(name, OTHERS[0])
        _draw_ways(axes["view"], error, colour)
        _draw_gap(axes["end"], error, colour, name)
        _draw_errors(axes["metres"], error, error.errors_m, colour)
        _draw_errors(axes["degrees"], error, error.errors_deg, colour)
    first = next(iter(errors.values()))
    _finish_round_trip_view(axes["view"], first)
    _finish_end(axes["end"], errors)
    _finish_errors(axes["metres"], axes["degrees"])
    handles, labels = axes["end"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _draw_ways(view: Axes, error: RoundTripError, colour: str) -> None:
    for trajectory, linestyle in ((error.forward, "-"), (error.backward, "--")):
        shown = _decimated(trajectory.positions[:, [0, 2]])
        view.plot(*shown.T, color=colour, linestyle=linestyle, linewidth=1.2)


def _draw_gap(end: Axes, error: RoundTripError, colour: str, name: str) -> None:
    """Draw where the way back ends, as seen from the start, and the way to it."""
    gap = error.errors[0, :3, 3]
    share = "" if error.error_pct is None else f", {error.error_pct:.3g} % of the path"
    label = f"{name}: {error.error_m:.3g} m{share}, {error.error_deg:.3g} deg"
    end.plot([0.0, gap[0]], [0.0, gap[2]], color=colour, linewidth=1.2)
    # causal and smoothed end in the same pose: the larger mark is hollow, and seen around the other
    size, face = (13.0, "none") if name == "causal" else (7.0, colour)
    end.plot(gap[0], gap[2], "s", mec=colour, mfc=face, mew=1.5, markersize=size, label=label)


def _draw_errors(panel: Axes, error: RoundTripError, values: FloatArray, colour: str) -> None:
    stamps_ns = error.forward.stamps_ns
    to_turn_s = (stamps_ns - stamps_ns[-1]) / 1e9
    panel.plot(*_decimated(np.column_stack([to_turn_s, values])).T, color=colour, linewidth=1.2)


def _finish_round_trip_view(view: Axes, error: RoundTripError) -> None:
    from matplotlib.lines import Line2D

    view.plot(0.0, 0.0, "o", mfc="white", mec="black", zorder=4.0)
    turn = error.forward.positions[-1, [0, 2]]
    view.plot(*turn, "^", mfc="white", mec="black", zorder=4.0)
    view.set(xlabel="x [m]", ylabel="z [m]", title="from above")
    view.set_aspect("equal", adjustable="datalim")
    view.margins(0.08)
    view.grid(alpha=0.3)
    grey = "#555555"
    keys = [
        Line2D([], [], color=grey, linestyle="-", label="forward"),
        Line2D([], [], color=grey, linestyle="--", label="backward"),
        Line2D([], [], color="none", marker="o", mfc="white", mec="black", label="start"),
        Line2D([], [], color="none", marker="^", mfc="white", mec="black", label="turn"),
    ]
    view.legend(handles=keys, loc="best", fontsize="small")


def _finish_end(end: Axes, errors: Mapping[str, RoundTripError]) -> None:
    end.plot(0.0, 0.0, "o", mfc="white", mec="black", zorder=4.0)
    largest = max(float(np.abs(error.errors[0, [0, 2], 3]).max()) for error in errors.values())
    limit = 1.25 * max(largest, 1e-6)
    end.set(xlim=(-limit, limit), ylim=(-limit, limit))
    end.set(xlabel="x [m]", ylabel="z [m]", title="round-trip error, from above")
    end.set_aspect("equal", adjustable="box")
    end.locator_params(nbins=5)
    end.grid(alpha=0.3)


def _finish_errors(metres: Axes, degrees: Axes) -> None:
    metres.set(ylabel="distance [m]", title="between forward and backward")
    degrees.set(ylabel="angle [deg]", xlabel="frame, before the turn [s]")
    metres.tick_params(labelbottom=False)
    for panel in (metres, degrees):
        panel.set_ylim(bottom=0.0)
        panel.grid(alpha=0.3)


def _decimated(points: FloatArray) -> FloatArray:
    """Return at most so many rows, the first and the last among them."""
    if len(points) <= _MAX_POINTS:
        return points
    return points[np.linspace(0, len(points) - 1, _MAX_POINTS).round().astype(np.int64)]
