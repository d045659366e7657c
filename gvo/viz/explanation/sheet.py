"""A picture with its title above and its caption below, as PNG."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gvo.types import FloatArray, ImageArray
from gvo.viz.palette import INLIERS, OUTLIERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

KEPT: Final = INLIERS
REFUSED: Final = OUTLIERS
BEFORE: Final = "#999999"
AFTER: Final = "#0072B2"
LIMIT: Final = "#D55E00"
_REASONS: Final = ("#E69F00", "#D55E00", "#CC79A7", "#F0E442", "#0072B2", "#009E73", "#999999")
_MARKERS: Final = "xsD^vP+"
_WIDTH_INCHES: Final = 13.0
_DPI: Final = 100
_CAPTION_CHARACTERS: Final = 165
_MIN_CAPTION_CHARACTERS: Final = 80
# The margin of the title, on both sides.
_CAPTION_INCHES: Final = _WIDTH_INCHES * (1.0 - 2 * 0.008)
_LINE_INCHES: Final = 0.235
_FONT_SIZE: Final = 11.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One step of the explanation.

    Parameters
    ----------
    name : str
        Of the file, without its ending: `01_keypoints`.
    title, caption : str
    png : bytes or None
        None where there is nothing to show, and the caption says why.
    """

    name: str
    title: str
    caption: str
    png: bytes | None


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A figure that is being drawn.

    Parameters
    ----------
    figure : Figure
    panels : SubFigure
        Where the axes go.
    """

    figure: Figure
    panels: SubFigure


def open_sheet(height_inches: float, title: str, caption: str) -> Sheet:
    """Make a figure with room for axes of some height between title and caption."""
    from matplotlib.figure import Figure

    lines = wrap(caption)
    below = _LINE_INCHES * (len(lines) + 0.8)
    figure = Figure(
        figsize=(_WIDTH_INCHES, height_inches + 0.45 + below), dpi=_DPI, layout="constrained"
    )
    heights = [height_inches + 0.45, below]
    panels, footer = split(figure, heights)
    panels.suptitle(title, x=0.008, ha="left", fontsize=14, fontweight="bold")
    footer.text(0.008, 0.95, "\n".join(lines), va="top", fontsize=_FONT_SIZE, linespacing=1.35)
    return Sheet(figure=figure, panels=panels)


def split(figure: Figure | SubFigure, heights: Sequence[float]) -> list[SubFigure]:
    """Divide a figure into rows."""
    rows = figure.subfigures(len(heights), 1, height_ratios=list(heights), squeeze=False)
    return [row[0] for row in np.asarray(rows)]


def close_sheet(sheet: Sheet, name: str, title: str, caption: str) -> Picture:
    """Turn a drawn figure into a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(sheet.figure)
    buffer = io.BytesIO()
    sheet.figure.savefig(buffer, format="png", metadata={"Software": None})
    return Picture(name=name, title=title, caption=caption, png=buffer.getvalue())


def words_only(name: str, title: str, caption: str) -> Picture:
    """Return a step that has nothing to show."""
    return Picture(name=name, title=title, caption=caption, png=None)


def wrap(text: str) -> list[str]:
    """Break a caption into lines; its own line breaks stay."""
    return [line for paragraph in text.split("\n") for line in _wrapped(paragraph)]


def _wrapped(paragraph: str) -> list[str]:
    # Letters differ in width: as many characters as fit in the widest line.
    n_characters = _CAPTION_CHARACTERS
    while True:
        lines = textwrap.wrap(paragraph, n_characters) or [""]
        width = max(_width_inches(line) for line in lines)
        if width <= _CAPTION_INCHES or n_characters <= _MIN_CAPTION_CHARACTERS:
            return lines
        n_characters -= 2


def _width_inches(line: str) -> float:
    """Return how wide a line of a caption becomes."""
    from matplotlib.backends.backend_agg import RendererAgg
    from matplotlib.font_manager import FontProperties

    make_renderer: Any = RendererAgg  # has no types
    renderer = make_renderer(1, 1, _DPI)
    font = FontProperties(size=_FONT_SIZE)
    width, _, _ = renderer.get_text_width_height_descent(line, font, ismath=False)
    return float(width) / _DPI


def is_wide(shape: Sequence[int]) -> bool:
    """Tell that images of (height, width) read better above each other than side by side."""
    return shape[1] > 2 * shape[0]


def image_height(shape: Sequence[int], *, share: float = 1.0) -> float:
    """Return the height in inches of an image over a share of the width, its title included."""
    return 0.97 * share * _WIDTH_INCHES * shape[0] / shape[1] + 0.3


def paired_height(shape: Sequence[int]) -> float:
    """Return the height in inches of two images with lines between them."""
    joined = (2 * shape[0], shape[1]) if is_wide(shape) else (shape[0], 2 * shape[1])
    return image_height(joined)


def show_image(axes: Axes, image: Any, title: str = "", **options: Any) -> None:  # noqa: ANN401
    """Show an image, grey unless told otherwise, without ticks."""
    axes.imshow(image, **{"cmap": "gray", "vmin": 0, "vmax": 255, **options})
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks([])
    if title:
        axes.set_title(title, fontsize=_FONT_SIZE, loc="left")


def join_images(first: ImageArray, second: ImageArray) -> tuple[ImageArray, FloatArray]:
    """Put two images above each other or side by side; also the second's first pixel."""
    axis = 0 if is_wide(first.shape) else 1
    shift = np.zeros(2)
    shift[1 - axis] = first.shape[axis]
    return np.concatenate([first, second], axis=axis), shift


def draw_segments(
    axes: Axes,
    starts: FloatArray,
    ends: FloatArray,
    **options: Any,  # noqa: ANN401 - matplotlib's
) -> Any:  # noqa: ANN401
    """Draw lines between pixels (n, 2) and return the collection."""
    from matplotlib.collections import LineCollection

    lines = LineCollection(list(np.stack([starts, ends], axis=1)), **{"linewidths": 1.0, **options})
    axes.add_collection(lines, autolim=False)
    return lines


def reason_style(number: int) -> dict[str, Any]:
    """Return colour and marker of a reason to drop something."""
    colour, marker = _REASONS[number % len(_REASONS)], _MARKERS[number % len(_MARKERS)]
    return {"color": colour, "marker": marker, "linestyle": "none", "markersize": 6.0}


def legend_below(axes: Axes, n_columns: int) -> None:
    """Put the legend under the axes, where it hides nothing."""
    if not axes.get_legend_handles_labels()[1]:
        return
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(0.0, -0.01),
        ncols=n_columns,
        fontsize=10,
        frameon=False,
        borderaxespad=0.0,
        handletextpad=0.3,
        columnspacing=1.2,
    )


def count_text(counts: dict[str, int]) -> str:
    """Return counts as words: `track lost 3, kept 12`; what did not occur is left out."""
    return ", ".join(f"{name} {number}" for name, number in counts.items() if number) or "none"
