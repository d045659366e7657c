"""Disparities of single pixels, found along the row of the right image.

No keypoints of the right image are needed, so that any pixel can be measured, around what
`gvo.frontend.disparity_search` or the motion so far predicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.stereo import parabola_minimum
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Grey values squared, over a patch: the gradients of a flat one are no less than noise.
_MIN_ENERGY = 50.0
# Steps of the fine search after the parabola: the last moves by less than 0.01 pixels.
_N_STEPS = 3
_MAX_FINE_STEP_PX = 0.5
# The same from a prediction: each at most so long, the last one as good as none.
_MAX_STEP_PX = 1.5
_MAX_LAST_STEP_PX = 0.3
# What left and right may differ by at a point that both see: of the variance of the patch this
# share, and the noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.2
_UNLIKE_NOISE = 18.0
# A rival disparity counts where the patch differs from it by hardly more than from the one found.
_MAX_RIVALRY = 2.0
# Fewer say nothing of the rows, more hardly anything new.
_MIN_ROW_SHIFTS = 50
_MAX_ROW_SHIFTS = 120


def measure_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    reach_px: int,
    row_offset_px: float = 0.0,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels near predicted ones, to a fraction of a pixel.

    As `refine_disparities`, but between pixels: patches are interpolated, so that on a slanted
    surface, such as the road, the disparity is that of the very pixel. After the parabola come
    Gauss-Newton steps, which end where the patches are alike; the parabola alone leans to the
    side where the texture is weaker.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        Rectified left and right.
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    predicted : ndarray of float64, shape (n,)
        Pixels.
    config : StereoConfig
        Size of the patches.
    reach_px : int
        How far to search on either side.
    row_offset_px : float
        By how much rows of the right image are larger.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
    is_valid : ndarray of bool, shape (n,)
        False where a patch leaves the image or the best step is the last one searched.
    """
    radius, room = config.patch_radius_px, reach_px + 1

    def search(u: FloatArray, v: FloatArray, start: FloatArray) -> tuple[FloatArray, BoolArray]:
        wide = _sample(images[0], u, v, radius + 1, radius)
        columns = np.floor(u - start)
        strips = _sample(images[1], columns, v + row_offset_px, radius + room, radius)
        places, is_minimum = parabola_minimum(_squared_differences(wide[:, :, 1:-1], strips))
        if config.subpixel != "none":
            places, _ = _Patches.of(wide).descend(
                strips, places, n_steps=_N_STEPS, max_step=_MAX_FINE_STEP_PX
            )
        found = u - (columns + places - room)
        return np.rint(found) if config.subpixel == "none" else found, is_minimum

    return _measure_with_room(images[0].shape, pixels, predicted, radius, search)


