"""Relative pose from 3D-3D correspondences: RANSAC-Umeyama, then refinement."""

from __future__ import annotations

import numpy as np

from gvo.config import Config
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import ransac_rigid
from gvo.geometry.refinement import fit_covariance, refine_pose
from gvo.types import Failure, FloatArray, IntArray, Observations, RelativePose


def register_matches(
    reference: Observations,
    current: Observations,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
) -> RelativePose | Failure:
    """Estimate the motion between two frames from matched observations.

    Parameters
    ----------
    reference, current : Observations
    matches : ndarray of int64, shape (n, 2)
        Indices into reference and current.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.

    Returns
    -------
    RelativePose or Failure
    """
    return register_correspondences(
        Correspondences.of(reference, current, matches),
        matches,
        camera,
        config,
        stamps_ns=(reference.stamp_ns, current.stamp_ns),
    )


def register_correspondences(
    correspondences: Correspondences,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
    *,
    stamps_ns: tuple[int, int],
) -> RelativePose | Failure:
    """Estimate the motion between two frames from 3D-3D correspondences.

    Parameters
    ----------
    correspondences : Correspondences
        Source is the reference, target the current frame.
    matches : ndarray of int64, shape (n, 2)
        Handed through to the result.
    camera : StereoCamera
        Of both frames.
    config : Config
        Sections `ransac` and `registration`.
    stamps_ns : tuple of two int
        Stamps of reference and current.

    Returns
    -------
    RelativePose or Failure
    """
    # The generator depends on the two frames alone, so that a run that starts
    # anywhere draws the same samples for them.
    seeds = [config.ransac.seed, *stamps_ns]
    consensus = ransac_rigid(
        correspondences,
        camera,
        config.ransac,
        weights=_weights(correspondences, config),
        rng=np.random.default_rng([abs(seed) for seed in seeds]),
    )
    if isinstance(consensus, Failure):
        return consensus
    finish = fit_covariance if config.registration.refine == "none" else refine_pose
    refined = finish(
        consensus.T_target_source,
        correspondences,
        consensus.inliers,
        camera,
        config.registration,
    )
    n_inliers = int(np.count_nonzero(consensus.inliers))
    if isinstance(refined, Failure):
        return Failure(reason=refined.reason, n_matches=len(matches), n_inliers=n_inliers)
    n_inliers = int(np.count_nonzero(refined.inliers))
    if n_inliers < config.ransac.min_inliers:
        return Failure(
            reason=f"{n_inliers} of {len(matches)} matches fit the refined motion, "
            f"{config.ransac.min_inliers} are needed (ransac.min_inliers)",
            n_matches=len(matches),
            n_inliers=n_inliers,
        )
    return RelativePose(
        T_reference_current=se3.invert(refined.T_target_source),
        covariance=refined.covariance,
        matches=matches,
        inliers=refined.inliers,
        flow_px=_flow(correspondences.select(refined.inliers)),
    )


def _flow(correspondences: Correspondences) -> float:
    displacements = correspondences.target_uvd[:, :2] - correspondences.source_uvd[:, :2]
    return float(np.median(np.linalg.norm(displacements, axis=1)))


def _weights(correspondences: Correspondences, config: Config) -> FloatArray | None:
    if config.registration.weighting == "none":
        return None
    # Depth noise grows with z^2; 1/z^2 as a weight keeps near points in the lead without
    # giving up the far ones, which hold the rotation.
    return np.asarray(1.0 / correspondences.target_points[:, 2] ** 2)
