"""Faults of light, lens, depth and transfer: each a function of pixels and the image's numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.testing.faults import Fault, FaultyImage, PixelFault, Pixels

_WHITE = 255
Rng: TypeAlias = np.random.Generator
Part: TypeAlias = Literal["light", "depth", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Spoilt(PixelFault):
    """Pixels changed by a function of them, the number of the frame, and random numbers."""

    by: Callable[[Pixels, int, Rng], Pixels]
    of: Part = "light"

    def is_possible(self, is_depth: bool) -> bool:
        return self.of == "all" or is_depth == (self.of == "depth")

    def spoil(self, pixels: Pixels, image: FaultyImage) -> Pixels:
        rng = np.random.default_rng([self.seed, image.frame, image.given.stream])
        return self.by(pixels, image.frame, rng)


def spoilt(by: Callable[..., Pixels], of: Part = "light", **values: Any) -> Spoilt:
    """Return the fault of a function: the values are its own, or those that any fault has."""
    names = [field.name for field in fields(Fault)]
    options = {name: values.pop(name) for name in names if name in values}
    return Spoilt(by=partial(by, **values), of=of, **options)


of_depth = partial(spoilt, of="depth")
of_all = partial(spoilt, of="all")


def _grey(values: Pixels) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0, _WHITE), dtype=np.uint8)


def white(pixels: Pixels, frame: int, rng: Rng, part: float = 1.0) -> Pixels:
    """Saturate a part: the sun, the end of a tunnel."""
    changed = pixels.copy()
    changed[:, : round(part * pixels.shape[1])] = _WHITE
    return changed


def blurred(pixels: Pixels, frame: int, rng: Rng, sigma_px: float) -> Pixels:
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma_px))


def noisy(pixels: Pixels, frame: int, rng: Rng, sigma: float) -> Pixels:
    return _grey(pixels + sigma * rng.standard_normal(pixels.shape))


def exposed(pixels: Pixels, frame: int, rng: Rng, factor: float) -> Pixels:
    return _grey(factor * pixels.astype(np.float64))


def flickering(pixels: Pixels, frame: int, rng: Rng, amplitude: float) -> Pixels:
    """Swing in brightness from frame to frame, as under mains lamps."""
    return exposed(pixels, frame, rng, 1.0 + amplitude * np.sin(2.0 * np.pi * frame / 3.3))


def covered(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    """Cover a quarter by three blobs that stay: drops, dirt, a part of the robot."""
    height, width = pixels.shape[:2]
    fixed = np.random.default_rng(0)
    radius = float(np.sqrt(0.25 * height * width / (np.pi * 3)))
    dirt = cv2.GaussianBlur(fixed.integers(30, 120, (height, width)).astype(np.uint8), (0, 0), 1.5)
    changed = pixels.copy()
    v, u = np.mgrid[:height, :width]
    for centre_u, centre_v in fixed.random((3, 2)) * (width, height):
        is_covered = (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
        changed[is_covered] = np.asarray(dirt)[is_covered]
    return changed


def bonnet(
    pixels: Pixels, frame: int, rng: Rng, part: float, shift_px: float, sigma: float = 2.0
) -> Pixels:
    """Cover the lower part of the view by what rides with the camera, moved to the left."""
    height, width = pixels.shape
    rows, columns = np.mgrid[:height, :width]
    edge = 1.0 - part + 0.08 * (2.0 * columns / width - 1.0) ** 2 + 0.01 * np.sin(columns)
    white = np.random.default_rng(3).normal(size=pixels.shape).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), 1.2))
    M = np.array([[1.0, 0.0, -shift_px], [0.0, 1.0, 0.0]])
    texture = 110.0 + 40.0 * smooth / smooth.std()
    seen = cv2.warpAffine(texture, M, (width, height), borderMode=cv2.BORDER_REFLECT)
    return np.where(rows > edge * height, noisy(seen, frame, rng, sigma), pixels)


def along_ray(pixels: Pixels, frame: int, rng: Rng, camera: PinholeCamera, size: float) -> Pixels:
    """Measure depth along the ray of each pixel, not along the optical axis; size 1: all of it."""
    u, v = np.meshgrid(np.arange(pixels.shape[1]), np.arange(pixels.shape[0]))
    rays = camera.unproject(np.dstack([u, v]).astype(np.float64))
    lengths = np.linalg.norm(rays, axis=-1)
    measured: Pixels = pixels * (1.0 + size * (lengths - 1.0))
    return measured.astype(pixels.dtype)


def constant(pixels: Pixels, frame: int, rng: Rng, value: float = float("nan")) -> Pixels:
    return np.full_like(pixels, value)


def scaled(pixels: Pixels, frame: int, rng: Rng, factor: float) -> Pixels:
    return (factor * pixels).astype(pixels.dtype)


def quantized(pixels: Pixels, frame: int, rng: Rng, step_m: float) -> Pixels:
    return (step_m * np.rint(pixels / step_m)).astype(pixels.dtype)


def holes(pixels: Pixels, frame: int, rng: Rng, part: float, size_px: int = 8) -> Pixels:
    """Know nothing of squares of depth: sunlight, dark or shiny surfaces."""
    height, width = pixels.shape[:2]
    is_hole = rng.random((height // size_px + 1, width // size_px + 1)) < part
    spread = is_hole.repeat(size_px, axis=0).repeat(size_px, axis=1)[:height, :width]
    return np.where(spread, np.nan, pixels).astype(pixels.dtype)


def saturated(pixels: Pixels, frame: int, rng: Rng, depth_m: float) -> Pixels:
    """End depth at the sensor's range, also at unknown pixels."""
    return np.asarray(np.fmin(pixels, depth_m), dtype=pixels.dtype)


