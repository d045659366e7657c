"""The encodings of `sensor_msgs/Image`: how the bytes of a message become pixels.

References
----------
`sensor_msgs/image_encodings.hpp` of ROS 2, with which those of ROS 1 agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.bounded_text import shortened
from gvo.errors import RecordingError


class RawImage(Protocol):
    """What `sensor_msgs/Image` says of its pixels."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Encoding:
    """How pixels are stored.

    Parameters
    ----------
    dtype : str
        Of a value, in numpy's words without the byte order.
    n_channels : int
        Values of a pixel.
    to_bgr : int, optional
        Code for `cv2.cvtColor`; None where the values are grey, BGR or BGRA already.
    rows_per_two : int
        Rows of values for two rows of pixels: 3 where planes of colour follow below.
    """

    dtype: str
    n_channels: int
    to_bgr: int | None = None
    rows_per_two: int = 2


def _of_both_depths(name: str, n_channels: int, to_bgr: int | None) -> dict[str, Encoding]:
    return {
        f"{name}8": Encoding("u1", n_channels, to_bgr),
        f"{name}16": Encoding("u2", n_channels, to_bgr),
    }


# OpenCV names a Bayer pattern by its second row, ROS by its first.
BAYER = (
    _of_both_depths("bayer_rggb", 1, cv2.COLOR_BayerBG2BGR)
    | _of_both_depths("bayer_bggr", 1, cv2.COLOR_BayerRG2BGR)
    | _of_both_depths("bayer_gbrg", 1, cv2.COLOR_BayerGR2BGR)
    | _of_both_depths("bayer_grbg", 1, cv2.COLOR_BayerGB2BGR)
)
"""Mosaics of colour filters."""

IMAGES = {
    "mono8": Encoding("u1", 1),
    "8UC1": Encoding("u1", 1),
    "mono16": Encoding("u2", 1),
    "16UC1": Encoding("u2", 1),
    **_of_both_depths("bgr", 3, None),
    **_of_both_depths("rgb", 3, cv2.COLOR_RGB2BGR),
    **_of_both_depths("bgra", 4, None),
    **_of_both_depths("rgba", 4, cv2.COLOR_RGBA2BGR),
    # without names the channels are in OpenCV's order
    "8UC3": Encoding("u1", 3),
    "8UC4": Encoding("u1", 4),
    "16UC3": Encoding("u2", 3),
    "16UC4": Encoding("u2", 4),
    **BAYER,
    "yuv422": Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
    "nv12": Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV12, 3),
    "nv21": Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV21, 3),
}
"""Encodings of grey and colour images."""

DEPTHS = {
    "16UC1": Encoding("u2", 1),
    "mono16": Encoding("u2", 1),
    "32FC1": Encoding("f4", 1),
}
"""Encodings of depth."""


def find_encoding(name: str, encodings: dict[str, Encoding], where: str) -> Encoding:
    """Look an encoding up by its name.

    Raises
    ------
    RecordingError
        When it is none of these.
    """
    if name not in encodings:
        raise RecordingError(
            f"{where}: encoding {shortened(name)} is not supported, expected one of "
            f"{', '.join(encodings)}"
        )
    return encodings[name]


def stored_pixels(image: RawImage, encoding: Encoding, where: str) -> NDArray[Any]:
    """Return the values of an image as stored, without the padding of its rows.

    Parameters
    ----------
    image : sensor_msgs/Image
        Of this encoding.
    encoding : Encoding
        By its name.
    where : str
        The topic, for messages.

    Returns
    -------
    ndarray, shape (rows, width) or (rows, width, channels)
        In native byte order. A view of the data where nothing has to be moved.

    Raises
    ------
    RecordingError
        When size and data do not belong together; nothing is allocated before.
    """
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if image.is_bigendian else "<")
    height, width = int(image.height), int(image.width)
    step, n_bytes = int(image.step), len(image.data)
    pixel_bytes = encoding.n_channels * dtype.itemsize
    if height <= 0 or width <= 0:
        raise RecordingError(f"{where}: the image has no pixels ({width}x{height})")
    rows, is_odd = divmod(height * encoding.rows_per_two, 2)
    row_bytes = width * pixel_bytes
    if is_odd or step < row_bytes or n_bytes != step * rows:
        raise RecordingError(
            f"{where}: a {image.encoding} image of {width}x{height} with rows of {step} bytes "
            f"needs {max(step, row_bytes) * rows} bytes, got {n_bytes}"
        )
    shape = (rows, width, encoding.n_channels)
    data = np.ascontiguousarray(image.data).data
    pixels: NDArray[Any] = np.ndarray(
        shape, dtype, data, strides=(step, pixel_bytes, dtype.itemsize)
    )
    if encoding.n_channels == 1:
        pixels = pixels[:, :, 0]
    return np.ascontiguousarray(pixels, dtype=dtype.newbyteorder("="))


def convert_to_bgr(pixels: NDArray[Any], to_bgr: int, what: str) -> NDArray[Any]:
    """Convert stored pixels to BGR.

    Parameters
    ----------
    pixels : ndarray
        As stored.
    to_bgr : int
        Code for `cv2.cvtColor`.
    what : str
        Topic, size and encoding, for the message.

    Raises
    ------
    RecordingError
        When the size is impossible, such as an odd width where pixels share their colour.
    """
    try:
        return np.asarray(cv2.cvtColor(pixels, to_bgr))
    except cv2.error as error:
        height, width = pixels.shape[:2]
        raise RecordingError(f"{what}: {width}x{height} values cannot be converted") from error
