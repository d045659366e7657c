"""Faults of depth images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.testing.faults.fault import Kind, PixelFault, Shot


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFault(PixelFault):
    """A fault of depth images; grey and colour images are left as they are."""

    def kinds(self) -> tuple[Kind, ...]:
        """Return that of depth."""
        return ("depth",)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthConstant(DepthFault):
    """Depth that is one value everywhere.

    Parameters
    ----------
    depth_m : float
        Metres; may be NaN, zero, infinite or negative.
    """

    depth_m: float = float("nan")

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return an image of one value."""
        return np.full_like(pixels, self.depth_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScaled(DepthFault):
    """Depth in another unit.

    Parameters
    ----------
    factor : float
        1000: millimetres taken for metres.
    """

    factor: float = 1000.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the depth, multiplied."""
        return (self.factor * pixels).astype(pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthQuantized(DepthFault):
    """Depth in coarse steps.

    Parameters
    ----------
    step_m : float
    """

    step_m: float = 0.25

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the depth, rounded."""
        return (self.step_m * np.rint(pixels / self.step_m)).astype(pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthHoles(DepthFault):
    """Depth that is unknown in most places: sunlight, dark or shiny surfaces.

    Parameters
    ----------
    part : float
        Share of the pixels.
    size_px : int
        Of a hole, about.
    """

    part: float = 0.9
    size_px: int = 8

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the depth with holes, elsewhere in each image."""
        height, width = pixels.shape[:2]
        cells = rng.random((height // self.size_px + 1, width // self.size_px + 1))
        is_hole = cells < self.part
        spread = np.asarray(
            cv2.resize(is_hole.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        )
        spoilt = pixels.copy()
        spoilt[spread > 0] = np.nan
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthSaturated(DepthFault):
    """Depth that ends at the sensor's range, where unknown pixels have that value too.

    Parameters
    ----------
    depth_m : float
        The largest depth, metres.
    """

    depth_m: float = 2.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the depth, nowhere larger nor unknown."""
        return np.asarray(np.fmin(pixels, self.depth_m), dtype=pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthNoisy(DepthFault):
    """Depth with much noise, growing with its square.

    Parameters
    ----------
    sigma_m : float
        At one metre.
    """

    sigma_m: float = 0.05

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the depth with noise."""
        noise = self.sigma_m * pixels**2 * rng.standard_normal(pixels.shape)
        return (pixels + noise).astype(pixels.dtype)
