"""Sub-pixel disparities of any pixels, around predicted ones, without keypoints on the right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.stereo.matching import parabola_minimum
from gvo.frontend.stereo.patches import Patches, sample_patches, squared_differences
from gvo.types import BoolArray, FloatArray, ImageArray

# Gauss-Newton steps after the parabola: the last moves by less than 0.01 pixels.
_N_STEPS = 3
_MAX_FINE_STEP_PX = 0.5
# Steps from a prediction: largest step, and largest last step of a converged search.
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

    As `refine_disparities`, but with interpolated patches, so that on a slanted surface, such as
    the road, the disparity is that of the very pixel. Gauss-Newton steps after the parabola
    remove its bias towards the weaker texture.

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
        Row offset of the right image.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
    is_valid : ndarray of bool, shape (n,)
        False where a patch leaves the image or the minimum is at the end of the search.
    """

    def search(wide: NDArray[np.float32], strips: Strips) -> tuple[FloatArray, BoolArray]:
        places, is_minimum = strips.search(wide[:, :, 1:-1])
        if config.subpixel == "none":
            return np.rint(strips.disparities(places)), is_minimum
        places, _ = Patches.of(wide).descend(
            strips.values, places, n_steps=_N_STEPS, max_step=_MAX_FINE_STEP_PX
        )
        return strips.disparities(places), is_minimum

    return _measure(images, pixels, predicted, search, config, reach_px, row_offset_px)


def follow_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    n_steps: int,
    row_offset_px: float = 0.0,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels from predictions that are right to a pixel or two.

    As `measure_disparities`, by `n_steps` Gauss-Newton steps alone, in half the time; `is_valid`
    is False where they do not converge.
    """
    reach_px = config.search_radius_px
    if config.subpixel == "none":
        row = row_offset_px
        return measure_disparities(
            images, pixels, predicted, config, reach_px=reach_px, row_offset_px=row
        )

    def follow(wide: NDArray[np.float32], strips: Strips) -> tuple[FloatArray, BoolArray]:
        places, is_at_rest = strips.follow(Patches.of(wide), n_steps=n_steps)
        return strips.disparities(places), is_at_rest

    return _measure(images, pixels, predicted, follow, config, reach_px, row_offset_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strips:
    """Strips of the right image to search around start disparities.

    Parameters
    ----------
    values : ndarray of float32, shape (n, s, m)
        With m - s + 1 places for a patch of side s.
    u, columns : ndarray of float64, shape (n,)
        Column of the pixel in the left image, and of the middle place in the right one.
    starts : ndarray of float64, shape (n,)
        The start disparities.
    reach_px : int
        Search range on either side.
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
        """Cut strips out of the right image, at its rows, for patches of a radius."""
        columns = np.floor(u - starts)
        values = sample_patches(image, columns, rows, radius_px + reach_px + 1, radius_px)
        return cls(values=values, u=u, columns=columns, starts=starts, reach_px=reach_px)

    def disparities(self, places: FloatArray) -> FloatArray:
        """Return the disparities, shape (n,), of places."""
        return self.u - (self.columns + places - (self.reach_px + 1))

    def places(self, disparities: FloatArray) -> FloatArray:
        """Return the places, shape (n,), of disparities."""
        return self.u - disparities - self.columns + (self.reach_px + 1)

    def search(self, patches: NDArray[np.float32]) -> tuple[FloatArray, BoolArray]:
        """Return the places of least difference from left patches, and which are minima."""
        return parabola_minimum(squared_differences(patches, self.values))

    def follow(self, patches: Patches, *, n_steps: int) -> tuple[FloatArray, BoolArray]:
        """Return the places after steps from the start, and which converged within reach."""
        places, step = patches.descend(
            self.values, self.places(self.starts), n_steps=n_steps, max_step=MAX_STEP_PX
        )
        is_near = np.abs(self.disparities(places) - self.starts) < self.reach_px
        return places, is_near & (np.abs(step) < _MAX_LAST_STEP_PX)


def _measure(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    search: Callable[[NDArray[np.float32], Strips], tuple[FloatArray, BoolArray]],
    config: StereoConfig,
    reach_px: int,
    row_offset_px: float,
) -> tuple[FloatArray, BoolArray]:
    """Search for left patches, one column wider on either side, in strips of the right image."""
    radius = config.patch_radius_px
    disparities = np.full(len(pixels), np.nan)
    is_valid = have_room(images[0].shape, pixels, predicted, radius)
    chosen = np.flatnonzero(is_valid)
    if len(chosen) > 0:
        (u, v), starts = pixels[chosen].T, predicted[chosen]
        wide = sample_patches(images[0], u, v, radius + 1, radius)
        rows = v + row_offset_px
        strips = Strips.cut(images[1], u, rows, starts, radius_px=radius, reach_px=reach_px)
        disparities[chosen], is_valid[chosen] = search(wide, strips)
    return disparities, is_valid


def have_room(
    shape: tuple[int, ...], pixels: FloatArray, disparities: FloatArray, radius: int
) -> BoolArray:
    """Tell which pixels have room for a patch in both images.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the images.
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    disparities : ndarray of float64, shape (n,)
        NaN where there is none.
    radius : int
        Of the patch, pixels.
    """
    height, width = shape
    u, v = pixels.T
    last = np.array([width, height]) - 1 - radius
    is_inside = (u >= radius) & (u <= last[0]) & (v >= radius) & (v <= last[1])
    u_right = u - disparities
    return np.asarray(is_inside & (u_right >= radius) & (u_right <= last[0]))
