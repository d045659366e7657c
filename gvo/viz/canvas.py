"""Lines, marks, text, depth colours with OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import DepthArray, FloatArray, ImageArray, IntArray

Colour: TypeAlias = tuple[int, int, int]
"""BGR."""

WHITE: Final[Colour] = (255, 255, 255)
BLACK: Final[Colour] = (0, 0, 0)
HEIGHT_PX: Final = 28
"""Of the colour bar with its numbers."""
LABEL: Final = "depth [m]"

_BITS: Final = 4  # fractional bits of OpenCV's fixed-point pixels
_DOT_PX: Final = 2.0
_ARM_PX: Final = 3.0
_MAX_PX: Final = 20_000  # keeps OpenCV's integers from overflowing
_LINE_PX: Final = 16
_MARGIN_PX: Final = 5
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.45
_DARKEST = 64  # of viridis: darker colours vanish in a dark image
_FAR_DISPARITY_PX = 2.0
_NEAR_SHARE = 8.0  # image width over the disparity of the near end
_RGBD_M = (0.4, 8.0)
_UNKNOWN = (16, 16, 16)
_N_STEPS: Final = 4000  # of 2 mm up to 8 m
_BAR_MARGIN_PX = 8
_BAR_PX = 9


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
    """Draw discs at pixels, shape (n, 2), in one colour or in colours of shape (n, 3)."""
    # hundreds of calls of OpenCV would be the slowest part, and hold up the other threads
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
    """Write lines of text on a darkened strip in the upper left corner."""
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
    """Write text from its lower left corner; return its lower right corner."""
    text = plain(text)
    cv2.putText(canvas, text, corner, _FONT, _FONT_SCALE, colour, 1, cv2.LINE_AA)
    return corner[0] + text_width(text), corner[1]


def text_width(text: str) -> int:
    """Return the width of a line of text, pixels."""
    return int(cv2.getTextSize(plain(text), _FONT, _FONT_SCALE, 1)[0][0])


def shortened(text: str, n_pixels: int) -> str:
    """Return the text cut to a width in pixels, with an ellipsis if cut."""
    if text_width(text) <= n_pixels:
        return text
    n = next((n for n in range(len(text), 0, -1) if text_width(text[:n] + "...") <= n_pixels), 0)
    return text[:n].rstrip() + "..."


def plain(text: str) -> str:
    """Return the text with question marks for characters that are not ASCII."""
    return text.encode("ascii", "replace").decode()


def _disc(radius: float) -> IntArray:
    n = int(radius)
    v, u = np.mgrid[-n : n + 1, -n : n + 1]
    return np.asarray(np.argwhere(u**2 + v**2 <= radius**2)[:, ::-1] - n, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScale:
    """Viridis over the logarithm of depth: near is bright.

    Parameters
    ----------
    near_m, far_m : float
        Depths of the ends; depths beyond take the colour of the end.
    """

    near_m: float
    far_m: float

    @classmethod
    def of(cls, camera: PinholeCamera) -> DepthScale:
        """Return the scale for a stereo camera, by its disparities, or for an RGB-D camera."""
        if not isinstance(camera, StereoCamera):
            return cls(near_m=_RGBD_M[0], far_m=_RGBD_M[1])
        disparities = np.array([camera.width / _NEAR_SHARE, _FAR_DISPARITY_PX])
        near_m, far_m = camera.disparity_to_depth(disparities)
        return cls(near_m=float(near_m), far_m=float(far_m))

    def levels(self, depths: FloatArray | DepthArray) -> ImageArray:
        """Return the indices into `table` of depths in metres; NaN counts as far."""
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.log(depths / self.far_m) * (255.0 / np.log(self.near_m / self.far_m))
        known = np.nan_to_num(shares, nan=0.0, posinf=255.0, neginf=0.0)
        return np.asarray(np.rint(np.clip(known, 0.0, 255.0)), dtype=np.uint8)

    def ticks(self) -> list[float]:
        """Return round depths within the scale, metres."""
        decades = range(-3, 5)
        candidates = [digit * 10.0**n for n in decades for digit in (1, 2, 5)]
        return [depth for depth in candidates if self.near_m <= depth <= self.far_m]


@lru_cache
def table() -> ImageArray:
    """Return the colours, shape (256, 3), BGR, from far to near."""
    levels = np.linspace(_DARKEST, 255, 256).round().astype(np.uint8)
    coloured = cv2.applyColorMap(levels[:, np.newaxis], cv2.COLORMAP_VIRIDIS)
    colours = np.asarray(coloured, dtype=np.uint8).reshape(256, 3)
    colours.setflags(write=False)
    return colours


def paint_depth(depth: DepthArray, scale: DepthScale, size: tuple[int, int]) -> ImageArray:
    """Return a depth image in colours, unknown depth dark.

    Parameters
    ----------
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown.
    scale : DepthScale
    size : tuple of two int
        Width and height of the picture.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
    """
    # no interpolation: there is nothing between a near and a far pixel
    resized = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    # a table over even steps of depth replaces slow logarithms of all pixels
    steps = np.array(resized, dtype=np.float32)
    cv2.patchNaNs(steps, 0.0)
    steps *= _N_STEPS / scale.far_m
    np.minimum(steps, _N_STEPS, out=steps)
    return np.asarray(_colours_of_steps(scale)[steps.astype(np.uint16)])


@lru_cache(maxsize=8)
def _colours_of_steps(scale: DepthScale) -> ImageArray:
    """Return the colours of even steps of depth up to the far end, shape (n, 3); 0: unknown."""
    depths = np.arange(1, _N_STEPS + 1) * (scale.far_m / _N_STEPS)
    colours = np.concatenate([np.full((1, 3), _UNKNOWN), table()[scale.levels(depths)]])
    return colours.astype(np.uint8)


@lru_cache(maxsize=8)
def colour_bar(scale: DepthScale, width: int) -> ImageArray:
    """Return the colour bar with its numbers, shape (HEIGHT_PX, width, 3), near at the left."""
    bar = np.zeros((HEIGHT_PX, width, 3), dtype=np.uint8)
    left = write(bar, LABEL, (_BAR_MARGIN_PX, HEIGHT_PX - 10))[0] + 2 * _BAR_MARGIN_PX
    right = width - 3 * _BAR_MARGIN_PX
    columns = np.linspace(255, 0, right - left).round().astype(np.int64)
    bar[2 : 2 + _BAR_PX, left:right] = table()[columns]
    is_free_from = 0
    for depth, level in zip(scale.ticks(), _shares(scale), strict=True):
        text = f"{depth:g}"
        u = left + round(level * (right - left - 1))
        start = u - text_width(text) // 2
        if start < is_free_from or start + text_width(text) > width:
            continue
        bar[2 : 5 + _BAR_PX, u] = WHITE
        is_free_from = write(bar, text, (start, HEIGHT_PX - 4))[0] + _BAR_MARGIN_PX
    bar.setflags(write=False)
    return bar


def _shares(scale: DepthScale) -> FloatArray:
    depths = np.array(scale.ticks())
    return np.asarray(np.log(depths / scale.near_m) / np.log(scale.far_m / scale.near_m))


def in_groups(
    levels: ImageArray, n_groups: int = 32
) -> list[tuple[IntArray, tuple[int, int, int]]]:
    """Group points of similar level: indices and colour of each group."""
    groups = levels.astype(np.int64) * n_groups // 256
    found = []
    for group in np.unique(groups):
        indices = np.flatnonzero(groups == group)
        blue, green, red = table()[int((group + 0.5) * 256 / n_groups)].tolist()
        found.append((indices, (blue, green, red)))
    return found
