"""Textures and their atlas."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from gvo.types import BoolArray, ImageArray, IntArray

_MAX_ROWS = 32_000  # cv2.remap addresses images with 16 bits
_SMALLEST_LEVEL = 4
N_TEXELS = 1024
Canvas: TypeAlias = NDArray[np.float32]
Box: TypeAlias = tuple[float, float, float, float]
Point: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Texture:
    """A periodic grey image and the area of a surface that it covers.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (n, n)
        Grey values, n a power of two, the same for all textures of a scene.
    size_m : (float, float)
        Width and height of one period, metres.
    mask : ndarray of bool, shape (n, n), optional
        True where the texture is opaque.
    """

    pixels: ImageArray
    size_m: tuple[float, float]
    mask: BoolArray | None = None

    def __post_init__(self) -> None:
        """Check the shape once."""
        n = len(self.pixels)
        if self.pixels.shape != (n, n) or n < _SMALLEST_LEVEL or n & (n - 1):
            raise ValueError(
                f"pixels must be square, their size a power of two, got {self.pixels.shape}"
            )
        if self.mask is not None and self.mask.shape != self.pixels.shape:
            raise ValueError(f"mask must be {self.pixels.shape}, got {self.mask.shape}")


class TextureAtlas:
    """All textures in one image, shrunk independently along rows and columns.

    Level (i, j) of a texture is 2^i times narrower and 2^j times lower, so that surfaces seen
    at a grazing angle are blurred along one direction only.
    """

    def __init__(self, textures: Sequence[Texture]) -> None:
        self.size = len(textures[0].pixels)
        if any(len(texture.pixels) != self.size for texture in textures):
            raise ValueError("the textures of a scene must be of one size")
        n_levels = int(np.log2(self.size // _SMALLEST_LEVEL)) + 1
        sizes = self.size >> np.arange(n_levels)
        starts = np.concatenate([[0], np.cumsum(sizes + 2)])
        span = int(starts[-1])
        n_columns = -(-len(textures) // (_MAX_ROWS // span))
        per_column = -(-len(textures) // n_columns)
        self._image = np.zeros((per_column * span, n_columns * span), dtype=np.uint8)
        corners = []
        for k, texture in enumerate(textures):
            x, y = (k // per_column) * span, (k % per_column) * span
            corners.append((x, y))
            _write_levels(self._image[y : y + span, x : x + span], texture.pixels, starts)
        self.corners: NDArray[np.float32] = np.array(corners, dtype=np.float32)
        # Texel t of level i is at starts[i] + 1 + (t / 2^i - 0.5): one texel of gutter.
        self.starts = (starts[:-1] + 0.5).astype(np.float32)
        masks = [_mask_levels(texture.mask, n_levels) for texture in textures]
        self.masks: BoolArray = np.concatenate(masks)
        lengths = np.array([len(each) for each in masks])
        self._mask_starts = np.cumsum(lengths) - lengths
        self._level_starts = np.cumsum(sizes**2) - sizes**2
        self._mask_sizes = np.where(lengths[:, np.newaxis] > 0, sizes, 0)

    def cuts(self, textures: IntArray, levels: IntArray) -> IntArray:
        """Return where in `masks` those of textures begin, and their sizes (0: none), (n, 2)."""
        levels = np.minimum(levels, len(self.starts) - 1)
        starts = self._mask_starts[textures] + self._level_starts[levels]
        return np.stack([starts, self._mask_sizes[textures, levels]], axis=1)

    def sample(self, map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the grey values at n positions in the atlas, bilinear."""
        # cv2.remap writes images of fewer than 2^15 rows.
        pad = (0, -len(map_x) % 256 or 256 * (len(map_x) == 0))
        x, y = (np.pad(each, pad).reshape(-1, 256) for each in (map_x, map_y))
        grey = np.asarray(cv2.remap(self._image, x, y, cv2.INTER_LINEAR))
        return grey.ravel()[: len(map_x)].astype(np.float32)


