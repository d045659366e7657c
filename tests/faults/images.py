"""Faults of light, lens, depth and transfer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np

from gvo.testing.faults import FaultyImage, PixelFault, Pixels

_WHITE = 255
Turn: TypeAlias = Literal["upside down", "mirrored", "half turn", "transposed"]
PixelType: TypeAlias = Literal["float64", "float32", "uint16", "int32", "bool", "colour", "flat"]


@dataclass(frozen=True, slots=True, kw_only=True)
class White(PixelFault):
    """Saturated images: the sun, the end of a tunnel."""

    part: float = 1.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        spoilt = pixels.copy()
        spoilt[:, : round(self.part * pixels.shape[1])] = _WHITE
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class Blurred(PixelFault):
    """Images out of focus."""

    sigma_px: float = 4.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), self.sigma_px))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionBlurred(PixelFault):
    """Images exposed for too long while the camera turns."""

    length_px: int = 15

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return np.asarray(cv2.blur(pixels, (self.length_px, 1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Noisy(PixelFault):
    """Images with much noise: gain turned up at night."""

    sigma: float = 40.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
        return _to_uint8(pixels + self.sigma * rng.standard_normal(pixels.shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class SaltAndPepper(PixelFault):
    """Single pixels white or black: bit errors, a damaged sensor."""

    density: float = 0.1

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
        spoilt = pixels.copy()
        chance = rng.random(pixels.shape[:2])
        spoilt[chance < 0.5 * self.density] = 0
        spoilt[chance > 1.0 - 0.5 * self.density] = _WHITE
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposed(PixelFault):
    """Images brighter or darker than the others."""

    factor: float = 2.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return _to_uint8(self.factor * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Flickering(PixelFault):
    """Brightness that oscillates from frame to frame, as under mains lamps."""

    amplitude: float = 0.4
    period: float = 3.3

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        swing = np.sin(2.0 * np.pi * image.frame / self.period)
        return _to_uint8((1.0 + self.amplitude * swing) * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Banded(PixelFault):
    """Bands that roll through the image: a rolling shutter under mains lamps."""

    amplitude: float = 0.4
    period_rows: float = 40.0
    rows_per_frame: float = 7.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rows = np.arange(pixels.shape[0]) + self.rows_per_frame * image.frame
        gain = 1.0 + self.amplitude * np.sin(2.0 * np.pi * rows / self.period_rows)
        gain = gain.reshape(-1, *[1] * (pixels.ndim - 1))
        return _to_uint8(gain * pixels.astype(np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Covered(PixelFault):
    """A drop, dirt or part of the robot in front of the lens: blobs that stay where they are."""

    part: float = 0.25
    n_blobs: int = 3

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        height, width = pixels.shape[:2]
        fixed = np.random.default_rng([self.seed, image.given.stream])
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


def _to_uint8(values: Pixels) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0, _WHITE), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFault(PixelFault):
    """A fault of depth images; grey and colour images stay as they are."""

    def is_possible(self, is_depth: bool) -> bool:
        return is_depth


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthConstant(DepthFault):
    """Depth that is one value everywhere."""

    depth_m: float = float("nan")

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return np.full_like(pixels, self.depth_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScaled(DepthFault):
    """Depth in another unit."""

    factor: float = 1000.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return (self.factor * pixels).astype(pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthQuantized(DepthFault):
    """Depth in coarse steps."""

    step_m: float = 0.25

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return (self.step_m * np.rint(pixels / self.step_m)).astype(pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthHoles(DepthFault):
    """Depth that is unknown in most places: sunlight, dark or shiny surfaces."""

    part: float = 0.9
    size_px: int = 8

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
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
    """Depth that ends at the sensor's range, also at unknown pixels."""

    depth_m: float = 2.0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        return np.asarray(np.fmin(pixels, self.depth_m), dtype=pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthNoisy(DepthFault):
    """Depth with much noise, growing with its square."""

    sigma_m: float = 0.05

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
        noise = self.sigma_m * pixels**2 * rng.standard_normal(pixels.shape)
        return (pixels + noise).astype(pixels.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class _AnyImageFault(PixelFault):
    """A fault of images of all kinds."""

    def is_possible(self, is_depth: bool) -> bool:
        return True


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfWritten(PixelFault):
    """Images whose transfer was interrupted."""

    part: float = 0.5
    fill: Literal["grey", "garbage", "former"] = "grey"

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
        n_rows = round(self.part * len(pixels))
        spoilt = pixels.copy()
        rest = spoilt[n_rows:]
        if self.fill == "grey":
            rest[:] = 128
        elif self.fill == "garbage":
            rest[:] = rng.integers(0, 256, rest.shape)
        else:
            rest[:] = np.resize(pixels[: max(n_rows, 1)], rest.shape)
        return spoilt


@dataclass(frozen=True, slots=True, kw_only=True)
class RowsShifted(PixelFault):
    """Rows out of place: bytes missing in the transfer."""

    most_px: int = 40

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = self.rng(image)
        bands = np.array_split(pixels, 8)
        shifts = rng.integers(-self.most_px, self.most_px + 1, len(bands)).tolist()
        rolled = [np.roll(band, by, axis=1) for band, by in zip(bands, shifts, strict=True)]
        return np.concatenate(rolled)


@dataclass(frozen=True, slots=True, kw_only=True)
class Turned(_AnyImageFault):
    """Images turned or mirrored by the mounting of the camera or a setting of the driver."""

    how: Turn = "upside down"

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        views = {
            "upside down": pixels[::-1],
            "mirrored": pixels[:, ::-1],
            "half turn": pixels[::-1, ::-1],
            "transposed": pixels.swapaxes(0, 1),
        }
        return np.ascontiguousarray(views[self.how])


@dataclass(frozen=True, slots=True, kw_only=True)
class Resized(_AnyImageFault):
    """Images of another size than that of the calibration."""

    factor: float = 0.5

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        size = [max(round(self.factor * length), 1) for length in pixels.shape[1::-1]]
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST))


@dataclass(frozen=True, slots=True, kw_only=True)
class OfType(_AnyImageFault):
    """Pixels of a type or shape that a source must not give."""

    pixel_type: PixelType = "float64"

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        if self.pixel_type == "flat":
            return pixels.reshape(-1)
        if self.pixel_type == "colour":
            return np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels
        dtype = np.dtype(self.pixel_type)
        is_whole = dtype.kind in "iub"
        return (np.nan_to_num(pixels) if is_whole else pixels).astype(dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shifted(_AnyImageFault):
    """Images shifted against those of the other stream: a knock on the rig."""

    rows: int = 0
    columns: int = 0

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        pad = [(abs(self.rows),) * 2, (abs(self.columns),) * 2, *[(0, 0)] * (pixels.ndim - 2)]
        if pixels.dtype.kind == "f":
            padded = np.pad(pixels, pad, constant_values=np.nan)
        else:
            padded = np.pad(pixels, pad, mode="edge")
        v, u = abs(self.rows) - self.rows, abs(self.columns) - self.columns
        return np.ascontiguousarray(padded[v : v + pixels.shape[0], u : u + pixels.shape[1]])
