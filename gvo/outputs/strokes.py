"""Lines, marks and text on pictures, each kind drawn by a few calls for all points at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np

from gvo.types import FloatArray, ImageArray, IntArray

Colour: TypeAlias = tuple[int, int, int]
"""BGR."""

WHITE: Final[Colour] = (255, 255, 255)
BLACK: Final[Colour] = (0, 0, 0)
_BITS: Final = 4  # of a pixel's fraction, in OpenCV's drawing
_DOT_PX: Final = 2.0
_ARM_PX: Final = 3.0
_MAX_PX: Final = 20_000  # keeps OpenCV's integers from running over
_LINE_PX: Final = 16
_MARGIN_PX: Final = 5
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.45


def bgr(colour: str) -> Colour:
    """Return the BGR value of a colour such as "#E69F00"."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return blue, green, red


def draw_segments(canvas: ImageArray, segments: FloatArray, colour: Colour) -> None:
    """Draw straight lines between pairs of pixels, shape (n, 2, 2)."""
    scaled = np.rint(np.clip(segments, -_MAX_PX, _MAX_PX) * 2**_BITS)
    cv2.polylines(canvas, list(scaled.astype(np.int32)), False, colour, 1, cv2.LINE_AA, _BITS)


def draw_dots(
    canvas: ImageArray, pixels: FloatArray, colours: ImageArray | Colour, radius: float = _DOT_PX
) -> None:
    """Draw discs about pixels, shape (n, 2), in one colour or in colours of shape (n, 3)."""
    # A call of OpenCV for each of hundreds of discs costs more than all else, and holds up the
    # other threads.
    centres = np.rint(np.clip(pixels, -_MAX_PX, _MAX_PX)).astype(np.int64)
    offsets = _disc(radius)
    u, v = (centres[:, np.newaxis] + offsets).reshape(-1, 2).T
    height, width = canvas.shape[:2]
    is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values = np.asarray(colours, dtype=np.uint8)
    if values.ndim == 2:
        values = np.repeat(values, len(offsets), axis=0)[is_inside]
    canvas[v[is_inside], u[is_inside]] = values


def draw_crosses(canvas: ImageArray, pixels: FloatArray, colour: Colour) -> None:
    """Draw diagonal crosses at pixels, shape (n, 2)."""
    for step in ((_ARM_PX, _ARM_PX), (_ARM_PX, -_ARM_PX)):
        draw_segments(canvas, np.stack([pixels - step, pixels + step], axis=1), colour)


def write_lines(canvas: ImageArray, lines: Sequence[str]) -> None:
    """Write text over a darkened strip in the upper left corner."""
    texts = [plain(line) for line in lines]
    if not texts:
        return
    right = max(map(text_width, texts)) + 2 * _MARGIN_PX
    strip = canvas[: _LINE_PX * len(texts) + _MARGIN_PX, :right]
    strip //= 4
    for row, text in enumerate(texts, start=1):
        write(canvas, text, (_MARGIN_PX, _LINE_PX * row - 2))


def write(
    canvas: ImageArray, text: str, corner: tuple[int, int], colour: Colour = WHITE
) -> tuple[int, int]:
    """Write text whose lower left corner is given; return where it ends."""
    text = plain(text)
    cv2.putText(canvas, text, corner, _FONT, _FONT_SCALE, colour, 1, cv2.LINE_AA)
    return corner[0] + text_width(text), corner[1]


def text_width(text: str) -> int:
    """Return the width of a line of text, pixels."""
    return int(cv2.getTextSize(plain(text), _FONT, _FONT_SCALE, 1)[0][0])


def shortened(text: str, n_pixels: int) -> str:
    """Return as much of a line as is so wide, with dots where something is left out."""
    if text_width(text) <= n_pixels:
        return text
    n = next((n for n in range(len(text), 0, -1) if text_width(text[:n] + "...") <= n_pixels), 0)
    return text[:n].rstrip() + "..."


def plain(text: str) -> str:
    """Return text with question marks for what the font does not hold."""
    return text.encode("ascii", "replace").decode()


def _disc(radius: float) -> IntArray:
    n = int(radius)
    v, u = np.mgrid[-n : n + 1, -n : n + 1]
    return np.asarray(np.argwhere(u**2 + v**2 <= radius**2)[:, ::-1] - n, dtype=np.int64)
