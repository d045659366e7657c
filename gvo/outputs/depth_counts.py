"""Depth in metres as counts of 16 bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvo.sources.pixels import depth_from_counts
from gvo.types import DepthArray

MAX_COUNT = 65534
"""Largest count: 0 and 65535 are unknown."""

# Counts read as float32 metres and multiplied again miss an integer by its rounding only.
_TOLERANCE = 5e-3


def is_in_counts(depth: DepthArray, scale: float) -> bool:
    """Tell whether depth was made of counts of this scale.

    Parameters
    ----------
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown.
    scale : float
        Counts per metre.

    Returns
    -------
    bool
        False where nothing is known, too.
    """
    counts = scale * depth[np.isfinite(depth)].astype(np.float64)
    return len(counts) > 0 and bool(np.all(np.abs(counts - np.round(counts)) < _TOLERANCE))


def to_counts(depth: DepthArray, scale: float) -> tuple[NDArray[np.uint16], int]:
    """Return counts, and the number of pixels that are too far for them.

    Parameters
    ----------
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown.
    scale : float
        Counts per metre.

    Returns
    -------
    counts : ndarray of uint16, shape (h, w)
        Rounded, 0 = unknown or too far.
    n_too_far : int
    """
    counts = np.round(scale * np.nan_to_num(depth, nan=0.0).astype(np.float64))
    is_far = counts > MAX_COUNT
    counts[is_far] = 0
    return counts.astype(np.uint16), int(np.count_nonzero(is_far))


def exact_counts(depth: DepthArray, scale: float) -> NDArray[np.uint16] | None:
    """Return counts from which the depth comes back bit by bit; None where there are none.

    Parameters
    ----------
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown.
    scale : float
        Counts per metre.
    """
    counts, _ = to_counts(depth, scale)
    is_exact = np.array_equal(depth_from_counts(counts, scale, "depth"), depth, equal_nan=True)
    return counts if is_exact else None
