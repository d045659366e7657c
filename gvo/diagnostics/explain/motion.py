"""From matches to a motion: the attempts, which matches agree, what the refinement changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

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
from gvo.diagnostics.explain.values import Sorting, Step
from gvo.frontend.registration import search_consensus
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus
from gvo.geometry.refinement import Refinement
from gvo.geometry.residuals import StereoResiduals, whiten_in_place
from gvo.types import BoolArray, Failure, FloatArray, RelativePose

_MIN_DEPTH_M = 1e-3


def explain_matches(attempt: Trace, config: Config) -> Sorting | None:
    """Sort the points of the reference by the tests of their matches; None if none was tried."""
    begin = attempt.find("attempt")
    if not begin:
        return None
    sort = _sort_tracks if begin["method"] == "tracks" else _sort_descriptors
    return sort(begin, attempt, config)


def _sort_tracks(begin: Mapping[str, Any], attempt: Trace, config: Config) -> Sorting:
    pixels, indices = begin["source_uvd"][:, :2], begin["indices"]
    n, tracked = len(pixels), indices[begin["is_tracked"]]
    predicted, found = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    predicted[indices] = begin["predicted"][:, :2]
    found[tracked] = begin["pixels"][begin["is_tracked"]]
    tests = {"out of view": as_mask(indices, n), "track lost": as_mask(tracked, n)}
    for name, passes in _track_tests(attempt, config).items():
        tests[name] = as_mask(tracked[passes], n)
    return Sorting(tests=tests, pixels=pixels, partners=found, predicted=predicted)


def _track_tests(attempt: Trace, config: Config) -> dict[str, BoolArray]:
    """Tell which tracks pass each test of their disparity or depth."""
    measured, sampled = attempt.find("klt.measured"), attempt.find("depth.sampled")
    followed = attempt.find("klt.followed")
    if not measured:
        return {}
    if followed:
        return {
            "patch leaves an image": np.isfinite(followed["disparities"]),
            "did not converge": followed["is_at_rest"],
            "depth out of range": measured["is_valid"],
        }
    if not sampled:
        return {"depth out of range": measured["is_valid"]}
    return depth_tests(sampled["depths"], sampled["is_valid"], config.depth)


def _sort_descriptors(begin: Mapping[str, Any], attempt: Trace, config: Config) -> Sorting:
    temporal = config.temporal
    (reference, current), (expected, indices) = begin["pixels"], begin["predicted"]
    n, candidates = len(reference), attempt.find("temporal.candidates") or no_candidates()
    matches = attempt.find("registration.begin").get("matches", no_candidates()["pairs"])
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
    return Sorting(tests=tests, pixels=reference, partners=found, predicted=predicted)


def explain_rows(attempt: Trace) -> float | None:
    """Return by how many pixels matches were moved at most to the middle of the exposure."""
    moved = attempt.find("rows.settled")
    if not moved:
        return None
    return float(np.abs(moved["settled"] - moved["measured"]).max(initial=0.0))


def explain_consensus(attempt: Trace, camera: StereoCamera, config: Config) -> Step | None:
    """Count the matches that agree, and those of each sample; None if nothing was registered.

    Where the prediction made samples needless, they are those that would have been drawn.
    """
    begin, end = attempt.find("registration.begin"), attempt.find("registration.consensus")
    if not end:
        return None
    matches, answer = begin["correspondences"], end["consensus"]
    search, sampled = attempt.before("registration.consensus"), answer
    if end["is_known"]:
        with watched() as search:
            sampled = search_consensus(matches, camera, config, begin["stamps_ns"])
    known = attempt.find("registration.known")
    return Step(
        n_matches=len(matches),
        is_known=end["is_known"],
        n_agreeing_with_prediction=int(known["inliers"].sum()) if known else None,
        n_inliers=int(answer.inliers.sum()) if answer else None,
        samples=_samples(search, sampled),
        drawn=Step(
            n_needed=known.get("n_needed"),
            pixels=(matches.source_uvd[:, :2], matches.target_uvd[:, :2]),
            inliers=answer.inliers if answer else np.zeros(len(matches), np.bool_),
        ),
    )


def _samples(search: Trace, sampled: Consensus | Failure) -> Step:
    """Count the inliers of each sample, -1 for three points on a line, and of the best refitted."""
    drawn, blocks = search.find("ransac.samples"), search.all("ransac.block")
    n_drawn = max((block["n_before"] + len(block["is_valid"]) for block in blocks), default=0)
    counts = np.full(n_drawn, -1, dtype=np.int64)
    for block in blocks:
        counts[block["n_before"] + np.flatnonzero(block["is_valid"])] = block["counts"]
    return Step(
        n_drawn=n_drawn,
        n_planned=len(drawn.get("samples", ())),
        n_near=len(drawn.get("near", ())),
        share_of_near=float(blocks[-1]["share"]) if blocks else 0.0,
        reason=sampled.reason if isinstance(sampled, Failure) else "",
        inliers=counts,
        n_inliers=None if isinstance(sampled, Failure) else int(sampled.inliers.sum()),
    )


def explain_refinement(attempt: Trace, camera: StereoCamera, config: Config) -> Step | None:
    """Compare the residuals before and after; None if the refinement was not reached.

    Residuals are (u, v, disparity) measured less predicted, NaN behind the camera.
    """
    begin, before, after = (
        attempt.find(f"registration.{name}") for name in ("begin", "consensus", "refined")
    )
    if not after.get("refined"):
        return None
    matches, gate = begin["correspondences"], config.registration.gate
    ends: tuple[Consensus, Refinement] = before["consensus"], after["refined"]
    start, gated = attempt.find("refinement.begin"), attempt.find("refinement.gated")
    residuals_px = [_residuals(each.T_target_source, matches, camera) for each in ends]
    whitened = [_whiten(each, start["residuals"]) for each in residuals_px]
    within = start["residuals"].within(gated["T_target_source"], gate) if gated else None
    return Step(
        n_steps=len(attempt.before("registration.refined").all("refinement.step")),
        n_within_gate=None if within is None else np.count_nonzero(within),
        gate_sigma=gate,
        scale=ends[1].scale,
        n_inliers=[np.count_nonzero(each.inliers) for each in ends],
        median_abs_residual_px=[_medians(each) for each in residuals_px],
        median_abs_whitened=[_medians(each) for each in whitened],
        drawn=Step(
            T_target_source=[each.T_target_source for each in ends],
            inliers=ends[1].inliers,
            depths=matches.target_points[:, 2],
            residuals_px=np.stack(residuals_px),
            whitened=np.stack(whitened),
        ),
    )


def _residuals(T: FloatArray, matches: Correspondences, camera: StereoCamera) -> FloatArray:
    points = se3.transform_points(T, matches.source_points)
    points[points[:, 2] < _MIN_DEPTH_M] = np.nan
    return np.asarray(matches.target_uvd - camera.project_stereo(points))


def _whiten(residuals_px: FloatArray, residuals: StereoResiduals) -> FloatArray:
    rows = residuals_px.T.copy()
    whiten_in_place(residuals.columns[6:12], rows)
    return np.ascontiguousarray(rows.T)


def _medians(residuals: FloatArray) -> dict[str, float | None]:
    finite = residuals[np.isfinite(residuals).all(axis=1)]
    medians = np.median(np.abs(finite), axis=0).tolist() if len(finite) else [None] * 3
    return dict(zip(("u", "v", "disparity"), medians, strict=True))


class Registration(NamedTuple):
    """One registration of the current frame; each attempt begins with how it matched."""

    reference_ns: int
    result: RelativePose | Failure
    attempts: list[Trace]


def registrations_of(trace: Trace) -> list[Registration]:
    """Return the registrations of a frame in order."""
    return [
        Registration(
            reference_ns=part[0].values["reference"].stamp_ns,
            result=end["result"],
            attempts=[_last_round(each) for each in part.before("frontend.end").split("attempt")],
        )
        for part in trace.split("frontend.begin")
        if (end := part.find("frontend.end"))
    ]


def _last_round(attempt: Trace) -> Trace:
    """Leave out the first round of a step that was registered again with its own velocity."""
    rounds = attempt.split("rows.settled")
    registered = [each for each in rounds if each.find("registration.begin")]
    return Trace([*attempt.before("rows.settled"), *registered[-1]]) if registered else attempt


def has_prior(attempt: Trace) -> bool:
    """Tell whether an attempt started from a predicted motion."""
    prior = attempt.find("attempt")["prior"]
    return prior is not None and not np.array_equal(prior, np.eye(4))


def describe(registration: Registration, indices: Mapping[int, int]) -> list[str]:
    """Describe the attempts of a registration, one a line, with frames' numbers by their stamps."""
    against = f"against frame {indices[registration.reference_ns]}"
    methods = [f", {_method(attempt)}" for attempt in registration.attempts] or [""]
    answers = [*map(_outcome, registration.attempts[:-1]), _answer(registration.result)]
    return [f"{against}{method}: {each}" for method, each in zip(methods, answers, strict=True)]


def _method(attempt: Trace) -> str:
    values = attempt.find("attempt")
    if values["method"] == "descriptors":
        place = "predicted" if has_prior(attempt) else "previous"
        return f"descriptors within {values['radius_px']:g} px of the {place} pixels"
    if values["is_wide"]:
        return "tracks with the wide pyramid, checked backwards"
    return "tracks from the predicted pixels"


def _outcome(attempt: Trace) -> str:
    """Tell what came of an attempt that another one followed."""
    ends = attempt.find("registration.refined") or attempt.find("registration.consensus")
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
