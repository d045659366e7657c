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
from gvo.frontend.stereo.patches import cut_patches, steps_around
from gvo.geometry.camera import StereoCamera
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Of Lucas-Kanade: at most 10 iterations, or a step of 0.01 pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.01)
# The backward track starts at its goal and needs no pyramid: a wrong one does not find the first
# corner anyway.
_BACK_LEVELS = 0
# Corners are detected at half resolution, at a quarter of the cost: a patch need not be centred on
# its corner exactly, as it is tracked and measured wherever it is.
_REDUCTION = 2
# Smallest eigenvalue of a corner's gradient covariance, grey in [0, 1]: below it noise is tracked.
_MIN_EIGENVALUE = 1e-4
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
# Side of the square over which the gradients are summed, there.
_BLOCK_PX = 3
# Half size of the patches, and the offsets of their pixels, homogeneous.
RADIUS_PX = 4
_STEPS = np.vstack([steps_around(RADIUS_PX, RADIUS_PX), np.ones((2 * RADIUS_PX + 1) ** 2, "f4")])
# Variance of a gradient that is noise, grey values squared: keeps flat patches from dividing by
# nothing.
_NOISE = 1.0
# Distance to a plane, as a share of the reference's, below which the current camera is at it or
# behind it; and the steepest slope that a surface has in the current image.
_MIN_DISTANCE = 0.05
_MAX_SLOPE = 0.75
# An alignment makes so many steps; as many again are made by patches that the last of them moved by
# more than this.
_N_STEPS = 2
_MOVING_PX = 0.03
# A step of the alignment moves a patch by at most so much; it is at rest below so much.
_MAX_STEP_PX = 1.0
_MAX_LAST_STEP_PX = 0.2
# Largest variance of the difference of matching patches: a share of the patch's variance, plus the
# noise of the pixels, grey values squared.
_MAX_UNLIKE = 0.5
_UNLIKE_NOISE = 25.0


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

    Returns
    -------
    ndarray of float64, shape (n, 2)
        Whole pixels (u, v), with room for the window that is tracked.
    """
    border = (WINDOW_RADIUS_PX + 1) // _REDUCTION + 1
    if min(image.shape) // _REDUCTION <= 2 * border:
        return np.zeros((0, 2))
    half = halve(image) if half is None else half
    pixels, responses = _local_maxima(half, border)
    best = _best_of_cells(pixels, responses, spacing_px, width=image.shape[1])
    chosen = choose_spread(
        pixels[best],
        responses[best],
        width=image.shape[1],
        cell_size_px=CELL_SIZE_PX,
        n_chosen=n_corners,
    )
    return pixels[best[chosen]].astype(np.float64)


def _local_maxima(reduced: ImageArray, border: int) -> tuple[IntArray, NDArray[np.float32]]:
    """Return pixels of the full image, shape (n, 2), and their scores, shape (n,)."""
    scores = cv2.cornerMinEigenVal(reduced, _BLOCK_PX)
    neighbours = cv2.dilate(scores, np.ones((3, 3), dtype=np.uint8))
    is_corner = (scores == neighbours) & (scores > _MIN_EIGENVALUE)
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


def patch_warps(
    uvd: FloatArray, slopes: FloatArray, T_current_reference: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return by how much patches of surfaces are turned, stretched and sheared by a motion.

    The surface at a pixel is a plane: its inverse depth is linear in the pixel. Then a pixel x,
    in coordinates of the ray, goes to R x + t (n . x), divided by its third component.

    Parameters
    ----------
    uvd : ndarray of float64, shape (n, 3)
        Pixels of the reference and their disparities.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparity per pixel, along rows and columns; zero where a surface faces the
        camera.
    T_current_reference : ndarray of float64, shape (4, 4)
        Motion, metres.
    camera : StereoCamera
        Of both.

    Returns
    -------
    ndarray of float64, shape (n, 2, 2)
        Derivative of the current pixel (u, v) by the reference's.
    """
    f = np.array([camera.fx, camera.fy])
    rays = np.ones((len(uvd), 3))
    rays[:, :2] = (uvd[:, :2] - [camera.cx, camera.cy]) / f
    R, t = T_current_reference[:3, :3], T_current_reference[:3, 3]
    inverse_depths = uvd[:, 2] / (camera.fx * camera.baseline)
    points = rays @ R.T + inverse_depths[:, np.newaxis] * t
    inverse_slopes = slopes / (camera.fx * camera.baseline)
    # Of the points by the pixels, shape (n, 3, 2).
    derivatives = R[:, :2] / f + t[:, np.newaxis] * inverse_slopes[:, np.newaxis]
    z = points[:, 2, np.newaxis, np.newaxis]
    directions = points[:, :2, np.newaxis] / z
    warps = (derivatives[:, :2] - directions * derivatives[:, 2:]) / z
    return np.asarray(warps * f[:, np.newaxis])


