"""Corners, and tracks of them by Lucas-Kanade.

References
----------
J. Shi, C. Tomasi, "Good features to track", CVPR 1994, doi:10.1109/CVPR.1994.323794.
B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo
vision", IJCAI 1981.
J.-Y. Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", Intel, 2001.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import KltConfig
from gvo.frontend.features import choose_spread
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# At most 10 iterations, or a step of 0.01 pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.01)
# The backward track starts at its goal and needs no pyramid: a wrong one does not find the first
# corner anyway.
_BACK_LEVELS = 0
# Corners are detected at half resolution, at a quarter of the cost: a patch need not be centred on
# its corner exactly, as it is tracked and measured wherever it is.
_REDUCTION = 2
# Side of the square over which the gradients are summed, there.
_BLOCK_PX = 3


def track_pixels(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    start: FloatArray,
    config: KltConfig,
    *,
    n_levels: int,
    is_checked: bool,
) -> tuple[FloatArray, BoolArray]:
    """Track pixels by pyramidal Lucas-Kanade, forward and, where checked, backward.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        From, to.
    pixels : ndarray of float64, shape (n, 2)
        In the first image.
    start : ndarray of float64, shape (n, 2)
        Where the search in the second image begins.
    config : KltConfig
        Window, forward-backward error limit.
    n_levels : int
        Levels of the pyramid above the image itself.
    is_checked : bool
        Drop tracks of a large forward-backward error. From a good prediction the residuals of
        the registration show wrong tracks as well, at no cost.

    Returns
    -------
    tracked : ndarray of float64, shape (n, 2)
        In the second image.
    is_tracked : ndarray of bool, shape (n,)
        False where the search diverged, left the image, or failed the check.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
    first, begin = pixels.astype(np.float32), start.astype(np.float32)
    tracked, is_found = _follow(images, first, begin, config, n_levels=n_levels)
    if is_checked:
        back, is_back = _follow(images[::-1], tracked, first.copy(), config, n_levels=_BACK_LEVELS)
        is_found &= is_back & (np.linalg.norm(back - first, axis=1) <= config.max_return_px)
    height, width = images[1].shape
    is_inside = np.all((tracked >= 0) & (tracked <= [width - 1, height - 1]), axis=1)
    return tracked.astype(np.float64), is_found & is_inside


def _follow(
    images: tuple[ImageArray, ...],
    pixels: NDArray[np.float32],
    start: NDArray[np.float32],
    config: KltConfig,
    *,
    n_levels: int,
) -> tuple[NDArray[np.float32], BoolArray]:
    size = 2 * config.window_radius_px + 1
    tracked, is_found, _ = cv2.calcOpticalFlowPyrLK(
        images[0],
        images[1],
        pixels,
        start,
        winSize=(size, size),
        maxLevel=n_levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    is_finite = np.isfinite(tracked).all(axis=1)
    return np.asarray(tracked, dtype=np.float32), np.asarray(is_found[:, 0] > 0) & is_finite


def detect_corners(image: ImageArray, config: KltConfig) -> FloatArray:
    """Detect the corners of an image, to two pixels.

    The score of a pixel is the smaller eigenvalue of its gradients' covariance. Each cell of
    `min_distance_px` gives its best local maximum; these share the budget over larger cells.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
    config : KltConfig
        Number of corners, weakest score, distances.

    Returns
    -------
    ndarray of float64, shape (n, 2)
        Whole pixels (u, v), with room for the window that is tracked.
    """
    border = (config.window_radius_px + 1) // _REDUCTION + 1
    if min(image.shape) // _REDUCTION <= 2 * border:
        return np.zeros((0, 2))
    pixels, responses = _local_maxima(halve(image), config.min_eigenvalue, border)
    best = _best_of_cells(pixels, responses, config.min_distance_px, width=image.shape[1])
    chosen = choose_spread(
        pixels[best],
        responses[best],
        width=image.shape[1],
        cell_size_px=config.cell_size_px,
        n_chosen=config.n_corners,
    )
    return pixels[best[chosen]].astype(np.float64)


def _local_maxima(
    reduced: ImageArray, min_eigenvalue: float, border: int
) -> tuple[IntArray, NDArray[np.float32]]:
    """Return pixels of the full image, shape (n, 2), and their scores, shape (n,)."""
    scores = cv2.cornerMinEigenVal(reduced, _BLOCK_PX)
    neighbours = cv2.dilate(scores, np.ones((3, 3), dtype=np.uint8))
    is_corner = (scores == neighbours) & (scores > min_eigenvalue)
    # The indices of a flat array are found several times faster than those of two axes.
    found = np.flatnonzero(is_corner[border:-border, border:-border])
    rows, columns = np.divmod(found, reduced.shape[1] - 2 * border)
    rows, columns = rows + border, columns + border
    chosen = scores[rows, columns].astype(np.float32)
    return _REDUCTION * np.column_stack([columns, rows]), chosen


def _best_of_cells(
    pixels: IntArray, responses: NDArray[np.float32], size_px: int, *, width: int
) -> IntArray:
    """Return the index of the strongest corner of each cell, sorted; scores are positive."""
    columns, rows = width // size_px + 1, int(pixels[:, 1].max(initial=0)) // size_px + 1
    cells = pixels[:, 1] // size_px * columns + pixels[:, 0] // size_px
    # Positive floats are ordered as their bits are; of equal ones in a cell the last wins.
    keys = responses.view(np.uint32).astype(np.uint64) << np.uint64(32)
    best = np.zeros(rows * columns, dtype=np.uint64)
    np.maximum.at(best, cells, keys | np.arange(len(keys), dtype=np.uint64))
    return np.sort((best[best > 0] & np.uint64(0xFFFFFFFF)).astype(np.int64))


def halve(image: ImageArray) -> ImageArray:
    """Return an image of half the size, each pixel the mean of four; an odd edge is left out."""
    height, width = (size // 2 for size in image.shape)
    if min(height, width) == 0:
        return image
    # Of exactly twice the size OpenCV has a path that is ten times as fast as the general one.
    even = image[: 2 * height, : 2 * width]
    half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)
