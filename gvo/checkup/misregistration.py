"""How far the edges of depth lie from those of the colour image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.types import BoolArray, DepthArray, Failure, FloatArray, ImageArray, RgbdFrame

_MAX_SHIFT_PX = 12
# Depth is lost along edges (or smeared over them, negative) on both sides alike. Where the first
# or last fits best, the two sides met edges of texture that have nothing to do with one another.
_LOSSES_PX = range(-3, 7)
_REACH_PX = _MAX_SHIFT_PX + max(_LOSSES_PX)
# Depth of another focal length: sizes that colour and depth may differ by.
_ZOOMS = tuple(round(0.02 * step, 2) for step in range(-7, 8))
_MIN_ZOOM_GAIN = 1.15
# A step of depth, relative, over at most so many unknown pixels, which lie in the shadow behind.
_STEP, _MAX_SHADOW_PX = 0.1, 20
_N_POINTS_PER_FRAME = 500
_MIN_POINTS = 300
# How much stronger colour edges must be at the best shift than at the typical one.
_MIN_CONTRAST = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Misregistration:
    """What moves depth onto colour.

    Parameters
    ----------
    shift_px : tuple of two float
        (u, v) by which depth is to be moved; NaN along an axis whose edges do not tell.
    zoom : float
        Size that it is to be drawn to, about the middle of the image.
    contrast : float
        How much stronger the colour edges are there than at the typical shift.
    rms_px : float
        Size of the offset over the image.
    """

    shift_px: tuple[float, float]
    zoom: float
    contrast: float
    rms_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Strips:
    """Strength of colour edges along one axis around steps of depth, both kinds of steps.

    `values` (n, 2 * reach + 1) are NaN outside the image; `offsets` (n,) are from its middle.
    """

    values: NDArray[np.float32]
    offsets: FloatArray


_Axis = tuple[_Strips, _Strips]


def estimate_misregistration(frames: Sequence[RgbdFrame]) -> Misregistration | Failure:
    """Compare steps of depth with edges of the colour image.

    At the last pixel of a near thing before something farther there is an edge of colour too, more
    often than elsewhere. Its mean strength over shifts along the step has a peak at the offset.
    Depth that is lost along edges moves steps on the left and on the right of things towards
    each other, an offset moves both alike, so that both are sought together. Depth of another
    focal length (not registered at all) shows as a zoom, common to both axes.

    Parameters
    ----------
    frames : sequence of RgbdFrame
        Of one camera; the more, the less the texture beside edges matters.

    Returns
    -------
    Misregistration or Failure
        Failure where there are too few steps of depth, or no peak stands out.
    """
    axes = [_collect(frames, axis) for axis in (1, 0)]
    has_enough = [_has_enough(pair) for pair in axes]
    if not any(has_enough):
        return Failure(reason="too few steps of depth")
    scores = {
        zoom: [
            _score(pair, zoom) if ok else None for pair, ok in zip(axes, has_enough, strict=True)
        ]
        for zoom in _ZOOMS
    }
    contrasts = {zoom: _contrast(scores[zoom]) for zoom in _ZOOMS}
    zoom = max(contrasts, key=lambda zoom: contrasts[zoom])
    if contrasts[zoom] < _MIN_ZOOM_GAIN * contrasts[0.0]:
        zoom = 0.0
    if contrasts[zoom] < _MIN_CONTRAST:
        return Failure(reason="edges of depth and colour do not meet anywhere")
    shift = [math.nan if score is None else _peak(score) for score in scores[zoom]]
    if not np.any(np.isfinite(shift)):
        return Failure(reason="the two sides of things disagree about the offset")
    height, width = frames[0].depth.shape
    variance = np.nansum(np.square(shift)) + zoom**2 * (width**2 + height**2) / 12.0
    return Misregistration(
        shift_px=(shift[0], shift[1]),
        zoom=1.0 + zoom,
        contrast=contrasts[zoom],
        rms_px=math.sqrt(float(variance)),
    )


def depth_steps(depth: DepthArray) -> tuple[BoolArray, BoolArray]:
    """Find the pixels of near things beside something farther along a row.

    Parameters
    ----------
    depth : ndarray of float32, shape (height, width)
        Metres, NaN = unknown; a few unknown pixels between near and far do not matter.

    Returns
    -------
    before, after : ndarray of bool, shape (height, width)
        The farther one is on the right of the pixel; on its left.
    """
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
    """Keep steps that go on over neighbouring rows: single ones are noise."""
    counts = cv2.filter2D(
        steps.astype(np.uint8), -1, np.ones((5, 3)), borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(steps & (counts >= 4))


def _collect(frames: Sequence[RgbdFrame], axis: int) -> _Axis:
    rng = np.random.default_rng(0)
    parts: tuple[list[_Strips], list[_Strips]] = ([], [])
    for frame in frames:
        image, depth = (frame.image, frame.depth) if axis == 1 else (frame.image.T, frame.depth.T)
        edges = _edge_strength(np.ascontiguousarray(image))
        for part, steps in zip(parts, depth_steps(np.ascontiguousarray(depth)), strict=True):
            part.append(_cut(edges, steps, rng))
    return _joined(parts[0]), _joined(parts[1])


def _edge_strength(image: ImageArray) -> NDArray[np.float32]:
    """Return the size of the gradient along rows, cut off at its 90 % and scaled to one."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    sizes = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3))
    return np.asarray(np.minimum(sizes / (np.percentile(sizes, 90) + 1e-6), 1.0), dtype=np.float32)


