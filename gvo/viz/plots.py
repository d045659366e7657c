"""Trajectories and errors with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo._text import visible
from gvo.errors import ConfigurationError, TrajectoryError, write_faults
from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.measures import compare
from gvo.viz.palette import REFERENCE_STYLE, Style, styles_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# equal input gives equal files: no dates, no versions
METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None},
}
"""By the suffixes of the files that can be drawn."""
HOLLOW: dict[str, Any] = {"mfc": "white", "mec": "black", "zorder": 4.0}
"""The marks of start and turn."""

_FLAT = 0.05  # extent of a flat axis, relative to another
_DOWN = 0.8  # cosine, on the mean, of the camera's y axis and that of a world whose y points down
_GAP = 10.0  # a line is broken at steps longer than so many medians
_SIZE_INCHES = (11.0, 5.5)
_LEGEND_CHARACTERS = 135  # of a row
_MAX_POINTS = 4000


def check_suffix(path: Path | None, expected: Collection[str] = METADATA) -> None:
    """Refuse the name of a file, if any, that has another suffix; by default that of a plot.

    Raises
    ------
    ConfigurationError
        With what is expected.
    """
    if path is not None and path.suffix.lower() not in expected:
        raise ConfigurationError(
            f"{path}: expected a name ending in {', '.join(expected)}, got "
            f"{path.suffix or 'no ending'}"
        )


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
    if reference is None:
        figure = _figure_of_positions(estimates)
    else:
        figure = _figure_of_errors(reference, estimates, align)
    save_figure(figure, path)


def _figure_of_errors(
    reference: Trajectory, estimates: Mapping[str, Trajectory], align: AlignMode
) -> Figure:
    compared = [compare(reference, e, name=name, align=align) for name, e in estimates.items()]
    first_ns = min(int(each.reference.stamps_ns[0]) for each in compared)
    last_ns = max(int(each.reference.stamps_ns[-1]) for each in compared)
    shown = _around(reference, first_ns, last_ns)
    figure = _new_figure(_SIZE_INCHES)
    view, errors = figure.subplots(1, 2)
    plane = ground_plane(reference)
    _draw_path(view, shown, plane, REFERENCE_STYLE, "reference")
    for each, style in zip(compared, styles_of(estimates), strict=True):
        label = f"{plain(each.name)} (ATE {each.ate_m:.3g} m)"
        _draw_path(view, each.trajectory, plane, style, label)
        elapsed_s = elapsed(each.reference.stamps_ns, int(shown.stamps_ns[0]))
        _draw_values(errors, elapsed_s, each.errors_m, style)
    _mark_start(view, shown, plane)
    words = f"position error [m], alignment: {align}"
    errors.set(xlabel=_stamp_label(shown), ylabel=words, ylim=(0.0, None))
    errors.grid(alpha=0.3)
    _place_legend(figure, view)
    return figure


def _figure_of_positions(estimates: Mapping[str, Trajectory]) -> Figure:
    start = min(estimates.values(), key=lambda estimate: int(estimate.stamps_ns[0]))
    plane = ground_plane(next(iter(estimates.values())))
    figure = _new_figure(_SIZE_INCHES)
    axes = figure.subplot_mosaic([["view", axis] for axis in "xyz"])
    view, panels = axes["view"], [axes[axis] for axis in "xyz"]
    for (name, estimate), style in zip(estimates.items(), styles_of(estimates), strict=True):
        _draw_path(view, estimate, plane, style, plain(name))
        elapsed_s = elapsed(estimate.stamps_ns, int(start.stamps_ns[0]))
        for axis, panel in enumerate(panels):
            _draw_values(panel, elapsed_s, estimate.positions[:, axis], style)
    _mark_start(view, start, plane)
    for letter, panel in zip("xyz", panels, strict=True):
        panel.set_ylabel(f"{letter} [m]")
        panel.tick_params(labelbottom=letter == "z")
        panel.grid(alpha=0.3)
    figure.align_ylabels(panels)
    panels[-1].set_xlabel(_stamp_label(start))
    _place_legend(figure, view)
    return figure


def _around(reference: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    """Return the reference from its last pose before the first stamp to the last stamp."""
    start = int(np.searchsorted(reference.stamps_ns, first_ns, side="right")) - 1
    end = int(np.searchsorted(reference.stamps_ns, last_ns))
    return reference.select(slice(max(start, 0), end + 1))


def evenly(n: int, n_most: int) -> IntArray:
    """Return indices of n items, at most so many: spread evenly, first and last among them."""
    return np.linspace(0, n - 1, min(n, n_most)).round().astype(np.int64)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as its suffix says; equal figures give equal files.

    Raises
    ------
    TrajectoryError
        When the file cannot be written.
    """
    from matplotlib import rc_context

    suffix = path.suffix.lower()
    # the salt of the ids in SVG is random by default; the setting ends with the block
    with write_faults(TrajectoryError, path), rc_context({"svg.hashsalt": "gvo"}):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format=suffix[1:], dpi=150, metadata=METADATA[suffix])


def _new_figure(size_inches: tuple[float, float]) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=size_inches, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06))


def _draw_path(
    view: Axes, trajectory: Trajectory, plane: tuple[int, int], style: Style, label: str
) -> None:
    points = broken(trajectory.stamps_ns / 1e9, trajectory.positions[:, plane])
    view.plot(*points.T, label=label, **asdict(style))


def _draw_values(axes: Axes, elapsed: FloatArray, values: FloatArray, style: Style) -> None:
    axes.plot(*broken(elapsed, np.column_stack([elapsed, values])).T, **asdict(style))


def _mark_start(view: Axes, start: Trajectory, plane: tuple[int, int]) -> None:
    view.plot(*start.positions[:1, plane].T, "o", label="start", **HOLLOW)
    _set_view(view, plane)
    view.ticklabel_format(useOffset=False)


def _set_view(view: Axes, plane: tuple[int, int]) -> None:
    """Label the axes of a view, with one scale on both."""
    horizontal, vertical = ("xyz"[axis] for axis in plane)
    view.set(xlabel=f"{horizontal} [m]", ylabel=f"{vertical} [m]")
    view.set_aspect("equal", adjustable="datalim")
    view.grid(alpha=0.3)


def elapsed(stamps_ns: IntArray, first_ns: int) -> FloatArray:
    """Return seconds since a stamp."""
    return np.asarray((stamps_ns - first_ns) / 1e9, dtype=np.float64)


def _stamp_label(trajectory: Trajectory) -> str:
    # poses without stamps are one second apart
    return "row" if trajectory.stamps_from == "rows" else "elapsed [s]"


def _place_legend(figure: Figure, view: Axes) -> None:
    handles, labels = view.get_legend_handles_labels()
    n_fitting = max(1, _LEGEND_CHARACTERS // (max(map(len, labels)) + 8))
    n_rows = math.ceil(len(labels) / n_fitting)
    add_legend(figure, handles, labels, n_rows, loc="outside lower center")


def add_legend(
    figure: Figure,
    handles: Sequence[Any],
    labels: Sequence[str],
    n_rows: int,
    **place: Any,  # noqa: ANN401 - options of matplotlib
) -> None:
    """Add a frameless legend of so many rows to a figure."""
    figure.legend(handles, labels, ncols=math.ceil(len(labels) / n_rows), frameon=False, **place)


def gaps_before(seconds: FloatArray) -> IntArray:
    """Return the indices, shape (m,), of the poses that follow a gap.

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


def plain(name: str) -> str:
    """Escape what matplotlib takes for markup: dollars, a leading underscore; else `visible`."""
    text = visible(name).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text
