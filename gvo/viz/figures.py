"""What all figures share: style, layout, legends, curves, images, and how they become files."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gvo._text import visible
from gvo.errors import ConfigurationError, TrajectoryError, named_faults, write_faults
from gvo.types import FloatArray, ImageArray, IntArray
from gvo.viz.palette import Style

WIDE = 11.0
"""Width of a figure across the page, inches."""
HALF = 6.4
"""Width of a figure that shares a row with another, inches."""
MANY = 3000
"""From so many points on a curve or a filled area is drawn as pixels, also within SVG."""
HOLLOW: dict[str, Any] = {"mfc": "white", "mec": "black", "zorder": 4.0}
"""The mark of the start of a path."""

# Equal input gives equal files: no dates, no versions.
_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None, "Type": None, "Format": None},
}
_GAP = 10.0  # a line is broken at steps longer than so many medians
_MAX_LABEL = 60
_INCHES_PER_CHARACTER = 0.072
_STYLE: dict[str, Any] = {
    "font.family": ["sans-serif"],
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",
}


@contextmanager
def style(salt: str = "gvo") -> Iterator[None]:
    """Make and write figures in the style of gvo within the context.

    Parameters
    ----------
    salt : str
        Of the ids within SVG, which would be random without it.
    """
    settings: Any = {**_STYLE, "svg.hashsalt": salt}  # names that are typed in newer Matplotlib
    with rc_context(settings):
        yield


def new_figure(height: float, width: float = WIDE) -> Figure:
    """Return an empty figure, inches, that makes room for labels and legends by itself."""
    return ShownFigure(figsize=(width, height), layout="constrained")


class ShownFigure(Figure):
    """A figure that a notebook shows, without `pyplot` and its backends."""

    def _repr_png_(self) -> bytes:
        return _encoded(self, ".png", salt="gvo")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plot:
    """A figure with its words, or the reason why there is none.

    Parameters
    ----------
    slug : str
        Id of its section, and stem of its file names.
    title : str
    text : str
        What it shows, or the reason why there is no figure; empty where `pages/plots.html` says it.
    facts : mapping of str to object
        Numbers for the words there.
    figure : Figure or None
    is_half : bool
        Two of them share a row.
    is_image : bool
        It shows photographs: the page embeds it as PNG.
    """

    slug: str
    title: str
    text: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    figure: Figure | None = None
    is_half: bool = False
    is_image: bool = False

    def svg(self) -> str:
        """Return the figure as an SVG element."""
        text = self._encoded(".svg").decode()
        return text[text.index("<svg") :]

    def png(self) -> bytes:
        """Return the figure as a PNG file."""
        return self._encoded(".png")

    def _encoded(self, suffix: str) -> bytes:
        if self.figure is None:
            raise ValueError(f"{self.slug} has no figure")
        return _encoded(self.figure, suffix, salt=self.slug)


def _encoded(figure: Figure, suffix: str, *, salt: str) -> bytes:
    buffer = io.BytesIO()
    with style(salt):
        _write(figure, buffer, suffix)
    return buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as its suffix says; equal figures give equal files."""
    suffix = path.suffix.lower()
    with write_faults(TrajectoryError, path), style():
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(figure, path, suffix, dpi=150)


def _write(figure: Figure, to: Path | io.BytesIO, suffix: str, **options: Any) -> None:  # noqa: ANN401
    if (engine := figure.get_layout_engine()) is not None:
        # Once: laid out again it would differ a little, and with an engine savefig draws twice.
        engine.execute(figure)
        figure.set_layout_engine(None)
    figure.savefig(to, format=suffix[1:], metadata=_METADATA[suffix], **options)


def write_plots(plots: Sequence[Plot], folder: Path) -> list[Path]:
    """Write each figure as PNG and PDF, numbered in the order of the page."""
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


def legend_above(figure: Figure, axes: Axes) -> None:
    """List the labels of some axes above all axes of their figure, in rows that fit."""
    _legend(figure, axes, "outside upper center")


def legend_below(figure: Figure, axes: Axes) -> None:
    """List the labels of some axes below all axes of their figure, in rows that fit."""
    _legend(figure, axes, "outside lower center")


def _legend(figure: Figure, axes: Axes, place: Any) -> None:  # noqa: ANN401 - of matplotlib
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return
    labels = [_shortened(label) for label in labels]
    widths = [(len(label) + 6) * _INCHES_PER_CHARACTER for label in labels]
    room = figure.get_size_inches()[0] - 0.2
    n_fitting = len(labels) if sum(widths) < room else max(1, int(room / max(widths)))
    n_rows = math.ceil(len(labels) / n_fitting)
    figure.legend(handles, labels, loc=place, ncols=math.ceil(len(labels) / n_rows), frameon=False)