def move_slopes(
    uvd: FloatArray, slopes: FloatArray, T_current_reference: FloatArray, camera: StereoCamera
) -> FloatArray:
    """Return the slopes of the disparities of surfaces in the current image, shape (n, 2).

    A plane n . p = 1, whose inverse depth is n . x for a ray x, becomes R n / (1 + t . R n).

    Parameters
    ----------
    uvd : ndarray of float64, shape (n, 3)
        Pixels of the reference and their disparities.
    slopes : ndarray of float64, shape (n, 2)
        Change of the disparity per pixel in the reference, along rows and columns.
    T_current_reference : ndarray of float64, shape (4, 4)
        Motion, metres.
    camera : StereoCamera
        Of both.
    """
    scales = np.array([1.0, camera.fy / camera.fx]) / camera.baseline
    rays = (uvd[:, :2] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    normals = np.empty((len(uvd), 3))
    normals[:, :2] = slopes * scales
    inverse_depths = uvd[:, 2] / (camera.fx * camera.baseline)
    normals[:, 2] = inverse_depths - np.einsum("ni,ni->n", normals[:, :2], rays)
    normals = normals @ T_current_reference[:3, :3].T
    distances = 1.0 + normals @ T_current_reference[:3, 3]
    moved = normals[:, :2] / np.maximum(distances, _MIN_DISTANCE)[:, np.newaxis]
    return np.clip(moved / scales, -_MAX_SLOPE, _MAX_SLOPE)


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Square patches of a reference image, prepared for inverse compositional alignment.

    Gradients and Hessian are those of the reference, computed once. Means are subtracted, so that
    a difference of exposure has no effect.

    Parameters
    ----------
    values : ndarray of float32, shape (n, s * s)
        Grey values less their mean.
    gradients : ndarray of float32, shape (n, 2, s * s)
        Along rows and columns.
    inverses : ndarray of float32, shape (n, 2, 2)
        Inverse Hessians.

    References
    ----------
    S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004,
    doi:10.1023/B:VISI.0000011205.11775.fd.
    """

    values: NDArray[np.float32]
    gradients: NDArray[np.float32]
    inverses: NDArray[np.float32]

    @classmethod
    def of(cls, image: ImageArray, pixels: FloatArray) -> Templates:
        """Cut patches around whole pixels, shape (n, 2), out of an image."""
        return cls.of_patches(cut_patches(image, pixels, RADIUS_PX + 1))

    @classmethod
    def of_patches(cls, patches: NDArray[np.uint8]) -> Templates:
        """Prepare patches (n, 11, 11), which are one pixel wider on all sides."""
        n, size = len(patches), 2 * RADIUS_PX + 1
        wide = patches.astype(np.float32)
        along = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2])
        across = 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1])
        gradients = np.stack([along, across], axis=1).reshape(n, 2, size * size)
        gradients -= gradients.mean(axis=2, keepdims=True)
        values = wide[:, 1:-1, 1:-1].reshape(n, size * size)
        hessians = np.matmul(gradients, np.swapaxes(gradients, 1, 2)) + _NOISE * np.eye(2)
        return cls(
            values=values - values.mean(axis=1, keepdims=True),
            gradients=gradients,
            inverses=np.linalg.inv(hessians).astype(np.float32),
        )

    def take(self, chosen: IntArray) -> Templates:
        """Select patches by index."""
        arrays = self.values, self.gradients, self.inverses
        return Templates(*(each.take(chosen, axis=0) for each in arrays))

    def align(
        self, image: ImageArray, start: FloatArray, warps: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Find the patches in another image, near the start.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
        start : ndarray of float64, shape (n, 2)
            Pixels (u, v).
        warps : ndarray of float64, shape (n, 2, 2)
            See `patch_warps`.

        Returns
        -------
        pixels : ndarray of float64, shape (n, 2)
        is_found : ndarray of bool, shape (n,)
            False where the search does not come to rest, or what it finds is unlike the patch.
        """
        single = warps.astype(np.float32)
        pixels, unlike, moves = self._steps(image, start, single)
        moving = np.flatnonzero(moves > _MOVING_PX)
        if len(moving):
            more = self.take(moving)._steps(image, pixels[moving], single[moving])
            pixels[moving], unlike[moving], moves[moving] = more
        variances = np.einsum("ni,ni->n", self.values, self.values) / self.values.shape[1]
        are_alike = unlike <= _MAX_UNLIKE * variances + _UNLIKE_NOISE
        return pixels, are_alike & (moves < _MAX_LAST_STEP_PX)

    def _steps(
        self, image: ImageArray, start: FloatArray, warps: NDArray[np.float32]
    ) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
        """Return pixels after some steps, how unlike the patches are there, and the last moves."""
        pixels = start.copy()
        for _ in range(_N_STEPS):
            # Its mean has no effect: that of the gradients is zero.
            differences = sample_warped(image, pixels, warps) - self.values
            slopes = np.einsum("nij,nj->ni", self.gradients, differences)
            steps = np.einsum("nij,nj->ni", self.inverses, slopes)
            clipped = np.clip(steps, -_MAX_STEP_PX, _MAX_STEP_PX)
            moves = np.einsum("nij,nj->ni", warps, clipped)
            pixels -= moves
        differences -= differences.mean(axis=1, keepdims=True)
        # What the last step explains of the difference is gone.
        unlike = np.einsum("ni,ni->n", differences, differences)
        unlike -= np.einsum("ni,ni->n", slopes, steps)
        return pixels, unlike / self.values.shape[1], np.hypot(*moves.T)


def sample_warped(
    image: ImageArray, pixels: FloatArray, warps: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Return warped patches around pixels, shape (n, s * s), interpolated."""
    n = len(pixels)
    if n == 0:  # refused by OpenCV
        return np.zeros((0, _STEPS.shape[1]), dtype=np.uint8)
    places = np.empty((2, n, 3), dtype=np.float32)
    places[:, :, :2], places[:, :, 2] = np.swapaxes(warps, 0, 1), pixels.T
    columns, rows = places @ _STEPS
    seen = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.uint8)