def _cut(edges: NDArray[np.float32], steps: BoolArray, rng: np.random.Generator) -> _Strips:
    width = edges.shape[1]
    rows, columns = np.nonzero(steps)
    if len(rows) > _N_POINTS_PER_FRAME:
        chosen = rng.choice(len(rows), _N_POINTS_PER_FRAME, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    reach = _REACH_PX + math.ceil(max(_ZOOMS) * width / 2)
    padded = np.pad(edges, ((0, 0), (reach, reach)), constant_values=np.nan)
    values = padded[rows[:, np.newaxis], columns[:, np.newaxis] + np.arange(2 * reach + 1)]
    return _Strips(values=values, offsets=columns - 0.5 * (width - 1))


def _joined(parts: Sequence[_Strips]) -> _Strips:
    return _Strips(
        values=np.concatenate([part.values for part in parts]),
        offsets=np.concatenate([part.offsets for part in parts]),
    )


def _has_enough(pair: _Axis) -> bool:
    return min(len(strips.offsets) for strips in pair) >= _MIN_POINTS


def _score(pair: _Axis, zoom: float) -> FloatArray:
    """Return the strength over (loss, shift), each kind of step relative to its typical one."""
    before, after = (_profile(strips, zoom) for strips in pair)
    shifts = np.arange(-_MAX_SHIFT_PX, _MAX_SHIFT_PX + 1) + _REACH_PX
    return np.stack([0.5 * (before[shifts + loss] + after[shifts - loss]) for loss in _LOSSES_PX])


def _profile(strips: _Strips, zoom: float) -> FloatArray:
    middle = strips.values.shape[1] // 2
    moved = middle + np.rint(zoom * strips.offsets).astype(np.int64)
    positions = moved[:, np.newaxis] + np.arange(-_REACH_PX, _REACH_PX + 1)
    values = np.take_along_axis(strips.values, positions, axis=1)
    is_seen = np.isfinite(values).any(axis=0)
    if not np.any(is_seen):
        return np.ones(values.shape[1])  # all moved out of the image: no shift stands out
    seen = np.nanmean(values[:, is_seen], axis=0).astype(np.float64)
    means = np.full(values.shape[1], np.median(seen))  # outside of the image nothing stands out
    means[is_seen] = seen
    padded = np.pad(means, 1, mode="edge")
    smooth = np.convolve(padded, [0.25, 0.5, 0.25], mode="valid")
    return np.asarray(smooth / max(float(np.median(smooth)), 1e-6))


def _contrast(scores: Sequence[FloatArray | None]) -> float:
    return float(np.mean([score.max() - 1.0 for score in scores if score is not None]))


def _peak(score: FloatArray) -> float:
    """Return the shift of the maximum to a fraction of a pixel, by a parabola; NaN for none."""
    loss, best = np.unravel_index(int(np.argmax(score)), score.shape)
    if loss in (0, len(_LOSSES_PX) - 1):
        return math.nan
    row, position = score[loss], int(best)
    shift = float(position - _MAX_SHIFT_PX)
    if not 0 < position < len(row) - 1:
        return shift
    before, at, after = row[position - 1 : position + 2]
    return shift + 0.5 * float((before - after) / min(before - 2.0 * at + after, -1e-9))
