"""Following pixels from one image into another.

References
----------
B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo
vision", IJCAI 1981.
J.-Y. Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", Intel, 2001.
"""

from __future__ import annotations

import cv2
import numpy as np

from gvo.config import KltConfig
from gvo.types import BoolArray, FloatArray, ImageArray

_MAX_ITERATIONS = 10
_MIN_STEP_PX = 0.01
# The way back starts at its goal and needs no pyramid: a track that went astray does not find
# the first corner in what it sees.
_BACK_LEVELS = 0


def track_pixels(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    start: FloatArray,
    config: KltConfig,
    *,
    n_levels: int,
    is_checked: bool,
) -> tuple[FloatArray, BoolArray]:
    """Follow pixels by pyramidal Lucas-Kanade, and back where they are to be checked.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        From, to.
    pixels : ndarray of float64, shape (n, 2)
        In the first image.
    start : ndarray of float64, shape (n, 2)
        Where the search in the second image begins.
    config : KltConfig
        Window, largest distance between a pixel and where the way back ends.
    n_levels : int
        Levels of the pyramid above the image itself.
    is_checked : bool
        Drop a track that does not lead back. From a good prediction the residuals of the
        registration tell wrong tracks as well, for nothing.

    Returns
    -------
    tracked : ndarray of float64, shape (n, 2)
        In the second image.
    is_tracked : ndarray of bool, shape (n,)
        False where the search got lost, left the image, or was checked and does not lead back.
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
    pixels: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    start: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    config: KltConfig,
    *,
    n_levels: int,
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float32]], BoolArray]:
    size = 2 * config.window_radius_px + 1
    tracked, is_found, _ = cv2.calcOpticalFlowPyrLK(
        images[0],
        images[1],
        pixels,
        start,
        winSize=(size, size),
        maxLevel=n_levels,
        criteria=(
            cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
            _MAX_ITERATIONS,
            _MIN_STEP_PX,
        ),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    is_finite = np.isfinite(tracked).all(axis=1)
    return np.asarray(tracked, dtype=np.float32), np.asarray(is_found[:, 0] > 0) & is_finite
