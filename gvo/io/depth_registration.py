"""Depth of a camera of its own, seen from the colour camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.geometry import se3
from gvo.geometry.camera import Calibration
from gvo.io.recording import DepthView
from gvo.types import DepthArray, FloatArray, IntArray

_BAND = 32_768  # points at once: their temporaries stay in the cache
_NOTHING = np.float32(1e30)  # farther than anything; morphology does not keep infinity
_NEAREST_M = np.float32(1e-3)
_SHINE_THROUGH = 0.03  # relative step behind a surface from which a pixel counts as a gap in it
_STRETCH = 1.2  # how much wider than on a surface facing the camera gaps may be
_WIDEST_PERCENTILE = 95.0
_MAX_ITERATIONS = 100
_TOLERANCE_PX = 1e-3
_MAX_RESIDUAL_PX = 0.1


class DepthRegistration:
    """Warp depth images into the rectified image of a colour camera.

    Parameters
    ----------
    color : Calibration
        Of the colour camera; only its rectified camera counts.
    view : DepthView
        The camera that sees the depth, raw or rectified, and where it is.

    Raises
    ------
    ValueError
        When `T_color_depth` is not a rigid transform.

    Notes
    -----
    Each depth pixel is a point on a ray that is known beforehand; the point falls into one
    pixel of the colour image. Where several fall into the same pixel the nearest must win.
    Depths need not be compared for that: points that hide one another from the colour camera lie
    in one plane with both cameras, and there the nearer one is seen by the depth camera closer to
    the direction of the colour camera [1]_. Painting the pixels in the order of that angle, known
    beforehand too, leaves the nearest.

    Neighbours fall at most `s` pixels apart, the ratio of the resolutions, so that a surface has
    gaps, empty or showing what lies behind, of less than `k = floor(1.2 s) + 1` pixels, at least
    2. A morphological opening of the depth with a square of `k` pixels closes them, and leaves
    planes as they are: a pixel more than 3 % behind it takes its value. So does a slit between
    nearer surfaces that is narrower than `k`, and a speck of unknown depth. What only the colour
    camera sees stays unknown.

    References
    ----------
    .. [1] L. McMillan, "A list-priority rendering algorithm for redisplaying projected surfaces",
       Technical report 95-005, University of North Carolina, 1995.
    """

    def __init__(self, color: Calibration, view: DepthView) -> None:
        fault = se3.transform_fault(view.T_color_depth)
        if fault:
            raise ValueError(f"T_color_depth {fault}, got {view.T_color_depth.tolist()}")
        self._shape = (color.height, color.width)
        self._depth_shape = (view.calibration.height, view.calibration.width)
        R_color_depth, t_color_depth = view.T_color_depth[:3, :3], view.T_color_depth[:3, 3]
        K_color = color.P[:, :3]
        rays = _rays(view.calibration)
        spacing = _spacing(rays, color)
        order = _back_to_front(rays.reshape(-1, 3), R_color_depth.T @ -t_color_depth)
        lines = rays.reshape(-1, 3)[order] @ (K_color @ R_color_depth).T
        self._order = order
        self._lines = np.ascontiguousarray(lines.T, dtype=np.float32)
        self._offsets = (K_color @ t_color_depth).astype(np.float32)
        n_pixels = max(2, int(_STRETCH * spacing) + 1)
        self._square = np.ones((n_pixels, n_pixels), dtype=np.uint8)

    def __call__(self, depth: DepthArray) -> DepthArray:
        """Return metres (h, w) in the rectified colour image, NaN = unknown, of those recorded."""
        if depth.shape != self._depth_shape:
            raise ValueError(f"expected depth of shape {self._depth_shape}, got {depth.shape}")
        return _close_gaps(self._paint(depth), self._square)

    def _paint(self, depth: DepthArray) -> DepthArray:
        """Return the nearest depth that falls into each pixel, `_NOTHING` where none does."""
        height, width = self._shape
        # a frame of one pixel takes what falls outside
        painted = np.full((height + 2, width + 2), _NOTHING, dtype=np.float32)
        cells, depths = painted.reshape(-1), depth.reshape(-1)
        for start in range(0, len(self._order), _BAND):
            band = slice(start, start + _BAND)
            u, v, z = self._lines[:, band] * depths.take(self._order[band])
            for values, offset in zip((u, v, z), self._offsets, strict=True):
                values += offset
            z[~(z > _NEAREST_M)] = np.nan
            # The cast rounds down: half a pixel to round to the nearest, one for the frame.
            columns = _clip(u / z + np.float32(1.5), width + 1)
            rows = _clip(v / z + np.float32(1.5), height + 1)
            # of equal indices the last one stays
            cells[rows.astype(np.int32) * (width + 2) + columns.astype(np.int32)] = z
        return painted[1:-1, 1:-1]


def _clip(values: DepthArray, largest: int) -> DepthArray:
    """Limit values to 0 and the largest; NaN becomes 0."""
    return np.asarray(np.fmin(np.fmax(values, np.float32(0)), np.float32(largest)))


def _close_gaps(painted: DepthArray, square: NDArray[np.uint8]) -> DepthArray:
    last = (square.shape[1] - 1, square.shape[0] - 1)
    # OpenCV does not mirror the square for the second half: its own opening shifts even sizes.
    nearest = cv2.erode(painted, square, anchor=(0, 0))
    opened = np.asarray(cv2.dilate(nearest, square, anchor=last))
    is_gap = painted > opened * np.float32(1 + _SHINE_THROUGH)
    closed = np.where(is_gap, opened, painted)
    closed[closed == _NOTHING] = np.nan
    return closed


def _rays(calibration: Calibration) -> FloatArray:
    """Return the point of depth one that each pixel sees, shape (height, width, 3).

    The point has depth one in the image as recorded, and is given in the frame of the rectified
    camera. It is NaN where the model of the lens has no inverse.
    """
    height, width = calibration.height, calibration.width
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    if calibration.is_rectified:
        return calibration.pinhole().unproject(pixels)
    raw = _undistorted(pixels.reshape(-1, 2), calibration)
    rays: FloatArray = raw @ calibration.R.T
    return rays.reshape(height, width, 3)


def _undistorted(pixels: FloatArray, calibration: Calibration) -> FloatArray:
    """Invert the lens by fixed-point iteration over those pixels that are not there yet."""
    K = calibration.K
    focal_lengths = np.array([K[0, 0], K[1, 1]])
    rays = np.hstack([(pixels - K[:2, 2]) / focal_lengths, np.ones((len(pixels), 1))])
    residuals = np.full(len(pixels), np.inf)
    left = np.arange(len(pixels))
    for _ in range(_MAX_ITERATIONS):
        errors = pixels[left] - calibration.lens.project(rays[left])
        residuals[left] = np.linalg.norm(errors, axis=1)
        is_open = residuals[left] > _TOLERANCE_PX
        left = left[is_open]
        if len(left) == 0:
            break
        rays[left, :2] += errors[is_open] / focal_lengths
    rays[~(residuals < _MAX_RESIDUAL_PX)] = np.nan
    return rays


def _spacing(rays: FloatArray, color: Calibration) -> float:
    """Return how far apart neighbouring points of one depth fall, colour pixels."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    columns = np.nanpercentile(np.abs(np.diff(x, axis=1)), _WIDEST_PERCENTILE) * color.P[0, 0]
    rows = np.nanpercentile(np.abs(np.diff(y, axis=0)), _WIDEST_PERCENTILE) * color.P[1, 1]
    return float(max(columns, rows))


def _back_to_front(rays: FloatArray, towards: FloatArray) -> IntArray:
    """Return the indices of known rays, those closest to a direction last."""
    known = np.flatnonzero(np.isfinite(rays[:, 0]))
    cosines = rays[known] @ towards / np.linalg.norm(rays[known], axis=1)
    return np.asarray(known[np.argsort(cosines, kind="stable")], dtype=np.int64)
