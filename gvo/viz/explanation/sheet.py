"""A picture with its title above and its caption below, as PNG."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.font_manager import FontProperties
from matplotlib.image import imsave

from gvo.types import FloatArray, ImageArray
from gvo.viz.palette import INLIERS, OUTLIERS

KEPT: Final = INLIERS
REFUSED: Final = OUTLIERS
BEFORE: Final = "#999999"
AFTER: Final = "#0072B2"
LIMIT: Final = "#D55E00"
REASONS: Final = ("#E69F00", "#D55E00", "#CC79A7", "#F0E442", "#0072B2", "#009E73", "#999999")
MARKERS: Final = "xsD^vP+"
TITLES: Final = {
    "01_keypoints": "Keypoints and buckets",
    "02_stereo": "Stereo matches",
    "02_depth": "Valid depth",
    "03_subpixel": "Sub-pixel disparity of one match",
    "03_depth_keypoints": "Keypoints with depth",
    "04_disparity_and_depth": "Disparity and depth",
    "05_matches": "Matches with the reference",
    "06_consensus": "Consensus: which matches agree on a motion",
    "07_residuals": "Residuals before and after the refinement",
    "08_pose": "The pose and its covariance",
    "09_links": "Links to earlier frames",
}
"""Of the pictures by name, in order."""
_WIDTH_INCHES: Final = 13.0
_DPI: Final = 100
_CAPTION_CHARACTERS: Final = 165
_MIN_CAPTION_CHARACTERS: Final = 80
# The margin of the title, on both sides.
_MARGIN: Final = 0.008
_LINE_INCHES: Final = 0.235
_TITLE_INCHES: Final = 0.45
_FONT_SIZE: Final = 11.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One step of the explanation.

    Parameters
    ----------
    name : str
        Of the file, without its ending: one of `TITLES`.
    caption : str
    png, panels_png : bytes or None
        With title and caption, and without; None if there is nothing to show: the caption says why.
    """

    name: str
    caption: str
    png: bytes | None = None
    panels_png: bytes | None = None

    @property
    def title(self) -> str:
        """Its title."""
        return TITLES[self.name]


class Sheet:
    """A picture that is being drawn.

    Parameters
    ----------
    name, caption : str
    height_inches : float
        Of the axes.

    Attributes
    ----------
    panels : SubFigure
        The room for the axes.
    """

    def __init__(self, name: str, caption: str, height_inches: float) -> None:
        self._name, self._caption = name, caption
        lines = [line for paragraph in caption.split("\n") for line in _wrap(paragraph)]
        heights = [height_inches + _TITLE_INCHES, _LINE_INCHES * (len(lines) + 0.8)]
        self._figure = Figure(figsize=(_WIDTH_INCHES, sum(heights)), dpi=_DPI, layout="constrained")
        self.panels, self._footer = split(self._figure, heights)
        self._title = self.panels.suptitle(
            TITLES[name], x=_MARGIN, ha="left", fontsize=14, fontweight="bold"
        )
        text = "\n".join(lines)
        self._footer.text(_MARGIN, 0.95, text, va="top", fontsize=_FONT_SIZE, linespacing=1.35)

    def colorbar(self, mappable: Any, axes: Axes, **options: Any) -> None:  # noqa: ANN401
        """Add a colour bar beside axes."""
        self._figure.colorbar(mappable, ax=axes, **{"pad": 0.01, **options})

    def picture(self) -> Picture:
        """Return the picture drawn."""
        canvas: Any = FigureCanvasAgg(self._figure)  # has no types
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
        top, bottom = (
            len(pixels) - round(height)
            for height in (self._title.get_window_extent().y0, self._footer.bbox.y1)
        )
        png, panels_png = _encode(pixels), _encode(pixels[top:bottom])
        return Picture(name=self._name, caption=self._caption, png=png, panels_png=panels_png)


def _encode(pixels: ImageArray) -> bytes:
    buffer, metadata = io.BytesIO(), cast("dict[str, str]", {"Software": None})
    imsave(buffer, pixels, format="png", dpi=_DPI, metadata=metadata)
    return buffer.getvalue()


def split(figure: Figure | SubFigure, heights: Sequence[float]) -> list[SubFigure]:
    """Divide a figure into rows."""
    rows = figure.subfigures(len(heights), 1, height_ratios=list(heights), squeeze=False)
    return [row[0] for row in np.asarray(rows)]


def _wrap(paragraph: str) -> list[str]:
    # Letters differ in width: as many characters as fit in the widest line.
    n_characters = _CAPTION_CHARACTERS
    while True:
        lines = textwrap.wrap(paragraph, n_characters) or [""]
        width = max(_width_inches(line) for line in lines)
        if width <= _WIDTH_INCHES * (1 - 2 * _MARGIN) or n_characters <= _MIN_CAPTION_CHARACTERS:
            return lines
        n_characters -= 2


def _width_inches(line: str) -> float:
    """Return the width of a line of a caption."""
    make_renderer: Any = RendererAgg  # has no types
    renderer, font = make_renderer(1, 1, _DPI), FontProperties(size=_FONT_SIZE)
    return float(renderer.get_text_width_height_descent(line, font, ismath=False)[0]) / _DPI


def is_wide(shape: Sequence[int]) -> bool:
    """Tell whether images of (height, width) belong above each other rather than side by side."""
    return shape[1] > 2 * shape[0]


def image_height(shape: Sequence[int], *, share: float = 1.0) -> float:
    """Return the height in inches of an image over a share of the width, its title included."""
    return 0.97 * share * _WIDTH_INCHES * shape[0] / shape[1] + 0.3


def paired_height(shape: Sequence[int]) -> float:
    """Return the height in inches of two images with lines between them."""
    return image_height((2 * shape[0], shape[1]) if is_wide(shape) else (shape[0], 2 * shape[1]))


def show_image(axes: Axes, image: Any, title: str = "", **options: Any) -> None:  # noqa: ANN401
    """Show an image, grey by default, without ticks."""
    axes.imshow(image, **{"cmap": "gray", "vmin": 0, "vmax": 255, **options})
    height, width = image.shape[:2]
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=_FONT_SIZE, loc="left")


def finish_axes(axes: Axes, x_label: str, y_label: str, title: str = "", **legend: Any) -> None:  # noqa: ANN401
    """Label axes, with a grid and a legend."""
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.set_title(title, fontsize=_FONT_SIZE, loc="left")
    axes.grid(color=BEFORE, alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(**{"fontsize": 9, **legend})


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


def legend_below(axes: Axes, n_columns: int, **options: Any) -> None:  # noqa: ANN401
    """Put the legend under the axes, where it hides nothing."""
    if options or axes.get_legend_handles_labels()[1]:
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(0.0, -0.01),
            ncols=n_columns,
            fontsize=10,
            frameon=False,
            borderaxespad=0.0,
            handletextpad=0.3,
            columnspacing=1.2,
            **options,
        )


def count_text(counts: dict[str, int]) -> str:
    """Return counts as words, zeros left out: `track lost 3, kept 12`."""
    return ", ".join(f"{name} {number}" for name, number in counts.items() if number) or "none"
