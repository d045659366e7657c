"""Depth at keypoints, with the unreliable ones filtered out."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gvo.config import DepthConfig
from gvo.types import BoolArray, DepthArray, FloatArray


def sample_depth(
    depth: DepthArray, keypoints: FloatArray, config: DepthConfig
) -> tuple[FloatArray, BoolArray]:
    """Read the depth at keypoints and tell which can be trusted.

    Parameters
    ----------
    depth : ndarray of float32, shape (height, width)
        Metres, NaN = unknown.
    keypoints : ndarray of float64, shape (n, 2)
        Pixels (u, v).
    config : DepthConfig
        Range of valid depth, and how much it may vary around a keypoint.

    Returns
    -------
    depths : ndarray of float64, shape (n,)
        Metres.
    is_valid : ndarray of bool, shape (n,)
        False where depth is unknown, out of range, or breaks around the keypoint: there a
        shift of a pixel between colour and depth changes the point by metres.
    """
    height, width = depth.shape
    columns, rows = np.rint(keypoints).astype(np.int64).T
    is_inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.where(is_inside, rows, 0), np.where(is_inside, columns, 0)
    depths = depth[rows, columns].astype(np.float64)
    radius = config.edge_radius_px
    padded = np.pad(depth, radius, constant_values=np.nan)
    windows = sliding_window_view(padded, (2 * radius + 1, 2 * radius + 1))[rows, columns]
    # fmin and fmax pass over NaN, and give it only where nothing else is.
    lowest, highest = (ufunc.reduce(windows, axis=(1, 2)) for ufunc in (np.fmin, np.fmax))
    with np.errstate(invalid="ignore"):
        is_smooth = highest - lowest <= config.max_edge_step * depths
        is_in_range = (depths >= config.min_depth_m) & (depths <= config.max_depth_m)
    return depths, is_inside & is_in_range & is_smooth
