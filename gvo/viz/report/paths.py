"""Trajectories from above and from the side, and the scene that turns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.figures import HALF, HOLLOW, Plot, broken, evenly, legend_above, new_figure, plain
from gvo.viz.palette import LOOP_STYLES, REFERENCE_STYLE, Style, styles_of
from gvo.viz.plots import ground_plane

_HEIGHT = 4.8
# More would not be seen in a picture, and burden the page.
_MAX_PATH_POINTS = 5000
_MIN_EXTENT_M = 1e-3
_DASHES = {"-": [], "--": [7, 5], "-.": [7, 4, 2, 4], ":": [2, 4]}


TITLES = {"above": "From above", "side": "From the side", "space": "In space"}
"""Of the views of paths, by slug."""


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Horizontal and vertical axes of the world.

    Parameters
    ----------
    ground : tuple of two int
        Horizontal axes: right and up in the view from above.
    up : int
        Vertical axis.
    is_up_negative : bool
        The vertical axis points down, as y of a camera.
    """

    ground: tuple[int, int]
    up: int
    is_up_negative: bool

    @classmethod
    def of(cls, reference: Trajectory) -> World:
        """Return y down for a world with camera axes, else z up."""
        ground = ground_plane(reference)
        up = 3 - sum(ground)
        return cls(ground=ground, up=up, is_up_negative=up == 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """A path for display: positions, shape (n, 3), metres, with rows of NaN at gaps."""

    name: str
    points: FloatArray
    style: Style


def lines_of(reference: Trajectory | None, estimates: Mapping[str, Trajectory]) -> list[Line]:
    """Return the paths of trajectories in one world, the reference first."""
    lines = []
    if reference is not None:
        lines.append(Line(name="truth", points=_points_of(reference), style=REFERENCE_STYLE))
    for (name, estimate), style in zip(estimates.items(), styles_of(estimates), strict=True):
        lines.append(Line(name=name, points=_points_of(estimate), style=style))
    return lines


def _points_of(trajectory: Trajectory) -> FloatArray:
    """Return a path for display, shape (m, 3), with rows of NaN where poses are missing."""
    points = broken(trajectory.stamps_ns / 1e9, trajectory.positions)
    kept = evenly(len(points), _MAX_PATH_POINTS)
    # A gap between two points that stay must stay, too.
    gaps = np.flatnonzero(np.isnan(points[:, 0]))
    return points[np.union1d(kept, gaps)]


def loop_lines(ends: Mapping[str, FloatArray]) -> list[Line]:
    """Return the lines between both ends of loops, shape (n, 2, 3) by a name of `LOOP_STYLES`."""
    return [
        Line(
            name=f"{name} ({len(segments)})",
            points=np.insert(segments, 2, np.nan, axis=1).reshape(-1, 3),
            style=LOOP_STYLES[name],
        )
        for name, segments in ends.items()
        if len(segments) > 0
    ]


def path_plots(lines: Sequence[Line], world: World) -> list[Plot]:
    """Return the views from above, from the side and in space."""
    points = np.concatenate([line.points for line in lines])
    extents = np.nanmax(points, axis=0) - np.nanmin(points, axis=0)
    along = max(world.ground, key=lambda axis: extents[axis])
    return [
        Plot(
            slug="above",
            title=TITLES["above"],
            facts={
                "is_up_negative": world.is_up_negative,
                "has_truth": any(line.name == "truth" for line in lines),
                "has_loops": any(line.style in LOOP_STYLES.values() for line in lines),
            },
            figure=_view(lines, world.ground, is_flipped=False),
            is_half=True,
        ),
        Plot(
            slug="side",
            title=TITLES["side"],
            figure=_view(lines, (along, world.up), is_flipped=world.is_up_negative),
            is_half=True,
        ),
        Plot(slug="space", title=TITLES["space"]),  # a canvas of the page
    ]


def _view(lines: Sequence[Line], plane: tuple[int, int], *, is_flipped: bool) -> Figure:
    figure = new_figure(_HEIGHT, HALF)
    axes = figure.subplots()
    draw_lines(axes, lines, plane)
    axes.set(xlabel=f"{'xyz'[plane[0]]} [m]", ylabel=f"{'xyz'[plane[1]]} [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.04)
    legend_above(figure, axes)
    if is_flipped:
        axes.invert_yaxis()
    return figure


def draw_lines(axes: Any, lines: Sequence[Line], order: tuple[int, ...]) -> None:  # noqa: ANN401
    """Draw paths in some axes of the world, and the start of the first one."""
    for line in lines:
        axes.plot(*line.points[:, order].T, label=plain(line.name), **asdict(line.style))
    axes.plot(*lines[0].points[:1, order].T, "o", label="start", **HOLLOW)


def turning_scene(lines: Sequence[Line], world: World) -> dict[str, Any]:
    """Return the lines of the view that turns, as plain values."""
    points = np.concatenate([line.points for line in lines])
    extent = float(np.nanmax(np.ptp(points[np.isfinite(points[:, 0])], axis=0)))
    n_decimals = max(0, 4 - int(np.floor(np.log10(max(extent, _MIN_EXTENT_M)))))
    return {
        "right": world.ground[0],
        "ahead": world.ground[1],
        "up": world.up,
        "sign": -1 if world.is_up_negative else 1,
        "lines": [
            {
                "name": line.name,
                "colour": line.style.color,
                "dash": _DASHES[line.style.linestyle],
                "pieces": _pieces(line.points, n_decimals),
            }
            for line in lines
        ],
    }


def _pieces(points: FloatArray, n_decimals: int) -> list[list[list[float]]]:
    pieces = np.split(points, np.flatnonzero(np.isnan(points[:, 0])))
    solid = [piece[np.isfinite(piece[:, 0])] for piece in pieces]
    return [np.round(piece, n_decimals).tolist() for piece in solid if len(piece) > 0]