def _shortened(label: str) -> str:
    half = _MAX_LABEL // 2 - 1
    return label if len(label) <= _MAX_LABEL else f"{label[:half]}...{label[-half:]}"


def draw_curve(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    style: Style,
    *,
    seconds: FloatArray | None = None,
    label: str = "",
) -> None:
    """Draw a curve over increasing x, broken where poses are missing by `seconds` (else by x)."""
    gaps = gaps_before(x if seconds is None else seconds)
    x, y = np.insert(x, gaps, x[gaps]), np.insert(y, gaps, np.nan)
    axes.plot(x, y, label=plain(label) if label else "_", **asdict(style))
    # A point between two gaps has no line.
    is_gap = np.isnan(np.concatenate([[np.nan], y, [np.nan]]))
    lone = np.flatnonzero(is_gap[:-2] & ~is_gap[1:-1] & is_gap[2:])
    axes.plot(x[lone], y[lone], ".", ms=5.0, color=style.color, zorder=style.zorder)


def gaps_before(seconds: FloatArray) -> IntArray:
    """Return the indices of the poses that follow a gap, by their increasing stamps, shape (n,)."""
    steps = np.diff(seconds)
    if len(steps) == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(np.flatnonzero(steps > _GAP * np.median(steps)) + 1, dtype=np.int64)


def broken(seconds: FloatArray, points: FloatArray) -> FloatArray:
    """Return points, shape (n, k), with rows of NaN where poses are missing."""
    return np.insert(points, gaps_before(seconds), np.nan, axis=0)


def evenly(n: int, n_most: int) -> IntArray:
    """Return indices of n items, at most so many, spread evenly with first and last among them."""
    return np.linspace(0, n - 1, min(n, n_most)).round().astype(np.int64)


def elapsed(stamps_ns: IntArray, first_ns: int) -> FloatArray:
    """Return seconds since a stamp."""
    return np.asarray((stamps_ns - first_ns) / 1e9, dtype=np.float64)


def plain(name: str) -> str:
    """Escape what matplotlib takes for markup: dollars, a leading underscore; else `visible`."""
    text = visible(name).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def plain_decades(axis: Any) -> None:  # noqa: ANN401 - of any axes
    """Label a logarithmic axis with plain numbers: powers of ten are slow to typeset."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda *_: "")


def is_wide(shape: Sequence[int]) -> bool:
    """Tell whether images of (height, width) belong above each other, not side by side."""
    return shape[1] > 2 * shape[0]


def image_height(shape: Sequence[int], *, share: float = 1.0) -> float:
    """Return the height in inches of an image over a share of the width, its title included."""
    return share * WIDE * shape[0] / shape[1] + 0.3


def pair_height(shape: Sequence[int]) -> float:
    """Return the height in inches of two images joined by `join_images`."""
    return image_height((2 * shape[0], shape[1]) if is_wide(shape) else (shape[0], 2 * shape[1]))


def show_image(axes: Axes, image: Any, title: str = "", **options: Any) -> None:  # noqa: ANN401
    """Show an image, grey by default, without ticks."""
    axes.imshow(image, **{"cmap": "gray", "vmin": 0, "vmax": 255, **options})
    height, width = image.shape[:2]
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.set_title(title, loc="left")


def join_images(first: ImageArray, second: ImageArray) -> tuple[ImageArray, FloatArray]:
    """Put two images above each other or side by side; also return the second's first pixel."""
    axis = 0 if is_wide(first.shape) else 1
    shift = np.zeros(2)
    shift[1 - axis] = first.shape[axis]
    return np.concatenate([first, second], axis=axis), shift


def draw_segments(axes: Axes, starts: FloatArray, ends: FloatArray, **options: Any) -> Any:  # noqa: ANN401
    """Draw lines between pixels (n, 2) and return the collection."""
    lines = LineCollection(list(np.stack([starts, ends], axis=1)), **{"linewidths": 1.0, **options})
    axes.add_collection(lines, autolim=False)
    return lines


def count_words(counts: Mapping[str, int]) -> str:
    """Return counts as words, zeros left out: `track lost 3, kept 12`."""
    return ", ".join(f"{name} {number}" for name, number in counts.items() if number) or "none"
