"""Disparities of corners, searched for along the whole row."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.stereo.disparity import MAX_STEP_PX, Strips, fit_slopes, have_room
from gvo.frontend.stereo.matching import parabola_vertex
from gvo.frontend.stereo.patches import (
    PATCH_RADIUS_PX,
    SEARCH_RADIUS_PX,
    Likeness,
    Patches,
    correlate_rows,
    cut_patches,
    sample_patches,
)
from gvo.frontend.tracking import halve
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Gauss-Newton steps from the coarse search to the disparity.
_N_SEARCH_STEPS = 6
# Number of patches that the row offset is measured with.
_MIN_ROW_SHIFTS = 50
_MAX_ROW_SHIFTS = 120
# The coarse search: images are halved twice, patches have this radius there.
_REDUCTION = 4
_COARSE_RADIUS_PX = 2
_MIN_CORRELATION = 0.7
# Steps on either side that belong to the same peak of correlation; and how much lower a second
# peak may be: so much do equal patches differ in the small images.
_PEAK_STEPS = 2
_MAX_GAP = 0.25
# Number of further peaks that are examined.
_N_RIVALS = 3
# Lower bound of the energy of a patch, grey values squared: flat ones correlate with anything.
_MIN_ENERGY = 50.0
# Largest error of the coarse search, in pixels of the full image.
COARSE_ERROR_PX = _REDUCTION + 1


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
    row_shift_px : float or None
        Remaining row offset of the right image; None from too few patches.
    """

    disparities: FloatArray
    slopes: FloatArray
    are_reliable: BoolArray
    row_shift_px: float | None


def measure_corners(
    images: tuple[ImageArray, ImageArray],
    halves: tuple[ImageArray, ImageArray],
    corners: FloatArray,
    config: StereoConfig,
    *,
    max_disparity: float,
    row_offset_px: float = 0.0,
) -> CornerDisparities:
    """Search for corners of the left image along the whole row, and measure their disparities.

    Patches are cut once: those of the left image, and strips of the right one around the result
    of the coarse search. Its next peaks are measured in the same way, as the windows of a house
    are all alike: where two disparities match as well, either may be wrong. What is reliable is
    measured again together with the slope of its surface.

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
    row_offset_px : float
        By how much rows of the right image are larger.

    Returns
    -------
    CornerDisparities
    """
    rough, is_found, rivals = search_disparities(halves, corners, max_disparity)
    shape, radius = images[0].shape, PATCH_RADIUS_PX
    placed = np.flatnonzero(is_found & have_room(shape, corners, rough, radius))
    have_rival = [have_room(shape, corners[placed], column, radius) for column in rivals[placed].T]
    ranks, doubtful = np.nonzero(have_rival)
    owners = np.concatenate([np.arange(len(placed)), doubtful])
    starts = np.concatenate([rough[placed], rivals[placed[doubtful], ranks]])
    # One pixel wider on all sides, for the gradients along rows and across them.
    left = cut_patches(images[0], corners[placed], radius + 1).astype(np.float32)
    found, right, is_at_rest = _search_strips(
        (left, images[1]), corners[placed], owners, starts, config, row_offset_px=row_offset_px
    )
    likeness = Likeness.of(left[owners, 1:-1, 1:-1], right).where(is_at_rest)
    is_reliable = _are_unrivalled(likeness, found, doubtful)

    slopes = np.zeros((len(corners), 2))
    if config.subpixel != "none":
        chosen = np.flatnonzero(is_reliable)
        pixels = corners[placed[chosen]] + [0.0, row_offset_px]
        fitted = fit_slopes(left[chosen], images[1], pixels, found[chosen])
        found[chosen], right[chosen] = fitted.disparities, fitted.right
        slopes[placed[chosen]] = fitted.slopes
        is_reliable[chosen] = fitted.are_plausible
    disparities = np.full(len(corners), np.nan)
    disparities[placed] = found[: len(placed)]
    are_reliable = _scatter(is_reliable, placed, len(corners))
    row_shift_px = measure_row_shift(left, right, np.flatnonzero(is_reliable))
    return CornerDisparities(
        disparities=disparities, slopes=slopes, are_reliable=are_reliable, row_shift_px=row_shift_px
    )


