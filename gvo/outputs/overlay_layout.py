"""Where the parts of the picture of a frame are, and the text around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.outputs.depth_colours import HEIGHT_PX as FOOTER_PX
from gvo.outputs.depth_colours import DepthScale, colour_bar
from gvo.outputs.palette import INLIERS, OUTLIERS, STATUSES
from gvo.outputs.strokes import BLACK, WHITE, bgr, shortened, text_width, write
from gvo.types import FaultyFrame, FloatArray, FrameResult, ImageArray, Status

HEADER_PX: Final = 44
MIN_WIDTH_PX: Final = 640
"""The text needs it."""

_WIDE = 2.0  # an image so much wider than high has its depth below
_MARGIN_PX = 8
_GAP_PX = 18
_ROWS_PX = (17, 37)
_DARK_TEXT = frozenset({Status.OK, Status.COASTING})


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Two panels of one size, one above the other or side by side, a header and a footer.

    Parameters
    ----------
    panel : tuple of two int
        Width and height of a panel, pixels; both even, as encoders want them.
    scale : float
        Pixels of a panel per pixel of the image.
    is_stacked : bool
        One panel above the other.
    """

    panel: tuple[int, int]
    scale: float
    is_stacked: bool

    @classmethod
    def of(cls, camera: PinholeCamera, max_width: int) -> Layout:
        """Return the layout for the images of a camera.

        Raises
        ------
        ValueError
            When the picture would be too narrow for its text.
        """
        if max_width < MIN_WIDTH_PX:
            raise ValueError(f"max_width must be at least {MIN_WIDTH_PX}, got {max_width}")
        is_stacked = camera.width >= _WIDE * camera.height
        n_columns = 1 if is_stacked else 2
        widest, narrowest = max_width // n_columns, MIN_WIDTH_PX // n_columns
        width = max(narrowest, min(widest, camera.width)) & ~1
        scale = width / camera.width
        height = max(2, round(camera.height * scale) & ~1)
        return cls(panel=(width, height), scale=scale, is_stacked=is_stacked)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole, pixels."""
        width, height = self.panel
        across, down = (1, 2) if self.is_stacked else (2, 1)
        return across * width, HEADER_PX + down * height + FOOTER_PX

    def empty(self) -> ImageArray:
        """Return a black picture, shape (height, width, 3)."""
        width, height = self.size
        return np.zeros((height, width, 3), dtype=np.uint8)

    def panels(self, canvas: ImageArray) -> tuple[ImageArray, ImageArray]:
        """Return the parts of a picture that are the panels, to be written to."""
        width, height = self.panel
        body = canvas[HEADER_PX : canvas.shape[0] - FOOTER_PX]
        if self.is_stacked:
            return body[:height], body[height:]
        return body[:, :width], body[:, width:]

    def scaled(self, pixels: FloatArray) -> FloatArray:
        """Return where pixels of the image, shape (n, 2), are in a panel."""
        return np.asarray((pixels + 0.5) * self.scale - 0.5)


def write_header(
    canvas: ImageArray,
    layout: Layout,
    result: FrameResult | FaultyFrame,
    *,
    index: int | None,
    rate_hz: float | None = None,
) -> None:
    """Write status, number, stamp, counts and rate above the panels."""
    status = result.status if isinstance(result, FrameResult) else Status.SKIPPED
    upper, lower = _ROWS_PX
    u = _write_badge(canvas, status) + _GAP_PX
    if index is not None:
        u = write(canvas, f"frame {index}", (u, upper))[0] + _GAP_PX
    seconds, nanoseconds = divmod(result.stamp_ns, 10**9)
    write(canvas, f"stamp {seconds}.{nanoseconds // 1000:06d} s", (u, upper))
    if not isinstance(result, FrameResult):
        return
    n_outliers = max(0, result.n_matches - result.n_inliers)
    u = write(canvas, f"{result.n_matches} matches", (_MARGIN_PX, lower))[0] + _GAP_PX
    for text, colour in (
        (f"{result.n_inliers} inliers", bgr(INLIERS)),
        (f"{n_outliers} outliers", bgr(OUTLIERS)),
        (f"{result.n_links} links", WHITE),
    ):
        u = write(canvas, text, (u, lower), colour)[0] + _GAP_PX
    rate = _rate_text(result, rate_hz)
    write(canvas, rate, (layout.size[0] - text_width(rate) - _MARGIN_PX, lower))


def write_footer(canvas: ImageArray, layout: Layout, camera: PinholeCamera, reason: str) -> None:
    """Write a reason, and the scale of depth, below the panels."""
    width, height = layout.size
    middle = width // 2
    canvas[height - FOOTER_PX :, middle:] = colour_bar(DepthScale.of(camera), width - middle)
    text = shortened(reason, middle - 2 * _MARGIN_PX)
    write(canvas, text, (_MARGIN_PX, height - 10))


def _write_badge(canvas: ImageArray, status: Status) -> int:
    """Write the status in a field of its colour; return where that ends."""
    text = status.value
    right = _MARGIN_PX + text_width(text) + 2 * _MARGIN_PX
    field = canvas[2 : _ROWS_PX[0] + 6, _MARGIN_PX:right]
    field[:] = bgr(STATUSES[status.value])
    if status is Status.SKIPPED:  # black on black
        field[[0, -1]] = WHITE
        field[:, [0, -1]] = WHITE
    write(canvas, text, (2 * _MARGIN_PX, _ROWS_PX[0]), BLACK if status in _DARK_TEXT else WHITE)
    return right


def _rate_text(result: FrameResult, rate_hz: float | None) -> str:
    elapsed_ms = sum(result.stage_ms.values())
    if rate_hz is None and elapsed_ms > 0.0:
        rate_hz = 1e3 / elapsed_ms
    parts = [f"{elapsed_ms:.1f} ms"] if elapsed_ms > 0.0 else []
    parts += [] if rate_hz is None else [f"{rate_hz:.1f} Hz"]
    return "   ".join(parts)
