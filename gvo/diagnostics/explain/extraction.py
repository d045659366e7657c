"""What was found in the frame itself: keypoints, their disparities or depths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._trace import Trace
from gvo.config import DepthConfig, StereoConfig
from gvo.diagnostics.explain.values import Sorting, SubpixelStep
from gvo.frontend.features import Features
from gvo.frontend.matching import best_ratios
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.stereo.corners import N_SEARCH_STEPS
from gvo.frontend.stereo.disparity import follow_disparities
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray, RgbdFrame, StereoFrame

# Of the curve of squared differences around the result, pixels.
_REACH_PX = 4
_STEP_PX = 0.125


def explain_keypoints(trace: Trace) -> Sorting:
    """Sort the keypoints detected into those within the budget and the others."""
    spread = trace.find("keypoints.spread")
    if spread is None:
        return Sorting.by({}, np.zeros((0, 2)))
    pixels = np.asarray(spread["pixels"], dtype=np.float64)
    return Sorting.by({"over the budget": as_mask(spread["chosen"], len(pixels))}, pixels)


def explain_stereo(trace: Trace, config: StereoConfig, row_offset_px: float) -> Sorting:
    """Sort the keypoints by the tests of their matches in the right image."""
    matched = trace.find("descriptor.stereo")
    corners, searched = trace.find("klt.corners"), trace.find("corners.searched")
    if corners is not None and searched is not None:
        return _sort_corners(corners, searched, row_offset_px)
    if matched is None:
        raise ValueError("the trace holds no stereo matches")
    return _sort_matches(matched, trace.find("stereo.candidates"), config)


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
    return Sorting.by(tests, pixels, partners=partners, values=disparities)


def _sort_matches(
    matched: Mapping[str, Any], candidates: Mapping[str, Any] | None, config: StereoConfig
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
    return Sorting.by(tests, left.keypoints, partners=partners, values=disparities)


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


def explain_depth(trace: Trace, config: DepthConfig) -> Sorting:
    """Sort the keypoints by the tests of their depth."""
    sampled = trace.find("depth.sampled")
    if sampled is None:
        raise ValueError("the trace holds no depths")
    pixels, depths, is_valid = (sampled[name] for name in ("pixels", "depths", "is_valid"))
    return Sorting.by(depth_tests(depths, is_valid, config), pixels, values=depths)


def explain_depth_pixels(frame: RgbdFrame, config: DepthConfig) -> Sorting:
    """Sort all pixels of a depth image by the same tests, row by row."""
    rows, columns = np.indices(frame.depth.shape, dtype=np.float64)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    return Sorting.by(depth_tests(*sample_depth(frame.depth, pixels, config), config), pixels)


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
    trace: Trace, frame: StereoFrame, stereo: Sorting, config: StereoConfig, row_offset_px: float
) -> SubpixelStep | None:
    """Follow the match of the median horizontal gradient; None if no match was kept."""
    if not stereo.are_kept.any():
        return None
    images, radius = (frame.left, frame.right), config.patch_radius_px
    chosen = _choose(frame.left, stereo, radius)
    pixel, disparity = stereo.pixels[chosen], float(stereo.values[chosen])
    searched, matched = trace.find("corners.searched"), trace.find("descriptor.stereo")
    if searched is not None:
        method, rough = "gauss-newton", searched["rough"][chosen : chosen + 1]
        iterates = _follow(images, pixel, rough, config, row_offset_px)
        columns = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX) + round(disparity)
    elif matched is not None:
        # Patches are those of whole pixels, and so are the columns.
        method, pixel, row_offset_px = "parabola", np.rint(pixel), 0.0
        start = float(pixel[0] - np.rint(_partner(matched, chosen)[0]))
        iterates, reach = np.array([start, disparity]), config.search_radius_px
        columns = start + np.arange(-reach, reach + 1, dtype=np.float64)
    u, v = pixel
    left = _patch(frame.left, u, v, radius)
    patches = [_patch(frame.right, u - d, v + row_offset_px, radius) for d in columns]
    return SubpixelStep(
        pixel=pixel,
        left=left,
        right=_patch(frame.right, u - disparity, v + row_offset_px, radius),
        columns_px=columns,
        ssd=np.array([_ssd(left, patch) for patch in patches]),
        iterates_px=iterates,
        disparity_px=disparity,
        method="none" if config.subpixel == "none" else method,
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


def _follow(
    images: tuple[ImageArray, ImageArray],
    pixel: FloatArray,
    rough: FloatArray,
    config: StereoConfig,
    row_offset_px: float,
) -> FloatArray:
    """Return the disparities at the start and after each step of the front-end."""
    ends = [
        follow_disparities(
            images, pixel[np.newaxis], rough, config, n_steps=n, row_offset_px=row_offset_px
        )[0]
        for n in range(1, N_SEARCH_STEPS + 1)
    ]
    return np.concatenate([rough, *ends])


def _patch(image: ImageArray, u: float, v: float, radius: int) -> NDArray[np.float32]:
    size = 2 * radius + 1
    patch = cv2.getRectSubPix(image, (size, size), (float(u), float(v)), patchType=cv2.CV_32F)
    return np.asarray(patch, dtype=np.float32)


def _ssd(left: NDArray[np.float32], right: NDArray[np.float32]) -> float:
    difference = (right - left).astype(np.float64)
    return float(np.sum((difference - difference.mean()) ** 2))
