"""From matches to a motion: the attempts, which matches agree, what the refinement changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gvo._trace import Trace, watched
from gvo.config import Config
from gvo.diagnostics.explain.extraction import (
    as_mask,
    best_partners,
    depth_tests,
    distance_tests,
    no_candidates,
)
from gvo.diagnostics.explain.values import ConsensusStep, RefinementStep, Sorting
from gvo.frontend.registration import search_consensus
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus
from gvo.geometry.refinement import Refinement
from gvo.geometry.residuals import StereoResiduals, whiten_in_place
from gvo.types import BoolArray, Failure, FloatArray, IntArray, RelativePose

_MIN_DEPTH_M = 1e-3


def explain_matches(attempt: Trace, config: Config) -> Sorting:
    """Sort the points of the reference by the tests of their matches."""
    is_of_tracks = attempt[0].values["method"] == "tracks"
    return _tracks(attempt, config) if is_of_tracks else _descriptors(attempt, config)


def _tracks(attempt: Trace, config: Config) -> Sorting:
    begin = attempt[0].values
    pixels, indices = begin["source_uvd"][:, :2], begin["indices"]
    n, tracked = len(pixels), indices[begin["is_tracked"]]
    predicted, found = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    predicted[indices] = begin["predicted"][:, :2]
    found[tracked] = begin["pixels"][begin["is_tracked"]]
    tests = {"out of view": as_mask(indices, n), "track lost": as_mask(tracked, n)}
    for name, passes in _track_tests(attempt, config).items():
        tests[name] = as_mask(tracked[passes], n)
    return Sorting.by(tests, pixels, partners=found, predicted=predicted)


def _track_tests(attempt: Trace, config: Config) -> dict[str, BoolArray]:
    """Tell which tracks pass each test of their disparity or depth."""
    measured, sampled = attempt.find("klt.measured"), attempt.find("depth.sampled")
    followed = attempt.find("klt.followed")
    if measured is None:
        return {}
    if followed is not None:
        return {
            "patch leaves an image": np.isfinite(followed["disparities"]),
            "did not converge": followed["is_at_rest"],
            "depth out of range": measured["is_valid"],
        }
    if sampled is None:
        return {"depth out of range": measured["is_valid"]}
    return depth_tests(sampled["depths"], sampled["is_valid"], config.depth)


def _descriptors(attempt: Trace, config: Config) -> Sorting:
    begin, temporal = attempt[0].values, config.temporal
    (reference, current), (expected, indices) = begin["pixels"], begin["predicted"]
    n, candidates = len(reference), attempt.find("temporal.candidates") or no_candidates()
    registered = attempt.find("registration.begin") or {"matches": no_candidates()["pairs"]}
    matches = registered["matches"]
    predicted = np.full((n, 2), np.nan)
    predicted[indices] = expected
    found = best_partners(candidates, current, n)
    found[matches[:, 0]] = current[matches[:, 1]]
    limits = {"max_distance": temporal.max_distance, "max_ratio": temporal.max_ratio}
    tests = {
        "behind the camera": as_mask(indices, n),
        "none within the radius": as_mask(candidates["pairs"][:, 0], n),
        **distance_tests(candidates, n, **limits),
        "reciprocity": as_mask(matches[:, 0], n),
    }
    return Sorting.by(tests, reference, partners=found, predicted=predicted)


def explain_consensus(attempt: Trace, camera: StereoCamera, config: Config) -> ConsensusStep | None:
    """Return which matches agree; None if nothing was registered."""
    begin, end = attempt.find("registration.begin"), attempt.find("registration.consensus")
    if begin is None or end is None:
        return None
    matches: Correspondences = begin["correspondences"]
    consensus: Consensus | Failure = end["consensus"]
    search, sampled = attempt.before("registration.consensus"), consensus
    if end["is_known"]:
        with watched() as search:
            sampled = search_consensus(matches, camera, config, begin["stamps_ns"])
    known = attempt.find("registration.known")
    samples = search.find("ransac.samples") or {"samples": (), "near": ()}
    blocks = search.all("ransac.block")
    return ConsensusStep(
        pixels_reference=matches.source_uvd[:, :2],
        pixels_current=matches.target_uvd[:, :2],
        inliers=consensus.inliers if isinstance(consensus, Consensus) else None,
        n_agreeing_with_prediction=None
        if known is None
        else int(np.count_nonzero(known["inliers"])),
        n_needed=0.0 if known is None else float(known["n_needed"]),
        is_known=end["is_known"],
        n_planned=len(samples["samples"]),
        n_near=len(samples["near"]),
        counts=_counts(search),
        share_of_near=float(blocks[-1]["share"]) if blocks else 0.0,
        sampled=sampled.inliers if isinstance(sampled, Consensus) else None,
        reason=sampled.reason if isinstance(sampled, Failure) else "",
    )


def _counts(search: Trace) -> IntArray:
    """Return the inliers of each sample; -1 for three points on a line."""
    blocks = search.all("ransac.block")
    n_drawn = max((block["n_before"] + len(block["is_valid"]) for block in blocks), default=0)
    counts = np.full(n_drawn, -1, dtype=np.int64)
    for block in blocks:
        counts[block["n_before"] + np.flatnonzero(block["is_valid"])] = block["counts"]
    return counts


def explain_refinement(
    attempt: Trace, camera: StereoCamera, config: Config
) -> RefinementStep | None:
    """Return the residuals before and after; None if the refinement was not reached."""
    names = "registration.begin", "registration.consensus", "refinement.begin"
    begin, consensus, start = (attempt.find(name) for name in names)
    end = attempt.find("registration.refined")
    if begin is None or consensus is None or start is None or end is None or not end["refined"]:
        return None
    residuals: StereoResiduals = start["residuals"]
    ends: tuple[Consensus, Refinement] = consensus["consensus"], end["refined"]
    residuals_px = [
        _residuals(each.T_target_source, begin["correspondences"], camera) for each in ends
    ]
    gated, gate = attempt.find("refinement.gated"), config.registration.gate
    within = None if gated is None else residuals.within(gated["T_target_source"], gate)
    return RefinementStep(
        T_target_source=np.stack([each.T_target_source for each in ends]),
        residuals_px=np.stack(residuals_px),
        whitened=np.stack([_whiten(each, residuals) for each in residuals_px]),
        inliers=np.stack([each.inliers for each in ends]),
        depths=begin["correspondences"].target_points[:, 2],
        n_within_gate=None if within is None else int(np.count_nonzero(within)),
        n_steps=len(attempt.before("registration.refined").all("refinement.step")),
        gate_sigma=gate,
        scale=ends[1].scale,
    )


def _residuals(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    """Return (u, v, disparity) measured less predicted, shape (n, 3); NaN behind the camera."""
    points = se3.transform_points(T, matches.source_points)
    points[points[:, 2] < _MIN_DEPTH_M] = np.nan
    return np.asarray(matches.target_uvd - camera.project_stereo(points))


def _whiten(residuals_px: FloatArray, residuals: StereoResiduals) -> FloatArray:
    rows = residuals_px.T.copy()
    whiten_in_place(residuals.columns[6:12], rows)
    return np.ascontiguousarray(rows.T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """One registration of the current frame.

    Parameters
    ----------
    reference_ns : int
        Stamp of the reference.
    result : RelativePose or Failure
    attempts : list of Trace
        Each begins with how it matched.
    """

    reference_ns: int
    result: RelativePose | Failure
    attempts: list[Trace]


def registrations_of(trace: Trace) -> list[Registration]:
    """Return the registrations of a frame in order."""
    return [
        Registration(
            reference_ns=part[0].values["reference"].stamp_ns,
            result=end["result"],
            attempts=part.before("frontend.end").split("attempt"),
        )
        for part in trace.split("frontend.begin")
        if (end := part.find("frontend.end")) is not None
    ]


def has_prior(attempt: Trace) -> bool:
    """Tell whether an attempt started from a predicted motion."""
    prior = attempt[0].values["prior"]
    return prior is not None and not np.array_equal(prior, np.eye(4))


def describe(registration: Registration, indices: Mapping[int, int]) -> list[str]:
    """Describe the attempts of a registration, one a line.

    Parameters
    ----------
    registration : Registration
    indices : mapping of int to int
        Numbers of frames by their stamps.
    """
    against = f"against frame {indices[registration.reference_ns]}"
    answer = _answer(registration.result)
    if not registration.attempts:
        return [f"{against}: {answer}"]
    *failed, last = registration.attempts
    lines = [f"{against}, {_method(attempt)}: {_outcome(attempt)}" for attempt in failed]
    return [*lines, f"{against}, {_method(last)}: {answer}"]


def _method(attempt: Trace) -> str:
    values = attempt[0].values
    if values["method"] == "descriptors":
        place = "predicted" if has_prior(attempt) else "previous"
        return f"descriptors within {values['radius_px']:g} px of the {place} pixels"
    if values["is_wide"]:
        return "tracks with the wide pyramid, checked backwards"
    return "tracks from the predicted pixels"


def _outcome(attempt: Trace) -> str:
    """Tell what came of an attempt that another one followed."""
    ends = attempt.find("registration.refined") or attempt.find("registration.consensus") or {}
    answer = ends.get("refined", ends.get("consensus"))
    if answer is None:
        return "not registered"
    if isinstance(answer, Failure):
        return answer.reason
    return f"{int(answer.inliers.sum())} inliers, used as the prediction of the next attempt"


def _answer(result: RelativePose | Failure) -> str:
    if isinstance(result, Failure):
        return result.reason
    return f"registered, {result.n_inliers} inliers of {result.n_matches} matches"
