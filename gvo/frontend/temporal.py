"""Matching of two frames' observations within windows around predicted pixels."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gvo._trace import note
from gvo.frontend.matching import best_ratios, descriptor_distances, mutual_best
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray, IntArray, Observations


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


def match_temporal(
    reference: Observations,
    current: Observations,
    predicted: tuple[FloatArray, IntArray],
    *,
    radius_px: float,
    max_distance: float,
    max_ratio: float = 1.0,
) -> IntArray:
    """Match observations of two frames: window, left and right descriptors, ratio, reciprocal.

    Parameters
    ----------
    reference, current : Observations
    predicted : tuple of arrays
        From `predict_pixels`.
    radius_px : float
        Search radius around a predicted pixel.
    max_distance : float
        Largest mean descriptor distance over left and right, as a share of the largest.
    max_ratio : float
        Largest ratio of a reference's best to its second best distance; 1 takes any.

    Returns
    -------
    ndarray of int64, shape (m, 2)
        Indices into reference and current, each at most once.
    """
    pixels, indices = predicted
    if len(indices) == 0 or len(current) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = _pairs_within(pixels, current.keypoints, radius_px)
    pairs = np.stack([indices[pairs[:, 0]], pairs[:, 1]], axis=1)
    distances = descriptor_distances(reference.descriptors_left, current.descriptors_left, pairs)
    if reference.descriptors_right is not None and current.descriptors_right is not None:
        distances = 0.5 * distances + 0.5 * descriptor_distances(
            reference.descriptors_right, current.descriptors_right, pairs
        )
    is_usable = distances <= max_distance
    note("temporal.candidates", pairs=pairs, distances=distances)
    if max_ratio < 1.0:
        is_usable &= best_ratios(pairs[:, 0], distances, len(reference))[pairs[:, 0]] <= max_ratio
    pairs, distances = pairs[is_usable], distances[is_usable]
    return pairs[mutual_best(pairs, distances, len(reference), len(current))]


def _pairs_within(first: FloatArray, second: FloatArray, radius: float) -> IntArray:
    """List the pairs of points within a distance, shape (k, 2), in a fixed order."""
    tree = cKDTree(second)
    near = cKDTree(first).sparse_distance_matrix(tree, radius, output_type="ndarray")
    pairs = np.stack([near["i"], near["j"]], axis=1).astype(np.int64)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
