"""Stereo pairs: matches, rectification, lens distortion, order and timing of left and right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.limits import MIN_STEREO_MATCHES, judged, measured, unknown
from gvo.diagnostics.check.sampling import Sample
from gvo.frontend.features import FeatureExtractor, Features
from gvo.frontend.matching import descriptor_distances, mutual_best
from gvo.frontend.tracking import track_pixels
from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, ImageArray, IntArray, StereoFrame

# A quarter of the front-end's features is enough for a percentile.
_N_FEATURES = 600
# Search range across rows and along them, as a share of the image.
_ROW_SHARE, _MIN_ROW_BAND_PX = 0.06, 12.0
_COLUMN_SHARE = 0.35
# Lowe's ratio of the best distance to the best one elsewhere.
_MAX_RATIO = 0.8
_ELSEWHERE_PX = 3.0
# Limit of the step from the match to where Lucas-Kanade finds it.
_MAX_STEP_PX = 3.0
# Fit of the lens distortion: limit of the first residuals, rounds, limit of the others, and the
# largest standard deviation of k1 that is of use.
_MAX_ROW_PX = 8.0
_N_ROUNDS = 5
_N_SIGMAS = 3.0
_MAX_SIGMA = 0.03
# What rows are off by is told from so many sigmas on.
_SIGNIFICANT = 4.0
# The sign of smaller disparities is noise.
_SIGN_PX = 1.0
# Row differences farther from the median are wrong matches.
_OUTLIER_PX, _OUTLIER_SIGMAS = 3.0, 8.0
# Another pairing fits better if it reduces the spread of the rows by this factor, from a spread
# that is not small anyway.
_STEP_RATIO, _MIN_STEP_SPREAD_PX = 0.6, 0.5
_MIN_STEPS = 3


class FreeMatcher:
    """Match two images without the epipolar constraint, for disparities of either sign.

    ORB descriptors that are mutually best and pass the ratio test, in a band of rows far wider
    than a rectified pair needs; then Lucas-Kanade in both axes with a forward-backward check.
    """

    def __init__(self, config: Config) -> None:
        features = config.features.model_copy(update={"n_features": _N_FEATURES, "kind": "orb"})
        self._extractor = FeatureExtractor(features)
        self._max_distance = config.stereo.max_distance

    def match(self, left: ImageArray, right: ImageArray) -> FloatArray:
        """Return the pixels of matches, shape (n, 4): u, v in the left and in the right image."""
        found_left, found_right = self._extractor.extract(left), self._extractor.extract(right)
        if len(found_left) == 0 or len(found_right) == 0:
            return np.zeros((0, 4))
        pairs = self._pair(found_left, found_right, left.shape)
        start, guess = found_left.keypoints[pairs[:, 0]], found_right.keypoints[pairs[:, 1]]
        images = left, _as_bright(right, left)
        ends, is_kept = track_pixels(images, start, guess, n_levels=0, is_checked=True)
        is_kept &= np.linalg.norm(ends - guess, axis=1) <= _MAX_STEP_PX
        return np.hstack([start, ends])[is_kept]

    def _pair(self, left: Features, right: Features, shape: tuple[int, ...]) -> IntArray:
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


def lens_error(matches: FloatArray, camera: PinholeCamera) -> tuple[float, float]:
    """Estimate the radial distortion k1 that is left in both images, and its standard deviation.

    Distortion moves a point along its radius by the factor 1 + k1 r^2. Left and right see the point
    at different radii, so its rows differ by fy y k1 (r_left^2 - r_right^2). Offset, scale and
    rotation of the rows, which make other patterns, are estimated together with k1. The deviation
    is infinite where the matches do not tell these apart.

    References
    ----------
    D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering, 1966.
    """
    left, right = (camera.unproject(matches[:, each])[:, :2] for each in ((0, 1), (2, 3)))
    rows = matches[:, 1] - matches[:, 3]
    y = camera.fy * left[:, 1]
    pattern = y * (np.sum(left**2, axis=1) - np.sum(right**2, axis=1))
    columns = np.column_stack([np.ones(len(y)), y, camera.fy * left[:, 0], pattern])
    found = _fit(columns, rows)
    if found is None:
        return 0.0, math.inf
    return float(found[0][3]), float(np.sqrt(found[1][3, 3]))


def row_field(matches: FloatArray, camera: PinholeCamera) -> float:
    """Return by how much v_right - v_left is off anywhere, as a polynomial of the place, pixels.

    Where that is not significant it is zero.
    """
    x, y = camera.unproject(matches[:, :2])[:, :2].T
    columns = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    found = _fit(columns, matches[:, 3] - matches[:, 1])
    if found is None:
        return 0.0
    errors = np.abs(columns @ found[0])
    sigmas = np.sqrt(np.sum((columns @ found[1]) * columns, axis=1))
    return float(np.max(errors * (errors > _SIGNIFICANT * sigmas)))


def _fit(columns: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the robust solution of a linear model and its covariance; None if it is not told."""
    is_kept = np.abs(rows - np.median(rows)) < _MAX_ROW_PX
    for _ in range(_N_ROUNDS):
        errors = rows - columns @ _solve(columns[is_kept], rows[is_kept])
        spread = 1.4826 * np.median(np.abs(errors[is_kept]))
        is_kept = np.abs(errors) <= _N_SIGMAS * spread + 1e-6
    kept = columns[is_kept]
    if np.linalg.matrix_rank(kept) < kept.shape[1]:
        return None
    covariance = float(np.var(errors[is_kept])) * np.linalg.pinv(kept.T @ kept)
    return _solve(kept, rows[is_kept]), np.asarray(covariance)