def follow_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    n_steps: int,
    row_offset_px: float = 0.0,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels from predictions right to a pixel or two.

    As `measure_disparities`, by the Gauss-Newton steps alone, in half the time.

    Parameters and results are those of `measure_disparities`, but for `n_steps`, the number of
    steps; `is_valid` is False where they do not come to rest.
    """
    if config.subpixel == "none":
        return measure_disparities(
            images,
            pixels,
            predicted,
            config,
            reach_px=config.search_radius_px,
            row_offset_px=row_offset_px,
        )
    radius, room = config.patch_radius_px, config.search_radius_px + 1

    def follow(u: FloatArray, v: FloatArray, start: FloatArray) -> tuple[FloatArray, BoolArray]:
        left = _Patches.of(_sample(images[0], u, v, radius + 1, radius))
        columns = np.floor(u - start)
        strips = _sample(images[1], columns, v + row_offset_px, radius + room, radius)
        places, step = left.descend(
            strips, u - start - columns + room, n_steps=n_steps, max_step=_MAX_STEP_PX
        )
        found = u - (columns + places - room)
        is_at_rest = np.abs(step) < _MAX_LAST_STEP_PX
        return found, is_at_rest & (np.abs(found - start) < config.search_radius_px)

    return _measure_with_room(images[0].shape, pixels, predicted, radius, follow)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Likeness:
    """How much the patches of left and right are alike at pixels and their disparities.

    Parameters
    ----------
    unlike : ndarray of float64, shape (n,)
        Variance of the difference, grey values squared; infinite where there is no disparity.
    limits : ndarray of float64, shape (n,)
        What it may be at a point that both cameras see.
    """

    unlike: FloatArray
    limits: FloatArray

    @property
    def are_alike(self) -> BoolArray:
        """Tell whether left and right show the same.

        Where the depth breaks within a patch, its parts differ by more than one disparity aligns:
        the disparity is that of neither surface. The error stays with the corner from frame to
        frame, so that no residual shows it, and motions add it up.
        """
        return np.asarray(self.unlike <= self.limits)

    def select(self, chosen: IntArray) -> Likeness:
        """Return that of some pixels."""
        return Likeness(unlike=self.unlike[chosen], limits=self.limits[chosen])

    def rivals(self, found: Likeness) -> BoolArray:
        """Tell where these disparities show the same as well as those that were found.

        Windows of a house are all alike, and where the rows show one beside the other, nothing
        tells which one the other camera saw: the depth is any of several, and mostly wrong.
        """
        return self.are_alike & (self.unlike <= _MAX_RIVALRY * found.unlike + _UNLIKE_NOISE)


def compare_patches(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    disparities: FloatArray,
    config: StereoConfig,
    *,
    row_offset_px: float = 0.0,
) -> Likeness:
    """Compare left and right at pixels and their disparities.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        Rectified left and right.
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    disparities : ndarray of float64, shape (n,)
        Measured ones, or not a number.
    config : StereoConfig
        Size of the patches.
    row_offset_px : float
        By how much rows of the right image are larger.

    Returns
    -------
    Likeness
    """
    radius = config.patch_radius_px
    unlike, limits = np.full(len(pixels), np.inf), np.zeros(len(pixels))
    chosen = np.flatnonzero(np.isfinite(disparities))
    if len(chosen) > 0:
        u, v = pixels[chosen].T
        left = _sample(images[0], u, v, radius, radius)
        right = _sample(images[1], u - disparities[chosen], v + row_offset_px, radius, radius)
        limits[chosen] = _MAX_UNLIKE * _variances(left) + _UNLIKE_NOISE
        unlike[chosen] = _variances(right - left)
    return Likeness(unlike=unlike, limits=limits)


def _variances(patches: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the variances, shape (n,), of patches; in a third of the time of `ndarray.var`."""
    flat = patches.reshape(len(patches), -1)
    centred = flat - (np.add.reduce(flat, axis=1) / flat.shape[1])[:, np.newaxis]
    return np.asarray(np.einsum("ni,ni->n", centred, centred) / flat.shape[1])


