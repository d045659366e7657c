"""Textures, and the atlas that holds them at all sizes.

References
----------
L. Williams, "Pyramidal Parametrics", SIGGRAPH 1983, doi:10.1145/800059.801126.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

_MAX_ROWS = 32_000  # cv2.remap addresses images with 16 bits
_SMALLEST_LEVEL = 4


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

    Parameters
    ----------
    textures : sequence of Texture
        All of one size.
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
        self.corners: FloatArray = np.array(corners, dtype=np.float64)
        # Texel t of level i is at starts[i] + 1 + (t / 2^i - 0.5): one texel of gutter.
        self._scales = (0.5 ** np.arange(n_levels)).astype(np.float32)
        self._starts = (starts[:-1] + 0.5).astype(np.float32)
        self._masks = [_mask_levels(texture.mask, n_levels) for texture in textures]

    def locate(
        self, texels: NDArray[np.float32], footprints: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return where in the atlas texture coordinates lie, relative to the texture's corner.

        Parameters
        ----------
        texels : ndarray of float32
            Coordinates along one axis, the first texel's centre at 0.5, any period.
        footprints : ndarray of float32, the same shape
            Texels per pixel; the level whose texel is nearest to one pixel is taken.
        """
        exponents = (footprints * np.float32(np.sqrt(2.0))).view(np.int32) >> 23
        levels = np.clip(exponents - 127, 0, len(self._scales) - 1)
        wrapped = texels - np.floor(texels * np.float32(1.0 / self.size)) * np.float32(self.size)
        return np.asarray(wrapped * self._scales.take(levels) + self._starts.take(levels))

    def sample(self, map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the grey values at positions in the atlas, bilinear.

        Parameters
        ----------
        map_x, map_y : ndarray of float32, shape (n,) or (h, w)
            Column and row in the atlas, texels.

        Returns
        -------
        ndarray of float32, of the same shape
            0 to 255.
        """
        shape = map_x.shape
        if map_x.ndim == 1:  # cv2.remap writes images of fewer than 2^15 rows
            pad = -len(map_x) % 256
            map_x = np.pad(map_x, (0, pad)).reshape(-1, 256)
            map_y = np.pad(map_y, (0, pad)).reshape(-1, 256)
        if map_x.size == 0:
            return np.zeros(shape, dtype=np.float32)
        grey = np.asarray(cv2.remap(self._image, map_x, map_y, cv2.INTER_LINEAR))
        return grey.ravel()[: np.prod(shape)].reshape(shape).astype(np.float32)

    def is_opaque(
        self, texture: int, level: int, s: NDArray[np.float32], t: NDArray[np.float32]
    ) -> BoolArray:
        """Tell where a texture is opaque.

        Parameters
        ----------
        texture : int
            Index of a texture that has a mask.
        level : int
            Of the mask's pyramid: 0 is the finest.
        s, t : ndarray of float32, shape (n,) or (h, w)
            Texture coordinates, texels of the finest level.

        Returns
        -------
        ndarray of bool, of the same shape
        """
        masks = self._masks[texture]
        mask = masks[min(level, len(masks) - 1)]
        n = len(mask)
        scale = np.float32(n / self.size)
        columns = np.floor(s * scale).astype(np.int32) & (n - 1)
        rows = np.floor(t * scale).astype(np.int32) & (n - 1)
        return np.asarray(mask.ravel().take(rows * n + columns))


def _write_levels(block: ImageArray, pixels: ImageArray, starts: IntArray) -> None:
    narrow = pixels.astype(np.float32)
    for x, x_end in pairwise(starts):
        level = narrow
        for y, y_end in pairwise(starts):
            padded = np.pad(np.rint(level), 1, mode="wrap")
            block[y:y_end, x:x_end] = padded.astype(np.uint8)
            level = 0.5 * (level[0::2] + level[1::2])
        narrow = 0.5 * (narrow[:, 0::2] + narrow[:, 1::2])


def _mask_levels(mask: BoolArray | None, n_levels: int) -> list[BoolArray]:
    if mask is None:
        return []
    shares = mask.astype(np.float32)
    levels = [mask]
    for _ in range(n_levels - 1):
        shares = 0.5 * (shares[0::2] + shares[1::2])
        shares = 0.5 * (shares[:, 0::2] + shares[:, 1::2])
        levels.append(shares >= 0.5)
    return levels
