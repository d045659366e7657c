"""Fewer points for display: no outlier of a curve and no corner of a path is lost."""

from __future__ import annotations

import numpy as np

from gvo.outputs.drawing import gaps_before
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

N_COLUMNS = 1000
"""Columns of a plot over the whole width, about the pixels that it has."""
_MAX_PATH_POINTS = 3000
# of the diagonal of a view of the path: less than half a pixel
_PATH_TOLERANCE = 1.0 / 3000.0
# of the diagonal in space: no view is taken for smaller, as that along a straight line is
_MIN_VIEW = 0.02


def kept_of_curve(x: FloatArray, y: FloatArray, *, n_columns: int = N_COLUMNS) -> IntArray:
    """Choose the points of a curve that show all that its pixels could.

    Of each column of pixels the first and the last point are kept, the smallest and the largest,
    and the first gap.

    Parameters
    ----------
    x : ndarray of float64, shape (n,)
        Increasing, finite.
    y : ndarray of float64, shape (n,)
        NaN where the curve is broken.
    n_columns : int
        Of pixels.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices, at most five per column; all where that is no more.
    """
    n = len(x)
    if n <= 5 * n_columns:
        return np.arange(n)
    columns = columns_of(x, n_columns)
    is_gap = np.isnan(y)
    kept = [_first(columns, np.flatnonzero(is_gap))]
    solid = np.flatnonzero(~is_gap)
    kept += [_first(columns, solid), _last(columns, solid)]
    by_value = solid[np.lexsort([y[solid], columns[solid]])]
    kept += [_first(columns, by_value), _last(columns, by_value)]
    return np.unique(np.concatenate(kept))


def columns_of(x: FloatArray, n_columns: int) -> IntArray:
    """Return the column of pixels of each x, shape (n,), from 0 to n_columns - 1."""
    extent = float(x[-1] - x[0]) if len(x) > 0 else 0.0
    if extent <= 0.0:
        return np.zeros(len(x), dtype=np.int64)
    columns = np.minimum((x - x[0]) / extent * n_columns, n_columns - 1)
    return np.asarray(columns, dtype=np.int64)


def kept_of_dots(x: FloatArray, y: FloatArray, *, n_columns: int, n_rows: int) -> IntArray:
    """Choose one dot of each cell of a grid over the plot: all others lie on top of it.

    Parameters
    ----------
    x, y : ndarray of float64, shape (n,)
        Finite, in the units of the page: of a logarithmic axis the logarithms.
    n_columns, n_rows : int
        Of the grid.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices.
    """
    if len(x) == 0:
        return np.arange(0)
    cells = []
    for values, n_cells in ((x, n_columns), (y, n_rows)):
        extent = float(np.ptp(values)) or 1.0
        cells.append(np.rint((values - values.min()) / extent * n_cells).astype(np.int64))
    _, first = np.unique(cells[0] * (n_rows + 1) + cells[1], return_index=True)
    return np.sort(first)


def display_path(trajectory: Trajectory) -> FloatArray:
    """Return the positions that show the path, shape (m, 3), metres; rows of NaN are gaps.

    No position lies off the path shown by more than a three-thousandth of the diagonal of its
    smallest view, which is that from above where the path climbs; of paths that need more than a
    few thousand points even so, by more.
    """
    positions = trajectory.positions
    if len(trajectory) == 0:
        return positions
    extents = np.sort(np.ptp(positions, axis=0))
    smallest = max(np.linalg.norm(extents[:2]), _MIN_VIEW * np.linalg.norm(extents))
    tolerance = _PATH_TOLERANCE * float(smallest)
    gaps = gaps_before(trajectory.stamps_ns / 1e9)
    pieces = np.split(positions, gaps)
    shown = _within_limit(pieces, tolerance)
    parts: list[FloatArray] = [shown[0]]
    for piece in shown[1:]:
        parts += [np.full((1, 3), np.nan), piece]
    return np.concatenate(parts)


def _within_limit(pieces: list[FloatArray], tolerance: float) -> list[FloatArray]:
    """Simplify all pieces by one tolerance that is doubled until few points are left."""
    limit = _MAX_PATH_POINTS + 2 * len(pieces)
    while True:
        shown: list[FloatArray] = []
        for piece in pieces:
            n_left = limit - sum(map(len, shown))
            shown.append(piece[simplified(piece, tolerance, limit=n_left)])
            if sum(map(len, shown)) > limit:
                break
        else:
            return shown
        tolerance *= 2.0


def simplified(points: FloatArray, tolerance: float, *, limit: int | None = None) -> IntArray:
    """Choose the corners of a polyline, so that no point lies off by more than the tolerance.

    Parameters
    ----------
    points : ndarray of float64, shape (n, k)
        Finite.
    tolerance : float
        In the unit of the points.
    limit : int, optional
        The search ends as soon as more points are needed: a tolerance that is too small for a
        long path costs little.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices, the first and the last among them; more than the limit where the
        search was ended.

    References
    ----------
    D. H. Douglas, T. K. Peucker, "Algorithms for the reduction of the number of points required
    to represent a digitized line or its caricature", Cartographica 10(2), 1973,
    doi:10.3138/FM57-6770-U75U-7727.
    """
    if len(points) == 0:
        return np.arange(0)
    is_kept = np.zeros(len(points), dtype=np.bool_)
    is_kept[[0, -1]] = True
    left, n_kept = [(0, len(points) - 1)], min(len(points), 2)
    while left and (limit is None or n_kept <= limit):
        start, end = left.pop()
        if end - start < 2:
            continue
        distances = _off_segment(points[start + 1 : end], points[start], points[end])
        farthest = int(np.argmax(distances))
        if distances[farthest] > tolerance:
            corner = start + 1 + farthest
            is_kept[corner] = True
            n_kept += 1
            left += [(start, corner), (corner, end)]
    return np.flatnonzero(is_kept)


def _off_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    along = end - start
    square = float(along @ along)
    offsets = points - start
    if square > 0.0:
        shares = np.clip(offsets @ along / square, 0.0, 1.0)
        offsets = offsets - shares[:, np.newaxis] * along
    return np.asarray(np.linalg.norm(offsets, axis=1))


def _first(columns: IntArray, indices: IntArray) -> IntArray:
    """Return those of the indices, grouped by column, that begin a group."""
    if len(indices) == 0:
        return indices
    return np.asarray(indices[np.diff(columns[indices], prepend=-1) != 0])


def _last(columns: IntArray, indices: IntArray) -> IntArray:
    return _first(columns, indices[::-1])
