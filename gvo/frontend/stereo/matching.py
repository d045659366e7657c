"""Sparse stereo matching along epipolar lines, with sub-pixel disparity."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gvo.config import StereoConfig
from gvo.frontend.features import Features
from gvo.frontend.matching import descriptor_distances, expand_ranges, select_matches
from gvo.geometry.camera import StereoCamera
from gvo.kernels.stereo import RADIUS_PX, REACH_PX
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray


def candidate_pairs(
    left: Features, right: Features, camera: StereoCamera, config: StereoConfig
) -> IntArray:
    """List the pairs that obey the epipolar constraint and the depth limits.

    A table of the right keypoints, sorted by row and then by column, gives one range of columns
    for each left keypoint and each row within the tolerance.

    Returns
    -------
    ndarray of int64, shape (k, 2)
        Indices into left and right.
    """
    if len(left) == 0 or len(right) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    min_disparity = float(camera.depth_to_disparity(config.max_depth_m))
    max_disparity = float(camera.depth_to_disparity(config.min_depth_m))
    order, keys = _row_table(right.keypoints, camera.width)
    reach = int(np.ceil(config.row_tolerance_px))
    rows_left = _rows(left.keypoints)
    rows = rows_left[:, np.newaxis] + np.arange(-reach, reach + 1)
    u_left = left.keypoints[:, :1]
    base = rows * (2.0 * camera.width)
    starts = np.searchsorted(keys, base + np.maximum(u_left - max_disparity, 0.0), "left")
    stops = np.searchsorted(keys, base + np.maximum(u_left - min_disparity, -1.0), "right")
    flat, positions = expand_ranges(starts.ravel(), stops.ravel())
    pairs = np.stack([flat // rows.shape[1], order[positions]], axis=1)
    row_differences = left.keypoints[pairs[:, 0], 1] - right.keypoints[pairs[:, 1], 1]
    return np.asarray(pairs[np.abs(row_differences) <= config.row_tolerance_px])


def _row_table(keypoints: FloatArray, width: int) -> tuple[IntArray, FloatArray]:
    """Sort keypoints by row, then column; the key holds both in one number."""
    keys = _rows(keypoints) * (2.0 * width) + keypoints[:, 0]
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


def _rows(keypoints: FloatArray) -> IntArray:
    # Not rint: it rounds halves to even, so that 0.5 and 1.5 come two rows apart.
    return np.asarray(np.floor(keypoints[:, 1] + 0.5).astype(np.int64))


def compare_rows(
    left: Features, right: Features, candidates: IntArray
) -> tuple[IntArray, FloatArray]:
    """Return the candidate pairs of about the same octave, and their descriptor distances."""
    octave_steps = left.octaves[candidates[:, 0]] - right.octaves[candidates[:, 1]]
    pairs = candidates[np.abs(octave_steps) <= 1]
    return pairs, descriptor_distances(left.descriptors, right.descriptors, pairs)


def match_stereo(
    left: Features, right: Features, camera: StereoCamera, config: StereoConfig
) -> IntArray:
    """Match left and right keypoints: epipolar candidates, distance, ratio, reciprocal.

    Returns
    -------
    ndarray of int64, shape (m, 2)
        Indices into left and right, each at most once.
    """
    pairs, distances = compare_rows(left, right, candidate_pairs(left, right, camera, config))
    return select_matches(pairs, distances, config, (len(left), len(right)))


def refine_disparities(
    images: tuple[ImageArray, ImageArray],
    pixels_left: FloatArray,
    pixels_right: FloatArray,
    config: StereoConfig,
) -> tuple[FloatArray, BoolArray]:
    """Fit the disparity of matches to a fraction of a pixel.

    A patch around the left pixel is compared with patches of the right image on the same row,
    `REACH_PX` columns to either side; a parabola through the sum of squared
    differences (patch means removed) at the best column and its neighbours gives the fraction.

    Parameters
    ----------
    images : tuple of two ndarrays of uint8, shape (height, width)
    pixels_left, pixels_right : ndarray of float64, shape (n, 2)
        Matched pixels.

    Returns
    -------
    disparities : ndarray of float64, shape (n,)
    is_valid : ndarray of bool, shape (n,)
        False where a patch leaves the image or the best column is the last one searched.
    """
    if config.subpixel == "none":
        disparities = pixels_left[:, 0] - pixels_right[:, 0]
        return disparities, np.ones(len(disparities), dtype=np.bool_)
    radius, reach = RADIUS_PX, REACH_PX
    columns = np.rint(pixels_right[:, 0]).astype(np.int64)
    column_left, row = np.rint(pixels_left).astype(np.int64).T
    # Patches, and the strips to search them in, lie in the images.
    (height, width), margin = images[0].shape, radius + reach
    is_valid = (row >= radius) & (row < height - radius)
    is_valid &= (column_left >= radius) & (column_left < width - radius)
    is_valid &= (columns >= margin) & (columns < width - margin)
    chosen = np.flatnonzero(is_valid)
    places = row[chosen], column_left[chosen], columns[chosen]
    offsets, is_minimum = parabola_minimum(_patch_ssd(images, *places, radius=radius, reach=reach))
    disparities = np.full(len(row), np.nan)
    disparities[chosen] = column_left[chosen] - columns[chosen] - (offsets - reach)
    is_valid[chosen] = is_minimum
    return disparities, is_valid


def is_in_depth_range(
    disparities: FloatArray, camera: StereoCamera, config: StereoConfig
) -> BoolArray:
    """Tell which disparities, shape (n,), mean a depth between the limits."""
    nearest, farthest = config.min_depth_m, config.max_depth_m
    is_far_enough = (disparities > 0.0) & (disparities <= camera.depth_to_disparity(nearest))
    return np.asarray(is_far_enough & (disparities >= camera.depth_to_disparity(farthest)))


def _patch_ssd(
    images: tuple[ImageArray, ImageArray],
    row: IntArray,
    column_left: IntArray,
    column_right: IntArray,
    *,
    radius: int,
    reach: int,
) -> NDArray[np.float32]:
    """Return the sums of squared differences less their mean, shape (n, 2 * reach + 1).

    Without the mean, so that a pair of unequal exposure gives the same disparities.
    """
    size, n_offsets = 2 * radius + 1, 2 * reach + 1
    if len(row) == 0:  # also for images smaller than a patch, which have no windows
        return np.zeros((0, n_offsets), dtype=np.float32)
    left_windows = sliding_window_view(images[0], (size, size))
    right_windows = sliding_window_view(images[1], (size, size + 2 * reach))
    patches = left_windows[row - radius, column_left - radius].astype(np.float32)
    strips = right_windows[row - radius, column_right - radius - reach].astype(np.float32)
    ssd = np.empty((len(row), n_offsets), dtype=np.float32)
    for offset in range(n_offsets):
        difference = strips[:, :, offset : offset + size] - patches
        squares = np.einsum("nij,nij->n", difference, difference)
        ssd[:, offset] = squares - difference.sum(axis=(1, 2)) ** 2 / size**2
    return ssd


def parabola_minimum(values: NDArray[np.float32]) -> tuple[FloatArray, BoolArray]:
    """Locate the minimum of sampled curves between samples.

    Parameters
    ----------
    values : ndarray of float32, shape (n, m)
        Curves at 0 .. m - 1.

    Returns
    -------
    positions : ndarray of float64, shape (n,)
    is_minimum : ndarray of bool, shape (n,)
        False where the smallest sample is the first or last.
    """
    (n, m), best = values.shape, np.argmin(values, axis=1)
    inner = np.minimum(np.maximum(best, 1), m - 2)
    places = m * np.arange(n) + inner
    samples = values.ravel()[np.stack([places - 1, places, places + 1])]
    before, at, after = samples.astype(np.float64)
    curvature = before - 2.0 * at + after
    is_between = (best > 0) & (best < m - 1) & (curvature != 0.0)
    shift = 0.5 * (before - after) / np.where(is_between, curvature, 1.0)
    return inner + shift, is_between
