"""The coarse search for disparities, over all that are possible, in small images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gvo.frontend.corners import halve
from gvo.frontend.patches import correlate_rows
from gvo.frontend.stereo import parabola_minimum
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Images are reduced by this, patches are of this half size there.
_N_HALVINGS = 2
_REDUCTION = 2**_N_HALVINGS
_COARSE_RADIUS_PX = 2
_MIN_CORRELATION = 0.7
# Steps on either side that belong to the same peak of correlation; and by how much less another
# one may correlate and still be looked at: so much do equal things differ in the small images.
_PEAK_STEPS = 2
_MAX_GAP = 0.25
# Grey values squared, over a patch: below this it is flat, and correlates with anything.
_MIN_ENERGY = 50.0
# What the search leaves open on either side, in pixels of the full image.
COARSE_ERROR_PX = _REDUCTION + 1


def search_disparities(
    images: tuple[ImageArray, ImageArray], pixels: FloatArray, max_disparity: float
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Find the disparities of pixels to a few pixels, by normalized cross-correlation.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
        Rectified left and right.
    pixels : ndarray of float64, shape (n, 2)
        Whole pixels in the left image.
    max_disparity : float
        Pixels.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
        Right to `COARSE_ERROR_PX`.
    is_found : ndarray of bool, shape (n,)
    rivals : ndarray of float64, shape (n,)
        A disparity farther away that is nearly as good here; not a number where there is none.
    """
    left, right = (_reduce(image) for image in images)
    n_steps = min(int(np.ceil(max_disparity / _REDUCTION)), left.shape[1])
    columns, rows = (pixels // _REDUCTION).astype(np.int64).T
    columns = np.minimum(columns, left.shape[1] - 1)
    rows = np.minimum(rows, left.shape[0] - 1)
    correlations = _correlate(left, right, (rows, columns), n_steps)
    disparities = n_steps - np.arange(n_steps + 1)
    correlations[disparities > columns[:, np.newaxis]] = -1.0  # left of the right image
    best = np.argmax(correlations, axis=1)
    is_found = correlations[np.arange(len(best)), best] > _MIN_CORRELATION
    between, is_between = parabola_minimum(-correlations)
    steps = n_steps - np.where(is_between, between, best)
    rivals = _find_rivals(correlations, best, n_steps)
    return float(_REDUCTION) * steps, is_found, float(_REDUCTION) * rivals


def _find_rivals(correlations: NDArray[np.float32], best: IntArray, n_steps: int) -> FloatArray:
    """Return the best steps away from the best where they are nearly as good, else no number."""
    rows = np.arange(len(best))
    elsewhere = correlations.copy()
    for offset in range(-_PEAK_STEPS, _PEAK_STEPS + 1):
        elsewhere[rows, np.clip(best + offset, 0, n_steps)] = -1.0
    second = np.argmax(elsewhere, axis=1)
    gaps = correlations[rows, best] - elsewhere[rows, second]
    rivalled = np.flatnonzero(gaps < _MAX_GAP)
    between, is_between = parabola_minimum(-elsewhere[rivalled])
    rivals = np.full(len(best), np.nan)
    rivals[rivalled] = n_steps - np.where(is_between, between, second[rivalled])
    return rivals


def _reduce(image: ImageArray) -> NDArray[np.float32]:
    # Halved twice: a tenth of the time of a reduction by four.
    for _ in range(_N_HALVINGS):
        image = halve(image)
    return image.astype(np.float32)


def _correlate(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    pixels: tuple[IntArray, IntArray],
    n_steps: int,
) -> NDArray[np.float32]:
    """Return the correlations at disparities n_steps .. 0 of pixels, (n, n_steps + 1)."""
    radius = _COARSE_RADIUS_PX
    size = 2 * radius + 1
    padded = np.pad(left, radius, mode="edge")
    patches = sliding_window_view(padded, (size, size))[pixels]
    patches = patches - patches.mean(axis=(1, 2), keepdims=True)
    energy = np.maximum(np.sum(patches**2, axis=(1, 2)), _MIN_ENERGY)
    padded = np.pad(right, ((radius, radius), (radius + n_steps, radius)), mode="edge")
    strips = sliding_window_view(padded, (size, size + n_steps))[pixels]
    products = correlate_rows(patches, strips)
    energies = sliding_window_view(_energies(padded), n_steps + 1, axis=1)[pixels]
    return np.asarray(products / np.sqrt(energies * energy[:, np.newaxis]))


def _energies(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the squared deviations from their mean of all patches that lie in the image."""
    radius = _COARSE_RADIUS_PX
    size = (2 * radius + 1, 2 * radius + 1)
    centred = image - np.float32(image.mean())  # or the difference loses its digits
    sums = cv2.boxFilter(centred, -1, size, normalize=False)
    squares = cv2.boxFilter(centred**2, -1, size, normalize=False)
    energies = squares - sums**2 / np.float32(size[0] * size[1])
    return np.maximum(energies[radius:-radius, radius:-radius], np.float32(_MIN_ENERGY))
