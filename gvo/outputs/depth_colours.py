"""Depth as colours: one scale per camera, the same in every frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.outputs.strokes import WHITE, text_width, write
from gvo.types import DepthArray, FloatArray, ImageArray, IntArray

LABEL: Final = "depth [m]"
HEIGHT_PX: Final = 28
"""Of the bar with its numbers."""

_DARKEST = 64  # of viridis: what is darker does not stand out of a dark image
_FAR_DISPARITY_PX = 2.0
_NEAR_SHARE = 8.0  # of the width of the image, as disparity of the nearest
_RGBD_M = (0.4, 8.0)
_UNKNOWN = (16, 16, 16)
_N_STEPS: Final = 4000  # of 2 mm where the far end is 8 m
_MARGIN_PX = 8
_BAR_PX = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScale:
    """Viridis over the logarithm of depth: near is bright.

    Parameters
    ----------
    near_m, far_m : float
        Depths of the ends; what is beyond has the colour of the end.
    """

    near_m: float
    far_m: float

    @classmethod
    def of(cls, camera: PinholeCamera) -> DepthScale:
        """Return the scale of a stereo camera, by its disparities, or of an RGB-D camera."""
        if not isinstance(camera, StereoCamera):
            return cls(near_m=_RGBD_M[0], far_m=_RGBD_M[1])
        disparities = np.array([camera.width / _NEAR_SHARE, _FAR_DISPARITY_PX])
        near_m, far_m = camera.disparity_to_depth(disparities)
        return cls(near_m=float(near_m), far_m=float(far_m))

    def levels(self, depths: FloatArray | DepthArray) -> ImageArray:
        """Return rows of the table of colours, 0 to 255, of depths in metres; NaN as far."""
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.log(depths / self.far_m) * (255.0 / np.log(self.near_m / self.far_m))
        known = np.nan_to_num(shares, nan=0.0, posinf=255.0, neginf=0.0)
        return np.asarray(np.rint(np.clip(known, 0.0, 255.0)), dtype=np.uint8)

    def ticks(self) -> list[float]:
        """Return round depths between the ends, metres."""
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
    # Neither blended nor rounded: between a near and a far pixel there is nothing.
    resized = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    # Logarithms of all pixels would take most of the time: a table by even steps has them ready.
    steps = np.array(resized, dtype=np.float32)
    cv2.patchNaNs(steps, 0.0)
    steps *= _N_STEPS / scale.far_m
    np.minimum(steps, _N_STEPS, out=steps)
    return np.asarray(_colours_of_steps(scale)[steps.astype(np.uint16)])


@lru_cache(maxsize=8)
def _colours_of_steps(scale: DepthScale) -> ImageArray:
    """Return the colours of even steps of depth up to the far end, shape (n, 3); 0 is unknown."""
    depths = np.arange(1, _N_STEPS + 1) * (scale.far_m / _N_STEPS)
    colours = np.concatenate([np.full((1, 3), _UNKNOWN), table()[scale.levels(depths)]])
    return colours.astype(np.uint8)


@lru_cache(maxsize=8)
def colour_bar(scale: DepthScale, width: int) -> ImageArray:
    """Return the bar of a scale with its numbers, shape (HEIGHT_PX, width, 3), near at the left."""
    bar = np.zeros((HEIGHT_PX, width, 3), dtype=np.uint8)
    left = write(bar, LABEL, (_MARGIN_PX, HEIGHT_PX - 10))[0] + 2 * _MARGIN_PX
    right = width - 3 * _MARGIN_PX
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
        is_free_from = write(bar, text, (start, HEIGHT_PX - 4))[0] + _MARGIN_PX
    bar.setflags(write=False)
    return bar


def _shares(scale: DepthScale) -> FloatArray:
    depths = np.array(scale.ticks())
    return np.asarray(np.log(depths / scale.near_m) / np.log(scale.far_m / scale.near_m))


def in_groups(
    levels: ImageArray, n_groups: int = 32
) -> list[tuple[IntArray, tuple[int, int, int]]]:
    """Return the indices of points of about one level with their colour: a line each has one."""
    groups = levels.astype(np.int64) * n_groups // 256
    found = []
    for group in np.unique(groups):
        indices = np.flatnonzero(groups == group)
        blue, green, red = table()[int((group + 0.5) * 256 / n_groups)].tolist()
        found.append((indices, (blue, green, red)))
    return found