def _write_levels(block: ImageArray, pixels: ImageArray, starts: IntArray) -> None:
    narrow = pixels.astype(np.float32)
    for x, x_end in pairwise(starts):
        level = narrow
        for y, y_end in pairwise(starts):
            rounded = np.asarray(cv2.convertScaleAbs(level))
            block[y:y_end, x:x_end] = np.pad(rounded, 1, mode="wrap")
            level = 0.5 * (level[0::2] + level[1::2])
        narrow = 0.5 * (narrow[:, 0::2] + narrow[:, 1::2])


def _mask_levels(mask: BoolArray | None, n_levels: int) -> BoolArray:
    if mask is None:
        return np.zeros(0, dtype=np.bool_)
    shares = mask.astype(np.float32)
    levels = [mask.ravel()]
    for _ in range(n_levels - 1):
        shares = 0.5 * (shares[0::2] + shares[1::2])
        shares = 0.5 * (shares[:, 0::2] + shares[:, 1::2])
        levels.append(shares.ravel() >= 0.5)
    return np.concatenate(levels)


def blank(grey: float) -> Canvas:
    """Return a canvas of one grey value."""
    return np.full((N_TEXELS, N_TEXELS), grey, dtype=np.float32)


def gradient(top: float, bottom: float) -> Canvas:
    """Return a canvas that changes from the first to the last row."""
    column = np.linspace(top, bottom, N_TEXELS, dtype=np.float32)[:, np.newaxis]
    return np.repeat(column, N_TEXELS, axis=1)


def noise(rng: np.random.Generator, *, exponent: float = 1.0, largest: float = 0.5) -> Canvas:
    """Return periodic noise of unit variance whose amplitudes fall as 1/f^exponent."""
    f = _frequencies()
    half = np.where(f < 1.0 / largest, 0.0, np.maximum(f, 1.0) ** np.float32(-exponent))
    amplitudes = np.concatenate([half, half[-2:0:-1]])  # those of -f_y are those of f_y
    white = fft.rfft2(rng.standard_normal((N_TEXELS, N_TEXELS), dtype=np.float32))
    field = fft.irfft2(white * amplitudes.astype(np.float32), s=(N_TEXELS, N_TEXELS))
    return np.asarray(field / field.std(), dtype=np.float32)


