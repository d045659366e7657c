"""Faults of exposure and optics: black, white, blurred, noisy, flickering, covered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.testing.faults.fault import PixelFault, Shot

_WHITE = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class Black(PixelFault):
    """Black images: a cap on the lens, no light."""

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return zeros."""
        return np.zeros_like(pixels)


@dataclass(frozen=True, slots=True, kw_only=True)
class White(PixelFault):
    """Saturated images: the sun, the end of a tunnel.

    Parameters
    ----------
    part : float
        Share of the columns, from the left.
    """

    part: float = 1.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image with white columns."""
        spoilt = pixels.copy()
        spoilt[:, : round(self.part * pixels.shape[1])] = _WHITE
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class Blurred(PixelFault):
    """Images out of focus.

    Parameters
    ----------
    sigma_px : float
        Of a Gaussian, pixels.
    """

    sigma_px: float = 4.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image, smoothed."""
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), self.sigma_px))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionBlurred(PixelFault):
    """Images exposed for too long while the camera turns.

    Parameters
    ----------
    length_px : int
        Way of a point along a row, pixels.
    """

    length_px: int = 15

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image, smeared along its rows."""
        return np.asarray(cv2.blur(pixels, (self.length_px, 1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Noisy(PixelFault):
    """Images with much noise: gain turned up at night.

    Parameters
    ----------
    sigma : float
        Of Gaussian noise, grey values.
    """

    sigma: float = 40.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image with noise."""
        return _to_uint8(pixels + self.sigma * rng.standard_normal(pixels.shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class SaltAndPepper(PixelFault):
    """Single pixels white or black: bit errors, a damaged sensor.

    Parameters
    ----------
    density : float
        Share of the pixels.
    """

    density: float = 0.1

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image with some pixels at either end of the range."""
        spoilt = pixels.copy()
        chance = rng.random(pixels.shape[:2])
        spoilt[chance < 0.5 * self.density] = 0
        spoilt[chance > 1.0 - 0.5 * self.density] = _WHITE
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposed(PixelFault):
    """Images brighter or darker than the others.

    Parameters
    ----------
    factor : float
        Of the grey values.
    """

    factor: float = 2.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image at another exposure."""
        return _to_uint8(self.factor * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Flickering(PixelFault):
    """Brightness that swings from frame to frame, as under lamps on mains.

    Parameters
    ----------
    amplitude : float
        Share of the brightness.
    period : float
        Frames.
    """

    amplitude: float = 0.4
    period: float = 3.3

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image, brighter or darker by its number."""
        swing = np.sin(2.0 * np.pi * shot.frame / self.period)
        return _to_uint8((1.0 + self.amplitude * swing) * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Banded(PixelFault):
    """Bands that roll through the image: a rolling shutter under lamps on mains.

    Parameters
    ----------
    amplitude : float
        Share of the brightness.
    period_rows : float
        Height of a band.
    rows_per_frame : float
        How far they move.
    """

    amplitude: float = 0.4
    period_rows: float = 40.0
    rows_per_frame: float = 7.0

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image with bright and dark rows."""
        rows = np.arange(pixels.shape[0]) + self.rows_per_frame * shot.frame
        gain = 1.0 + self.amplitude * np.sin(2.0 * np.pi * rows / self.period_rows)
        gain = gain.reshape(-1, *[1] * (pixels.ndim - 1))
        return _to_uint8(gain * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Covered(PixelFault):
    """A drop, dirt or part of the robot in front of the lens: blobs that stay where they are.

    Parameters
    ----------
    part : float
        Share of the image that is covered, about.
    n_blobs : int
        So many, placed by the seed, the same in all images of a stream.
    """

    part: float = 0.25
    n_blobs: int = 3

    def spoil(self, pixels: NDArray[Any], rng: np.random.Generator, shot: Shot) -> NDArray[Any]:
        """Return the image with mottled grey blobs."""
        height, width = pixels.shape[:2]
        fixed = np.random.default_rng([self.seed, shot.image.stream])
        radius = float(np.sqrt(self.part * height * width / (np.pi * self.n_blobs)))
        dirt = fixed.integers(30, 120, (height, width)).astype(np.uint8)
        dirt = np.asarray(cv2.GaussianBlur(dirt, (0, 0), 1.5))
        spoilt = pixels.copy()
        v, u = np.mgrid[:height, :width]
        for centre_u, centre_v in fixed.random((self.n_blobs, 2)) * (width, height):
            is_covered = (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
            grey = dirt[is_covered]
            spoilt[is_covered] = grey if pixels.ndim == 2 else grey[:, np.newaxis]
        return spoilt


def _to_uint8(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(values), 0, _WHITE), dtype=np.uint8)
