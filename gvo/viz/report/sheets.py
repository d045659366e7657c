"""One plot of the report; points thinned for display."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.errors import ConfigurationError
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.palette import Style
from gvo.viz.plots import METADATA, gaps_before, plain, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

N_COLUMNS = 1000
"""Columns of a plot over the whole width, about the pixels that it has."""
_MAX_PATH_POINTS = 3000
# of the diagonal of a view of the path: less than half a pixel
_PATH_TOLERANCE = 1.0 / 3000.0
# of the diagonal in space: no view is taken for smaller, as that along a straight line is
_MIN_VIEW = 0.02
WIDE = 11.0
"""Inches of a plot over the whole page."""
HALF = 6.4
"""Inches of a plot of which two stand side by side."""
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plot:
    """A plot of the report, or why there is none.

    Parameters
    ----------
    slug : str
        What its files are called by.
    title : str
    text : str
        What it shows and what a good one looks like; where there is no figure, why.
    figure : Figure or None
    is_half : bool
        Two of them fit side by side.
    """

    slug: str
    title: str
    text: str
    figure: Figure | None = None
    is_half: bool = False

    def svg(self) -> str:
        """Return the figure as SVG that can stand within a page beside others."""
        if self.figure is None:
            raise ValueError(f"{self.slug} has no figure")
        buffer = io.StringIO()
        self.figure.savefig(buffer, format="svg", metadata=METADATA[".svg"])
        return _inlined(buffer.getvalue(), self.slug, self.title)


@contextmanager
def settings() -> Iterator[None]:
    """Let figures that are made and written in the context look as those of the report."""
    from matplotlib import rc_context

    with rc_context(_SETTINGS):  # type: ignore[arg-type,unused-ignore]
        yield


def write_plots(plots: Sequence[Plot], folder: Path) -> list[Path]:
    """Write each figure as PNG and PDF.

    Parameters
    ----------
    plots : sequence of Plot
        Numbered as they stand in the report; those without a figure keep their number.
    folder : Path
        Made where it is missing.

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
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"--plots {folder}: cannot be made: {error.strerror}; give a folder to write into"
        ) from error
    paths = []
    for number, plot in enumerate(plots, start=1):
        if plot.figure is None:
            continue
        for suffix in (".png", ".pdf"):
            paths.append(folder / f"{number:02d}_{plot.slug}{suffix}")
            save_figure(plot.figure, paths[-1])
    return paths


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def arrange(figure: Figure, axes: Axes | None = None, *, left: float | None = None) -> None:
    """Lay out a figure, with the legend of some axes above its plots.

    Parameters
    ----------
    figure : Figure
    axes : Axes, optional
        Whose labels go into the legend; no legend where omitted.
    left : float, optional
        Inches left of the plots.
    """
    width, height = figure.get_size_inches()
    margins = dict(_MARGINS_INCHES)
    margins["left"] = left or _left_inches(figure)
    handles, labels = ([], []) if axes is None else axes.get_legend_handles_labels()
    if labels:
        labels = [_shortened(label) for label in labels]
        n_rows = _legend_rows(labels, width)
        margins["top"] += n_rows * _LEGEND_ROW_INCHES
        figure.legend(
            handles,
            labels,
            loc="upper center",
            ncols=math.ceil(len(labels) / n_rows),
            frameon=False,
            borderaxespad=0.1,
        )
    figure.subplots_adjust(
        left=margins["left"] / width,
        right=1.0 - margins["right"] / width,
        bottom=margins["bottom"] / height,
        top=1.0 - min(margins["top"], 0.5 * height) / height,
    )


def fit_left(figure: Figure) -> None:
    """Make room for the numbers left of the plots, where the limits changed after `arrange`."""
    figure.subplots_adjust(left=_left_inches(figure) / figure.get_size_inches()[0])


def _left_inches(figure: Figure) -> float:
    """Return the margin that the longest number left of the plots needs, with its label."""
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
    """Label a logarithmic axis by plain numbers: powers would cost more than all else."""
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
    """Draw a curve with what its pixels can show; it ends where poses are missing.

    Parameters
    ----------
    axes : Axes
    x, y : ndarray of float64, shape (n,)
        x increases.
    style : Style
    seconds : ndarray of float64, shape (n,), optional
        By which poses are missing; x where omitted.
    label : str
        In the legend; none where empty.
    n_columns : int
        Of pixels.
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
        looks: dict[str, Any] = {
            "marker": ".",
            "markersize": 5.0,
            "linestyle": "",
            "zorder": style.zorder,
        }
        axes.plot(x[lone], y[lone], color=style.color, **looks)


def elapsed(stamps_ns: IntArray, first_ns: int) -> FloatArray:
    """Return seconds since a stamp."""
    return np.asarray((stamps_ns - first_ns) / 1e9, dtype=np.float64)


def _shortened(label: str) -> str:
    if len(label) <= _MAX_LABEL:
        return label
    half = _MAX_LABEL // 2 - 1
    return f"{label[:half]}...{label[-half:]}"


def _rounded(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}"


def _inlined(svg: str, slug: str, title: str) -> str:
    """Return SVG without prolog, metadata and foreign names; its ids begin with the slug."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    svg = _FAMILY.sub(lambda match: f"font-size: {match[1]}" if match[1] else "", svg)
    used = set(_REFERENCE.findall(svg))
    svg = _ID.sub(lambda match: f' id="{slug}-{match[1]}"' if match[1] in used else "", svg)
    svg = re.sub(r"(url\(#|href=\"#)", rf"\g<1>{slug}-", svg)
    svg = _TAG.sub(lambda tag: _NUMBER.sub(_rounded, tag[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" @>', svg, count=1)
    return svg.replace("@", f'role="img" aria-label="{title}"', 1).strip()