def rough(pixels: Pixels, frame: int, rng: Rng, sigma_m: float) -> Pixels:
    """Add noise to depth that grows with its square."""
    return (pixels + sigma_m * pixels**2 * rng.standard_normal(pixels.shape)).astype(pixels.dtype)


def half_written(pixels: Pixels, frame: int, rng: Rng, fill: str = "grey") -> Pixels:
    """Interrupt the transfer after half of the rows."""
    n_rows = len(pixels) // 2
    changed = pixels.copy()
    rest = changed[n_rows:]
    rest[:] = rng.integers(0, 256, rest.shape) if fill == "garbage" else 128
    return changed


def rows_shifted(pixels: Pixels, frame: int, rng: Rng, most_px: int = 40) -> Pixels:
    """Put bands of rows out of place: bytes are missing in the transfer."""
    bands = np.array_split(pixels, 8)
    shifts = rng.integers(-most_px, most_px + 1, len(bands)).tolist()
    return np.concatenate(
        [np.roll(band, by, axis=1) for band, by in zip(bands, shifts, strict=True)]
    )


def upside_down(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    return np.ascontiguousarray(pixels[::-1])


def mirrored(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    return np.ascontiguousarray(pixels[:, ::-1])


def transposed(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    return np.ascontiguousarray(pixels.swapaxes(0, 1))


def halved(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    return np.ascontiguousarray(pixels[::2, ::2])


def of_type(pixels: Pixels, frame: int, rng: Rng, dtype: str) -> Pixels:
    return np.nan_to_num(pixels).astype(dtype)


def in_colour(pixels: Pixels, frame: int, rng: Rng) -> Pixels:
    return np.dstack([pixels] * 3)


def shifted(pixels: Pixels, frame: int, rng: Rng, columns: int = 0, rows: int = 0) -> Pixels:
    """Shift against the other stream; nothing is known of what comes into view."""
    moved = np.roll(pixels, (rows, columns), axis=(0, 1))
    if pixels.dtype.kind == "f":
        moved[: max(rows, 0)] = moved[:, : max(columns, 0)] = np.nan
        moved[len(moved) + min(rows, 0) :] = moved[:, moved.shape[1] + min(columns, 0) :] = np.nan
    return moved
