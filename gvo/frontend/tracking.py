"""Corners, tracks of them by Lucas-Kanade, and patches aligned with another image.

References
----------
J. Shi, C. Tomasi, "Good features to track", CVPR 1994, doi:10.1109/CVPR.1994.323794.
B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo
vision", IJCAI 1981.
J.-Y. Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", Intel, 2001.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.frontend.features import choose_spread
from gvo.kernels import corners, sampling, templates
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Of Lucas-Kanade: at most 10 iterations, or a step of 0.01 pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.01)
# The backward track starts at its goal and needs no pyramid: a wrong one does not find the first
# corner anyway.
_BACK_LEVELS = 0
# Sides of the cells with at most one corner each, and of those that share the number of corners.
SPACING_PX = 10
CELL_SIZE_PX = 40
# Half size of the window that Lucas-Kanade compares.
WINDOW_RADIUS_PX = 4
# Levels of the pyramid above the halved image from a prediction; above the image itself without
# one, or after it failed.
_N_HALF_LEVELS = 1
N_WIDE_LEVELS = 4
# Largest error of a track that is followed back to its corner.
_MAX_RETURN_PX = 0.5


def track_pixels(
    images: tuple[ImageArray, ImageArray],
    pixels: FloatArray,
    start: FloatArray,
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
    tracked, is_found = _follow(images, first, begin, n_levels=n_levels)
    if is_checked:
        back, is_back = _follow(images[::-1], tracked, first.copy(), n_levels=_BACK_LEVELS)
        is_found &= is_back & (np.linalg.norm(back - first, axis=1) <= _MAX_RETURN_PX)
    height, width = images[1].shape
    is_inside = np.all((tracked >= 0) & (tracked <= [width - 1, height - 1]), axis=1)
    return tracked.astype(np.float64), is_found & is_inside


def track_roughly(
    halves: tuple[ImageArray, ImageArray], pixels: FloatArray, start: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Track pixels from a good prediction in images of half the size; as `track_pixels`.

    At a fraction of the cost it tells which patches are there, and where to align them from.
    """
    # The centre of a pixel of the half image is between those of four.
    first, begin = (0.5 * each - 0.25 for each in (pixels, start))
    tracked, is_tracked = track_pixels(
        halves, first, begin, n_levels=_N_HALF_LEVELS, is_checked=False
    )
    return 2.0 * tracked + 0.5, is_tracked


def _follow(
    images: tuple[ImageArray, ...],
    pixels: NDArray[np.float32],
    start: NDArray[np.float32],
    *,
    n_levels: int,
) -> tuple[NDArray[np.float32], BoolArray]:
    size = 2 * WINDOW_RADIUS_PX + 1
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


def detect_corners(
    image: ImageArray,
    n_corners: int,
    *,
    spacing_px: int = SPACING_PX,
    half: ImageArray | None = None,
    mask: ImageArray | None = None,
) -> FloatArray:
    """Detect the corners of an image, to two pixels.

    The score of a pixel is the smaller eigenvalue of its gradients' covariance. Each cell of
    `spacing_px` gives its best local maximum; these share the budget over larger cells.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
    n_corners : int
        The largest number returned.
    spacing_px : int
        Side of the cells with at most one corner each.
    half : ndarray of uint8, optional
        The image halved, where it is at hand.
    mask : ndarray of uint8, shape (height, width), optional
        0 where there are to be no corners.

    Returns
    -------
    ndarray of float64, shape (n, 2)
        Whole pixels (u, v), with room for the window that is tracked.
    """
    border = (WINDOW_RADIUS_PX + 1) // corners.REDUCTION + 1
    if min(image.shape) // corners.REDUCTION <= 2 * border:
        return np.zeros((0, 2))
    half = halve(image) if half is None else half
    shape = image.shape[0] // spacing_px + 1, image.shape[1] // spacing_px + 1
    places, scores = np.empty(shape, np.int64), np.empty(shape, np.float32)
    rows = np.empty((corners.N_ROWS, half.shape[1]), np.float32)
    corners.find_corners(np.ascontiguousarray(half), border, spacing_px, rows, places, scores)
    by_rows = np.argsort(places, axis=None)[np.count_nonzero(places < 0) :]
    v, u = np.divmod(places.ravel()[by_rows], half.shape[1])
    if mask is not None:
        is_used = mask[corners.REDUCTION * v, corners.REDUCTION * u] > 0
        by_rows, v, u = by_rows[is_used], v[is_used], u[is_used]
    pixels = np.stack([u, v], axis=1) * float(corners.REDUCTION)
    chosen = choose_spread(
        pixels,
        scores.ravel()[by_rows],
        cell_size_px=CELL_SIZE_PX,
        n_chosen=n_corners,
    )
    return pixels[chosen]


