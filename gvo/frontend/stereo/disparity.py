"""Disparities of single pixels, found along the row of the right image.

No keypoints of the right image are needed, so that any pixel can be measured, around what
`gvo.frontend.stereo.corners` or the motion so far predicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.stereo.matching import parabola_minimum
from gvo.frontend.stereo.patches import Patches, sample_patches, squared_differences
from gvo.types import BoolArray, FloatArray, ImageArray

# Steps of the fine search after the parabola: the last moves by less than 0.01 pixels.
_N_STEPS = 3
_MAX_FINE_STEP_PX = 0.5
# The same from a prediction: each at most so long, the last one as good as none.
MAX_STEP_PX = 1.5
_MAX_LAST_STEP_PX = 0.3


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
    radius = config.patch_radius_px

    def search(u: FloatArray, v: FloatArray, start: FloatArray) -> tuple[FloatArray, BoolArray]:
        wide = sample_patches(images[0], u, v, radius + 1, radius)
        strips = Strips.cut(
            images[1], u, v + row_offset_px, start, radius_px=radius, reach_px=reach_px
        )
        places, is_minimum = strips.search(wide[:, :, 1:-1])
        if config.subpixel == "none":
            return np.rint(strips.disparities(places)), is_minimum
        places, _ = Patches.of(wide).descend(
            strips.values, places, n_steps=_N_STEPS, max_step=_MAX_FINE_STEP_PX
        )
        return strips.disparities(places), is_minimum

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
    radius, reach_px = config.patch_radius_px, config.search_radius_px

    def follow(u: FloatArray, v: FloatArray, start: FloatArray) -> tuple[FloatArray, BoolArray]:
        left = Patches.of(sample_patches(images[0], u, v, radius + 1, radius))
        strips = Strips.cut(
            images[1], u, v + row_offset_px, start, radius_px=radius, reach_px=reach_px
        )
        places, is_at_rest = strips.follow(left, n_steps=n_steps)
        return strips.disparities(places), is_at_rest

    return _measure_with_room(images[0].shape, pixels, predicted, radius, follow)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strips:
    """Strips of the right image around the disparities where patches are looked for.

    Parameters
    ----------
    values : ndarray of float32, shape (n, s, m)
        A patch of side s may lie at m - s + 1 places.
    u, columns : ndarray of float64, shape (n,)
        Column of the pixel in the left image, and of the middle place in the right one.
    starts : ndarray of float64, shape (n,)
        The disparities.
    reach_px : int
        How far to search on either side of them.
    """

    values: NDArray[np.float32]
    u: FloatArray
    columns: FloatArray
    starts: FloatArray
    reach_px: int

    @classmethod
    def cut(
        cls,
        image: ImageArray,
        u: FloatArray,
        rows: FloatArray,
        starts: FloatArray,
        *,
        radius_px: int,
        reach_px: int,
    ) -> Strips:
        """Cut them out of the right image, for patches of a half size, at rows of it."""
        columns = np.floor(u - starts)
        values = sample_patches(image, columns, rows, radius_px + reach_px + 1, radius_px)
        return cls(values=values, u=u, columns=columns, starts=starts, reach_px=reach_px)

    def disparities(self, places: FloatArray) -> FloatArray:
        """Return the disparities, shape (n,), of places."""
        return self.u - (self.columns + places - (self.reach_px + 1))

    def places(self, disparities: FloatArray) -> FloatArray:
        """Return the places, shape (n,), of disparities; `disparities` the other way round."""
        return self.u - disparities - self.columns + (self.reach_px + 1)

    def search(self, patches: NDArray[np.float32]) -> tuple[FloatArray, BoolArray]:
        """Return where left patches (n, s, s) differ least, and whether that is a minimum."""
        return parabola_minimum(squared_differences(patches, self.values))

    def follow(self, patches: Patches, *, n_steps: int) -> tuple[FloatArray, BoolArray]:
        """Return where steps lead from the start, and whether they come to rest within reach."""
        places, step = patches.descend(
            self.values, self.places(self.starts), n_steps=n_steps, max_step=MAX_STEP_PX
        )
        is_near = np.abs(self.disparities(places) - self.starts) < self.reach_px
        return places, is_near & (np.abs(step) < _MAX_LAST_STEP_PX)


def _measure_with_room(
    shape: tuple[int, ...],
    pixels: FloatArray,
    predicted: FloatArray,
    radius: int,
    measure: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, BoolArray]],
) -> tuple[FloatArray, BoolArray]:
    """Measure where patches lie in both images: from (u, v, predicted) disparity and validity."""
    disparities = np.full(len(pixels), np.nan)
    is_valid = have_room(shape, pixels, predicted, radius)
    chosen = np.flatnonzero(is_valid)
    if len(chosen) > 0:
        u, v = pixels[chosen].T
        disparities[chosen], is_valid[chosen] = measure(u, v, predicted[chosen])
    return disparities, is_valid


def have_room(
    shape: tuple[int, ...], pixels: FloatArray, disparities: FloatArray, radius: int
) -> BoolArray:
    """Tell which pixels have room for a patch in the left image, and in the right one.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the images.
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    disparities : ndarray of float64, shape (n,)
        None where not a number.
    radius : int
        Of the patch, pixels.
    """
    height, width = shape
    u, v = pixels.T
    last = np.array([width, height]) - 1 - radius
    is_inside = (u >= radius) & (u <= last[0]) & (v >= radius) & (v <= last[1])
    u_right = u - disparities
    return np.asarray(is_inside & (u_right >= radius) & (u_right <= last[0]))
