"""Relative pose from 3D-3D correspondences, between neighbours and for places seen again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.frontend.matching import mutual_best
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.verification import verify_motion
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus, find_inliers, ransac_rigid
from gvo.geometry.refinement import Refinement, descend, fit_covariance, refine_pose
from gvo.geometry.residuals import StereoResiduals
from gvo.types import (
    Failure,
    FloatArray,
    IntArray,
    MotionPrior,
    Observations,
    RelativePose,
)

# From such a share of inliers on RANSAC would find the same motion again.
_MIN_KNOWN_SHARE = 0.7
# Gauss-Newton steps of a rough estimate.
_N_ROUGH_ITERATIONS = 2
# By how much more its inliers may be off: rows are bent by a velocity that is not measured yet.
_ROUGH_FACTOR = 2.0
# Best over second best distance of a match (D. Lowe, 2004, doi:10.1023/B:VISI.0000029664.99615.94).
_MAX_RATIO = 0.8
# More RANSAC hypotheses: more matches are wrong than between neighbouring frames.
_N_HYPOTHESES = 1000
# Matches that have to agree, before the view tells: at least, and as a share, of which
# `ransac.min_inliers` are enough. Of places that are seen again from elsewhere a quarter of the
# matches is right, often fewer than twenty.
_MIN_INLIERS = 8
_MIN_INLIER_SHARE = 0.2
# Share of the points in view. In rendered streets of repeated facades, places that only look alike
# reach 0.16 and the same place, seen from 10 m behind, 0.26; in a room it has 0.45.
_MIN_SHARE_OF_VIEW = 0.25
# Share where the depth images agree on the rest: what is blurred is not found, however near. Of
# pairs of three recordings from the hand whose descriptors agree on the right motion 0.61 reach
# the share above, and 0.93 this one.
_MIN_SHARE_BESIDE_DEPTH = 0.08
_MIN_DEPTH_M = 1e-3
# Bands of rows, and by how much fewer of them inliers may be spread over than matches. In steps
# of sound recordings this share is 0.46 at least, and rarely below 0.6; two of 576 links had 0.35,
# and no pose changed without them. Of images whose rows lost their place it is 0.13 to 0.7.
_N_BANDS = 8
_MIN_SPREAD = 0.42


def register_correspondences(
    correspondences: Correspondences,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
    *,
    stamps_ns: tuple[int, int],
    prior: MotionPrior | None = None,
    T_start: FloatArray | None = None,
) -> RelativePose | Failure:
    """Estimate the motion between two frames from 3D-3D correspondences.

    Parameters
    ----------
    correspondences : Correspondences
    matches : ndarray of int64, shape (n, 2)
        Handed through to the result.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.
    stamps_ns : tuple of two int
        Stamps of reference and current.
    prior : MotionPrior, optional
        Where most matches agree with its prediction, RANSAC is skipped: the refinement starts
        from it, and chooses its inliers anew (not with `registration.refine` none, where the fit
        to the consensus is the result).
    T_start : ndarray of float64, shape (4, 4), optional
        T_reference_current that is used so in place of the prediction.

    Returns
    -------
    RelativePose or Failure
    """
    if prior is not None and T_start is None:
        T_start = prior.T_predicted
    consensus = find_consensus(correspondences, camera, config, stamps_ns, T_start)
    if isinstance(consensus, Failure):
        return consensus
    found = consensus.T_reference_current, correspondences, consensus.inliers, camera
    refined: Refinement | Failure
    if config.registration.refine == "none":
        refined = fit_covariance(*found)
    else:
        refined = refine_pose(*found)
        if isinstance(refined, Refinement):
            refined = verify_motion(
                *(refined, correspondences, camera, config),
                prior=prior,
                make_rng=partial(_rng, config, stamps_ns),
            )
    return _conclude(refined, consensus, correspondences, matches, config.ransac.min_inliers)


def estimate_roughly(
    correspondences: Correspondences,
    camera: StereoCamera,
    config: Config,
    *,
    stamps_ns: tuple[int, int],
    prior: MotionPrior | None,
) -> FloatArray | Failure:
    """Return T_reference_current after a few steps, not verified; as `register_correspondences`."""
    thresholds = "inlier_threshold_px", "inlier_threshold_m"
    wide = {name: _ROUGH_FACTOR * getattr(config.ransac, name) for name in thresholds}
    config = config.model_copy(update={"ransac": config.ransac.model_copy(update=wide)})
    T = None if prior is None else prior.T_predicted
    found = find_consensus(correspondences, camera, config, stamps_ns, T)
    if isinstance(found, Failure):
        return found
    T = found.T_reference_current
    residuals = StereoResiduals.of(T, correspondences, camera)
    refined = descend(T, residuals, found.inliers, n_iterations=_N_ROUGH_ITERATIONS)
    return T if refined is None else refined


def find_consensus(
    correspondences: Correspondences,
    camera: StereoCamera,
    config: Config,
    stamps_ns: tuple[int, int],
    T_start: FloatArray | None,
) -> Consensus | Failure:
    """Return the start value if most matches agree with it, else what RANSAC finds.

    Arguments are those of `register_correspondences`; the start is a T_reference_current.
    """
    ransac, is_refined = config.ransac, config.registration.refine != "none"
    if T_start is not None and is_refined:
        inliers = find_inliers(T_start[np.newaxis], correspondences, camera, ransac)[0]
        n_needed = max(ransac.min_inliers, _MIN_KNOWN_SHARE * len(correspondences))
        if np.count_nonzero(inliers) >= n_needed:
            return Consensus(T_reference_current=T_start, inliers=inliers)
    # Depth noise grows with z^2; 1/z^2 as a weight keeps near points in the lead without
    # giving up the far ones, which hold the rotation.
    is_weighted = config.registration.weighting != "none"
    weights = 1.0 / correspondences.current_points[:, 2] ** 2 if is_weighted else None
    rng = _rng(config, stamps_ns)
    return ransac_rigid(correspondences, camera, ransac, weights=weights, rng=rng)


def _conclude(
    refined: Refinement | Failure,
    consensus: Consensus,
    correspondences: Correspondences,
    matches: IntArray,
    min_inliers: int,
) -> RelativePose | Failure:
    """Return the relative pose, or a failure with the numbers of matches and inliers."""
    if isinstance(refined, Failure):
        n_inliers = int(np.count_nonzero(consensus.inliers))
        return replace(refined, n_matches=len(matches), n_inliers=n_inliers)
    n_inliers = int(np.count_nonzero(refined.inliers))
    if n_inliers < min_inliers:
        return Failure(
            reason=f"{n_inliers} of {len(matches)} matches fit the refined motion, "
            f"{min_inliers} are needed (ransac.min_inliers)",
            n_matches=len(matches),
            n_inliers=n_inliers,
        )
    pixels = correspondences.reference_uvd[:, :2], correspondences.current_uvd[:, :2]
    displacements = (pixels[1] - pixels[0])[refined.inliers]
    return RelativePose(
        T_reference_current=refined.T_reference_current,
        covariance=refined.covariance,
        matches=matches,
        inliers=refined.inliers,
        pixels_reference=pixels[0],
        pixels_current=pixels[1],
        points_current=correspondences.current_points,
        flow_px=median(np.hypot(*displacements.T).tolist()),
        effects=refined.effects,
    )


def _rng(config: Config, stamps_ns: tuple[int, int]) -> np.random.Generator:
    # The generator depends on the two frames alone, so that a run that starts
    # anywhere draws the same samples for them.
    seeds = [config.ransac.seed, *stamps_ns]
    return np.random.default_rng([abs(seed) for seed in seeds])


def match_anywhere(reference: Sequence[NDArray[Any]], current: Sequence[NDArray[Any]]) -> IntArray:
    """Match descriptors of the whole images: ratio test, reciprocal.

    Parameters
    ----------
    reference, current : sequences of ndarray of uint8 or float32, shape (n, m)
        Descriptors of the same points, one array for each size of their patches. The first size
        is compared with all of the other image: what is nearer there looks larger.

    Returns
    -------
    ndarray of int64, shape (m, 2)
        Indices into reference and current, each at most once.
    """
    sizes = [(reference[0], each) for each in current]
    sizes += [(each, current[0]) for each in reference[1:]]
    found = [_match(*each) for each in sizes]
    pairs = np.concatenate([each[0] for each in found])
    distances = np.concatenate([each[1] for each in found])
    return np.asarray(pairs[mutual_best(pairs, distances, len(reference[0]), len(current[0]))])


def register_anywhere(
    reference: Observations,
    current: Observations,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
    *,
    offsets: RigOffsets,
) -> RelativePose | Failure:
    """Estimate the motion between two frames far apart; the view has to confirm it.

    Parameters
    ----------
    reference, current : Observations
    matches : ndarray of int64, shape (n, 2)
        See `match_anywhere`.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`; fewer matches have to agree than between neighbours.
    offsets : RigOffsets
        What is taken off all measurements.

    Returns
    -------
    RelativePose or Failure
    """
    ransac, n_needed = config.ransac, max(_MIN_INLIERS, int(_MIN_INLIER_SHARE * len(matches)))
    few = {
        "n_hypotheses": max(ransac.n_hypotheses, _N_HYPOTHESES),
        "min_inliers": min(ransac.min_inliers, n_needed),
    }
    found = Correspondences.of(reference, current, matches)
    uvd = offsets.take_off(found.reference_uvd), offsets.take_off(found.current_uvd)
    sigmas = found.reference_sigmas, found.current_sigmas
    return register_correspondences(
        Correspondences.of_pixels(uvd, sigmas, camera),
        matches,
        camera,
        config.model_copy(update={"ransac": ransac.model_copy(update=few)}),
        stamps_ns=(reference.stamp_ns, current.stamp_ns),
    )


def check_view(
    result: RelativePose | Failure,
    points_reference: FloatArray,
    camera: StereoCamera,
    *,
    depths_agree: bool = False,
) -> RelativePose | Failure:
    """Refuse a place that looks alike: enough of the points in view must be inliers.

    Facades, carpets and trees repeat: a part of the image agrees with another place as well as
    with its own. The rest of the view tells them apart.

    Parameters
    ----------
    result : RelativePose or Failure
        From matches searched all over the view that it predicts.
    points_reference : ndarray of float64, shape (n, 3)
        Points of the reference, in its `cam` frame, metres.
    camera : StereoCamera
    depths_agree : bool
        That depth images tell as much of the rest of the view: then fewer are enough.

    Returns
    -------
    RelativePose or Failure
    """
    if isinstance(result, Failure):
        return result
    T_current_reference = se3.invert(result.T_reference_current)
    points = se3.transform_points(T_current_reference, points_reference)
    points = points[points[:, 2] > _MIN_DEPTH_M]
    n_in_view = int(np.count_nonzero(camera.is_in_view(camera.project(points))))
    min_share = _MIN_SHARE_BESIDE_DEPTH if depths_agree else _MIN_SHARE_OF_VIEW
    if result.n_inliers >= min_share * n_in_view:
        return check_rows(result, camera)
    return Failure(
        reason=f"{result.n_inliers} of {n_in_view} points in view are seen again, "
        f"{min_share:.0%} are needed to know a place again",
        n_matches=result.n_matches,
        n_inliers=result.n_inliers,
    )


def check_rows(result: RelativePose, camera: StereoCamera) -> RelativePose | Failure:
    """Refuse what agrees in a few bands of rows only, while matches are spread over more.

    Where bytes are lost in the transfer, rows lose their place: each band moves as it likes, and
    one that happens to be near the prediction, or larger than the others, is no consensus.
    Without this check frames of a rendered RGB-D recording with shifted rows are all registered.

    Parameters
    ----------
    result : RelativePose
    camera : StereoCamera
    """
    bands = np.clip(result.pixels_current[:, 1] * (_N_BANDS / camera.height), 0, _N_BANDS - 1)
    spread, spread_matches = (_n_occupied(bands[chosen]) for chosen in (result.inliers, ...))
    if spread >= _MIN_SPREAD * spread_matches:
        return result
    return Failure(
        reason=f"{result.n_inliers} of {result.n_matches} matches agree, but in few rows of the "
        "image only: rows have lost their place",
        n_matches=result.n_matches,
        n_inliers=result.n_inliers,
    )


def _n_occupied(bands: FloatArray) -> float:
    """Return over how many bands points are spread: the exponential of the entropy."""
    counts = np.bincount(bands.astype(np.int64))
    shares = counts[counts > 0] / len(bands)
    return float(np.exp(-shares @ np.log(shares)))


def _match(first: NDArray[Any], second: NDArray[Any]) -> tuple[IntArray, FloatArray]:
    """Return pairs that are the best of both and pass the ratio test, and their distances."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    (forth, distances), (back, _) = _best(first, second), _best(second, first)
    indices = np.flatnonzero(forth >= 0)
    indices = indices[back[forth[indices]] == indices]
    return np.column_stack([indices, forth[indices]]), distances[indices]


def _best(first: NDArray[Any], second: NDArray[Any]) -> tuple[IntArray, FloatArray]:
    """Return the match of each descriptor that passes the ratio test, else -1; its distance."""
    is_binary = first.dtype == np.uint8
    kind, norm = (cv2.CV_32S, cv2.NORM_HAMMING) if is_binary else (cv2.CV_32F, cv2.NORM_L2)
    distances, nearest = cv2.batchDistance(first, second, kind, normType=norm, K=2)
    is_distinct = distances[:, 0] <= _MAX_RATIO * distances[:, 1]
    return np.where(is_distinct, nearest[:, 0], -1), distances[:, 0].astype(np.float64)
