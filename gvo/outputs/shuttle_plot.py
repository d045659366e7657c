"""The picture of a drive there and back: both ways from above, and how far they are apart."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvo.errors import RecordingError
from gvo.outputs.palette import ESTIMATES, OTHERS
from gvo.trajectory.round_trip import Closing
from gvo.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE_INCHES = (11.0, 6.2)
_MAX_POINTS = 4000


def plot_shuttle(path: str | Path, closings: Mapping[str, Closing]) -> None:
    """Draw the ways there (solid) and back (dashed) from above, and their distance by frame.

    The world is that of the first camera: x to the right, z ahead. Equal input gives equal files.

    Parameters
    ----------
    path : str or Path
        PNG file.
    closings : mapping of str to Closing
        By the names of the trajectories, at least one; "raw", "causal" and "smoothed" have
        colours of their own.

    Raises
    ------
    RecordingError
        Where the file cannot be written.
    ValueError
        Where there is no trajectory.
    """
    if not closings:
        raise ValueError("expected at least one trajectory")
    figure = _draw(closings)
    try:
        figure.savefig(path, format="png", dpi=150, metadata={"Software": None})
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def _draw(closings: Mapping[str, Closing]) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=_SIZE_INCHES, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06))
    axes = figure.subplot_mosaic(
        [["view", "end", "metres"], ["view", "end", "degrees"]], width_ratios=[1.15, 1.0, 1.15]
    )
    for name, closing in closings.items():
        colour = ESTIMATES.get(name, OTHERS[0])
        _draw_ways(axes["view"], closing, colour)
        _draw_gap(axes["end"], closing, colour, name)
        _draw_errors(axes["metres"], closing, closing.errors_m, colour)
        _draw_errors(axes["degrees"], closing, closing.errors_deg, colour)
    first = next(iter(closings.values()))
    _finish_view(axes["view"], first)
    _finish_end(axes["end"], closings)
    _finish_errors(axes["metres"], axes["degrees"])
    handles, labels = axes["end"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _draw_ways(view: Axes, closing: Closing, colour: str) -> None:
    for trajectory, linestyle in ((closing.there, "-"), (closing.back, "--")):
        shown = _decimated(trajectory.positions[:, [0, 2]])
        view.plot(*shown.T, color=colour, linestyle=linestyle, linewidth=1.2)


def _draw_gap(end: Axes, closing: Closing, colour: str, name: str) -> None:
    """Draw where the way back ends, as seen from the start, and the way to it."""
    gap = closing.errors[0, :3, 3]
    share = "" if closing.closing_pct is None else f", {closing.closing_pct:.3g} % of the path"
    label = f"{name}: {closing.closing_m:.3g} m{share}, {closing.closing_deg:.3g} deg"
    end.plot([0.0, gap[0]], [0.0, gap[2]], color=colour, linewidth=1.2)
    # causal and smoothed end in the same pose: the larger mark is hollow, and seen around the other
    size, face = (13.0, "none") if name == "causal" else (7.0, colour)
    end.plot(gap[0], gap[2], "s", mec=colour, mfc=face, mew=1.5, markersize=size, label=label)


def _draw_errors(panel: Axes, closing: Closing, values: FloatArray, colour: str) -> None:
    stamps_ns = closing.there.stamps_ns
    to_turn_s = (stamps_ns - stamps_ns[-1]) / 1e9
    panel.plot(*_decimated(np.column_stack([to_turn_s, values])).T, color=colour, linewidth=1.2)


def _finish_view(view: Axes, closing: Closing) -> None:
    from matplotlib.lines import Line2D

    view.plot(0.0, 0.0, "o", mfc="white", mec="black", zorder=4.0)
    turn = closing.there.positions[-1, [0, 2]]
    view.plot(*turn, "^", mfc="white", mec="black", zorder=4.0)
    view.set(xlabel="x [m]", ylabel="z [m]", title="from above")
    view.set_aspect("equal", adjustable="datalim")
    view.margins(0.08)
    view.grid(alpha=0.3)
    grey = "#555555"
    keys = [
        Line2D([], [], color=grey, linestyle="-", label="there"),
        Line2D([], [], color=grey, linestyle="--", label="back"),
        Line2D([], [], color="none", marker="o", mfc="white", mec="black", label="start"),
        Line2D([], [], color="none", marker="^", mfc="white", mec="black", label="turn"),
    ]
    view.legend(handles=keys, loc="best", fontsize="small")


def _finish_end(end: Axes, closings: Mapping[str, Closing]) -> None:
    end.plot(0.0, 0.0, "o", mfc="white", mec="black", zorder=4.0)
    largest = max(
        float(np.abs(closing.errors[0, [0, 2], 3]).max()) for closing in closings.values()
    )
    limit = 1.25 * max(largest, 1e-6)
    end.set(xlim=(-limit, limit), ylim=(-limit, limit))
    end.set(xlabel="x [m]", ylabel="z [m]", title="closing error, from above")
    end.set_aspect("equal", adjustable="box")
    end.locator_params(nbins=5)
    end.grid(alpha=0.3)


def _finish_errors(metres: Axes, degrees: Axes) -> None:
    metres.set(ylabel="distance [m]", title="between there and back")
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
