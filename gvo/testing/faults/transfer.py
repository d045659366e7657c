"""Faults of transfer and drivers: torn, turned, resized images, pixels of a wrong type."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np

from gvo.testing.faults.fault import FaultyImage, Kind, PixelFault, Pixels

Turn: TypeAlias = Literal["upside down", "mirrored", "half turn", "transposed"]
PixelType: TypeAlias = Literal["float64", "float32", "uint16", "int32", "bool", "colour", "flat"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _AnyImageFault(PixelFault):
    """A fault of images of all kinds."""

    def kinds(self) -> tuple[Kind, ...]:
        """Return all kinds."""
        return ("image", "depth")


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfWritten(PixelFault):
    """Images whose transfer was interrupted.

    Parameters
    ----------
    part : float
        Share of the rows that arrived.
    fill : {"grey", "garbage", "former"}
        Content of the others: one value, noise, or the upper rows again.
    """

    part: float = 0.5
    fill: Literal["grey", "garbage", "former"] = "grey"

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the image with other pixels below."""
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
    """Rows out of place: bytes missing in the transfer.

    Parameters
    ----------
    most_px : int
        Limit of the random shift of each of eight bands of rows, pixels.
    """

    most_px: int = 40

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the image with bands of rows rolled."""
        bands = np.array_split(pixels, 8)
        shifts = rng.integers(-self.most_px, self.most_px + 1, len(bands)).tolist()
        rolled = [np.roll(band, by, axis=1) for band, by in zip(bands, shifts, strict=True)]
        return np.concatenate(rolled)


@dataclass(frozen=True, slots=True, kw_only=True)
class Turned(_AnyImageFault):
    """Images turned or mirrored by the mounting of the camera or a setting of the driver.

    Parameters
    ----------
    how : {"upside down", "mirrored", "half turn", "transposed"}
        Rows in opposite order, columns in opposite order, both, or rows and columns exchanged.
    """

    how: Turn = "upside down"

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the image, turned."""
        views = {
            "upside down": pixels[::-1],
            "mirrored": pixels[:, ::-1],
            "half turn": pixels[::-1, ::-1],
            "transposed": pixels.swapaxes(0, 1),
        }
        return np.ascontiguousarray(views[self.how])


@dataclass(frozen=True, slots=True, kw_only=True)
class Resized(_AnyImageFault):
    """Images of another size than that of the calibration.

    Parameters
    ----------
    factor : float
    """

    factor: float = 0.5

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the image, smaller or larger."""
        size = [max(round(self.factor * length), 1) for length in pixels.shape[1::-1]]
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST))


@dataclass(frozen=True, slots=True, kw_only=True)
class OfType(_AnyImageFault):
    """Pixels of a type or shape that a source must not give.

    Parameters
    ----------
    pixel_type : {"float64", "float32", "uint16", "int32", "bool", "colour", "flat"}
        "colour": three channels instead of one; "flat": all pixels in one row.
    """

    pixel_type: PixelType = "float64"

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the same values in another type."""
        if self.pixel_type == "flat":
            return pixels.reshape(-1)
        if self.pixel_type == "colour":
            return np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels
        dtype = np.dtype(self.pixel_type)
        is_whole = dtype.kind in "iub"
        return (np.nan_to_num(pixels) if is_whole else pixels).astype(dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shifted(_AnyImageFault):
    """Images shifted against those of the other stream: a knock on the rig, a wrong registration.

    Parameters
    ----------
    rows, columns : int
        Pixels, down and to the right; filled by the border, in depth by NaN.
    """

    rows: int = 0
    columns: int = 0

    def spoil(self, pixels: Pixels, rng: np.random.Generator, image: FaultyImage) -> Pixels:
        """Return the image, shifted."""
        pad = [(abs(self.rows),) * 2, (abs(self.columns),) * 2, *[(0, 0)] * (pixels.ndim - 2)]
        if pixels.dtype.kind == "f":
            padded = np.pad(pixels, pad, constant_values=np.nan)
        else:
            padded = np.pad(pixels, pad, mode="edge")
        v, u = abs(self.rows) - self.rows, abs(self.columns) - self.columns
        return np.ascontiguousarray(padded[v : v + pixels.shape[0], u : u + pixels.shape[1]])
