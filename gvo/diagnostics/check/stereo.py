"""Stereo pairs: matches, rectification, lens distortion, order and timing of left and right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding, judged, unknown
from gvo.diagnostics.check.images import follow
from gvo.diagnostics.check.limits import MIN_STEREO_MATCHES, measured
from gvo.diagnostics.check.sampling import Sample
from gvo.frontend.features import FeatureExtractor, Features
from gvo.frontend.matching import descriptor_distances, mutual_best
from gvo.geometry.camera import PinholeCamera
from gvo.types import Failure, FloatArray, ImageArray, IntArray, StereoFrame

# A quarter of the front-end's features is enough for a percentile.
_N_FEATURES = 600
# Search range across rows and along them, as a share of the image.
_ROW_SHARE, _MIN_ROW_BAND_PX = 0.06, 12.0
_COLUMN_SHARE = 0.35
# Lowe's ratio of the best distance to the best one elsewhere.
_MAX_RATIO = 0.8
_ELSEWHERE_PX = 3.0
# Lucas-Kanade from the match, limits of the forward-backward error and of the step from there.
_TRACKING = {
    "maxLevel": 0,
    "criteria": (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.01),
    "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
}
_MAX_RETURN_PX, _MAX_STEP_PX = 0.3, 3.0
# Fit of the lens distortion: limit of the first residuals, rounds, limit of the others, and the
# largest standard deviation of k1 that is of use.
_MAX_ROW_PX = 8.0
_N_ROUNDS = 5
_N_SIGMAS = 3.0
_MAX_SIGMA = 0.03
# The sign of smaller disparities is noise.
_SIGN_PX = 1.0
# Row differences farther from the median are wrong matches.
_OUTLIER_PX, _OUTLIER_SIGMAS = 3.0, 8.0
# Another pairing is better if it reduces the spread of the rows, of a minimum size, by this factor.
_STEP_RATIO, _MIN_STEP_SPREAD_PX = 0.6, 0.5
_MIN_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeMatches:
    """Matched pixels of left and right.

    Parameters
    ----------
    pixels_left, pixels_right : ndarray of float64, shape (n, 2)
        (u, v), the right ones sub-pixel.
    """

    pixels_left: FloatArray
    pixels_right: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[FreeMatches]) -> FreeMatches:
        """Return the matches of several pairs as one."""
        return cls(
            pixels_left=np.concatenate([part.pixels_left for part in parts]),
            pixels_right=np.concatenate([part.pixels_right for part in parts]),
        )

    def __len__(self) -> int:
        """Return the number of matches."""
        return len(self.pixels_left)

    @property
    def disparities(self) -> FloatArray:
        """u_left - u_right, pixels, of either sign, shape (n,)."""
        return np.asarray(self.pixels_left[:, 0] - self.pixels_right[:, 0])

    @property
    def row_differences(self) -> FloatArray:
        """v_right - v_left, pixels, shape (n,)."""
        return np.asarray(self.pixels_right[:, 1] - self.pixels_left[:, 1])


class FreeMatcher:
    """Match two images without the epipolar constraint, for disparities of either sign.

    ORB descriptors that are mutually best and pass the ratio test, in a band of rows far wider
    than a rectified pair needs; then Lucas-Kanade in both axes with a forward-backward check.

    Parameters
    ----------
    config : Config
        `features` and `stereo.max_distance`.
    """

    def __init__(self, config: Config) -> None:
        features = config.features.model_copy(update={"n_features": _N_FEATURES, "kind": "orb"})
        self._extractor = FeatureExtractor(features)
        self._max_distance = config.stereo.max_distance

    def match(self, left: ImageArray, right: ImageArray) -> FreeMatches:
        """Return the matches of two images, uint8 (height, width)."""
        features_left = self._extractor.extract(left)
        features_right = self._extractor.extract(right)
        pairs = self._pair(features_left, features_right, left.shape)
        pixels_left = features_left.keypoints[pairs[:, 0]]
        pixels_right = features_right.keypoints[pairs[:, 1]]
        return _refine(left, _as_bright(right, left), pixels_left, pixels_right)

    def _pair(self, left: Features, right: Features, shape: tuple[int, ...]) -> IntArray:
        if len(left) == 0 or len(right) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        apart = np.abs(right.keypoints[np.newaxis] - left.keypoints[:, np.newaxis])
        band = max(_MIN_ROW_BAND_PX, _ROW_SHARE * shape[0])
        is_near = (apart[:, :, 1] <= band) & (apart[:, :, 0] <= _COLUMN_SHARE * shape[1])
        pairs = np.argwhere(is_near)
        distances = descriptor_distances(left.descriptors, right.descriptors, pairs)
        table = np.full(is_near.shape, 1.0)
        table[pairs[:, 0], pairs[:, 1]] = distances
        chosen = mutual_best(pairs, distances, len(left), len(right))
        best, nearest = pairs[chosen], distances[chosen]
        to_best = right.keypoints[np.newaxis] - right.keypoints[best[:, 1]][:, np.newaxis]
        is_elsewhere = np.abs(to_best).max(axis=2) > _ELSEWHERE_PX
        others = np.where(is_elsewhere, table[best[:, 0]], 1.0).min(axis=1)
        is_kept = (nearest <= self._max_distance) & (nearest < _MAX_RATIO * others)
        return np.asarray(best[is_kept])


def _as_bright(image: ImageArray, other: ImageArray) -> ImageArray:
    """Return an image with the mean and contrast of another one, as Lucas-Kanade needs it."""
    gain = float(other.std()) / max(float(image.std()), 1.0)
    offset = float(other.mean()) - gain * float(image.mean())
    return np.asarray(cv2.addWeighted(image, gain, image, 0.0, offset), dtype=np.uint8)


def _refine(
    left: ImageArray, right: ImageArray, pixels_left: FloatArray, pixels_right: FloatArray
) -> FreeMatches:
    """Refine the right pixels; drop those that fail the forward-backward check."""
    if len(pixels_left) == 0:
        return FreeMatches(pixels_left=pixels_left, pixels_right=pixels_right)
    start = pixels_left.astype(np.float32)
    guess = pixels_right.astype(np.float32)
    there, is_kept = follow(left, right, start, guess, _MAX_RETURN_PX, **_TRACKING)
    is_kept &= np.linalg.norm(there - guess, axis=1) <= _MAX_STEP_PX
    return FreeMatches(
        pixels_left=pixels_left[is_kept], pixels_right=there[is_kept].astype(np.float64)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LensError:
    """Remaining radial distortion of a rectified pair.

    Parameters
    ----------
    k1 : float
        First radial coefficient, as of `plumb_bob`; the same in both cameras.
    sigma : float
        Standard deviation of `k1`.
    """

    k1: float
    sigma: float


def lens_error(matches: FreeMatches, camera: PinholeCamera) -> LensError | Failure:
    """Estimate the remaining radial distortion of both images of a rectified pair.

    Distortion moves a point along its radius by the factor 1 + k1 r^2. Left and right see the point
    at different radii, so its rows differ by fy y k1 (r_left^2 - r_right^2). Offset, scale and
    rotation of the rows, which make other patterns, are estimated together with k1.

    References
    ----------
    D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering, 1966.
    """
    left = camera.unproject(matches.pixels_left)[:, :2]
    right = camera.unproject(matches.pixels_right)[:, :2]
    rows = -matches.row_differences
    y = camera.fy * left[:, 1]
    pattern = y * (np.sum(left**2, axis=1) - np.sum(right**2, axis=1))
    columns = np.column_stack([np.ones(len(y)), y, camera.fy * left[:, 0], pattern])
    is_kept = np.abs(rows - np.median(rows)) < _MAX_ROW_PX
    for _ in range(_N_ROUNDS):
        errors = rows - columns @ _solve(columns[is_kept], rows[is_kept])
        spread = 1.4826 * np.median(np.abs(errors[is_kept]))
        is_kept = np.abs(errors) <= _N_SIGMAS * spread + 1e-6
    kept = columns[is_kept]
    variance = float(np.var(errors[is_kept]))
    sigma = float(np.sqrt(variance * np.linalg.pinv(kept.T @ kept)[3, 3]))
    if np.linalg.matrix_rank(kept) < kept.shape[1] or sigma > _MAX_SIGMA:
        return Failure(reason=f"{len(rows)} matches do not show it (k1 to +/- {sigma:.2f})")
    return LensError(k1=float(_solve(kept, rows[is_kept])[3]), sigma=sigma)


def _solve(columns: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class RowError:
    """Difference of the rows of left and right.

    Parameters
    ----------
    median_px : float
        Median of v_right - v_left.
    percentile_95_px : float
        95th percentile of its size.
    """

    median_px: float
    percentile_95_px: float


def row_error(matches: FreeMatches) -> RowError:
    """Measure the row differences of matches made without the epipolar constraint.

    Matches beyond eight robust standard deviations of the median (at least 3 px) are wrong; a
    rotated or distorted pair, whose rows spread evenly, keeps all.
    """
    rows = matches.row_differences
    if len(rows) == 0:
        return RowError(median_px=math.nan, percentile_95_px=math.nan)
    median = np.median(rows)
    sigma = 1.4826 * np.median(np.abs(rows - median))
    kept = rows[np.abs(rows - median) <= max(_OUTLIER_PX, _OUTLIER_SIGMAS * sigma)]
    return RowError(
        median_px=float(np.median(kept)), percentile_95_px=float(np.percentile(np.abs(kept), 95))
    )


def check_stereo(
    samples: Sequence[Sample], camera: PinholeCamera, config: Config
) -> Iterator[Finding]:
    """Yield the findings on the matches of left and right."""
    pairs = [sample.first for sample in samples if isinstance(sample.first, StereoFrame)]
    if not pairs:
        yield unknown("left/right: matches", "no stereo frame to look at")
        return
    matcher = FreeMatcher(config)
    found = [matcher.match(frame.left, frame.right) for frame in pairs]
    count = float(np.median([len(matches) for matches in found]))
    yield measured(
        "matches",
        count,
        stream="left/right",
        fault_low=config.ransac.min_inliers,
        text=f"{count:.0f} per frame (median)",
    )
    matches = FreeMatches.joined(found)
    if len(matches) < MIN_STEREO_MATCHES:
        yield unknown("left/right: rows", f"{len(matches)} matches are too few")
        return
    yield from _check_rows(matches)
    yield _check_lens(matches, camera)
    yield _check_order(matches)
    yield _check_step(samples, matcher)


def _check_rows(matches: FreeMatches) -> Iterator[Finding]:
    error = row_error(matches)
    fix = (
        "calibrate the pair anew, or check R and P and that the topic is as (un)rectified as its "
        "CameraInfo says"
    )
    yield measured(
        "row offset",
        error.median_px,
        stream="left/right",
        text=f"{error.median_px:+z.2f} px median",
        fix=fix,
    )
    yield measured(
        "row spread",
        error.percentile_95_px,
        stream="left/right",
        text=f"{error.percentile_95_px:.2f} px at 95 %",
        fix=fix,
    )
    # Half rows: corners lie on whole pixels.
    seed = math.ceil(2.0 * (error.percentile_95_px + 0.25)) / 2.0
    yield Finding(
        name="left/right: row search",
        value=f"+/- {seed:g} px would hold 95 % (stereo.row_tolerance_px)",
    )


def _check_lens(matches: FreeMatches, camera: PinholeCamera) -> Finding:
    error = lens_error(matches, camera)
    if isinstance(error, Failure):
        return unknown("left/right: lens distortion", error.reason)
    return measured(
        "lens distortion",
        error.k1,
        stream="left/right",
        text=f"k1 of about {error.k1:+z.2f} is left, sigma {error.sigma:.3f}",
    )


def _check_order(matches: FreeMatches) -> Finding:
    disparities = matches.disparities
    sure = disparities[np.abs(disparities) > _SIGN_PX]
    share = float(np.mean(sure < 0)) if len(sure) >= MIN_STEREO_MATCHES else math.nan
    is_swapped = share > 0.5
    median_px = float(np.median(disparities))
    return measured(
        "order",
        share,
        stream="left/right",
        text=f"{share:.1%} of the disparities are negative, median {median_px:+.1f} px",
        fix="exchange --left and --right"
        if is_swapped
        else "points behind infinity: the rectification turns the cameras apart",
    )


def _check_step(samples: Sequence[Sample], matcher: FreeMatcher) -> Finding:
    """Check whether the right image of the next or the last frame fits the left one better.

    While the camera turns or shakes, the rows of images taken at different times differ. If they
    differ at equal stamps, and much less in another pairing, one stream lags by a frame.
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
    """Return the row spread of left 1 and right 1, left 1 and right 2, left 2 and right 1."""
    pairs = ((first.left, first.right), (first.left, second.right), (second.left, first.right))
    return np.array([row_error(matcher.match(*pair)).percentile_95_px for pair in pairs])