def _are_unrivalled(likeness: Likeness, found: FloatArray, doubtful: IntArray) -> BoolArray:
    """Tell which of n patches match, and match better than the rivals, which come after."""
    n = len(found) - len(doubtful)
    is_rivalled = likeness.select(np.arange(n, len(found))).rivals(likeness.select(doubtful))
    # A second minimum at the same disparity is no rival.
    is_rivalled &= np.abs(found[n:] - found[doubtful]) > COARSE_ERROR_PX
    is_reliable = likeness.are_alike[:n].copy()
    is_reliable[doubtful[is_rivalled]] = False
    return is_reliable


def _search_strips(
    images: tuple[NDArray[np.float32], ImageArray],
    pixels: FloatArray,
    owners: IntArray,
    starts: FloatArray,
    config: StereoConfig,
    *,
    row_offset_px: float,
) -> tuple[FloatArray, NDArray[np.float32], BoolArray]:
    """Search for left patches in the right image, around start disparities of their owners.

    Returns the disparities, the patches of the right image there, and which searches converged.
    """
    left, right_image = images
    radius, reach_px = PATCH_RADIUS_PX, SEARCH_RADIUS_PX
    u, v = pixels[owners].T
    strips = Strips.cut(
        right_image, u, v + row_offset_px, starts, radius_px=radius, reach_px=reach_px
    )
    if config.subpixel == "none":
        places, is_at_rest = strips.search(left[owners, 1:-1, 1:-1])
        whole = strips.places(np.rint(strips.disparities(places)))
        places = np.clip(whole, 0, 2 * (reach_px + 1))
    else:
        patches = Patches.of(left[:, 1:-1]).take(owners)
        places, is_at_rest = strips.follow(patches, n_steps=_N_SEARCH_STEPS)
    disparities = strips.disparities(places)
    right = sample_patches(right_image, u - disparities, v + row_offset_px, radius, radius)
    return disparities, right, is_at_rest


