"""Corners that Lucas-Kanade can follow, spread over the image.

References
----------
J. Shi, C. Tomasi, "Good features to track", CVPR 1994, doi:10.1109/CVPR.1994.323794.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import KltConfig
from gvo.frontend.features import choose_spread
from gvo.types import FloatArray, ImageArray, IntArray

# Corners are looked for in an image of half the size, at a quarter of the cost: where exactly a
# patch is cut out matters to nobody, as it is tracked and measured wherever that is.
_REDUCTION = 2
# Side of the square over which the gradients are summed, there.
_BLOCK_PX = 3


def detect_corners(image: ImageArray, config: KltConfig) -> FloatArray:
    """Find the corners of an image, to two pixels.

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
    reduced = halve(image)
    scores = cv2.cornerMinEigenVal(reduced, _BLOCK_PX)
    neighbours = cv2.dilate(scores, np.ones((3, 3), dtype=np.uint8))
    is_corner = (scores == neighbours) & (scores > config.min_eigenvalue)
    # The indices of a flat array are found several times faster than those of two axes.
    found = np.flatnonzero(is_corner[border:-border, border:-border])
    rows, columns = np.divmod(found, reduced.shape[1] - 2 * border)
    rows, columns = rows + border, columns + border
    responses = scores[rows, columns]
    pixels = _REDUCTION * np.column_stack([columns, rows])
    best = _best_of_cells(pixels, responses, config.min_distance_px, width=image.shape[1])
    chosen = choose_spread(
        pixels[best],
        responses[best],
        width=image.shape[1],
        cell_size_px=config.cell_size_px,
        n_chosen=config.n_corners,
    )
    return pixels[best[chosen]].astype(np.float64)


def _best_of_cells(
    pixels: IntArray, responses: NDArray[Any], size_px: int, *, width: int
) -> IntArray:
    """Return the index of the strongest corner of each cell, sorted."""
    columns, rows = width // size_px + 1, int(pixels[:, 1].max(initial=0)) // size_px + 1
    cells = pixels[:, 1] // size_px * columns + pixels[:, 0] // size_px
    weakest_first = np.argsort(responses, kind="stable")
    best = np.full(rows * columns, -1)
    best[cells[weakest_first]] = weakest_first  # of several in a cell the last stays
    return np.sort(best[best >= 0])


def halve(image: ImageArray) -> ImageArray:
    """Return an image of half the size, each pixel the mean of four; an odd edge is left out."""
    height, width = (size // 2 for size in image.shape)
    if min(height, width) == 0:
        return image
    # Of exactly twice the size OpenCV has a path that is ten times as fast as the general one.
    even = image[: 2 * height, : 2 * width]
    half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)