def halve(image: ImageArray) -> ImageArray:
    """Return an image of half the size, each pixel the mean of four; an odd edge is left out."""
    height, width = (size // 2 for size in image.shape)
    if min(height, width) == 0:
        return image
    # Of exactly twice the size OpenCV has a path that is ten times as fast as the general one.
    even = image[: 2 * height, : 2 * width]
    half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Square patches of a reference image, prepared to be aligned; see `gvo.kernels.templates`.

    Parameters
    ----------
    values : ndarray of float32, shape (n, s * s)
        Grey values less their mean.
    gradients : ndarray of float32, shape (n, 2, s * s)
        Along rows and columns, likewise.
    inverses : ndarray of float64, shape (n, 4)
        Inverse Hessians (00, 01, 11), and the variances of the values.
    """

    values: NDArray[np.float32]
    gradients: NDArray[np.float32]
    inverses: FloatArray

    @classmethod
    def of(cls, image: ImageArray, pixels: FloatArray) -> Templates:
        """Cut patches around whole pixels, shape (n, 2), out of an image."""
        return cls.of_patches(cut_patches(image, pixels, templates.RADIUS_PX + 1))

    @classmethod
    def of_patches(cls, patches: NDArray[np.uint8]) -> Templates:
        """Prepare patches (n, 11, 11), which are one pixel wider on all sides."""
        n, n_pixels = len(patches), (2 * templates.RADIUS_PX + 1) ** 2
        values, gradients = np.empty((n, n_pixels), "f4"), np.empty((n, 2, n_pixels), "f4")
        inverses = np.empty((n, 4))
        templates.prepare(patches, values, gradients, inverses)
        return cls(values, gradients, inverses)

    def align(
        self, image: ImageArray, indices: IntArray, start: FloatArray, warps: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Find some of the patches in another image, near the start.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
        indices : ndarray of int64, shape (m,)
            Of the patches.
        start : ndarray of float64, shape (m, 2)
            Pixels (u, v).
        warps : ndarray of float64, shape (m, 2, 2)
            Derivatives of the image's pixels by those of the patches.

        Returns
        -------
        pixels : ndarray of float64, shape (m, 2)
        is_found : ndarray of bool, shape (m,)
            False where the search does not come to rest, or what it finds is unlike the patch.
        """
        pixels, is_found = np.array(start), np.empty(len(indices), np.bool_)
        image = np.ascontiguousarray(image)
        templates.align(
            *(image, self.values, self.gradients, self.inverses, indices, warps, pixels, is_found)
        )
        return pixels, is_found


def cut_patches(image: ImageArray, pixels: FloatArray, radius: int) -> NDArray[np.uint8]:
    """Return patches around whole pixels (n, 2) of an image, whose border is replicated.

    Returns
    -------
    ndarray of uint8, shape (n, 2 * radius + 1, 2 * radius + 1)
    """
    patches = np.empty((len(pixels), 2 * radius + 1, 2 * radius + 1), np.uint8)
    sampling.cut_patches(np.ascontiguousarray(image), np.ascontiguousarray(pixels), patches)
    return patches
