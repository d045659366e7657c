"""Keypoints spread over the image, with descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo._trace import note
from gvo.config import FeaturesConfig
from gvo.types import FloatArray, ImageArray, IntArray

Descriptors = NDArray[np.uint8] | NDArray[np.float32]

# Border that the descriptors' patch needs (31 px with its rotation), at the first octave.
_BORDER_PX = 19
# Ratio of candidates to the budget. ORB limits its candidates by strength over the whole image, and
# a tight limit drops those on the road: near points, which carry the translation.
_N_CANDIDATES = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Keypoints of one image.

    Parameters
    ----------
    keypoints : ndarray of float64, shape (n, 2)
        Pixels (u, v).
    octaves : ndarray of int64, shape (n,)
        Pyramid level of each; 0 is the image itself.
    descriptors : ndarray of uint8 or float32, shape (n, m)
    """

    keypoints: FloatArray
    octaves: IntArray
    descriptors: Descriptors

    def __len__(self) -> int:
        """Return the number of keypoints."""
        return len(self.keypoints)


class FeatureExtractor:
    """Detects and describes keypoints with OpenCV, whose detectors keep state: one per thread.

    Parameters
    ----------
    config : FeaturesConfig
    """

    def __init__(self, config: FeaturesConfig) -> None:
        self._config = config
        self._orb = _make_orb(config, config.fast_threshold)
        self._detectors = _make_detectors(config, self._orb)

    def extract(self, image: ImageArray) -> Features:
        """Return the keypoints of a grey image, spread over a grid, with descriptors.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
        """
        found = self._detect(image)
        if self._config.kind in ("fast", "gftt"):
            found = _inside(found, image.shape)
        found = _spread(found, image.shape, self._config)
        if self._config.upright and self._config.kind != "sift":
            for point in found:
                point.angle = 0.0
        describer = self._detectors[0] if self._config.kind == "sift" else self._orb
        found, descriptors = describer.compute(image, found)
        if descriptors is None or len(found) == 0:
            return _no_features(self._config.kind)
        return Features(
            keypoints=np.asarray(cv2.KeyPoint.convert(found), dtype=np.float64),
            octaves=_octaves(found),
            descriptors=_typed(descriptors, self._config.kind),
        )

    def _detect(self, image: ImageArray) -> Sequence[cv2.KeyPoint]:
        """Detect with the first detector that fills the budget, or the last one."""
        found: Sequence[cv2.KeyPoint] = ()
        for detector in self._detectors:
            found = detector.detect(image)
            if len(found) >= self._config.n_features:
                break
        return found


def _make_orb(config: FeaturesConfig, threshold: int) -> cv2.Feature2D:
    orb: cv2.Feature2D = cv2.ORB_create(  # type: ignore[attr-defined]
        nfeatures=_N_CANDIDATES * config.n_features,
        scaleFactor=config.scale_factor,
        nlevels=config.n_octaves,
        edgeThreshold=_BORDER_PX,
        fastThreshold=threshold,
        scoreType=cv2.ORB_FAST_SCORE,
    )
    return orb


def _make_detectors(config: FeaturesConfig, orb: cv2.Feature2D) -> list[cv2.Feature2D]:
    n_candidates = _N_CANDIDATES * config.n_features
    if config.kind == "sift":
        return [cv2.SIFT_create(nfeatures=n_candidates)]  # type: ignore[attr-defined]
    if config.kind == "gftt":
        return [
            cv2.GFTTDetector_create(  # type: ignore[attr-defined]
                maxCorners=n_candidates, qualityLevel=0.001, minDistance=3
            )
        ]
    low = min(config.low_fast_threshold, config.fast_threshold)
    if config.kind == "fast":
        return [
            cv2.FastFeatureDetector_create(threshold=threshold)  # type: ignore[attr-defined]
            for threshold in (config.fast_threshold, low)
        ]
    return [orb, _make_orb(config, low)]


def _no_features(kind: str) -> Features:
    size = 128 if kind == "sift" else 32
    descriptors = _typed(np.zeros((0, size)), kind)
    return Features(
        keypoints=np.zeros((0, 2)), octaves=np.zeros(0, np.int64), descriptors=descriptors
    )


def _inside(found: Sequence[cv2.KeyPoint], shape: tuple[int, ...]) -> Sequence[cv2.KeyPoint]:
    """Drop corners without room for ORB's patch, before they take a share of the budget."""
    if len(found) == 0:
        return found
    pixels = np.asarray(cv2.KeyPoint.convert(found))
    limits = np.array([shape[1], shape[0]]) - _BORDER_PX
    fits = np.all((pixels >= _BORDER_PX) & (pixels < limits), axis=1)
    return [found[int(index)] for index in np.flatnonzero(fits)]


def _octaves(found: Sequence[cv2.KeyPoint]) -> IntArray:
    # The lowest byte is signed: SIFT starts at -1, an image of twice the size.
    octaves = np.array([point.octave & 0xFF for point in found], dtype=np.uint8)
    return octaves.view(np.int8).astype(np.int64)


def _spread(
    found: Sequence[cv2.KeyPoint], shape: tuple[int, ...], config: FeaturesConfig
) -> list[cv2.KeyPoint]:
    """Keep the strongest of each grid cell, round by round, up to the budget."""
    if len(found) == 0:
        return []
    chosen = choose_spread(
        np.asarray(cv2.KeyPoint.convert(found), dtype=np.float64),
        np.array([point.response for point in found]),
        width=shape[1],
        cell_size_px=config.cell_size_px,
        n_chosen=config.n_features,
    )
    return [found[int(index)] for index in chosen]


def choose_spread(
    pixels: FloatArray | IntArray,
    responses: NDArray[Any],
    *,
    width: int,
    cell_size_px: int,
    n_chosen: int,
) -> IntArray:
    """Choose the strongest keypoints of each grid cell, round by round, up to the budget.

    Parameters
    ----------
    pixels : ndarray of float64 or int64, shape (n, 2)
    responses : ndarray, shape (n,)
        Strengths.
    width : int
        Of the image, pixels.
    cell_size_px : int
        Size of the grid cells.
    n_chosen : int
        The budget.

    Returns
    -------
    ndarray of int64, shape (m,)
        Indices, sorted.
    """
    columns = -(-width // cell_size_px)
    # Cells and ranks are small integers, which NumPy sorts stably in linear time.
    cells = ((pixels // cell_size_px) @ [1, columns]).astype(np.uint16)
    by_response = np.argsort(-responses, kind="stable")
    by_cell = np.argsort(cells[by_response], kind="stable")
    ranks = np.empty(len(pixels), dtype=np.uint16)
    ranks[by_cell] = np.minimum(rank_in_group(cells[by_response][by_cell]), 65535)
    # The first of every cell before the second of any: the weakest rank is cut by response.
    chosen = np.sort(by_response[np.argsort(ranks, kind="stable")[:n_chosen]])
    note("keypoints.spread", pixels=pixels, chosen=chosen)
    return chosen


def rank_in_group(sorted_groups: NDArray[Any]) -> IntArray:
    """Return the rank of the members of each run of equal values, from zero, shape (n,)."""
    n = len(sorted_groups)
    is_first = np.ones(n, dtype=np.bool_)
    is_first[1:] = sorted_groups[1:] != sorted_groups[:-1]
    starts = np.flatnonzero(is_first)
    return np.asarray(np.arange(n) - starts[np.cumsum(is_first) - 1])


def _typed(descriptors: NDArray[Any], kind: str) -> Descriptors:
    if kind == "sift":
        return np.asarray(descriptors, dtype=np.float32)
    return np.asarray(descriptors, dtype=np.uint8)