@cache
def _frequencies() -> Canvas:
    """Return the frequency of each amplitude, rows from zero to the highest alone."""
    f = np.arange(N_TEXELS // 2 + 1)
    return np.hypot(f, f[:, np.newaxis]).astype(np.float32)


def bricks(
    rng: np.random.Generator, n_columns: int, n_rows: int, *, joint: int = 2, shift: float = 0.5
) -> Canvas:
    """Return a bond of bricks: the tone of each normally distributed, joints at -3."""
    y = np.arange(N_TEXELS) * (n_rows / N_TEXELS)
    row = y.astype(np.int64)
    # Of an even and of an odd row: each texel of a row has its place in one of these.
    x = np.arange(N_TEXELS) * (n_columns / N_TEXELS) + shift * np.array([[0], [1]])
    tones = rng.standard_normal((n_rows, n_columns)).astype(np.float32)
    wide, high = N_TEXELS / n_columns, N_TEXELS / n_rows
    columns = x.astype(np.int64) % n_columns
    canvas = tones[row[:, np.newaxis], columns[row % 2]]
    canvas[((x % 1.0) * wide < joint)[row % 2]] = -3.0
    canvas[(y % 1.0) * high < joint] = -3.0
    return canvas


def fill(canvas: Canvas, box: Box, grey: float | Canvas) -> None:
    """Fill a box (x, y, width, height) with a grey value, or the same part of a canvas."""
    part = _part(box)
    canvas[part] = grey[part] if isinstance(grey, np.ndarray) else grey


def frame(canvas: Canvas, box: Box, grey: float, thickness: float) -> None:
    """Draw the outline of a box, inwards."""
    x, y, w, h = box
    fill(canvas, (x, y, w, thickness), grey)
    fill(canvas, (x, y + h - thickness, w, thickness), grey)
    fill(canvas, (x, y, thickness, h), grey)
    fill(canvas, (x + w - thickness, y, thickness, h), grey)


def _part(box: Box) -> tuple[slice, slice]:
    x, y, w, h = (round(value * N_TEXELS) for value in box)
    return slice(max(y, 0), max(y + max(h, 1), 0)), slice(max(x, 0), max(x + max(w, 1), 0))


def polyline(canvas: Canvas, points: NDArray[np.float64], grey: float, thickness: int) -> None:
    """Draw connected lines through points, shape (n, 2); what leaves comes back opposite."""
    path = np.rint(points * N_TEXELS).astype(np.int32)
    for dx in (-N_TEXELS, 0, N_TEXELS):
        for dy in (-N_TEXELS, 0, N_TEXELS):
            shifted = path + np.array([dx, dy], dtype=np.int32)
            cv2.polylines(canvas, [shifted], False, float(grey), thickness)


def polygon(canvas: Canvas, points: Sequence[Point], grey: float) -> None:
    """Fill a polygon."""
    cv2.fillPoly(canvas, [np.rint(np.array(points) * N_TEXELS).astype(np.int32)], float(grey))


def disc(canvas: Canvas, center: Point, radii: Point, grey: float) -> None:
    """Fill an ellipse."""
    x, y, a, b = (round(value * N_TEXELS) for value in (*center, *radii))
    cv2.ellipse(canvas, (x, y), (a, b), 0, 0, 360, float(grey), cv2.FILLED)


def write(canvas: Canvas, text: str, box: Box, grey: float) -> None:
    """Write a line of text into a box."""
    x, y, w, h = (round(value * N_TEXELS) for value in box)
    font = cv2.FONT_HERSHEY_DUPLEX
    (wide, high), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min(w / wide, h / high)
    ink = np.zeros(canvas[y : y + h, x : x + w].shape, dtype=np.uint8)
    bold = max(1, round(2 * scale))
    cv2.putText(ink, text, (0, len(ink) - 1), font, scale, 255, bold, cv2.LINE_AA)
    share = ink.astype(np.float32) / 255
    canvas[y : y + h, x : x + w] += share * (np.float32(grey) - canvas[y : y + h, x : x + w])


def crack(canvas: Canvas, rng: np.random.Generator, *, n_steps: int, grey: float) -> None:
    """Draw a random walk that keeps its direction for a while."""
    headings = rng.uniform(0, 2 * np.pi) + 0.35 * np.cumsum(rng.standard_normal(n_steps))
    steps = 0.008 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    polyline(canvas, rng.uniform(0, 1, 2) + np.cumsum(steps, axis=0), grey, 2)


def opaque(canvas: Canvas) -> BoolArray:
    """Return the mask of a canvas: opaque where its value is positive."""
    return np.asarray(canvas > 0)


def finish(canvas: Canvas, size_m: tuple[float, float], mask: BoolArray | None = None) -> Texture:
    """Return the texture of a canvas, blurred by half a texel: no lens is sharper."""
    padded = np.pad(canvas, 4, mode="wrap")
    smooth = np.asarray(cv2.GaussianBlur(padded, (0, 0), 0.6))[4:-4, 4:-4]
    pixels = np.clip(np.rint(smooth), 0, 255).astype(np.uint8)
    return Texture(pixels=pixels, size_m=size_m, mask=mask)


def painted(
    painters: Sequence[Callable[[np.random.Generator], Texture]], *seed: int
) -> dict[str, Texture]:
    """Return textures by the names of the functions that paint them, each of a seed of its own."""
    named = {painter.__name__.removeprefix("_"): painter for painter in painters}
    return {
        name: painter(np.random.default_rng([*seed, number]))
        for number, (name, painter) in enumerate(named.items())
    }
