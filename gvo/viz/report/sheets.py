"""A plot of the report: its figure, files and layout; points thinned for display."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gvo.errors import ConfigurationError, named_faults
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.palette import Style
from gvo.viz.plots import METADATA, add_legend, gaps_before, plain, save_figure

TITLES = {
    "above": "From above",
    "side": "From the side",
    "space": "In space",
    "errors_over_time": "Errors over time",
    "errors_over_distance": "Errors over distance travelled",
    "drift": "Drift by length of segment",
    "covariance": "Errors within their covariances",
    "status": "Status",
    "counts": "Features, matches and inliers",
    "timings": "Milliseconds per frame",
    "chi2": "Chi-square of the edges",
    "chi2_histogram": "Distribution of chi-square",
}
"""Of the plots of trajectories and runs, by slug, in their order."""
WIDE = 11.0
"""Width of a plot across the page, inches."""
HALF = 6.4
"""Width of a plot that shares a row with another, inches."""
N_COLUMNS = 1000
"""Pixel columns of a plot across the page, about."""
_MAX_PATH_POINTS = 3000
# of the diagonal of a view of the path: less than half a pixel
_PATH_TOLERANCE = 1.0 / 3000.0
# least diagonal of a view, relative to that in space: the view along a straight line has none
_MIN_VIEW = 0.02
_MARGINS_INCHES = {"left": 0.78, "right": 0.2, "bottom": 0.52, "top": 0.12}
_LEGEND_ROW_INCHES = 0.24
_INCHES_PER_CHARACTER = 0.072
_LABEL_INCHES = 0.34
_INCHES_PER_DIGIT = 0.08
_MAX_LABEL = 60
_SETTINGS: dict[str, Any] = {
    "font.family": ["sans-serif"],
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.6,
    "path.simplify": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "gvo",
}
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_TAG = re.compile("<[^>]*>")
_ID = re.compile(r' id="([^"]*)"')
_REFERENCE = re.compile(r'(?:url\(#|href="#)([^)"]+)')
_FAMILY = re.compile(r"font(?:-family)?: ?(?:(\d[\d.]*px) )?'[^;\"]*")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plot:
    """A plot of the report, or why there is none.

    Parameters
    ----------
    slug : str
        Id of its section, and stem of its file names.
    text : str
        What it shows and how a good one looks; without a figure, the reason.
    title : str
        That of `TITLES` where omitted.
    figure : Figure or None
    is_half : bool
        Two of them share a row.
    """

    slug: str
    text: str
    title: str = ""
    figure: Figure | None = None
    is_half: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", self.title or TITLES[self.slug])

    def svg(self) -> str:
        """Return the figure as SVG to be embedded in a page beside others."""
        if self.figure is None:
            raise ValueError(f"{self.slug} has no figure")
        buffer = io.StringIO()
        self.figure.savefig(buffer, format="svg", metadata=METADATA[".svg"])
        return _inlined(buffer.getvalue(), self.slug, self.title)


def settings() -> AbstractContextManager[None]:
    """Make and write figures in the style of the report within the context."""
    return rc_context(_SETTINGS)  # type: ignore[arg-type,unused-ignore]


def write_plots(plots: Sequence[Plot], folder: Path) -> list[Path]:
    """Write each figure as PNG and PDF.

    Parameters
    ----------
    plots : sequence of Plot
        Numbered in the order of the report, those without a figure too.
    folder : Path
        Created if missing.

    Returns
    -------
    list of Path

    Raises
    ------
    ConfigurationError
        When the folder cannot be made.
    TrajectoryError
        When a file cannot be written.
    """
    with named_faults(ConfigurationError, f"--plots {folder}", "cannot be made"):
        folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, plot in enumerate(plots, start=1):
        if plot.figure is None:
            continue
        for suffix in (".png", ".pdf"):
            paths.append(folder / f"{number:02d}_{plot.slug}{suffix}")
            save_figure(plot.figure, paths[-1])
    return paths


def _inlined(svg: str, slug: str, title: str) -> str:
    """Return SVG without prolog, metadata and namespaces, its ids prefixed by the slug."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    svg = _FAMILY.sub(lambda match: f"font-size: {match[1]}" if match[1] else "", svg)
    used = set(_REFERENCE.findall(svg))
    svg = _ID.sub(lambda match: f' id="{slug}-{match[1]}"' if match[1] in used else "", svg)
    svg = re.sub(r"(url\(#|href=\"#)", rf"\g<1>{slug}-", svg)
    svg = _TAG.sub(lambda tag: _NUMBER.sub(lambda number: f"{float(number[0]):.2f}", tag[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" @>', svg, count=1)
    return svg.replace("@", f'role="img" aria-label="{title}"', 1).strip()


def time_axes(height: float, ylabel: str) -> tuple[Figure, Axes]:
    """Return a figure across the page with one plot over the elapsed time."""
    figure = Figure(figsize=(WIDE, height))
    axes = figure.subplots()
    axes.margins(x=0.01)
    axes.set(xlabel="elapsed [s]", ylabel=ylabel)
    return figure, axes


def arrange(figure: Figure, axes: Axes | None = None, *, left: float | None = None) -> None:
    """Set the margins of a figure, with the legend of some axes above its plots.

    Parameters
    ----------
    figure : Figure
    axes : Axes, optional
        Whose labels the legend lists; no legend where omitted.
    left : float, optional
        Margin left of the plots, inches; as wide as the tick labels need where omitted.
    """
    width, height = figure.get_size_inches()
    top = _MARGINS_INCHES["top"]
    handles, labels = ([], []) if axes is None else axes.get_legend_handles_labels()
    if labels:
        labels = [_shortened(label) for label in labels]
        n_rows = _legend_rows(labels, width)
        top += n_rows * _LEGEND_ROW_INCHES
        add_legend(figure, handles, labels, n_rows, loc="upper center", borderaxespad=0.1)
    figure.subplots_adjust(
        left=(left or _left_inches(figure)) / width,
        right=1.0 - _MARGINS_INCHES["right"] / width,
        bottom=_MARGINS_INCHES["bottom"] / height,
        top=1.0 - min(top, 0.5 * height) / height,
    )


def fit_left(figure: Figure) -> None:
    """Fit the left margin to the tick labels again, after limits changed."""
    figure.subplots_adjust(left=_left_inches(figure) / figure.get_size_inches()[0])


def _left_inches(figure: Figure) -> float:
    """Return the margin left of the plots that tick labels and the axis label need."""
    n_longest = 0
    for axes in figure.axes:
        spec = axes.get_subplotspec()
        if spec is not None and spec.is_first_col():
            ticks = axes.yaxis.get_majorticklocs().tolist()
            texts = axes.yaxis.get_major_formatter().format_ticks(ticks)
            n_longest = max([n_longest, *map(len, texts)])
    return max(_MARGINS_INCHES["left"], _LABEL_INCHES + _INCHES_PER_DIGIT * n_longest)


def _legend_rows(labels: Sequence[str], width: float) -> int:
    columns = [(len(label) + 6) * _INCHES_PER_CHARACTER for label in labels]
    if sum(columns) < width - 0.2:
        return 1
    return math.ceil(len(labels) / max(1, int((width - 0.2) / max(columns))))


def plain_decades(axis: Any) -> None:  # noqa: ANN401 - of any axes
    """Label a logarithmic axis with plain numbers: powers of ten are slow to typeset."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda *_: "")


def draw_curve(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    style: Style,
    *,
    seconds: FloatArray | None = None,
    label: str = "",
    n_columns: int = N_COLUMNS,
) -> None:
    """Draw a curve, thinned to what its pixels can show and broken where poses are missing.

    Parameters
    ----------
    axes : Axes
    x, y : ndarray of float64, shape (n,)
        x increasing.
    style : Style
    seconds : ndarray of float64, shape (n,), optional
        Stamps by which gaps are found; x where omitted.
    label : str
        Entry of the legend; none if empty.
    n_columns : int
        Pixel columns.
    """
    gaps = gaps_before(x if seconds is None else seconds)
    x, y = np.insert(x, gaps, x[gaps]), np.insert(y, gaps, np.nan)
    kept = kept_of_curve(x, y, n_columns=n_columns)
    x, y = x[kept], y[kept]
    axes.plot(x, y, label=plain(label) if label else "_", **asdict(style))
    # a point between two gaps has no line
    is_gap = np.isnan(np.concatenate([[np.nan], y, [np.nan]]))
    lone = np.flatnonzero(is_gap[:-2] & ~is_gap[1:-1] & is_gap[2:])
    if len(lone) > 0:
        axes.plot(x[lone], y[lone], ".", ms=5.0, color=style.color, zorder=style.zorder)


def _shortened(label: str) -> str:
    if len(label) <= _MAX_LABEL:
        return label
    half = _MAX_LABEL // 2 - 1
    return f"{label[:half]}...{label[-half:]}"


def kept_of_curve(x: FloatArray, y: FloatArray, *, n_columns: int = N_COLUMNS) -> IntArray:
    """Return the points of a curve that look the same as all of them.

    Of each pixel column the first, last, smallest and largest point and the first gap are kept.

    Parameters
    ----------
    x : ndarray of float64, shape (n,)
        Increasing, finite.
    y : ndarray of float64, shape (n,)
        NaN at gaps.
    n_columns : int
        Pixel columns.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices, at most five per column; all indices of a short curve.
    """
    n = len(x)
    if n <= 5 * n_columns:
        return np.arange(n)
    columns = columns_of(x, n_columns)
    gaps, solid = np.flatnonzero(np.isnan(y)), np.flatnonzero(~np.isnan(y))
    by_value = solid[np.lexsort([y[solid], columns[solid]])]
    orders = (gaps, solid, solid[::-1], by_value, by_value[::-1])
    return np.unique(np.concatenate([_first(columns, order) for order in orders]))


def columns_of(x: FloatArray, n_columns: int) -> IntArray:
    """Return the pixel column of each x, shape (n,), from 0 to n_columns - 1."""
    extent = float(x[-1] - x[0]) if len(x) > 0 else 0.0
    if extent <= 0.0:
        return np.zeros(len(x), dtype=np.int64)
    columns = np.minimum((x - x[0]) / extent * n_columns, n_columns - 1)
    return np.asarray(columns, dtype=np.int64)


def kept_of_dots(x: FloatArray, y: FloatArray, *, n_columns: int, n_rows: int) -> IntArray:
    """Return one dot of each cell of a grid over the plot: the others are hidden by it.

    Parameters
    ----------
    x, y : ndarray of float64, shape (n,)
        Finite; logarithms on a logarithmic axis.
    n_columns, n_rows : int
        Cells of the grid.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices.
    """
    if len(x) == 0:
        return np.arange(0)
    columns, rows = _cells(x, n_columns), _cells(y, n_rows)
    _, first = np.unique(columns * (n_rows + 1) + rows, return_index=True)
    return np.sort(first)


def _cells(values: FloatArray, n_cells: int) -> IntArray:
    extent = float(np.ptp(values)) or 1.0
    return np.asarray(np.rint((values - values.min()) / extent * n_cells), dtype=np.int64)


def display_path(trajectory: Trajectory) -> FloatArray:
    """Return the simplified path, shape (m, 3), metres, with rows of NaN at gaps.

    The tolerance is 1/3000 of the diagonal of the smallest of the three views (from above for a
    climb); it is doubled until a few thousand points are enough.
    """
    positions = trajectory.positions
    if len(trajectory) == 0:
        return positions
    extents = np.sort(np.ptp(positions, axis=0))
    smallest = max(np.linalg.norm(extents[:2]), _MIN_VIEW * np.linalg.norm(extents))
    tolerance = _PATH_TOLERANCE * float(smallest)
    pieces = np.split(positions, gaps_before(trajectory.stamps_ns / 1e9))
    shown = _within_limit(pieces, tolerance)
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for piece in shown for part in (gap, piece)][1:])


def _within_limit(pieces: list[FloatArray], tolerance: float) -> list[FloatArray]:
    """Simplify all pieces with one tolerance, doubled until few points are left."""
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
    """Return the vertices of a polyline simplified by Douglas and Peucker.

    Parameters
    ----------
    points : ndarray of float64, shape (n, k)
        Finite.
    tolerance : float
        Largest distance of a point to the simplified line, in the unit of the points.
    limit : int, optional
        Stop once more vertices are needed: too small a tolerance costs little then.

    Returns
    -------
    ndarray of int64, shape (m,)
        Increasing indices, including first and last; more than the limit if it stopped.

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
    """Return the first index of each column; the indices are grouped by column."""
    if len(indices) == 0:
        return indices
    return np.asarray(indices[np.diff(columns[indices], prepend=-1) != 0])
