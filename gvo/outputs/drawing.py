"""What all pictures of trajectories share: gaps, planes, labels, files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvo.errors import TrajectoryError
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

if TYPE_CHECKING:
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