def _solve(columns: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0])


def row_error(matches: FloatArray) -> tuple[float, float]:
    """Return the median of v_right - v_left, and the 95th percentile of its size, pixels.

    Matches beyond eight robust standard deviations of the median (at least 3 px) are wrong; a
    rotated or distorted pair, whose rows spread evenly, keeps all. NaN without matches.
    """
    rows = matches[:, 3] - matches[:, 1]
    if len(rows) == 0:
        return math.nan, math.nan
    median = np.median(rows)
    sigma = 1.4826 * np.median(np.abs(rows - median))
    kept = rows[np.abs(rows - median) <= max(_OUTLIER_PX, _OUTLIER_SIGMAS * sigma)]
    return float(np.median(kept)), float(np.percentile(np.abs(kept), 95))


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
        "left/right: matches",
        count,
        fault_low=config.ransac.min_inliers,
        text=f"{count:.0f} per frame (median)",
    )
    matches = np.concatenate(found)
    if len(matches) < MIN_STEREO_MATCHES:
        yield unknown("left/right: rows", f"{len(matches)} matches are too few")
        return
    yield from _check_rows(matches, camera)
    yield _check_lens(matches, camera)
    yield _check_order(matches)
    yield _check_step(samples, matcher)


def _check_rows(matches: FloatArray, camera: PinholeCamera) -> Iterator[Finding]:
    median_px, spread_px = row_error(matches)
    yield measured("left/right: row offset", median_px, text=f"{median_px:+z.2f} px median")
    yield measured("left/right: row spread", spread_px, text=f"{spread_px:.2f} px at 95 %")
    field_px = row_field(matches, camera)
    yield measured("left/right: row field", field_px, text=f"up to {field_px:.2f} px")
    # Half rows: corners lie on whole pixels.
    reach_px = math.ceil(2.0 * (spread_px + 0.25)) / 2.0
    yield Finding(
        name="left/right: row search",
        value=f"+/- {reach_px:g} px would hold 95 % (stereo.row_tolerance_px)",
    )


def _check_lens(matches: FloatArray, camera: PinholeCamera) -> Finding:
    k1, sigma = lens_error(matches, camera)
    if sigma > _MAX_SIGMA:
        reason = f"{len(matches)} matches do not show it (k1 to +/- {sigma:.2f})"
        return unknown("left/right: lens distortion", reason)
    text = f"k1 of about {k1:+z.2f} is left, sigma {sigma:.3f}"
    return measured("left/right: lens distortion", k1, text=text)


def _check_order(matches: FloatArray) -> Finding:
    disparities = matches[:, 0] - matches[:, 2]
    sure = disparities[np.abs(disparities) > _SIGN_PX]
    share = float(np.mean(sure < 0)) if len(sure) >= MIN_STEREO_MATCHES else math.nan
    text = f"{share:.1%} of the disparities are negative, median {np.median(disparities):+.1f} px"
    fix = "exchange --left and --right; if P forbids it, change its sign by --calibration FILE"
    return measured("left/right: order", share, text=text, fix=fix if share > 0.5 else "")


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


def _spreads(first: StereoFrame, second: StereoFrame, matcher: FreeMatcher) -> list[float]:
    """Return the row spread of left 1 and right 1, left 1 and right 2, left 2 and right 1."""
    pairs = ((first.left, first.right), (first.left, second.right), (second.left, first.right))
    return [row_error(matcher.match(*pair))[1] for pair in pairs]
