"""Relative pose from 3D-3D correspondences: consensus, then refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gvo._trace import note
from gvo.config import Config
from gvo.frontend.usual_motion import heed_usual_motion
from gvo.frontend.verification import verify_motion
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus, find_inliers, ransac_rigid
from gvo.geometry.refinement import Refinement, fit_covariance, refine_pose
from gvo.types import BoolArray, Failure, FloatArray, IntArray, RelativePose

# Wrong matches never agree in such numbers by chance: samples could only find the same motion.
_MIN_KNOWN_SHARE = 0.7


def register_correspondences(
    correspondences: Correspondences,
    matches: IntArray,
    camera: StereoCamera,
    config: Config,
    *,
    stamps_ns: tuple[int, int],
    start: FloatArray | None = None,
    T_usual: FloatArray | None = None,
    with_offset: bool = False,
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
    start : ndarray of float64, shape (4, 4), optional
        Predicted T_reference_current. Where most matches agree with it already, nothing is
        left for samples to find: these matches and this motion are where the refinement
        starts, which chooses its matches again anyhow. Of no use with `registration.refine`
        none, where the fit to the consensus is the result.
    T_usual : ndarray of float64, shape (4, 4), optional
        T_reference_current at the usual velocity, see `heed_usual_motion`.
    with_offset : bool
        Estimate a constant offset of the disparities too, `RelativePose.offset_px`.

    Returns
    -------
    RelativePose or Failure
    """
    note(
        "registration.begin",
        correspondences=correspondences,
        matches=matches,
        start=start,
        stamps_ns=stamps_ns,
    )
    known = _known_consensus(start, correspondences, camera, config)
    consensus = known or search_consensus(correspondences, camera, config, stamps_ns)
    note("registration.consensus", consensus=consensus, is_known=known is not None)
    if isinstance(consensus, Failure):
        return consensus
    finish = fit_covariance if config.registration.refine == "none" else refine_pose
    refined = finish(
        consensus.T_target_source,
        correspondences,
        consensus.inliers,
        camera,
        config.registration,
        with_offset=with_offset,
    )
    note("registration.refined", refined=refined)
    if not isinstance(refined, Failure) and config.registration.refine != "none":
        refined = _verify(
            *(refined, correspondences, camera, config),
            start=start,
            T_usual=T_usual,
            make_rng=lambda: _rng(config, stamps_ns),
            with_offset=with_offset,
        )
        note("registration.verified", refined=refined)
    n_inliers = int(np.count_nonzero(consensus.inliers))
    if isinstance(refined, Failure):
        return replace(refined, n_matches=len(matches), n_inliers=n_inliers)
    n_inliers = int(np.count_nonzero(refined.inliers))
    if n_inliers < config.ransac.min_inliers:
        return Failure(
            reason=f"{n_inliers} of {len(matches)} matches fit the refined motion, "
            f"{config.ransac.min_inliers} are needed (ransac.min_inliers)",
            n_matches=len(matches),
            n_inliers=n_inliers,
        )
    return _relative_pose(refined, correspondences, matches)


def _verify(
    refined: Refinement,
    correspondences: Correspondences,
    camera: StereoCamera,
    config: Config,
    *,
    start: FloatArray | None,
    T_usual: FloatArray | None,
    make_rng: Callable[[], np.random.Generator],
    with_offset: bool,
) -> Refinement | Failure:
    """Return the motion that the predictions speak for, at the last velocity and the usual one."""
    verified = verify_motion(
        *(refined, correspondences, camera, config),
        T_target_predicted=None if start is None else se3.invert(start),
        make_rng=make_rng,
        with_offset=with_offset,
    )
    if isinstance(verified, Failure) or T_usual is None:
        return verified
    return heed_usual_motion(
        *(verified, correspondences, camera, config),
        T_target_usual=se3.invert(T_usual),
        with_offset=with_offset,
    )


def _known_consensus(
    start: FloatArray | None, correspondences: Correspondences, camera: StereoCamera, config: Config
) -> Consensus | None:
    """Return the matches that agree with a prediction, if they are most of them."""
    if start is None or config.registration.refine == "none":
        return None
    T = se3.invert(start)
    inliers = find_inliers(T[np.newaxis], correspondences, camera, config.ransac)[0]
    n_needed = max(config.ransac.min_inliers, _MIN_KNOWN_SHARE * len(correspondences))
    note("registration.known", inliers=inliers, n_needed=n_needed)
    if np.count_nonzero(inliers) < n_needed:
        return None
    return Consensus(T_target_source=T, inliers=inliers)


def search_consensus(
    correspondences: Correspondences,
    camera: StereoCamera,
    config: Config,
    stamps_ns: tuple[int, int],
) -> Consensus | Failure:
    """Find the motion that most matches agree with, by samples; as `register_correspondences`."""
    return ransac_rigid(
        correspondences,
        camera,
        config.ransac,
        weights=_weights(correspondences, config),
        rng=_rng(config, stamps_ns),
    )


def _rng(config: Config, stamps_ns: tuple[int, int]) -> np.random.Generator:
    # The generator depends on the two frames alone, so that a run that starts
    # anywhere draws the same samples for them.
    seeds = [config.ransac.seed, *stamps_ns]
    return np.random.default_rng([abs(seed) for seed in seeds])


def _relative_pose(
    refined: Refinement, correspondences: Correspondences, matches: IntArray
) -> RelativePose:
    offset = refined.offset
    return RelativePose(
        T_reference_current=se3.invert(refined.T_target_source),
        covariance=refined.covariance,
        matches=matches,
        inliers=refined.inliers,
        pixels_reference=correspondences.source_uvd[:, :2],
        pixels_current=correspondences.target_uvd[:, :2],
        points_current=correspondences.target_points,
        flow_px=_flow(correspondences, refined.inliers),
        offset_px=None if offset is None else offset.offset_px,
        offset_sigma_px=None if offset is None else offset.sigma_px,
    )


def _flow(correspondences: Correspondences, inliers: BoolArray) -> float:
    displacements = correspondences.target_uvd[:, :2] - correspondences.source_uvd[:, :2]
    return float(np.median(np.hypot(*displacements[inliers].T)))


def _weights(correspondences: Correspondences, config: Config) -> FloatArray | None:
    if config.registration.weighting == "none":
        return None
    # Depth noise grows with z^2; 1/z^2 as a weight keeps near points in the lead without
    # giving up the far ones, which hold the rotation.
    return np.asarray(1.0 / correspondences.target_points[:, 2] ** 2)
