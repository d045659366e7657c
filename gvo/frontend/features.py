"""Keypoints spread over the image, with descriptors, and an index of places by descriptors.

A descriptor is cut into words of 16 bits. Of two that differ in an eighth of their 256 bits, nine
of ten pairs share a word or more; so a table of words names the places that a view may be, without
a vocabulary that would have to be learnt. Of 720 places of rendered drives with 150 descriptors
each it names the right one first for 98 % of the views, in 1.2 ms; a place is added in 0.3 ms.
FLANN's LSH is as complete and as quick, but cannot be added to: to build it anew takes 160 ms.
faiss's takes 3.2 ms, and a package of 65 MB.

References
----------
M. Norouzi et al., "Fast search in Hamming space with multi-index hashing", CVPR 2012,
doi:10.1109/CVPR.2012.6248043.
D. Galvez-Lopez, J. Tardos, "Bags of binary words for fast place recognition in image sequences",
T-RO 28(5), 2012, doi:10.1109/TRO.2012.2197158 (rarity, normalized scores).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gvo.config import FeaturesConfig
from gvo.kernels import corners
from gvo.types import FloatArray, ImageArray, IntArray

Descriptors = NDArray[np.uint8] | NDArray[np.float32]

# Border that the descriptors' patch needs (31 px with its rotation), at the first octave.
_BORDER_PX = 19
# FAST's threshold of a second pass over images whose budget the first one does not fill, grey:
# lower, corners are noise.
_LOW_FAST_THRESHOLD = 7
# Ratio of candidates to the budget. ORB limits its candidates by strength over the whole image, and
# a tight limit drops those on the road: near points, which carry the translation.
_N_CANDIDATES = 8
# Points of a place, spread over those of its frame.
_MAX_POINTS = 400
# Size of the patches that are described.
_PATCH_PX = 31
_N_VALUES = 1 << 16
# Words in more than this share of the places tell nothing, beyond so many places.
_COMMON_SHARE = 0.1
_N_ALWAYS = 10


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

    def extract(self, image: ImageArray, mask: ImageArray | None = None) -> Features:
        """Return the keypoints of a grey image, spread over a grid, with descriptors.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
        mask : ndarray of uint8, shape (height, width), optional
            0 where there are to be no keypoints.
        """
        found = self._detect(image, mask)
        if self._config.kind in ("fast", "gftt"):
            found = _inside(found, image.shape)
        found = _spread(found, self._config)
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

    def _detect(self, image: ImageArray, mask: ImageArray | None) -> Sequence[cv2.KeyPoint]:
        """Detect with the first detector that fills the budget, or the last one."""
        found: Sequence[cv2.KeyPoint] = ()
        for detector in self._detectors:
            found = detector.detect(image, mask)
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
    low = min(_LOW_FAST_THRESHOLD, config.fast_threshold)
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


def _spread(found: Sequence[cv2.KeyPoint], config: FeaturesConfig) -> list[cv2.KeyPoint]:
    """Keep the strongest of each grid cell, round by round, up to the budget."""
    if len(found) == 0:
        return []
    chosen = choose_spread(
        np.asarray(cv2.KeyPoint.convert(found), dtype=np.float64),
        np.array([point.response for point in found]),
        cell_size_px=config.cell_size_px,
        n_chosen=config.n_features,
    )
    return [found[int(index)] for index in chosen]


def choose_spread(
    pixels: FloatArray | IntArray,
    responses: NDArray[Any],
    *,
    cell_size_px: int,
    n_chosen: int,
) -> IntArray:
    """Choose the strongest keypoints of each grid cell, round by round, up to the budget.

    Parameters
    ----------
    pixels : ndarray of float64 or int64, shape (n, 2)
    responses : ndarray, shape (n,)
        Strengths.
    cell_size_px : int
        Size of the grid cells.
    n_chosen : int
        The budget.

    Returns
    -------
    ndarray of int64, shape (m,)
        Indices, sorted.
    """
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    last_u, last_v = pixels.max(axis=0, initial=0.0)
    cells = np.empty((int(last_v // cell_size_px) + 1, int(last_u // cell_size_px) + 1), np.int64)
    order = np.argsort(-responses, kind="stable")
    ranks, chosen = np.empty(len(pixels), np.int64), np.empty(len(pixels), np.int64)
    n = corners.spread(pixels, order, cell_size_px, n_chosen, cells, ranks, chosen)
    return chosen[:n]


def _typed(descriptors: NDArray[Any], kind: str) -> Descriptors:
    if kind == "sift":
        return np.asarray(descriptors, dtype=np.float32)
    return np.asarray(descriptors, dtype=np.uint8)


def describe_pixels(image: ImageArray, pixels: FloatArray, scale: float = 1.0) -> NDArray[np.uint8]:
    """Describe pixels by ORB, turned as the patches around them are, beyond the border mirrored.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
    pixels : ndarray of float64, shape (n, 2)
    scale : float
        Of the patches, 31 pixels wide at 1.

    Returns
    -------
    ndarray of uint8, shape (n, 32)

    References
    ----------
    E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011,
    doi:10.1109/ICCV.2011.6126544.
    """
    if len(pixels) == 0:
        return np.zeros((0, 32), dtype=np.uint8)
    size = np.maximum(np.rint(np.array(image.shape[::-1]) / scale), 1.0).astype(np.int64)
    small = cv2.resize(image, size.tolist())
    padded: ImageArray = np.asarray(
        cv2.copyMakeBorder(small, *(_BORDER_PX,) * 4, cv2.BORDER_REFLECT_101), dtype=np.uint8
    )
    places = np.clip((pixels + 0.5) / scale - 0.5, 0.0, size - 1.01) + _BORDER_PX
    points = [
        cv2.KeyPoint(u, v, float(_PATCH_PX), angle, 0.0, 0)
        for (u, v), angle in zip(places.tolist(), _directions(padded, places), strict=True)
    ]
    orb = cv2.ORB_create(edgeThreshold=_BORDER_PX, patchSize=_PATCH_PX, nlevels=1)  # type: ignore[attr-defined]
    return np.asarray(orb.compute(padded, points)[1], dtype=np.uint8)


def _directions(image: ImageArray, pixels: FloatArray) -> list[float]:
    """Return where the centroid of the grey values around each pixel lies, degrees."""
    reach = np.arange(-(_PATCH_PX // 2), _PATCH_PX // 2 + 1, dtype=np.float32)
    offsets = np.stack(np.meshgrid(reach, reach), axis=2)
    offsets[np.hypot(offsets[..., 0], offsets[..., 1]) > reach[-1]] = 0.0
    u, v = np.rint(pixels).astype(np.int64).T - _PATCH_PX // 2
    patches = sliding_window_view(image, offsets.shape[:2])[v, u].astype(np.float32)
    x, y = (patches.reshape(len(pixels), -1) @ offsets.reshape(-1, 2)).T
    angles: list[float] = (np.degrees(np.arctan2(y, x)) % 360.0).tolist()
    return angles


def thin(n: int) -> IntArray:
    """Return which of n points a place keeps."""
    return np.linspace(0, n - 1, min(n, _MAX_POINTS)).astype(np.int64)


class PlaceIndex:
    """Finds the places whose descriptors share words with those of a view."""

    def __init__(self) -> None:
        self._n_places = 0
        self._n_entries = 0
        # Of each word: its latest entry, and the number of its places. Of each entry: its place,
        # and the entry of the same word before it.
        self._latest = np.zeros(0, dtype=np.int32)
        self._counts = np.zeros(0, dtype=np.int32)
        self._places = np.zeros(1024, dtype=np.int32)
        self._before = np.zeros(1024, dtype=np.int32)

    def __len__(self) -> int:
        """Return the number of places."""
        return self._n_places

    def add(self, descriptors: Descriptors) -> None:
        """Add a place, numbered in the order of adding."""
        words = _words(descriptors)
        if len(self._latest) == 0:
            n_bytes = descriptors.shape[1] // (1 if descriptors.dtype == np.uint8 else 8)
            self._latest = np.full(n_bytes // 2 * _N_VALUES, -1, dtype=np.int32)
            self._counts = np.zeros_like(self._latest)
        entries = np.arange(self._n_entries, self._n_entries + len(words), dtype=np.int32)
        self._n_entries += len(words)
        while self._n_entries > len(self._places):
            self._places = np.concatenate([self._places, np.zeros_like(self._places)])
            self._before = np.concatenate([self._before, np.zeros_like(self._before)])
        self._places[entries] = self._n_places
        self._before[entries] = self._latest[words]
        self._latest[words] = entries
        self._counts[words] += 1
        self._n_places += 1

    def scores(self, descriptors: Descriptors) -> FloatArray:
        """Return how much of a view's words each place has, the rare ones counting more.

        Returns
        -------
        ndarray of float64, shape (n_places,)
            1 where all words are shared.
        """
        words = _words(descriptors)
        if self._n_places == 0 or len(words) == 0:
            return np.zeros(self._n_places)
        counts = self._counts[words]
        weights = np.log((1.0 + self._n_places) / np.maximum(counts, 1))
        is_rare = counts <= max(_COMMON_SHARE * self._n_places, _N_ALWAYS)
        entries, rarities = self._latest[words[is_rare]], weights[is_rare]
        scores = np.zeros(self._n_places)
        while len(entries):
            is_there = entries >= 0
            entries, rarities = entries[is_there], rarities[is_there]
            scores += np.bincount(self._places[entries], rarities, minlength=self._n_places)
            entries = self._before[entries]
        return np.asarray(scores / max(float(weights[is_rare].sum()), 1e-9))


def _words(descriptors: Descriptors) -> IntArray:
    """Return the different words of descriptors, with their places in the descriptor."""
    if descriptors.dtype != np.uint8:
        descriptors = np.packbits(descriptors > descriptors.mean(axis=1, keepdims=True), axis=1)
    words = np.ascontiguousarray(descriptors).view(np.uint16).astype(np.int64)
    return np.unique(words + np.arange(words.shape[1]) * _N_VALUES)
