"""Random images, and values between their pixels by SciPy."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates

from gvo.types import FloatArray, ImageArray

_FACING = np.eye(2)


def texture(
    rng: np.random.Generator, shape: tuple[int, int] = (48, 80), *, blur: float = 1.5
) -> ImageArray:
    """Return smooth noise, a quarter of it as dark or as bright as can be."""
    noise = gaussian_filter(rng.normal(size=shape), blur)
    return np.asarray(np.clip(np.rint(120 + 110 * noise / noise.std()), 0, 255).astype(np.uint8))


def around(
    image: ImageArray,
    pixel: ArrayLike,
    reach: tuple[int, int],
    warp: FloatArray = _FACING,
) -> FloatArray:
    """Return values at pixel + warp (i, j), |i| and |j| within reach (columns, rows), by rows."""
    j, i = np.mgrid[-reach[1] : reach[1] + 1, -reach[0] : reach[0] + 1]
    u, v = np.tensordot(warp, [i, j], axes=1) + np.reshape(pixel, (2, 1, 1))
    return np.asarray(map_coordinates(image.astype(float), [v, u], order=1, mode="nearest"))


def slopes_along(patch: FloatArray, axis: int) -> FloatArray:
    """Return central differences of the inner pixels of a patch, along rows (1) or columns (0)."""
    return np.asarray(np.gradient(patch, axis=axis)[1:-1, 1:-1])


def shifted(
    rng: np.random.Generator, image: ImageArray, warp: FloatArray, shift: ArrayLike
) -> ImageArray:
    """Return an image whose pixel warp (x - middle) + middle + shift shows what x shows, noisy."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    middle = np.reshape(image.shape[::-1], (2, 1, 1)) / 2.0
    seen = np.stack([u, v]) - middle - np.reshape(shift, (2, 1, 1))
    u, v = np.tensordot(np.linalg.inv(warp), seen, axes=1) + middle
    values = map_coordinates(image.astype(float), [v, u], order=1, mode="nearest")
    return np.clip(np.rint(values + rng.normal(size=values.shape)), 0, 255).astype(np.uint8)
