"""Sub-pixel disparities of any pixels, around predicted ones, without keypoints on the right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.stereo.matching import parabola_minimum
from gvo.frontend.stereo.patches import (
    PATCH_RADIUS_PX,
    SEARCH_RADIUS_PX,
    Patches,
    SlantedPatches,
    sample_patches,
    squared_differences,
)
from gvo.types import BoolArray, FloatArray, ImageArray

# Gauss-Newton steps after the parabola: the last moves by less than 0.01 pixels.
_N_STEPS = 3
_MAX_FINE_STEP_PX = 0.5
# Steps from a prediction: largest step, and largest last step of a converged search.
MAX_STEP_PX = 1.5
_MAX_LAST_STEP_PX = 0.3
# Gauss-Newton steps of a disparity with its slopes, and the largest slope of a surface.
_N_SLOPE_STEPS = 2
_MAX_SLOPE = 0.5
_MIN_WIDTH = 0.5


def measure_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
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
        Size of the patches, how far to search on either side.
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

    return _measure(images, pixels, predicted, search, config, row_offset_px)


def follow_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    n_steps: int,
    row_offset_px: float = 0.0,
    slopes: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels from predictions that are right to a pixel or two.

    As `measure_disparities`, by `n_steps` Gauss-Newton steps alone, in half the time; `is_valid`
    is False where they do not converge. With the slopes of the disparities, shape (n, 2), patches
    of the right image are sampled as those of slanted surfaces.
    """
    if config.subpixel == "none":
        return measure_disparities(images, pixels, predicted, config, row_offset_px=row_offset_px)

    def follow(wide: NDArray[np.float32], strips: Strips) -> tuple[FloatArray, BoolArray]:
        places, is_at_rest = strips.follow(Patches.of(wide), n_steps=n_steps)
        return strips.disparities(places), is_at_rest

    return _measure(images, pixels, predicted, follow, config, row_offset_px, slopes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlantedDisparities:
    """Disparities of surfaces that may be slanted.

    Parameters
    ----------
    disparities : ndarray of float64, shape (n,)
        Pixels.
    slopes : ndarray of float64, shape (n, 2)
        Their change per pixel, along rows and columns.
    right : ndarray of float32, shape (n, s, s)
        The patches of the right image there.
    are_plausible : ndarray of bool, shape (n,)
        False where a surface would be too steep to be seen by both cameras, or too far away from
        that facing them.
    """

    disparities: FloatArray
    slopes: FloatArray
    right: NDArray[np.float32]
    are_plausible: BoolArray


def fit_slopes(
    left: NDArray[np.float32], image: ImageArray, pixels: FloatArray, disparities: FloatArray
) -> SlantedDisparities:
    """Fit the disparities of pixels together with their slopes.

    Parameters
    ----------
    left : ndarray of float32, shape (n, s + 2, s + 2)
        Patches of the left image, one pixel wider on all sides.
    image : ndarray of uint8, shape (height, width)
        The right image.
    pixels : ndarray of float64, shape (n, 2)
        Columns in the left image, rows in the right one.
    disparities : ndarray of float64, shape (n,)
        Of surfaces that face the cameras, pixels.

    Returns
    -------
    SlantedDisparities
    """
    patches, radius = SlantedPatches.of(left), left.shape[1] // 2 - 1
    u, rows = pixels.T
    planes = np.column_stack([disparities, np.zeros_like(pixels)])
    for _ in range(_N_SLOPE_STEPS):
        u_right, slopes = u - planes[:, 0], planes[:, 1:]
        right = sample_patches(image, u_right, rows, radius, radius, slopes=slopes)
        steps = patches.step(right, slopes)
        # Steps are those of the left patch, whose columns are 1 - slope wide in the right image.
        widths = (1.0 - slopes[:, :1]) / np.maximum(1.0 + steps[:, 1:2], _MIN_WIDTH)
        planes += widths * steps
    changes = np.abs(planes[:, 0] - disparities)
    return SlantedDisparities(
        disparities=planes[:, 0],
        slopes=planes[:, 1:],
        right=right,
        are_plausible=(changes < MAX_STEP_PX) & np.all(np.abs(planes[:, 1:]) < _MAX_SLOPE, axis=1),
    )


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
    steps : ndarray of float64, shape (n,)
        Columns of the right image from place to place.
    reach_px : int
        Search range on either side.
    """

    values: NDArray[np.float32]
    u: FloatArray
    columns: FloatArray
    starts: FloatArray
    steps: FloatArray
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
        slopes: FloatArray | None = None,
    ) -> Strips:
        """Cut strips out of the right image, at its rows, for patches of a radius.

        With slopes, shape (n, 2), as the left image would show them.
        """
        # At whole columns nothing is interpolated twice; slanted strips begin where they will end.
        columns = np.floor(u - starts) if slopes is None else u - starts
        radius_u = radius_px + reach_px + 1
        values = sample_patches(image, columns, rows, radius_u, radius_px, slopes=slopes)
        steps = np.ones(len(u)) if slopes is None else 1.0 - slopes[:, 0]
        return cls(
            values=values, u=u, columns=columns, starts=starts, steps=steps, reach_px=reach_px
        )

    def disparities(self, places: FloatArray) -> FloatArray:
        """Return the disparities, shape (n,), of places."""
        return self.u - self.columns - self.steps * (places - (self.reach_px + 1))

    def places(self, disparities: FloatArray) -> FloatArray:
        """Return the places, shape (n,), of disparities."""
        return (self.u - disparities - self.columns) / self.steps + (self.reach_px + 1)

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
    row_offset_px: float,
    slopes: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Search for left patches, one column wider on either side, in strips of the right image."""
    radius = PATCH_RADIUS_PX
    disparities = np.full(len(pixels), np.nan)
    is_valid = have_room(images[0].shape, pixels, predicted, radius)
    chosen = np.flatnonzero(is_valid)
    if len(chosen) > 0:
        (u, v), starts = pixels[chosen].T, predicted[chosen]
        wide = sample_patches(images[0], u, v, radius + 1, radius)
        rows = v + row_offset_px
        strips = Strips.cut(
            images[1],
            u,
            rows,
            starts,
            radius_px=radius,
            reach_px=SEARCH_RADIUS_PX,
            slopes=None if slopes is None else slopes[chosen],
        )
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
