"""Depth images: unit, range, holes, steps, and whether they are registered to colour."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.images import check_frozen
from gvo.diagnostics.check.limits import measured, unknown
from gvo.diagnostics.check.sampling import Sample
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.tracking import detect_corners
from gvo.types import BoolArray, DepthArray, Failure, FloatArray, RgbdFrame

_MAX_SHIFT_PX = 12
# Pixels of depth lost along edges (negative: smeared over them), on both sides alike. If the first
# or last fits best, the two sides have met unrelated edges of texture.
_LOSSES_PX = range(-3, 7)
_REACH_PX = _MAX_SHIFT_PX + max(_LOSSES_PX)
# Relative differences in size of colour and depth: depth of another focal length.
_ZOOMS = tuple(round(0.02 * step, 2) for step in range(-7, 8))
_MIN_ZOOM_GAIN = 1.15
# A relative step of depth, across at most so many unknown pixels in the shadow behind.
_STEP, _MAX_SHADOW_PX = 0.1, 20
_N_POINTS_PER_FRAME = 500
_MIN_POINTS = 300
# Minimum gain in strength of the colour edges at the best shift over the typical one.
_MIN_CONTRAST = 0.25


class Misregistration(NamedTuple):
    """Offset (u, v) from depth to colour, pixels, NaN along an axis without evidence.

    `zoom` is the size of colour over that of depth, `rms_px` the offset over the whole image.
    """

    shift_px: tuple[float, float]
    zoom: float
    rms_px: float


class _Strips(NamedTuple):
    """Strength of colour edges along one axis around steps of depth, NaN outside the image.

    `values` have the shape (n, 2 * reach + 1); `offsets` (n,) are from the middle of the image.
    """

    values: NDArray[np.float32]
    offsets: FloatArray


_Axis = tuple[_Strips, _Strips]
"""Around the steps from near to far, and around those from far to near."""


def estimate_misregistration(frames: Sequence[RgbdFrame]) -> Misregistration | Failure:
    """Align steps of depth with edges of the colour image.

    Where depth steps from near to far, an edge of colour is more likely than elsewhere. Its mean
    strength over shifts along the step has a peak at the offset. Depth that is lost along edges
    moves the left and right steps of a thing towards each other, an offset moves both alike, so
    both are estimated together. Depth of another focal length (not registered at all) shows as a
    zoom, common to both axes.
    """
    pairs = {letter: _collect(frames, axis) for letter, axis in (("u", 1), ("v", 0))}
    known = {
        letter: pair
        for letter, pair in pairs.items()
        if min(len(each.offsets) for each in pair) >= _MIN_POINTS
    }
    if not known:
        return Failure(reason="too few steps of depth")
    contrasts = {
        zoom: float(np.mean([_score(pair, zoom).max() - 1.0 for pair in known.values()]))
        for zoom in _ZOOMS
    }
    zoom = max(_ZOOMS, key=contrasts.__getitem__)
    if contrasts[zoom] < _MIN_ZOOM_GAIN * contrasts[0.0]:
        zoom = 0.0
    if contrasts[zoom] < _MIN_CONTRAST:
        return Failure(reason="edges of depth and colour do not meet anywhere")
    peaks = {letter: _peak(_score(pair, zoom)) for letter, pair in known.items()}
    u, v = (peaks.get(letter, math.nan) for letter in "uv")
    if math.isnan(u) and math.isnan(v):
        return Failure(reason="the two sides of things disagree about the offset")
    height, width = frames[0].depth.shape
    variance = np.nansum(np.square([u, v])) + zoom**2 * (width**2 + height**2) / 12.0
    return Misregistration((u, v), 1.0 + zoom, math.sqrt(float(variance)))


def depth_steps(depth: DepthArray) -> tuple[BoolArray, BoolArray]:
    """Find the pixels next to which depth increases along a row."""
    height, width = depth.shape
    is_known = np.isfinite(depth)
    columns = np.arange(width)
    last = np.maximum.accumulate(np.where(is_known, columns, -1), axis=1)
    following = np.minimum.accumulate(np.where(is_known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    left = np.concatenate([np.full((height, 1), -1), last[:, :-1]], axis=1)
    right = np.concatenate([following[:, 1:], np.full((height, 1), width)], axis=1)
    beyond_left = np.take_along_axis(depth, left.clip(min=0), axis=1)
    beyond_right = np.take_along_axis(depth, right.clip(max=width - 1), axis=1)
    with np.errstate(invalid="ignore"):
        is_before = (right < width) & (beyond_right > depth * (1.0 + _STEP))
        is_after = (left >= 0) & (beyond_left > depth * (1.0 + _STEP))
    is_before &= right - columns <= _MAX_SHADOW_PX
    is_after &= columns - left <= _MAX_SHADOW_PX
    return _lines(is_before & is_known), _lines(is_after & is_known)


def _lines(steps: BoolArray) -> BoolArray:
    """Keep steps that continue over neighbouring rows; single ones are noise."""
    counts = cv2.filter2D(
        steps.astype(np.uint8), -1, np.ones((5, 3)), borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(steps & (counts >= 4))


def _collect(frames: Sequence[RgbdFrame], axis: int) -> _Axis:
    rng = np.random.default_rng(0)
    parts: tuple[list[_Strips], list[_Strips]] = ([], [])
    for frame in frames:
        image, depth = (frame.image, frame.depth) if axis == 1 else (frame.image.T, frame.depth.T)
        # The gradient along rows, clipped at its 90th percentile and scaled to one.
        smooth = cv2.GaussianBlur(image.astype(np.float32, order="C"), (0, 0), 1.0)
        sizes = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3))
        edges = np.minimum(sizes / (np.percentile(sizes, 90) + 1e-6), 1.0).astype(np.float32)
        for part, steps in zip(parts, depth_steps(np.ascontiguousarray(depth)), strict=True):
            part.append(_cut(edges, steps, rng))
    before, after = (
        _Strips(*(np.concatenate(each) for each in zip(*part, strict=True))) for part in parts
    )
    return before, after


def _cut(edges: NDArray[np.float32], steps: BoolArray, rng: np.random.Generator) -> _Strips:
    width = edges.shape[1]
    rows, columns = np.nonzero(steps)
    if len(rows) > _N_POINTS_PER_FRAME:
        chosen = rng.choice(len(rows), _N_POINTS_PER_FRAME, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    reach = _REACH_PX + math.ceil(max(_ZOOMS) * width / 2)
    padded = np.pad(edges, ((0, 0), (reach, reach)), constant_values=np.nan)
    values = padded[rows[:, np.newaxis], columns[:, np.newaxis] + np.arange(2 * reach + 1)]
    return _Strips(values, columns - 0.5 * (width - 1))


def _score(pair: _Axis, zoom: float) -> FloatArray:
    """Return the edge strength over (loss, shift), relative to the typical one."""
    before, after = (_profile(strips, zoom) for strips in pair)
    shifts = np.arange(-_MAX_SHIFT_PX, _MAX_SHIFT_PX + 1) + _REACH_PX
    return np.stack([0.5 * (before[shifts + loss] + after[shifts - loss]) for loss in _LOSSES_PX])


def _profile(strips: _Strips, zoom: float) -> FloatArray:
    """Return the mean edge strength over shifts, relative to its median; 1 outside the image."""
    middle = strips.values.shape[1] // 2
    moved = middle + np.rint(zoom * strips.offsets).astype(np.int64)
    positions = moved[:, np.newaxis] + np.arange(-_REACH_PX, _REACH_PX + 1)
    values = np.take_along_axis(strips.values, positions, axis=1)
    is_seen = np.isfinite(values).any(axis=0)
    if not np.any(is_seen):
        return np.ones(values.shape[1])
    seen = np.nanmean(values[:, is_seen], axis=0).astype(np.float64)
    means = np.full(values.shape[1], np.median(seen))
    means[is_seen] = seen
    smooth = np.convolve(np.pad(means, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.asarray(smooth / max(float(np.median(smooth)), 1e-6))


def _peak(score: FloatArray) -> float:
    """Return the sub-pixel shift of the maximum, by a parabola; NaN if there is none."""
    loss, best = np.unravel_index(int(np.argmax(score)), score.shape)
    if loss in (0, len(_LOSSES_PX) - 1):
        return math.nan
    row, position = score[loss], int(best)
    shift = float(position - _MAX_SHIFT_PX)
    if not 0 < position < len(row) - 1:
        return shift
    before, at, after = row[position - 1 : position + 2]
    return shift + 0.5 * float((before - after) / min(before - 2.0 * at + after, -1e-9))


def check_depth(samples: Sequence[Sample], config: Config) -> Iterator[Finding]:
    """Yield the findings on the depth images.

    A scale that is wrong by a small factor (5000 counts per metre taken as 1000) does not show in
    the images: the scene is five times as large and moves five times as far. Only ground truth, or
    a median depth that no scene has, reveals it.
    """
    frames = [sample.first for sample in samples if isinstance(sample.first, RgbdFrame)]
    if not frames:
        yield unknown("depth: median", "no depth image to look at")
        return
    yield from _check_values([frame.depth for frame in frames], config)
    yield _check_corners(frames, config)
    seconds = [sample.second for sample in samples if isinstance(sample.first, RgbdFrame)]
    depths = zip(frames, seconds, strict=True)
    pairs = [(one.depth, other.depth) for one, other in depths if isinstance(other, RgbdFrame)]
    if pairs:
        yield check_frozen("depth", pairs)
    yield _check_registration(frames)


def _check_values(depths: Sequence[DepthArray], config: Config) -> Iterator[Finding]:
    """Yield the findings on the depth values: medians over the images."""
    known = [depth[np.isfinite(depth)] for depth in depths]
    median_m = float(np.median([np.median(each) for each in known]))
    yield measured("depth: scale", median_m, text=f"median {median_m:.3g} m")
    low, high = config.depth.min_depth_m, config.depth.max_depth_m
    share = float(np.median([np.mean((each >= low) & (each <= high)) for each in known]))
    text = f"{share:.1%} of the known depth within {low:g} .. {high:g} m"
    yield measured("depth: within limits", share, text=text)
    share = 1.0 - float(np.median([np.mean(np.isfinite(depth)) for depth in depths]))
    yield measured("depth: unknown", share, text=f"{share:.1%} of the pixels")
    n_levels = float(np.median([len(np.unique(each)) for each in known]))
    yield measured("depth: levels", n_levels, text=f"{n_levels:.0f} per image")


def _check_corners(frames: Sequence[RgbdFrame], config: Config) -> Finding:
    """Count the corners that odometry can use: depth known, in range, away from steps."""
    counts = []
    for frame in frames:
        corners = detect_corners(frame.image, config.klt.n_corners, mask=frame.mask)
        counts.append(np.count_nonzero(sample_depth(frame.depth, corners, config.depth)[1]))
    typical, fewest = float(np.median(counts)), config.ransac.min_inliers
    text = f"{typical:.0f} per frame (median)"
    return measured("depth: corners with depth", typical, fault_low=fewest, text=text)


def _check_registration(frames: Sequence[RgbdFrame]) -> Finding:
    found = estimate_misregistration(frames)
    if isinstance(found, Failure):
        return unknown("depth: misregistration", found.reason)
    u, v = (f"{shift:+.1f}" if math.isfinite(shift) else "unknown" for shift in found.shift_px)
    zoom = "" if found.zoom == 1.0 else f", zoom {found.zoom:.2f}"
    text = f"{found.rms_px:.1f} px (depth to colour: u {u}, v {v}{zoom})"
    return measured("depth: misregistration", found.rms_px, text=text)
