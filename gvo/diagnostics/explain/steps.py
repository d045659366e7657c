"""The steps of a frame: keypoints, disparities, matches, consensus, refinement."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._trace import Trace, watched
from gvo.config import Config, DepthConfig, StereoConfig
from gvo.diagnostics.explain.values import Sorting, Step
from gvo.frontend.features import Features
from gvo.frontend.matching import best_ratios
from gvo.frontend.registration import search_consensus
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.stereo.corners import N_SEARCH_STEPS
from gvo.frontend.stereo.disparity import follow_disparities
from gvo.frontend.stereo.patches import PATCH_RADIUS_PX, SEARCH_RADIUS_PX
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus
from gvo.geometry.refinement import Refinement
from gvo.geometry.residuals import StereoResiduals, whiten_in_place
from gvo.types import (
    BoolArray,
    Failure,
    FloatArray,
    Frame,
    ImageArray,
    IntArray,
    RelativePose,
    StereoFrame,
)

# Of the curve of squared differences around the result, pixels.
_REACH_PX = 4
_STEP_PX = 0.125
_MIN_DEPTH_M = 1e-3


def explain_keypoints(trace: Trace) -> Sorting:
    """Sort the keypoints detected into those within the budget and the others."""
    spread = trace.find("keypoints.spread") or {"pixels": np.zeros((0, 2)), "chosen": ()}
    pixels = np.asarray(spread["pixels"], dtype=np.float64)
    tests = {"over the budget": as_mask(spread["chosen"], len(pixels))}
    return Sorting(tests=tests, pixels=pixels)


def explain_measured(trace: Trace, config: Config, row_offset_px: float) -> Sorting:
    """Sort the keypoints by the tests of their matches in the right image, or of their depth."""
    searched, matched = trace.find("corners.searched"), trace.find("descriptor.stereo")
    if searched:
        return _sort_corners(trace.find("klt.corners"), searched, row_offset_px)
    if matched:
        return _sort_matches(matched, trace.find("stereo.candidates"), config.stereo)
    sampled = trace.find("depth.sampled")
    tests = depth_tests(sampled["depths"], sampled["is_valid"], config.depth)
    return Sorting(tests=tests, pixels=sampled["pixels"], values=sampled["depths"])


def _sort_corners(
    corners: Mapping[str, Any], searched: Mapping[str, Any], row_offset_px: float
) -> Sorting:
    pixels, disparities = corners["corners"], corners["disparities"]
    is_placed = np.isfinite(disparities)
    tests = {
        "coarse correlation too weak": searched["is_found"],
        "patch leaves an image": is_placed,
        "did not converge": searched["is_at_rest"],
        "left and right unlike": searched["are_reliable"],
        "depth out of range": corners["is_valid"],
    }
    shown = np.where(is_placed, disparities, searched["rough"])
    partners = np.column_stack([pixels[:, 0] - shown, pixels[:, 1] + row_offset_px])
    return Sorting(tests=tests, pixels=pixels, partners=partners, values=disparities)


def _sort_matches(
    matched: Mapping[str, Any], candidates: Mapping[str, Any], config: StereoConfig
) -> Sorting:
    left, right = matched["features"]
    pairs, n = matched["pairs"], len(left)
    tried = candidates or no_candidates()
    tests = {
        "row": _have_rows(left, right, config.row_tolerance_px),
        "range": as_mask(tried["in_range"][:, 0], n),
        "octave": as_mask(tried["pairs"][:, 0], n),
        **distance_tests(tried, n, max_distance=config.max_distance, max_ratio=config.max_ratio),
        "reciprocity": as_mask(pairs[:, 0], n),
        "sub-pixel": as_mask(pairs[matched["is_fitted"], 0], n),
        "depth out of range": as_mask(pairs[matched["is_in_range"], 0], n),
    }
    disparities = np.full(n, np.nan)
    disparities[pairs[:, 0]] = matched["disparities"]
    partners = best_partners(tried, right.keypoints, n)
    partners[pairs[:, 0]] = right.keypoints[pairs[:, 1]]
    is_measured = np.isfinite(disparities)
    partners[is_measured, 0] = left.keypoints[is_measured, 0] - disparities[is_measured]
    return Sorting(tests=tests, pixels=left.keypoints, partners=partners, values=disparities)


def _have_rows(left: Features, right: Features, tolerance_px: float) -> BoolArray:
    """Tell which left keypoints have any right one on about their row."""
    differences = left.keypoints[:, 1:] - right.keypoints[:, 1]
    return np.asarray((np.abs(differences) <= tolerance_px).any(axis=1))


def no_candidates() -> dict[str, Any]:
    """Return the candidates of a search that had nothing to compare."""
    pairs = np.zeros((0, 2), dtype=np.int64)
    return {"in_range": pairs, "pairs": pairs, "distances": np.zeros(0)}


def best_partners(candidates: Mapping[str, Any], pixels: FloatArray, n: int) -> FloatArray:
    """Return the pixel of the best candidate of each of n points, shape (n, 2); NaN = none."""
    partners = np.full((n, 2), np.nan)
    worst_first = candidates["pairs"][np.argsort(-candidates["distances"], kind="stable")]
    partners[worst_first[:, 0]] = pixels[worst_first[:, 1]]
    return partners


def distance_tests(
    candidates: Mapping[str, Any], n: int, *, max_distance: float, max_ratio: float
) -> dict[str, BoolArray]:
    """Tell which of n points have a candidate near enough, and one that stands out."""
    pairs, distances = candidates["pairs"], candidates["distances"]
    tests = {"descriptor distance": as_mask(pairs[distances <= max_distance, 0], n)}
    if max_ratio < 1.0:
        tests["ratio"] = best_ratios(pairs[:, 0], distances, n) <= max_ratio
    return tests


def as_mask(indices: IntArray, n: int) -> BoolArray:
    """Return n flags, True at some indices."""
    mask = np.zeros(n, dtype=np.bool_)
    mask[indices] = True
    return mask


def explain_depth_pixels(frame: Frame, config: DepthConfig) -> Sorting | None:
    """Sort all pixels of a depth image by the same tests, row by row; None for stereo."""
    if isinstance(frame, StereoFrame):
        return None
    rows, columns = np.indices(frame.depth.shape, dtype=np.float64)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    tests = depth_tests(*sample_depth(frame.depth, pixels, config), config)
    return Sorting(tests=tests, pixels=pixels)


def depth_tests(
    depths: FloatArray, is_valid: BoolArray, config: DepthConfig
) -> dict[str, BoolArray]:
    """Tell which results of `sample_depth` pass each of its tests."""
    with np.errstate(invalid="ignore"):
        is_in_range = (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
    return {
        "depth unknown": np.isfinite(depths),
        "depth out of range": is_in_range,
        "depth edge": is_valid,
    }


def explain_subpixel(
    trace: Trace, frame: Frame, stereo: Sorting, config: StereoConfig, row_offset_px: float
) -> Step | None:
    """Follow the match of the median horizontal gradient; None if none was kept, and for RGB-D."""
    if not isinstance(frame, StereoFrame) or not stereo.are_kept.any():
        return None
    radius, searched = PATCH_RADIUS_PX, trace.find("corners.searched")
    chosen = _choose(frame.left, stereo, radius)
    pixel, disparity = stereo.pixels[chosen], float(stereo.values[chosen])
    if searched:
        method, rough = "gauss-newton", searched["rough"][chosen : chosen + 1]
        given = (frame.left, frame.right), pixel[np.newaxis], rough, config
        follow = partial(follow_disparities, *given, row_offset_px=row_offset_px)
        ends = [follow(n_steps=n)[0] for n in range(1, N_SEARCH_STEPS + 1)]
        # The last is fitted together with the slopes of the surface.
        iterates = np.concatenate([rough, *ends, [disparity]])
        columns = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX) + round(disparity)
    else:
        # Patches are those of whole pixels, and so are the columns.
        method, pixel = "parabola", np.rint(pixel)
        start = float(pixel[0] - np.rint(_partner(trace.find("descriptor.stereo"), chosen)[0]))
        iterates, reach = np.array([start, disparity]), SEARCH_RADIUS_PX
        columns = start + np.arange(-reach, reach + 1, dtype=np.float64)
    u, v = pixel
    left = _patch(frame.left, u, v, radius)
    *rights, right = (
        _patch(frame.right, u - d, v + row_offset_px, radius) for d in (*columns, disparity)
    )
    return Step(
        pixel=pixel,
        method="none" if config.subpixel == "none" else method,
        iterates_px=iterates,
        disparity_px=disparity,
        columns_px=columns,
        ssd=np.array([_ssd(left, each) for each in rights]),
        drawn=Step(left=left, right=right),
    )


def _choose(image: ImageArray, stereo: Sorting, radius: int) -> int:
    """Return the match whose patch determines its column better than half of the others."""
    kept = np.flatnonzero(stereo.are_kept)
    patches = [_patch(image, u, v, radius) for u, v in stereo.pixels[kept]]
    gradients = [float(np.sum(np.diff(patch, axis=1) ** 2)) for patch in patches]
    return int(kept[np.argsort(gradients, kind="stable")[len(kept) // 2]])


def _partner(matched: Mapping[str, Any], index: int) -> FloatArray:
    """Return the right keypoint that a left one was matched with."""
    pairs, keypoints = matched["pairs"], matched["features"][1].keypoints
    return np.asarray(keypoints[pairs[pairs[:, 0] == index, 1][0]])


def _patch(image: ImageArray, u: float, v: float, radius: int) -> NDArray[np.float32]:
    size = 2 * radius + 1
    patch = cv2.getRectSubPix(image, (size, size), (float(u), float(v)), patchType=cv2.CV_32F)
    return np.asarray(patch, dtype=np.float32)


def _ssd(left: NDArray[np.float32], right: NDArray[np.float32]) -> float:
    difference = (right - left).astype(np.float64)
    return float(np.sum((difference - difference.mean()) ** 2))


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
