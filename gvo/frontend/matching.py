"""Descriptor matching: distances of candidate pairs, mutual best, windows between frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gvo.config import StereoConfig, TemporalConfig
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray, IntArray, Observations

# Descriptors of SIFT have length 512 and no negative entry, so that two are at most this far apart.
_MAX_SIFT_DISTANCE = np.sqrt(2.0) * 512.0


def descriptor_distances(
    first: NDArray[np.uint8] | NDArray[np.float32],
    second: NDArray[np.uint8] | NDArray[np.float32],
    pairs: IntArray,
) -> FloatArray:
    """Return the distances of pairs of descriptors, as a share of the largest possible.

    Parameters
    ----------
    first, second : ndarray of uint8 or float32, shape (n, m)
        Binary descriptors (Hamming distance) or real ones (Euclidean distance).
    pairs : ndarray of int64, shape (k, 2)
        Indices into both.

    Returns
    -------
    ndarray of float64, shape (k,)
        In [0, 1].
    """
    a, b = first[pairs[:, 0]], second[pairs[:, 1]]
    if first.dtype == np.uint8:
        words_a, words_b = a.view(np.uint64), b.view(np.uint64)
        bits = np.bitwise_count(words_a ^ words_b).sum(axis=1, dtype=np.int64)
        return np.asarray(bits / (8.0 * first.shape[1]))
    return np.asarray(np.linalg.norm(a - b, axis=1) / _MAX_SIFT_DISTANCE, dtype=np.float64)


def mutual_best(pairs: IntArray, distances: FloatArray, n_first: int, n_second: int) -> IntArray:
    """Keep the pairs that are the best of both of their members.

    Parameters
    ----------
    pairs : ndarray of int64, shape (k, 2)
        Candidate pairs of indices below `n_first` and `n_second`.
    distances : ndarray of float64, shape (k,)
        Smaller is better; of equal ones the earlier pair wins.

    Returns
    -------
    ndarray of int64, shape (m,)
        Positions in `pairs`, sorted by the first member; no index occurs twice.
    """
    k = len(pairs)
    ranks = np.empty(k, dtype=np.int64)
    ranks[np.argsort(distances, kind="stable")] = np.arange(k)
    best_of_first = np.full(n_first, k, dtype=np.int64)
    best_of_second = np.full(n_second, k, dtype=np.int64)
    np.minimum.at(best_of_first, pairs[:, 0], ranks)
    np.minimum.at(best_of_second, pairs[:, 1], ranks)
    is_mutual = (ranks == best_of_first[pairs[:, 0]]) & (ranks == best_of_second[pairs[:, 1]])
    chosen = np.flatnonzero(is_mutual)
    return np.asarray(chosen[np.argsort(pairs[chosen, 0], kind="stable")])


def best_ratios(members: IntArray, distances: FloatArray, n_members: int) -> FloatArray:
    """Return the ratio of the best to the second best distance of each member.

    Parameters
    ----------
    members : ndarray of int64, shape (k,)
        Whose candidates these are, below `n_members`.
    distances : ndarray of float64, shape (k,)
        Smaller is better.
    n_members : int

    Returns
    -------
    ndarray of float64, shape (n_members,)
        Best over second best distance, in [0, 1]; 0 with less than two candidates, 1 where
        both are equal.

    References
    ----------
    D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004,
    doi:10.1023/B:VISI.0000029664.99615.94.
    """
    order = np.lexsort((distances, members))
    grouped, ascending = members[order], distances[order]
    is_first = np.ones(len(order), dtype=np.bool_)
    is_first[1:] = grouped[1:] != grouped[:-1]
    has_second = np.zeros(len(order), dtype=np.bool_)
    has_second[:-1] = is_first[:-1] & ~is_first[1:]
    best = np.flatnonzero(has_second)
    second = ascending[best + 1]
    ratios = np.zeros(n_members)
    ratios[grouped[best]] = np.where(
        second > 0, ascending[best] / np.where(second > 0, second, 1.0), 1.0
    )
    return ratios


def select_matches(
    pairs: IntArray,
    distances: FloatArray,
    config: StereoConfig | TemporalConfig,
    n_members: tuple[int, int],
) -> IntArray:
    """Keep pairs, shape (k, 2), by `max_distance`, `max_ratio` and mutual best distance."""
    is_usable = distances <= config.max_distance
    if config.max_ratio < 1.0:
        ratios = best_ratios(pairs[:, 0], distances, n_members[0])
        is_usable &= ratios[pairs[:, 0]] <= config.max_ratio
    pairs, distances = pairs[is_usable], distances[is_usable]
    return np.asarray(pairs[mutual_best(pairs, distances, *n_members)])


def expand_ranges(starts: IntArray, stops: IntArray) -> tuple[IntArray, IntArray]:
    """List all (row, position) of half-open ranges of positions, one range a row.

    Returns
    -------
    rows, positions : ndarray of int64, shape (sum of lengths,)
    """
    lengths = np.maximum(stops - starts, 0)
    rows = np.repeat(np.arange(len(starts)), lengths)
    offsets = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return rows, np.asarray(starts[rows] + offsets)


def predict_pixels(
    reference: Observations, T_reference_current: FloatArray | None, camera: StereoCamera
) -> tuple[FloatArray, IntArray]:
    """Predict where the points of the reference frame appear in the current one.

    Parameters
    ----------
    reference : Observations
    T_reference_current : ndarray of float64, shape (4, 4), or None
        Predicted motion; without it the previous pixels are the prediction.

    Returns
    -------
    pixels : ndarray of float64, shape (m, 2)
        Predicted pixels of the points that are in front of the current camera.
    indices : ndarray of int64, shape (m,)
        Which points of the reference these are.
    """
    if T_reference_current is None:
        return reference.keypoints, np.arange(len(reference))
    points = se3.transform_points(se3.invert(T_reference_current), reference.points_cam)
    indices = np.flatnonzero(points[:, 2] > 1e-3)
    return camera.project(points[indices]), indices


def compare_within(
    reference: Observations,
    current: Observations,
    predicted: tuple[FloatArray, IntArray],
    radius_px: float,
) -> tuple[IntArray, FloatArray]:
    """Return the pairs of two frames within a radius of the prediction, and their distances."""
    pixels, indices = predicted
    if len(indices) == 0 or len(current) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    near = _pairs_within(pixels, current.keypoints, radius_px)
    pairs = np.stack([indices[near[:, 0]], near[:, 1]], axis=1)
    return pairs, _mean_distances(reference, current, pairs)


def match_temporal(
    reference: Observations,
    current: Observations,
    predicted: tuple[FloatArray, IntArray],
    config: TemporalConfig,
    *,
    radius_px: float,
) -> IntArray:
    """Match observations of two frames: window, left and right descriptors, ratio, reciprocal.

    Parameters
    ----------
    reference, current : Observations
    predicted : tuple of arrays
        From `predict_pixels`.
    config : TemporalConfig
        Limits of descriptor distances and their ratios.
    radius_px : float
        Search radius around a predicted pixel.

    Returns
    -------
    ndarray of int64, shape (m, 2)
        Indices into reference and current, each at most once.
    """
    pairs, distances = compare_within(reference, current, predicted, radius_px)
    return select_matches(pairs, distances, config, (len(reference), len(current)))


def _mean_distances(reference: Observations, current: Observations, pairs: IntArray) -> FloatArray:
    """Return the descriptor distances of pairs, the mean of left and right for stereo."""
    distances = descriptor_distances(reference.descriptors_left, current.descriptors_left, pairs)
    if reference.descriptors_right is None or current.descriptors_right is None:
        return distances
    return 0.5 * distances + 0.5 * descriptor_distances(
        reference.descriptors_right, current.descriptors_right, pairs
    )


def _pairs_within(first: FloatArray, second: FloatArray, radius: float) -> IntArray:
    """List the pairs of points within a distance, shape (k, 2), in a fixed order."""
    near = cKDTree(first).sparse_distance_matrix(cKDTree(second), radius, output_type="ndarray")
    pairs = np.stack([near["i"], near["j"]], axis=1).astype(np.int64)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
