"""Matches of left and right that assume no rectification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.config import Config
from gvo.frontend.features import FeatureExtractor, Features
from gvo.frontend.matching import descriptor_distances, mutual_best
from gvo.types import BoolArray, FloatArray, ImageArray, IntArray

# Enough for a percentile, and a quarter of the cost of the front-end's budget.
_N_FEATURES = 600
# How far a match may lie off its row and along it, as a share of the image.
_ROW_SHARE, _MIN_ROW_BAND_PX = 0.06, 12.0
_COLUMN_SHARE = 0.35
# The best must be so much nearer than the best elsewhere (D. G. Lowe's ratio).
_MAX_RATIO = 0.8
_ELSEWHERE_PX = 3.0
_WINDOW = (15, 15)
_MAX_RETURN_PX, _MAX_STEP_PX = 0.3, 3.0

_Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeMatches:
    """Matched pixels of left and right.

    Parameters
    ----------
    pixels_left, pixels_right : ndarray of float64, shape (n, 2)
        (u, v), the right ones to a fraction of a pixel.
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
    """Match two images without the epipolar constraint and without a sign of the disparity.

    Mutual best of ORB descriptors that beat all others elsewhere, in a band of rows far wider
    than any rectified pair needs, then Lucas-Kanade in both axes, there and back.

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
        steps = right.keypoints[np.newaxis] - left.keypoints[:, np.newaxis]
        band = max(_MIN_ROW_BAND_PX, _ROW_SHARE * shape[0])
        is_near = (np.abs(steps[:, :, 1]) <= band) & (
            np.abs(steps[:, :, 0]) <= _COLUMN_SHARE * shape[1]
        )
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
    """Return an image with mean and contrast of another one: Lucas-Kanade takes both as given."""
    gain = float(other.std()) / max(float(image.std()), 1.0)
    offset = float(other.mean()) - gain * float(image.mean())
    return np.asarray(cv2.addWeighted(image, gain, image, 0.0, offset), dtype=np.uint8)


def _refine(
    left: ImageArray, right: ImageArray, pixels_left: FloatArray, pixels_right: FloatArray
) -> FreeMatches:
    """Move the right pixels to a fraction of a pixel; drop what does not find back."""
    if len(pixels_left) == 0:
        return FreeMatches(pixels_left=pixels_left, pixels_right=pixels_right)
    start = pixels_left.astype(np.float32)
    guess = pixels_right.astype(np.float32)
    there, is_there = _follow(left, right, start, guess)
    back, is_back = _follow(right, left, there, start)
    is_kept = is_there & is_back
    is_kept &= np.linalg.norm(back - start, axis=1) <= _MAX_RETURN_PX
    is_kept &= np.linalg.norm(there - guess, axis=1) <= _MAX_STEP_PX
    return FreeMatches(
        pixels_left=pixels_left[is_kept], pixels_right=there[is_kept].astype(np.float64)
    )


def _follow(
    first: ImageArray, second: ImageArray, start: _Pixels, guess: _Pixels
) -> tuple[_Pixels, BoolArray]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        start,
        guess.copy(),
        winSize=_WINDOW,
        maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found), np.asarray(status)[:, 0] > 0
