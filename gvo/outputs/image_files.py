"""Images as files in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.types import ImageArray


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Return an image as a PNG file.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (h, w) or (h, w, 3)
        Grey, or colour in BGR order.

    Raises
    ------
    RecordingError
        When it cannot be one.
    """
    return _encode(".png", pixels)


def encode_tiff(pixels: NDArray[Any]) -> bytes:
    """Return an image as a TIFF file.

    Parameters
    ----------
    pixels : ndarray of float32, shape (h, w)

    Raises
    ------
    RecordingError
        When it cannot be one.
    """
    return _encode(".tiff", pixels)


def encode_jpeg(image: ImageArray, *, quality: int = 80) -> bytes:
    """Return a picture as a JPEG file.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width, 3)
        BGR.
    quality : int
        0 to 100.

    Raises
    ------
    RecordingError
        When it cannot be one.
    """
    return _encode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def _encode(suffix: str, pixels: NDArray[Any], parameters: Sequence[int] = ()) -> bytes:
    is_encoded, data = cv2.imencode(suffix, pixels, parameters)
    if not is_encoded:
        raise RecordingError(
            f"an image of {pixels.dtype} {pixels.shape} cannot be written as {suffix[1:].upper()}"
        )
    return data.tobytes()