def measure_row_shift(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    disparities: FloatArray,
    config: StereoConfig,
    *,
    row_offset_px: float = 0.0,
) -> float | None:
    """Measure by how much the rows of left and right still differ.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    disparities : ndarray of float64, shape (n,)
        Measured ones.
    config : StereoConfig
        Size of the patches.
    row_offset_px : float
        The difference that is known.

    Returns
    -------
    float or None
        Median of what is left, pixels; None where too few patches show it.
    """
    if len(pixels) < _MIN_ROW_SHIFTS:
        return None
    every = -(-len(pixels) // _MAX_ROW_SHIFTS)
    pixels, disparities = pixels[::every], disparities[::every]
    radius = config.patch_radius_px
    u, v = pixels.T
    # Transposed, a step along the rows becomes one across them.
    left = np.swapaxes(_sample(images[0], u, v, radius, radius + 1), 1, 2)
    right = _sample(images[1], u - disparities, v + row_offset_px, radius, radius)
    steps = -_Patches.of(left).curve(np.swapaxes(right, 1, 2))[:, 0]
    steps = steps[np.abs(steps) < _MAX_STEP_PX]
    return float(np.median(steps)) if len(steps) >= _MIN_ROW_SHIFTS else None


@dataclass(frozen=True, slots=True, eq=False)
class _Patches:
    """Patches of the left image, ready to be compared with those of the right one.

    As in the inverse compositional way, the gradients are those of the patches that stay: they
    are computed once. Their mean is taken off, so that a difference of exposure has no effect.

    References
    ----------
    S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd.
    """

    weights: NDArray[np.float32]
    at_rest: NDArray[np.float32]

    @classmethod
    def of(cls, wide: NDArray[np.float32]) -> _Patches:
        """Make them of patches (n, s, s + 2) that are one column wider on either side."""
        gradients = 0.5 * (wide[:, :, 2:] - wide[:, :, :-2])
        gradients -= gradients.mean(axis=(1, 2), keepdims=True)
        energies = np.einsum("nij,nij->n", gradients, gradients)
        gradients /= np.maximum(energies, np.float32(_MIN_ENERGY))[:, np.newaxis, np.newaxis]
        at_rest = np.einsum("nij,nij->n", gradients, wide[:, :, 1:-1])
        return cls(weights=gradients, at_rest=at_rest)

    def curve(self, strips: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return by how much disparities should grow at places in strips of the right image.

        Parameters
        ----------
        strips : ndarray of float32, shape (n, s, m)

        Returns
        -------
        ndarray of float32, shape (n, m - s + 1)
            Between the places, where patches are interpolated, it is linear.
        """
        products = correlate_rows(self.weights, strips)
        products -= self.at_rest[:, np.newaxis]
        return products

    def descend(
        self, strips: NDArray[np.float32], places: FloatArray, *, n_steps: int, max_step: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the places in strips (n, s, m) where patches are after some steps, and the last.

        A step is a growth of the disparity; places end with the strips.
        """
        curve = self.curve(strips)
        n, n_places = curve.shape
        firsts, flat = n_places * np.arange(n), curve.ravel()
        step = np.zeros(n)
        places = np.minimum(np.maximum(places, 0.0), n_places - 1.0)
        for _ in range(n_steps):
            whole = np.minimum(places.astype(np.int64), n_places - 2)
            before, after = flat[firsts + whole], flat[firsts + whole + 1]
            step = before + (places - whole) * (after - before)
            step = np.minimum(np.maximum(step, -max_step), max_step)
            places = np.minimum(np.maximum(places - step, 0.0), n_places - 1.0)
        return places, step


def correlate_rows(
    patches: NDArray[np.float32], strips: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the sums of products of patches with all places along wider strips.

    Parameters
    ----------
    patches : ndarray of float32, shape (n, s, s)
    strips : ndarray of float32, shape (n, s, m)

    Returns
    -------
    ndarray of float32, shape (n, m - s + 1)
    """
    size, n_places = patches.shape[2], strips.shape[2] - patches.shape[2] + 1
    # Every column of a patch with every column of its strip, of which the diagonals are summed:
    # a sixth of the time of a loop over the pixels.
    products: NDArray[np.float32] = np.matmul(np.swapaxes(patches, 1, 2), strips)
    sums = products[:, 0, :n_places].copy()
    for column in range(1, size):
        sums += products[:, column, column : column + n_places]
    return sums


def _measure_with_room(
    shape: tuple[int, ...],
    pixels: FloatArray,
    predicted: FloatArray,
    radius: int,
    measure: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, BoolArray]],
) -> tuple[FloatArray, BoolArray]:
    """Measure where patches lie in both images: from (u, v, predicted) disparity and validity."""
    disparities = np.full(len(pixels), np.nan)
    is_valid = _have_room(shape, pixels, predicted, radius)
    chosen = np.flatnonzero(is_valid)
    if len(chosen) > 0:
        u, v = pixels[chosen].T
        disparities[chosen], is_valid[chosen] = measure(u, v, predicted[chosen])
    return disparities, is_valid


def _have_room(
    shape: tuple[int, ...], pixels: FloatArray, disparities: FloatArray, radius: int
) -> BoolArray:
    height, width = shape
    u, v = pixels.T
    last = np.array([width, height]) - 1 - radius
    is_inside = (u >= radius) & (u <= last[0]) & (v >= radius) & (v <= last[1])
    u_right = u - disparities
    return np.asarray(is_inside & (u_right >= radius) & (u_right <= last[0]))


def _sample(
    image: ImageArray, u: FloatArray, v: FloatArray, radius_u: int, radius_v: int
) -> NDArray[np.float32]:
    """Return patches around pixels, interpolated, shape (n, 2 radius_v + 1, 2 radius_u + 1)."""
    steps_u, steps_v = _steps_around(radius_u, radius_v)
    patches = cv2.remap(
        image,
        u.astype(np.float32)[:, np.newaxis] + steps_u,
        v.astype(np.float32)[:, np.newaxis] + steps_v,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return patches.astype(np.float32).reshape(len(u), 2 * radius_v + 1, 2 * radius_u + 1)


@lru_cache(maxsize=32)
def _steps_around(radius_u: int, radius_v: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the steps from the middle of a patch to its pixels, row by row."""
    v, u = np.mgrid[-radius_v : radius_v + 1, -radius_u : radius_u + 1].astype(np.float32)
    return u.ravel(), v.ravel()


def _squared_differences(
    patches: NDArray[np.float32], strips: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the sums of squared differences less their mean, shape (n, places)."""
    size = patches.shape[2]
    n_places = strips.shape[2] - size + 1
    sums = np.empty((len(patches), n_places), dtype=np.float32)
    for place in range(n_places):
        difference = (strips[:, :, place : place + size] - patches).reshape(len(patches), -1)
        squares = np.einsum("ni,ni->n", difference, difference)
        sums[:, place] = squares - difference.sum(axis=1) ** 2 / difference.shape[1]
    return sums
