"""Corners that Lucas-Kanade can follow, spread over the image.

References
----------
J. Shi, C. Tomasi, "Good features to track", CVPR 1994, doi:10.1109/CVPR.1994.323794.
"""

from __future__ import annotations

import cv2
import numpy as np

from gvo.config import KltConfig
from gvo.frontend.features import choose_spread
from gvo.types import FloatArray, ImageArray

# Side of the square over which the gradients are summed.
_BLOCK_PX = 3


def detect_corners(image: ImageArray, config: KltConfig) -> FloatArray:
    """Find the corners of an image.

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
    border = config.window_radius_px + 1
    if min(image.shape) <= 2 * border:
        return np.zeros((0, 2))
    scores = cv2.cornerMinEigenVal(image, _BLOCK_PX)
    neighbours = cv2.dilate(scores, np.ones((3, 3), dtype=np.uint8))
    is_corner = (scores == neighbours) & (scores > config.min_eigenvalue)
    rows, columns = np.nonzero(is_corner[border:-border, border:-border])
    rows, columns = rows + border, columns + border
    responses = scores[rows, columns]
    size = config.min_distance_px
    cells = rows // size * (image.shape[1] // size + 1) + columns // size
    order = np.lexsort((-responses, cells))
    is_best = np.ones(len(order), dtype=np.bool_)
    is_best[1:] = np.diff(cells[order]) > 0
    best = np.sort(order[is_best])
    pixels = np.column_stack([columns[best], rows[best]]).astype(np.float64)
    chosen = choose_spread(
        pixels,
        responses[best],
        width=image.shape[1],
        cell_size_px=config.cell_size_px,
        n_chosen=config.n_corners,
    )
    return pixels[chosen]
