"""The views of the paths: numbers and labels have room."""

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from gvo.trajectory.trajectory import Trajectory
from gvo.viz.figures import style
from gvo.viz.report.paths import World, lines_of, path_plots

MAP_GRID = (512_345.2, 4_600_123.5, -33.0)


@pytest.mark.parametrize(("origin", "step_m"), [((0.0, 0.0, 0.0), 1e-5), (MAP_GRID, 400.0)])
def test_numbers_and_labels_stay_in_the_picture_and_apart(
    origin: tuple[float, float, float], step_m: float
) -> None:
    T = np.tile(np.eye(4), (30, 1, 1))
    angles = np.linspace(0.0, 3.0, 30)
    T[:, :3, 3] = np.stack([np.sin(angles), np.cos(angles), 0.1 * angles], axis=1) * 10 * step_m
    T[:, :3, 3] += origin
    path = Trajectory(stamps_ns=np.arange(30) * 100_000_000, T_world_frame=T)
    with style():
        for plot in path_plots(lines_of(path, {"one": path}), World.of(path))[:2]:
            assert plot.figure is not None
            canvas: Any = FigureCanvasAgg(plot.figure)
            canvas.draw()
            (axes,), frame = plot.figure.axes, plot.figure.bbox
            below, left = _numbers(axes)
            for box in (*_boxes([axes.xaxis.label, axes.yaxis.label]), *left):
                assert frame.x0 <= box.x0 < box.x1 <= frame.x1
                assert frame.y0 <= box.y0
            beside = axes.yaxis.label.get_window_extent().x1
            assert all(beside <= box.x0 for box in left)
            assert all(one.x1 < other.x0 for one, other in pairwise(below))


def _numbers(axes: Any) -> tuple[list[Any], list[Any]]:
    """Return the boxes of the numbers that are drawn, below the axes and left of them."""
    below = _boxes(axes.get_xticklabels())
    left = _boxes(axes.get_yticklabels())
    frame = axes.bbox
    return (
        [box for box in below if frame.x0 <= 0.5 * (box.x0 + box.x1) <= frame.x1],
        [box for box in left if frame.y0 <= 0.5 * (box.y0 + box.y1) <= frame.y1],
    )


def _boxes(texts: Iterable[Any]) -> list[Any]:
    return [text.get_window_extent() for text in texts]
