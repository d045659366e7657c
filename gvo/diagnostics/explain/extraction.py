"""What was found in the frame itself: keypoints with disparity or depth, and one corner."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from gvo.config import Config
from gvo.diagnostics.explain.values import Corner, Registration, Sorting
from gvo.frontend.features import FeatureExtractor
from gvo.frontend.klt import image_of, is_unmasked
from gvo.frontend.matching import best_ratios
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.stereo.disparity import measure_corners
from gvo.frontend.stereo.matching import (
    candidate_pairs,
    compare_rows,
    is_in_depth_range,
    match_stereo,
    refine_disparities,
)
from gvo.frontend.tracking import WINDOW_RADIUS_PX, detect_corners, halve
from gvo.geometry.camera import StereoCamera
from gvo.kernels.stereo import RADIUS_PX
from gvo.types import BoolArray, FloatArray, Frame, ImageArray, IntArray, RgbdFrame, StereoFrame

# Columns of the correlation on either side of the partner, for RGB-D.
_REACH_PX = 20


def explain_measured(
    frame: Frame, camera: StereoCamera, config: Config, offsets: RigOffsets
) -> Sorting:
    """Sort the keypoints by the tests of their matches in the right image, or of their depth."""
    if isinstance(frame, RgbdFrame):
        return _sort_depths(frame, config, offsets)
    sort = _sort_corners if config.frontend.kind == "klt" else _sort_matches
    return sort(frame, camera, config, offsets)


def _sort_depths(frame: RgbdFrame, config: Config, offsets: RigOffsets) -> Sorting:
    if config.frontend.kind == "klt":
        pixels = detect_corners(frame.image, config.klt.n_corners, mask=frame.mask)
    else:
        pixels = FeatureExtractor(config.features).extract(frame.image, frame.mask).keypoints
    depths, is_valid = sample_depth(frame.depth, pixels, config.depth)
    with np.errstate(invalid="ignore"):
        is_in_range = (depths >= config.depth.min_depth_m) & (depths <= config.depth.max_depth_m)
    tests = {
        "rides with the camera": ~offsets.carried.holds(pixels),
        "depth unknown": np.isfinite(depths),
        "depth out of range": is_in_range,
        "depth edge": is_valid,
    }
    return Sorting(tests=tests, pixels=pixels, values=depths)


def _sort_corners(
    frame: StereoFrame, camera: StereoCamera, config: Config, offsets: RigOffsets
) -> Sorting:
    halves = halve(frame.left), halve(frame.right)
    pixels = detect_corners(frame.left, config.klt.n_corners, half=halves[0], mask=frame.mask)
    row_offsets_px = offsets.row_errors(pixels)
    found = measure_corners(
        (frame.left, frame.right),
        halves,
        pixels,
        config.stereo,
        max_disparity=float(camera.depth_to_disparity(config.stereo.min_depth_m)),
        row_offsets_px=row_offsets_px,
    )
    disparities = found.disparities
    corrected = offsets.take_off(np.column_stack([pixels, disparities]))[:, 2]
    tests = {
        "rides with the camera": ~offsets.carried.holds(pixels),
        "not found along the row": np.isfinite(disparities),
        "left and right unlike": found.are_reliable,
        "depth out of range": is_in_depth_range(corrected, camera, config.stereo),
        "masked on the right": is_unmasked(frame, pixels, disparities),
    }
    partners = np.column_stack([pixels[:, 0] - disparities, pixels[:, 1] + row_offsets_px])
    return Sorting(tests=tests, pixels=pixels, partners=partners, values=disparities)


def _sort_matches(
    frame: StereoFrame, camera: StereoCamera, config: Config, offsets: RigOffsets
) -> Sorting:
    extractor, stereo = FeatureExtractor(config.features), config.stereo
    views = (frame.left, frame.mask), (frame.right, frame.right_mask)
    left, right = (extractor.extract(*view) for view in views)
    in_range = candidate_pairs(left, right, camera, stereo)
    tried = compare_rows(left, right, in_range)
    pairs, n = match_stereo(left, right, camera, stereo), len(left)
    ends = left.keypoints[pairs[:, 0]], right.keypoints[pairs[:, 1]]
    found, is_fitted = refine_disparities((frame.left, frame.right), *ends, stereo)
    ideal = offsets.take_off(np.column_stack([ends[0], found]))
    is_in_range = is_fitted & is_in_depth_range(ideal[:, 2], camera, stereo)
    tests = {
        "no keypoint on its row in range": as_mask(in_range[:, 0], n),
        "octave": as_mask(tried[0][:, 0], n),
        **distance_tests(*tried, n, max_distance=stereo.max_distance, max_ratio=stereo.max_ratio),
        "reciprocity": as_mask(pairs[:, 0], n),
        "sub-pixel": as_mask(pairs[is_fitted, 0], n),
        "depth out of range": as_mask(pairs[is_in_range, 0], n),
    }
    disparities, partners = np.full(n, np.nan), np.full((n, 2), np.nan)
    disparities[pairs[:, 0]] = found
    partners[pairs[:, 0]] = np.column_stack([ends[0][:, 0] - found, ends[1][:, 1]])
    return Sorting(tests=tests, pixels=left.keypoints, partners=partners, values=disparities)


def distance_tests(
    pairs: IntArray, distances: FloatArray, n: int, *, max_distance: float, max_ratio: float
) -> Mapping[str, BoolArray]:
    """Tell which of n points have a candidate near enough, and one that stands out."""
    tests = {"descriptor distance": as_mask(pairs[distances <= max_distance, 0], n)}
    if max_ratio < 1.0:
        tests["ratio"] = best_ratios(pairs[:, 0], distances, n) <= max_ratio
    return tests


def as_mask(indices: IntArray, n: int) -> BoolArray:
    """Return n flags, True at some indices."""
    mask = np.zeros(n, dtype=np.bool_)
    mask[indices] = True
    return mask


def explain_corner(
    frame: Frame,
    reference: Frame | None,
    measured: Sorting,
    found: Registration | None,
    camera: StereoCamera,
    *,
    min_depth_m: float,
) -> Corner | None:
    """Follow one corner: along its row in the right image, or from the reference to the frame."""
    if isinstance(frame, StereoFrame):
        images, radius = (frame.left, frame.right), RADIUS_PX
        sorting, kept = measured, np.flatnonzero(measured.are_kept)
    elif reference is None or found is None:
        return None
    else:
        images, radius = (image_of(reference), image_of(frame)), WINDOW_RADIUS_PX
        sorting, kept = found.matches, np.flatnonzero(found.matches.are_kept)[found.inliers]
    index = _typical(images[0], sorting.pixels[kept], radius)
    if index is None:
        return None
    pixel, partner = sorting.pixels[kept][index], sorting.partners[kept][index]
    if isinstance(frame, StereoFrame):
        # From left to right in the image: from the largest disparity to the smallest.
        highest = min(float(camera.depth_to_disparity(min_depth_m)), pixel[0])
        names = np.arange(0.0, highest + 1.0)[::-1]
        places = pixel[0] - names
    else:
        names = np.arange(-_REACH_PX, _REACH_PX + 1.0)
        places = partner[0] + names
    return _follow(images, pixel, partner, names=names, places=places, radius=radius)


def _follow(
    images: tuple[ImageArray, ImageArray],
    pixel: FloatArray,
    partner: FloatArray,
    *,
    names: FloatArray,
    places: FloatArray,
    radius: int,
) -> Corner:
    """Correlate a patch with the row of its partner, at places along it with their names."""
    first = _patch(images[0], pixel, radius)
    middle = (0.5 * (places[0] + places[-1]), partner[1])
    size = (len(places) + 2 * radius, 2 * radius + 1)
    strip = cv2.getRectSubPix(images[1], size, middle, patchType=cv2.CV_32F)
    found = cv2.matchTemplate(strip, first.astype(np.float32), cv2.TM_CCOEFF_NORMED)[0]
    return Corner(
        pixel=pixel,
        partner=partner,
        patches=np.stack([first, _patch(images[1], partner, radius)]),
        columns=names,
        correlations=found.astype(np.float64),
        end=float(np.interp(partner[0], places, names)),
    )


def _typical(image: ImageArray, pixels: FloatArray, radius: int) -> int | None:
    """Return the pixel whose patch determines its column better than half of the others."""
    patches = [_patch(image, pixel, radius) for pixel in pixels]
    gradients = [float(np.sum(np.diff(patch, axis=1) ** 2)) for patch in patches]
    if not gradients:
        return None
    return int(np.argsort(gradients, kind="stable")[len(gradients) // 2])


def _patch(image: ImageArray, pixel: FloatArray, radius: int) -> FloatArray:
    size, (u, v) = 2 * radius + 1, pixel
    patch = cv2.getRectSubPix(image, (size, size), (float(u), float(v)), patchType=cv2.CV_32F)
    return np.asarray(patch, dtype=np.float64)
