"""Paint periodic grey textures: noise like that of natural images, bricks, boxes, letters.

A canvas is float32, shape (n, n), in grey values. Positions and sizes are shares of the
canvas, so that 0.25 is a quarter of its width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from gvo.sources.atlas import Texture
from gvo.types import BoolArray

N_TEXELS = 1024
Canvas: TypeAlias = NDArray[np.float32]
Box: TypeAlias = tuple[float, float, float, float]
Point: TypeAlias = tuple[float, float]


def blank(grey: float) -> Canvas:
    """Return a canvas of one grey value."""
    return np.full((N_TEXELS, N_TEXELS), grey, dtype=np.float32)


def gradient(top: float, bottom: float) -> Canvas:
    """Return a canvas that changes from the first to the last row."""
    column = np.linspace(top, bottom, N_TEXELS, dtype=np.float32)[:, np.newaxis]
    return np.repeat(column, N_TEXELS, axis=1)


def noise(rng: np.random.Generator, *, exponent: float = 1.0, largest: float = 0.5) -> Canvas:
    """Return periodic noise of unit variance whose amplitudes fall as 1/f^exponent.

    Parameters
    ----------
    rng : Generator
    exponent : float
        0 is white, 1 is like natural images, 2 is cloudy.
    largest : float
        Largest wavelength as a share of the canvas.
    """
    f_x = fft.rfftfreq(N_TEXELS) * N_TEXELS
    f_y = fft.fftfreq(N_TEXELS)[:, np.newaxis] * N_TEXELS
    f = np.hypot(f_x, f_y).astype(np.float32)
    amplitudes = np.where(f < 1.0 / largest, 0.0, np.maximum(f, 1.0) ** np.float32(-exponent))
    white = fft.rfft2(rng.standard_normal((N_TEXELS, N_TEXELS), dtype=np.float32))
    field = fft.irfft2(white * amplitudes.astype(np.float32), s=(N_TEXELS, N_TEXELS))
    return np.asarray(field / field.std(), dtype=np.float32)


def bricks(
    rng: np.random.Generator, n_columns: int, n_rows: int, *, joint: int = 2, shift: float = 0.5
) -> Canvas:
    """Return a bond of bricks: the tone of each normally distributed, joints at -3.

    Parameters
    ----------
    rng : Generator
    n_columns, n_rows : int
        Bricks in a period, the rows an even number.
    joint : int
        Width of the joints, texels.
    shift : float
        Of every second row, in bricks.
    """
    y = np.arange(N_TEXELS)[:, np.newaxis] * (n_rows / N_TEXELS)
    row = y.astype(np.int64)
    x = np.arange(N_TEXELS) * (n_columns / N_TEXELS) + shift * (row % 2)
    tones = rng.standard_normal((n_rows, n_columns))
    wide, high = N_TEXELS / n_columns, N_TEXELS / n_rows
    is_joint = ((x % 1.0) * wide < joint) | ((y % 1.0) * high < joint)
    return np.where(is_joint, -3.0, tones[row, x.astype(np.int64) % n_columns]).astype(np.float32)


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
    corners = np.rint(np.array(points) * N_TEXELS).astype(np.int32)
    cv2.fillPoly(canvas, [corners], float(grey))


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
