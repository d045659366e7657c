"""Trajectories and errors with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvo.io.run_folder.reader import Table
from gvo.trajectory.alignment import MAX_DIFFERENCE_NS, AlignMode
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.names import check_suffix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FLAT = 0.05  # extent of a flat axis, relative to another
_DOWN = 0.8  # cosine, on the mean, of the camera's y axis and that of a world whose y points down


def plot_trajectories(
    path: str | Path | None,
    reference: Trajectory | None,
    estimates: Mapping[str, Trajectory],
    *,
    align: AlignMode = "se3",
    loops: Table | None = None,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> Figure:
    """Draw trajectories from above, and their errors (or positions) over time.

    Equal input gives equal files.

    Parameters
    ----------
    path : str or Path, or None
        File with suffix .png, .pdf or .svg; None writes none.
    reference : Trajectory or None
        Without one, positions over time are drawn instead of errors.
    estimates : mapping of str to Trajectory
        By name, at least one; "raw", "causal", "smoothed" and "global" have fixed colours.
    align : {"none", "origin", "se3", "sim3"}
        Alignment of each estimate with the reference.
    loops : mapping of str to ndarray, optional
        Columns `stamp_ns`, `reference_ns` and `reason` of a run's `loops.csv`: those that count
        are marked on the last estimate, where there is a reference.
    max_difference_ns : int
        Largest difference of associated stamps, nanoseconds.

    Returns
    -------
    matplotlib.figure.Figure
        A notebook shows it where it is the last value of a cell.

    Raises
    ------
    ConfigurationError
        When the file name has another suffix.
    TrajectoryError
        When an estimate and the reference share fewer than three poses, or the file cannot be
        written.
    ValueError
        When there is no estimate, or one without poses.
    """
    path = None if path is None else Path(path)
    check_suffix(path)
    if not estimates or any(len(estimate) == 0 for estimate in estimates.values()):
        raise ValueError("expected at least one estimate, and poses in each")
    # Matplotlib takes a third of a second to load.
    from gvo.viz.figures import save_figure, style
    from gvo.viz.report.trajectories import figure_of_errors, figure_of_positions

    with style():
        if reference is None:
            figure = figure_of_positions(estimates)
        else:
            options = {"align": align, "max_difference_ns": max_difference_ns}
            figure = figure_of_errors(reference, estimates, loops, **options)
        if path is not None:
            save_figure(figure, path)
    return figure


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
