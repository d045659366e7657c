"""Stereo pairs: rectified or not, left and right swapped, out of step, matched at all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvo.checkup.lens import lens_error
from gvo.checkup.report import Finding, Limits, judged, measured, unknown
from gvo.checkup.sampling import Sample
from gvo.checkup.stereo_matches import FreeMatcher, FreeMatches
from gvo.config import CheckConfig, Config
from gvo.geometry.camera import PinholeCamera
from gvo.types import Failure, FloatArray, StereoFrame

# Disparities nearer to zero have no sure sign: far points and the noise of a match.
_SIGN_PX = 1.0
# Wrong matches lie anywhere; what is so far from the median is none of the rig's doing.
_OUTLIER_PX, _OUTLIER_SIGMAS = 3.0, 8.0
# Another pairing must leave so much less of the rows' spread, and the present one so much.
_STEP_RATIO, _MIN_STEP_SPREAD_PX = 0.6, 0.5
_MIN_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class RowError:
    """By how much the rows of left and right differ.

    Parameters
    ----------
    median_px : float
        Of v_right - v_left.
    percentile_95_px : float
        Of the sizes.
    """

    median_px: float
    percentile_95_px: float


def row_error(matches: FreeMatches) -> RowError:
    """Measure the rows over matches that were made without the epipolar constraint.

    Wrong matches are those beyond eight robust sigmas of the median (at least 3 px): a rotated
    or distorted pair spreads its rows evenly, and keeps them all.
    """
    rows = matches.row_differences
    if len(rows) == 0:
        return RowError(median_px=math.nan, percentile_95_px=math.nan)
    median = np.median(rows)
    sigma = 1.4826 * np.median(np.abs(rows - median))
    kept = rows[np.abs(rows - median) <= max(_OUTLIER_PX, _OUTLIER_SIGMAS * sigma)]
    return RowError(
        median_px=float(np.median(kept)),
        percentile_95_px=float(np.percentile(np.abs(kept), 95)),
    )


def check_stereo(
    samples: Sequence[Sample], camera: PinholeCamera, config: Config
) -> Iterator[Finding]:
    """Yield what the matches of left and right say."""
    check = config.check
    pairs = [sample.first for sample in samples if isinstance(sample.first, StereoFrame)]
    if not pairs:
        yield unknown("left/right: matches", "no stereo frame to look at")
        return
    matcher = FreeMatcher(config)
    found = [matcher.match(frame.left, frame.right) for frame in pairs]
    count = float(np.median([len(matches) for matches in found]))
    yield measured(
        "left/right: matches",
        count,
        Limits(low=check.min_stereo_matches, fault_low=config.ransac.min_inliers),
        text=f"{count:.0f} per frame (median)",
        fix="make sure that the topics are of one pair, in focus, lit and textured",
    )
    matches = FreeMatches.joined(found)
    if len(matches) < check.min_stereo_matches:
        yield unknown("left/right: rows", f"{len(matches)} matches are too few")
        return
    yield from _check_rows(matches, check)
    yield _check_lens(matches, camera, check)
    yield _check_order(matches, check)
    yield _check_step(samples, matcher)


def _check_rows(matches: FreeMatches, check: CheckConfig) -> Iterator[Finding]:
    error = row_error(matches)
    fix = (
        "calibrate the pair anew, or check R and P and that the topic is as (un)rectified as its "
        "CameraInfo says"
    )
    yield measured(
        "left/right: row offset",
        error.median_px,
        Limits(fault_low=-check.max_row_offset_px, fault_high=check.max_row_offset_px),
        unit="px",
        text=f"{error.median_px:+.2f} px median",
        fix=fix,
    )
    yield measured(
        "left/right: row spread",
        error.percentile_95_px,
        Limits(fault_high=check.max_row_spread_px),
        unit="px",
        text=f"{error.percentile_95_px:.2f} px at 95 %",
        fix=fix,
    )
    # Corners lie on whole pixels: half a row on either side is theirs.
    seed = math.ceil(2.0 * (error.percentile_95_px + 0.25)) / 2.0
    yield Finding(
        name="left/right: row search",
        value=f"+/- {seed:g} px would hold 95 % (stereo.row_tolerance_px)",
    )


def _check_lens(matches: FreeMatches, camera: PinholeCamera, check: CheckConfig) -> Finding:
    error = lens_error(matches, camera)
    if isinstance(error, Failure):
        return unknown("left/right: lens distortion", error.reason)
    return measured(
        "left/right: lens distortion",
        error.k1,
        Limits(fault_low=-check.max_lens_k1, fault_high=check.max_lens_k1),
        text=f"k1 of about {error.k1:+.2f} is left, sigma {error.sigma:.3f}",
        fix="the images are raw or wrongly calibrated: choose the raw topics with their D, or give "
        "a --calibration FILE with D",
    )


def _check_order(matches: FreeMatches, check: CheckConfig) -> Finding:
    disparities = matches.disparities
    sure = disparities[np.abs(disparities) > _SIGN_PX]
    share = float(np.mean(sure < 0)) if len(sure) >= check.min_stereo_matches else math.nan
    is_swapped = share > 0.5
    median_px = float(np.median(disparities))
    return measured(
        "left/right: order",
        share,
        Limits(high=check.max_negative_share, fault_high=0.5),
        unit="%",
        text=f"{share:.1%} of the disparities are negative, median {median_px:+.1f} px",
        fix="exchange --left and --right"
        if is_swapped
        else "points behind infinity: the rectification turns the cameras apart",
    )


def _check_step(samples: Sequence[Sample], matcher: FreeMatcher) -> Finding:
    """Look whether the right image of the next or the last frame fits the left one better.

    While the camera turns or shakes, rows of images that were not taken at once differ. Where
    they differ with equal stamps and much less for another pairing, one stream lags by a frame.
    """
    name = "left/right: same moment"
    spreads = [
        _spreads(sample.first, sample.second, matcher)
        for sample in samples
        if isinstance(sample.first, StereoFrame) and isinstance(sample.second, StereoFrame)
    ]
    known = np.array([row for row in spreads if np.all(np.isfinite(row))])
    if len(known) < _MIN_STEPS:
        return unknown(name, "too few consecutive frames")
    same, later, earlier = np.median(known, axis=0)
    is_off = same > _MIN_STEP_SPREAD_PX and min(later, earlier) < _STEP_RATIO * same
    return judged(
        name,
        f"rows spread {same:.2f} px; next right image {later:.2f}, last {earlier:.2f}",
        is_ok=not is_off,
        threshold=f"others >= {_STEP_RATIO:g} of it",
        otherwise="fault",
        fix=f"the right images are a frame {'late' if later < earlier else 'early'}: trigger both "
        "cameras together, or correct the stamps",
    )


def _spreads(first: StereoFrame, second: StereoFrame, matcher: FreeMatcher) -> FloatArray:
    """Return the rows' spread of left 1 and right 1, left 1 and right 2, left 2 and right 1."""
    pairs = ((first.left, first.right), (first.left, second.right), (second.left, first.right))
    errors = (row_error(matcher.match(*pair)).percentile_95_px for pair in pairs)
    return np.array(list(errors))