def measure_row_shift(
    left: NDArray[np.float32], right: NDArray[np.float32], chosen: IntArray
) -> float | None:
    """Measure the remaining row offset of the right image.

    Parameters
    ----------
    left : ndarray of float32, shape (n, s + 2, s + 2)
        Patches, one pixel wider on all sides.
    right : ndarray of float32, shape (m, s, s), m >= n
        At their disparities.
    chosen : ndarray of int64
        The reliable patches.

    Returns
    -------
    float or None
        Median, pixels; None from too few patches.
    """
    if len(chosen) < _MIN_ROW_SHIFTS:
        return None
    chosen = chosen[:: -(-len(chosen) // _MAX_ROW_SHIFTS)]
    # Transposed, a step along the rows becomes one across them.
    patches = Patches.of(np.swapaxes(left[chosen, :, 1:-1], 1, 2))
    across = np.swapaxes(right[chosen], 1, 2)
    steps = patches.at_rest - np.einsum("nij,nij->n", patches.weights, across)
    steps = steps[np.abs(steps) < MAX_STEP_PX]
    return float(np.median(steps)) if len(steps) >= _MIN_ROW_SHIFTS else None


def _scatter(flags: BoolArray, places: IntArray, n: int) -> BoolArray:
    """Return n flags: the given ones at their places, else False."""
    scattered = np.zeros(n, dtype=np.bool_)
    scattered[places] = flags
    return scattered


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
        Right to `COARSE_ERROR_PX`.
    is_found : ndarray of bool, shape (n,)
    rivals : ndarray of float64, shape (n, 3)
        Other disparities that correlate nearly as well, the best one first, else NaN.
    """
    left, right = (halve(half).astype(np.float32) for half in halves)
    n_steps = min(int(np.ceil(max_disparity / _REDUCTION)), left.shape[1])
    columns, rows = (pixels // _REDUCTION).astype(np.int64).T
    columns = np.minimum(columns, left.shape[1] - 1)
    rows = np.minimum(rows, left.shape[0] - 1)
    correlations = _correlate(left, right, (rows, columns), n_steps)
    disparities = n_steps - np.arange(n_steps + 1)
    correlations[disparities > columns[:, np.newaxis]] = -1.0  # left of the right image
    best = np.argmax(correlations, axis=1)
    is_found = correlations[np.arange(len(best)), best] > _MIN_CORRELATION
    between, is_between = parabola_vertex(correlations, best)
    steps = n_steps - np.where(is_between, between, best)
    rivals = _find_rivals(correlations, best, n_steps)
    return float(_REDUCTION) * steps, is_found, float(_REDUCTION) * rivals


def _find_rivals(correlations: NDArray[np.float32], best: IntArray, n_steps: int) -> FloatArray:
    """Return the next peaks, in steps, where they are nearly as good as the best, else NaN.

    The peaks are taken out of the correlations.
    """
    around = np.arange(-_PEAK_STEPS, _PEAK_STEPS + 1)
    rows, elsewhere, peaks = np.arange(len(best)), correlations, best
    least = correlations[rows, best] - _MAX_GAP
    rivals = np.full((len(best), _N_RIVALS), np.nan)
    for rank in range(_N_RIVALS):
        near = np.minimum(np.maximum(peaks[:, np.newaxis] + around, 0), n_steps)
        elsewhere[np.arange(len(peaks))[:, np.newaxis], near] = -1.0
        peaks = np.argmax(elsewhere, axis=1)
        # Where one is too low, so are the next.
        high = np.flatnonzero(elsewhere[np.arange(len(peaks)), peaks] > least[rows])
        rows, elsewhere, peaks = rows[high], elsewhere[high], peaks[high]
        between, is_between = parabola_vertex(elsewhere, peaks)
        rivals[rows, rank] = n_steps - np.where(is_between, between, peaks)
    return rivals


def _correlate(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    pixels: tuple[IntArray, IntArray],
    n_steps: int,
) -> NDArray[np.float32]:
    """Return the correlations at disparities n_steps .. 0 of pixels, (n, n_steps + 1)."""
    radius = _COARSE_RADIUS_PX
    size = 2 * radius + 1
    padded = _padded(left, radius, radius)
    patches = sliding_window_view(padded, (size, size))[pixels].reshape(-1, size**2)
    patches -= patches.mean(axis=1, keepdims=True)
    energies = np.einsum("ni,ni->n", patches, patches)[:, np.newaxis]
    patches /= np.sqrt(np.maximum(energies, np.float32(_MIN_ENERGY)))
    padded = _padded(right, radius, radius + n_steps)
    strips = sliding_window_view(padded, (size, size + n_steps))[pixels]
    products = correlate_rows(patches.reshape(-1, size, size), strips)
    products /= sliding_window_view(_deviations(padded), n_steps + 1, axis=1)[pixels]
    return products


def _padded(image: NDArray[np.float32], radius: int, margin_left: int) -> NDArray[np.float32]:
    margins = radius, radius, margin_left, radius
    return np.asarray(cv2.copyMakeBorder(image, *margins, cv2.BORDER_REPLICATE), dtype=np.float32)


def _deviations(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the norms of all patches that lie in the image, less their means."""
    radius = _COARSE_RADIUS_PX
    size = (2 * radius + 1, 2 * radius + 1)
    centred = image - np.float32(image.mean())  # or the difference loses its digits
    sums = cv2.boxFilter(centred, -1, size, normalize=False)
    squares = cv2.boxFilter(centred**2, -1, size, normalize=False)
    energies = squares - sums**2 / np.float32(size[0] * size[1])
    inside = energies[radius:-radius, radius:-radius]
    return np.asarray(np.sqrt(np.maximum(inside, np.float32(_MIN_ENERGY))))
