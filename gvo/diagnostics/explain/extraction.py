"""What was found in the frame itself: keypoints, their disparities or depths."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._trace import Trace
from gvo.config import Config, DepthConfig, StereoConfig
from gvo.diagnostics.explain.values import Sorting, Step
from gvo.frontend.features import Features
from gvo.frontend.matching import best_ratios
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.stereo.corners import N_SEARCH_STEPS
from gvo.frontend.stereo.disparity import follow_disparities
from gvo.types import BoolArray, FloatArray, Frame, ImageArray, IntArray, StereoFrame

# Of the curve of squared differences around the result, pixels.
_REACH_PX = 4
_STEP_PX = 0.125


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
    radius, searched = config.patch_radius_px, trace.find("corners.searched")
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
        iterates, reach = np.array([start, disparity]), config.search_radius_px
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
