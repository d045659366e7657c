"""RANSAC over rigid fits to minimal samples, many hypotheses at once.

References
----------
M. Fischler, R. Bolles, "Random sample consensus", CACM 24(6), 1981, doi:10.1145/358669.358692.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.config import RansacConfig
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.umeyama import fit_rigid, fit_rigid_triples
from gvo.kernels import consensus
from gvo.types import BoolArray, Failure, FloatArray, IntArray

# Hypotheses fitted and scored together, to amortize calls. Also the minimum number: any sample
# without outliers finds the inliers, but the best of many is less biased by its own noise.
_BLOCK = 64
# Early stop: accepted probability that no sample without outliers was drawn.
_MISS_PROBABILITY = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """The rigid transform that most correspondences agree with.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (4, 4)
        Refitted to the inliers.
    inliers : ndarray of bool, shape (n,)
        The correspondences that agree with it.
    """

    T_reference_current: FloatArray
    inliers: BoolArray


def ransac_rigid(
    correspondences: Correspondences,
    camera: StereoCamera,
    config: RansacConfig,
    *,
    weights: FloatArray | None,
    rng: np.random.Generator,
) -> Consensus | Failure:
    """Find the rigid transform with the largest set of inliers, refitted to that set.

    Parameters
    ----------
    correspondences : Correspondences
        Putative matches.
    camera : StereoCamera
        Of the current frame; used by the `reprojection` metric.
    config : RansacConfig
        Maximum number of hypotheses, metric, thresholds.
    weights : ndarray of float64, shape (n,), optional
        For the refit.
    rng : numpy.random.Generator
        Draws the samples.

    Returns
    -------
    Consensus or Failure
    """
    n = len(correspondences)
    if n < max(3, config.min_inliers):
        return Failure(
            reason=f"{n} matches, {config.min_inliers} are needed (ransac.min_inliers)", n_matches=n
        )
    near = _near(correspondences, config)
    # Where the near points lie on a line, the far ones may not.
    for pool in [near] if len(near) == n else [near, np.arange(n)]:
        samples = pool[draw_samples(len(pool), config.n_hypotheses, rng)]
        best = _search(samples, correspondences, camera, config, near=pool)
        if best is not None:
            return _refit(best, correspondences, camera, config, near=pool, weights=weights)
    return Failure(reason=f"{n} points lie on a line", n_matches=n)


def _search(
    samples: IntArray,
    correspondences: Correspondences,
    camera: StereoCamera,
    config: RansacConfig,
    *,
    near: IntArray,
) -> BoolArray | None:
    """Return the largest inlier set of the hypotheses; None if all samples are degenerate."""
    best: BoolArray | None = None
    for n_before in range(0, len(samples), _BLOCK):
        block = samples[n_before : n_before + _BLOCK]
        T, is_valid = fit_rigid_triples(
            correspondences.reference_points[block], correspondences.current_points[block]
        )
        if not is_valid.any():
            continue
        inliers = find_inliers(T[is_valid], correspondences, camera, config)
        counts = np.count_nonzero(inliers, axis=1)
        found = inliers[counts.argmax()]
        if best is None or np.count_nonzero(found) > np.count_nonzero(best):
            best = found
        # Samples are drawn from near points: their inlier ratio decides.
        share = np.count_nonzero(best[near]) / len(near)
        if (1.0 - share**3) ** (n_before + len(block)) < _MISS_PROBABILITY:
            break
    return best


def _near(correspondences: Correspondences, config: RansacConfig) -> IntArray:
    """Return the indices of points near enough to fit; all if those are too few."""
    disparities = np.minimum(correspondences.reference_uvd[:, 2], correspondences.current_uvd[:, 2])
    near = np.flatnonzero(disparities >= config.min_disparity_px)
    return near if len(near) >= config.min_inliers else np.arange(len(disparities))


def draw_samples(n: int, n_samples: int, rng: np.random.Generator) -> IntArray:
    """Draw `n_samples` triples of distinct indices below n, shape (n_samples, 3)."""
    first = rng.integers(n, size=n_samples)
    second = rng.integers(n - 1, size=n_samples)
    second += second >= first
    third = rng.integers(n - 2, size=n_samples)
    third += third >= np.minimum(first, second)
    third += third >= np.maximum(first, second)
    return np.stack([first, second, third], axis=1)


def find_inliers(
    T_reference_current: FloatArray,
    correspondences: Correspondences,
    camera: StereoCamera,
    config: RansacConfig,
) -> BoolArray:
    """Find the inliers of each of m transforms.

    Parameters
    ----------
    T_reference_current : ndarray of float64, shape (m, 4, 4)
        The hypotheses.

    Returns
    -------
    ndarray of bool, shape (m, n)
    """
    inliers = np.empty((len(T_reference_current), len(correspondences)), np.bool_)
    is_distance = config.inlier_metric == "distance"
    threshold = config.inlier_threshold_m if is_distance else config.inlier_threshold_px
    given = correspondences
    consensus.find_inliers(
        *(np.ascontiguousarray(T_reference_current), given.reference_points, given.current_points),
        *(given.current_uvd, camera.parameters, threshold, is_distance, inliers),
    )
    return inliers


def _refit(
    inliers: BoolArray,
    correspondences: Correspondences,
    camera: StereoCamera,
    config: RansacConfig,
    *,
    near: IntArray,
    weights: FloatArray | None,
) -> Consensus | Failure:
    n, n_inliers = len(correspondences), int(np.count_nonzero(inliers))
    if n_inliers < config.min_inliers:
        return Failure(
            reason=f"{n_inliers} of {n} matches agree on a motion, {config.min_inliers} are "
            "needed (ransac.min_inliers)",
            n_matches=n,
            n_inliers=n_inliers,
        )
    fitted = near[inliers[near]]
    if len(fitted) < config.min_inliers:
        fitted = np.flatnonzero(inliers)
    T = fit_rigid(
        correspondences.reference_points[fitted],
        correspondences.current_points[fitted],
        weights=None if weights is None else weights[fitted],
    )
    if isinstance(T, Failure):
        return T
    again = find_inliers(T[np.newaxis], correspondences, camera, config)[0]
    if np.count_nonzero(again) < config.min_inliers:
        again = inliers
    return Consensus(T_reference_current=T, inliers=again)
