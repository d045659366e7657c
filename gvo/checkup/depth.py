"""Depth images: unit, range, holes, steps, and whether they fit the colour images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from gvo.checkup.misregistration import estimate_misregistration
from gvo.checkup.report import Finding, Limits, lost_limits, measured, unknown
from gvo.checkup.sampling import Sample
from gvo.config import CheckConfig, Config
from gvo.frontend.rgbd import sample_depth
from gvo.frontend.tracking import detect_corners
from gvo.types import DepthArray, Failure, RgbdFrame

# Values within this of the median tell the step there.
_NEAR_MEDIAN = 0.1


def check_depth(samples: Sequence[Sample], config: Config) -> Iterator[Finding]:
    """Yield what the depth images say.

    A wrong scale by a small factor (5000 counts per metre taken as 1000) cannot be seen in the
    images: everything is five times as large and moves five times as far. Only a median depth
    that no scene has gives it away, or ground truth.
    """
    check = config.check
    frames = [sample.first for sample in samples if isinstance(sample.first, RgbdFrame)]
    if not frames:
        yield unknown("depth: median", "no depth image to look at")
        return
    depths = [frame.depth for frame in frames]
    yield from _check_range(depths, config)
    share_unknown = float(np.median([np.mean(~np.isfinite(depth)) for depth in depths]))
    yield measured(
        "depth: unknown",
        share_unknown,
        Limits(high=check.max_unknown_depth, fault_high=0.5 * (1.0 + check.max_unknown_depth)),
        unit="%",
        text=f"{share_unknown:.1%} of the pixels",
        fix="sunlight, dark or shiny surfaces, or too near: depth is missing there",
    )
    yield _check_corners(frames, config)
    yield from _check_levels(depths, check)
    yield from _check_frozen(samples, check)
    yield _check_registration(frames, check)


def _check_range(depths: Sequence[DepthArray], config: Config) -> Iterator[Finding]:
    check, limits = config.check, config.depth
    medians = [float(np.nanmedian(depth)) for depth in depths]
    median_m = float(np.median(medians))
    text = f"median {median_m:.3g} m, of images {min(medians):.3g} .. {max(medians):.3g} m"
    yield measured(
        "depth: scale",
        median_m,
        Limits(fault_low=check.min_depth_median_m, fault_high=check.max_depth_median_m),
        unit="m",
        text=text,
        fix=_scale_fix(median_m, check),
    )
    low, high = limits.min_depth_m, limits.max_depth_m
    with np.errstate(invalid="ignore"):
        shares = [
            np.mean((depth[np.isfinite(depth)] >= low) & (depth[np.isfinite(depth)] <= high))
            for depth in depths
        ]
    share = float(np.median(shares))
    yield measured(
        "depth: within limits",
        share,
        Limits(low=check.min_depth_in_range, fault_low=0.1 * check.min_depth_in_range),
        unit="%",
        text=f"{share:.1%} of the known depth within {low:g} .. {high:g} m",
        fix="check depth.scale, then depth.min_depth_m and depth.max_depth_m",
    )


def _check_corners(frames: Sequence[RgbdFrame], config: Config) -> Finding:
    """Count what odometry can use: corners whose depth is known, in range and without a break."""
    counts = []
    for frame in frames:
        corners = detect_corners(frame.image, config.klt)
        counts.append(int(np.count_nonzero(sample_depth(frame.depth, corners, config.depth)[1])))
    return measured(
        "depth: corners with depth",
        float(np.median(counts)),
        Limits(low=config.check.min_stereo_matches, fault_low=config.ransac.min_inliers),
        text=f"{np.median(counts):.0f} per frame (median)",
        fix="more light or texture, nearer things; depth that is noisy, full of holes, out of "
        "range or not registered to colour is of no use at corners",
    )


def _scale_fix(median_m: float, check: CheckConfig) -> str:
    if median_m > check.max_depth_median_m:
        return "set depth.scale (counts per metre: 1000 for mm, 5000 for TUM) higher"
    return "set depth.scale (counts per metre: 1000 for mm, 5000 for TUM) lower"


def _check_levels(depths: Sequence[DepthArray], check: CheckConfig) -> Iterator[Finding]:
    levels = [np.unique(depth[np.isfinite(depth)]) for depth in depths]
    count = float(np.median([len(values) for values in levels]))
    steps = [_step_at_median(values) for values in levels]
    known = [step for step in steps if math.isfinite(step)]
    step_text = f", steps of {1e3 * float(np.median(known)):.3g} mm at the median" if known else ""
    yield measured(
        "depth: levels",
        count,
        Limits(low=check.min_depth_levels, fault_low=0.25 * check.min_depth_levels),
        text=f"{count:.0f} per image{step_text}",
        fix="record 16UC1 or 32FC1: depth of 8 bits, or constant, is of no use",
    )


def _step_at_median(values: DepthArray) -> float:
    if len(values) == 0:
        return math.nan
    near = values[np.abs(values / np.median(values) - 1.0) <= _NEAR_MEDIAN]
    return float(np.median(np.diff(near))) if len(near) > 1 else math.nan


def _check_frozen(samples: Sequence[Sample], check: CheckConfig) -> Iterator[Finding]:
    pairs = [
        (sample.first.depth, sample.second.depth)
        for sample in samples
        if isinstance(sample.first, RgbdFrame) and isinstance(sample.second, RgbdFrame)
    ]
    if not pairs:
        return
    n_frozen = sum(np.array_equal(first, second, equal_nan=True) for first, second in pairs)
    yield measured(
        "depth: frozen images",
        n_frozen / len(pairs),
        lost_limits(check),
        unit="%",
        text=f"{n_frozen} of {len(pairs)} are the same as the one before",
        fix="the driver repeats depth images: record at the camera's own rate",
    )


def _check_registration(frames: Sequence[RgbdFrame], check: CheckConfig) -> Finding:
    name = "depth: misregistration"
    found = estimate_misregistration(frames)
    if isinstance(found, Failure):
        return unknown(name, found.reason)
    parts = [
        f"{axis} {shift:+.1f}" if math.isfinite(shift) else f"{axis} unknown"
        for axis, shift in zip("uv", found.shift_px, strict=True)
    ]
    zoom = "" if found.zoom == 1.0 else f", zoom {found.zoom:.2f}"
    return measured(
        name,
        found.rms_px,
        Limits(high=check.max_misregistration_px, fault_high=2.0 * check.max_misregistration_px),
        unit="px",
        text=f"{found.rms_px:.1f} px (depth to colour: {', '.join(parts)}{zoom})",
        fix="register depth to colour: record the depth camera's CameraInfo and tf, or switch on "
        "the driver's registration; late stamps look alike",
    )
