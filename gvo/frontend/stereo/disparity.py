"""Sub-pixel disparities of any pixels, without keypoints on the right; see `gvo.kernels.stereo`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.tracking import halve
from gvo.kernels import stereo
from gvo.types import BoolArray, FloatArray, ImageArray

# A row offset of one corner that is more than this is another one, pixels.
_MAX_ROW_SHIFT_PX = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CornerDisparities:
    """Disparities of corners of the left image.

    Parameters
    ----------
    disparities : ndarray of float64, shape (n,)
        Pixels, NaN where not measured.
    slopes : ndarray of float64, shape (n, 2)
        Change of the reliable ones per pixel, along rows and columns.
    are_reliable : ndarray of bool, shape (n,)
        Left and right match there, and nowhere else along the row.
    row_shifts_px : ndarray of float64, shape (n,)
        By how much rows of the right image are larger beyond that; NaN where not measured.
    """

    disparities: FloatArray
    slopes: FloatArray
    are_reliable: BoolArray
    row_shifts_px: FloatArray


def measure_corners(
    images: tuple[ImageArray, ImageArray],
    halves: tuple[ImageArray, ImageArray],
    corners: FloatArray,
    config: StereoConfig,
    *,
    max_disparity: float,
    row_offsets_px: FloatArray,
) -> CornerDisparities:
    """Search for corners of the left image along the whole row, and measure their disparities.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        Rectified left and right.
    halves : tuple of two ndarrays of uint8, shape (height // 2, width // 2)
        The same of half the size.
    corners : ndarray of float64, shape (n, 2)
        Whole pixels in the left image.
    config : StereoConfig
        Sub-pixel steps or none.
    max_disparity : float
        Pixels.
    row_offsets_px : ndarray of float64, shape (n,)
        By how much rows of the right image are larger there.

    Returns
    -------
    CornerDisparities
    """
    n = len(corners)
    rough = search_disparities(halves, corners, max_disparity)
    disparities, slopes, row_shifts = np.empty(n), np.empty((n, 2)), np.empty(n)
    are_reliable = np.empty(n, np.bool_)
    stereo.measure(
        *(*_contiguous(*images, corners), *rough, row_offsets_px, config.subpixel != "none"),
        *(disparities, slopes, are_reliable, row_shifts),
    )
    row_shifts[np.abs(row_shifts) > _MAX_ROW_SHIFT_PX] = np.nan
    return CornerDisparities(
        disparities=disparities,
        slopes=slopes,
        are_reliable=are_reliable,
        row_shifts_px=row_shifts,
    )


def search_disparities(
    halves: tuple[ImageArray, ImageArray], pixels: FloatArray, max_disparity: float
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Find the disparities of pixels to a few pixels, by normalized cross-correlation.

    Parameters
    ----------
    halves : tuple of two ndarrays of uint8, shape (height // 2, width // 2)
        Rectified left and right, of half the size.
    pixels : ndarray of float64, shape (n, 2)
        Whole pixels in the full left image.
    max_disparity : float
        Pixels.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
        Right to `gvo.kernels.stereo.COARSE_ERROR_PX`.
    is_found : ndarray of bool, shape (n,)
    rivals : ndarray of float64, shape (n, 3)
        Other disparities that correlate nearly as well, the best one first, else NaN.
    """
    n = len(pixels)
    disparities, is_found = np.empty(n), np.empty(n, np.bool_)
    rivals = np.empty((n, stereo.N_RIVALS))
    quarters = halve(halves[0]), halve(halves[1])
    stereo.search(*quarters, pixels, max_disparity, disparities, is_found, rivals)
    return disparities, is_found, rivals


def measure_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    row_offsets_px: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels near predicted ones, to a fraction of a pixel.

    Patches are interpolated, so that on a slanted surface, such as the road, the disparity is that
    of the very pixel.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        Rectified left and right.
    pixels : ndarray of float64, shape (n, 2)
        In the left image.
    predicted : ndarray of float64, shape (n,)
        Pixels, right to three.
    config : StereoConfig
        Sub-pixel steps or none.
    row_offsets_px : ndarray of float64, shape (n,)
        By how much rows of the right image are larger there.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
    is_valid : ndarray of bool, shape (n,)
        False where a patch leaves the image or the minimum is at the end of the search.
    """
    disparities, is_valid = np.empty(len(pixels)), np.empty(len(pixels), np.bool_)
    is_refined = config.subpixel != "none"
    given = *_contiguous(*images, pixels, predicted), row_offsets_px, is_refined
    stereo.search_near(*given, disparities, is_valid)
    return disparities, is_valid


def follow_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    predicted: FloatArray,
    config: StereoConfig,
    *,
    n_steps: int,
    slopes: FloatArray,
    row_offsets_px: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Measure the disparities of pixels from predictions that are right to a pixel or two.

    As `measure_disparities`, by `n_steps` Gauss-Newton steps alone, in half the time; `is_valid`
    is False where they do not converge. The slopes of the disparities, shape (n, 2), are those of
    the surfaces: patches of the right image are sampled so.
    """
    if config.subpixel == "none":
        return measure_disparities(images, pixels, predicted, config, row_offsets_px=row_offsets_px)
    disparities, is_valid = np.empty(len(pixels)), np.empty(len(pixels), np.bool_)
    given = *_contiguous(*images, pixels, predicted, slopes), row_offsets_px, n_steps
    stereo.follow(*given, disparities, is_valid)
    return disparities, is_valid


def _contiguous(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return arrays as kernels take them."""
    return tuple(np.ascontiguousarray(array) for array in arrays)
