"""What a camera's description says, as it stands in a `CameraInfo` message or a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from gvo.bounded_text import shortened
from gvo.errors import CalibrationError
from gvo.types import FloatArray

_LARGEST_NUMBER = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionOfInterest:
    """The part of the full image that was recorded; of width 0, all of it.

    Parameters
    ----------
    x_offset, y_offset : int
        Its first pixel, in pixels of the full image before binning.
    width, height : int
        Its size, in pixels of the full image before binning.
    """

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFields:
    """What a `CameraInfo` says, as it stands there.

    Parameters
    ----------
    where : str
        File or topic, for messages.
    width, height : int
        Size of the full image, pixels.
    model : str
        Distortion model.
    K, D, R, P : array_like of float
        9, 0 to 14, 9 and 12 numbers; R and P of zeros mean "not set". K and P are of the full
        image.
    binning : tuple of two ints
        How many columns and rows became one after the region was cut out; 0 means 1.
    roi : RegionOfInterest
        What was cut out.
    frame_id : str
        Of the camera in `/tf`, without a leading slash; empty where not known.
    is_distorted_by_zeros : bool
        D of zeros is meant: for `equidistant` no pinhole. Otherwise it says "no distortion".
    """

    where: str
    width: int
    height: int
    model: str
    K: ArrayLike
    D: ArrayLike
    R: ArrayLike
    P: ArrayLike
    binning: tuple[int, int] = (1, 1)
    roi: RegionOfInterest = RegionOfInterest()
    frame_id: str = ""
    is_distorted_by_zeros: bool = False

    @property
    def binning_factors(self) -> tuple[int, int]:
        """Columns and rows of the full image that became one."""
        return max(self.binning[0], 1), max(self.binning[1], 1)

    def recorded_size(self) -> tuple[int, int]:
        """Return width and height of the image as recorded, after region and binning.

        Raises
        ------
        CalibrationError
            When the region lies outside the full image.
        """
        roi = self.roi
        width = roi.width or self.width - roi.x_offset
        height = roi.height or self.height - roi.y_offset
        is_inside = roi.x_offset + width <= self.width and roi.y_offset + height <= self.height
        if (self.width > 0 and self.height > 0 and not is_inside) or min(width, height) < 0:
            raise CalibrationError(
                f"{self.where}: the region of {width}x{height} px at ({roi.x_offset}, "
                f"{roi.y_offset}) lies outside the full image of {self.width}x{self.height} px; "
                "mend roi, or give --calibration FILE of the images as recorded"
            )
        binning_x, binning_y = self.binning_factors
        return width // binning_x, height // binning_y


def read_numbers(values: object, what: str) -> FloatArray:
    """Return what a file or message holds as an array of one dimension.

    Parameters
    ----------
    values : object
        Numbers, nested or not; texts of numbers, as YAML reads `1e-5`.
    what : str
        File and key, for messages.

    Returns
    -------
    ndarray of float64, shape (n,)

    Raises
    ------
    CalibrationError
        When they are none, not finite, or larger than any calibration holds.
    """
    try:
        numbers = np.array(cast(ArrayLike, values), dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{what} must hold numbers, got {shortened(values)}") from error
    if not np.all(np.isfinite(numbers)):
        raise CalibrationError(f"{what} holds a value that is not finite")
    if np.any(np.abs(numbers) > _LARGEST_NUMBER):
        raise CalibrationError(f"{what} holds {np.abs(numbers).max():g}, which no camera has")
    return numbers
