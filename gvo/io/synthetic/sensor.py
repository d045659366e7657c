"""The noise of cameras and depth sensors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gvo.types import BoolArray, DepthArray

_EXPOSURE_PERIOD_S = 7.3
_BLOB_PX = 14
# Relative change of the inverse depth that counts as a step.
_STEP_SHARE = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Noise and limits of the sensor.

    Parameters
    ----------
    grey_sigma : float
        Gaussian noise of each pixel, grey values.
    exposure_drift : float
        Amplitude of the brightness that comes and goes within seconds, relative.
    exposure_mismatch : float
        How much brighter the right image is, relative.
    depth_sigma : float
        Gaussian noise of the inverse depth, 1/m: sigma_z = depth_sigma * z^2.
    depth_step : float
        Quantum of the inverse depth, 1/m; 0: none.
    hole_share : float
        Share of the depth image that is lost in blobs.
    edge_radius_px : int
        Depth is lost so far around steps of more than 3 %, pixels; 0: nowhere.
    min_depth_m, max_depth_m : float
        Depth out of this range is unknown.

    Raises
    ------
    ValueError
        For a negative noise, or a share that is not in [0, 1).
    """

    grey_sigma: float = 2.0
    exposure_drift: float = 0.05
    exposure_mismatch: float = 0.02
    depth_sigma: float = 0.0014
    depth_step: float = 0.002
    hole_share: float = 0.02
    edge_radius_px: int = 1
    min_depth_m: float = 0.4
    max_depth_m: float = 8.0

    def __post_init__(self) -> None:
        """Refuse what no sensor has."""
        sizes = (self.grey_sigma, self.depth_sigma, self.depth_step, self.edge_radius_px)
        if min(sizes) < 0 or not 0 <= self.hole_share < 1:
            raise ValueError(f"sigmas must not be negative, shares in [0, 1): {self}")


def expose(
    grey: DepthArray, noise: SensorNoise, rng: np.random.Generator, *, stream: int, elapsed_s: float
) -> DepthArray:
    """Return grey values with the brightness of the moment and noise; stream 1 is the right."""
    gain = 1.0 + noise.exposure_drift * np.sin(2 * np.pi * elapsed_s / _EXPOSURE_PERIOD_S)
    if stream == 1:
        gain *= 1.0 + noise.exposure_mismatch
    exposed = grey * np.float32(gain)
    if noise.grey_sigma > 0:
        white = rng.standard_normal(grey.shape, dtype=np.float32)
        exposed += np.float32(noise.grey_sigma) * white
    return exposed


def spoil_depth(depth: DepthArray, noise: SensorNoise, rng: np.random.Generator) -> DepthArray:
    """Return depth (m) as a structured-light camera measures it: inverse, in steps, with holes.

    References
    ----------
    K. Khoshelham, S. O. Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 12(2), 2012, doi:10.3390/s120201437.
    """
    white = rng.standard_normal(depth.shape, dtype=np.float32)
    inverse_depths = 1.0 / depth + np.float32(noise.depth_sigma) * white
    if noise.depth_step > 0:
        step = np.float32(noise.depth_step)
        inverse_depths = np.rint(inverse_depths / step) * step
    is_known = (depth >= noise.min_depth_m) & (depth <= noise.max_depth_m) & (inverse_depths > 0)
    if noise.hole_share > 0:
        is_known &= ~_blobs(depth.shape, noise.hole_share, rng)
    if noise.edge_radius_px > 0:
        is_known &= ~_edges(depth, noise.edge_radius_px)
    spoilt = np.full(depth.shape, np.nan, dtype=np.float32)
    spoilt[is_known] = 1.0 / inverse_depths[is_known]
    return spoilt


def _blobs(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> BoolArray:
    height, width = shape
    coarse = rng.standard_normal((height // _BLOB_PX + 2, width // _BLOB_PX + 2))
    field = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
    return np.asarray(field > np.quantile(field, 1.0 - share))


def _edges(depth: DepthArray, radius: int) -> BoolArray:
    """Tell where the depth jumps; the inverse depth of a plane is linear, so its Laplacian 0."""
    inverse_depths = np.nan_to_num(1.0 / depth, nan=0.0)
    curvature = np.abs(np.asarray(cv2.Laplacian(inverse_depths, cv2.CV_32F)))
    is_step = (curvature > _STEP_SHARE * inverse_depths).astype(np.uint8)
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(is_step, kernel)) > 0
