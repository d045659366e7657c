"""ROS messages of images and calibrations, decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.calibration import CameraFields
from gvo.sources.pixels import decode_image, depth_from_counts, depth_from_metres, to_8_bit
from gvo.types import DepthArray, FloatArray, ImageArray

_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")


class StampMessage(Protocol):
    """`builtin_interfaces/Time`."""

    sec: int
    nanosec: int


class HeaderMessage(Protocol):
    """`std_msgs/Header`."""

    stamp: StampMessage
    frame_id: str


class ImageMessage(Protocol):
    """`sensor_msgs/Image`."""

    header: HeaderMessage
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]


class CompressedImageMessage(Protocol):
    """`sensor_msgs/CompressedImage`."""

    header: HeaderMessage
    format: str
    data: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Encoding:
    dtype: str
    n_channels: int
    to_bgr: int | None = None


_ENCODINGS = {
    "mono8": _Encoding("u1", 1),
    "8UC1": _Encoding("u1", 1),
    "mono16": _Encoding("u2", 1),
    "16UC1": _Encoding("u2", 1),
    "bgr8": _Encoding("u1", 3),
    "8UC3": _Encoding("u1", 3),
    "rgb8": _Encoding("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": _Encoding("u1", 4),
    "8UC4": _Encoding("u1", 4),
    "rgba8": _Encoding("u1", 4, cv2.COLOR_RGBA2BGRA),
    "bgr16": _Encoding("u2", 3),
    "rgb16": _Encoding("u2", 3, cv2.COLOR_RGB2BGR),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": _Encoding("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": _Encoding("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": _Encoding("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": _Encoding("u1", 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": _Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": _Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": _Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": _Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
}
_DEPTH_ENCODINGS = {
    "16UC1": _Encoding("u2", 1),
    "mono16": _Encoding("u2", 1),
    "32FC1": _Encoding("f4", 1),
}


def stamp_of(header: HeaderMessage) -> int:
    """Return the stamp of a header in nanoseconds.

    Parameters
    ----------
    header : std_msgs/Header
        Of ROS 1 or ROS 2.
    """
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def decode_grey_or_color(message: ImageMessage, where: str) -> ImageArray:
    """Return the pixels of an `Image` message.

    Parameters
    ----------
    message : sensor_msgs/Image
        Of an 8- or 16-bit grey, colour, Bayer or YUV 4:2:2 encoding.
    where : str
        The topic, for messages.

    Returns
    -------
    ndarray of uint8, shape (height, width) or (height, width, 3)
        Grey, or colour in BGR order; 16 bits are shifted to 8.

    Raises
    ------
    RecordingError
        When the encoding is unknown, or size and data do not belong together.
    """
    encoding = _lookup(message.encoding, _ENCODINGS, where)
    pixels = _pixels(message, encoding, where)
    if encoding.to_bgr is not None:
        try:
            pixels = np.asarray(cv2.cvtColor(pixels, encoding.to_bgr))
        except cv2.error as error:
            raise RecordingError(
                f"{where}: {message.width}x{message.height} pixels cannot be {message.encoding}"
            ) from error
    return to_8_bit(pixels, where)


def decode_depth(message: ImageMessage, scale: float, where: str) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of an `Image` message of depth.

    Parameters
    ----------
    message : sensor_msgs/Image
        16UC1 or mono16 counts, or 32FC1 metres.
    scale : float
        Counts per metre.
    where : str
        The topic, for messages.

    Raises
    ------
    RecordingError
        When the encoding is no depth, or size and data do not belong together.
    """
    encoding = _lookup(message.encoding, _DEPTH_ENCODINGS, where)
    pixels = _pixels(message, encoding, where)
    if encoding.dtype == "f4":
        return depth_from_metres(pixels)
    return depth_from_counts(pixels, scale, where)


def decode_compressed(message: CompressedImageMessage, where: str) -> ImageArray:
    """Return the pixels of a `CompressedImage` message.

    Parameters
    ----------
    message : sensor_msgs/CompressedImage
        Of any format that OpenCV reads.
    where : str
        The topic, for messages.

    Returns
    -------
    ndarray of uint8, shape (h, w) or (h, w, 3)
        Grey, or colour in BGR order.

    Raises
    ------
    RecordingError
        When the image is damaged.
    """
    return to_8_bit(decode_image(np.asarray(message.data), where), where)


def decode_compressed_depth(
    message: CompressedImageMessage, scale: float, where: str
) -> DepthArray:
    """Return metres (h, w), NaN = unknown, of a `CompressedImage` message of depth.

    Parameters
    ----------
    message : sensor_msgs/CompressedImage
        A 16-bit PNG, plain or of the transport `compressedDepth`.
    scale : float
        Counts per metre of integer depth.
    where : str
        The topic, for messages.

    Raises
    ------
    RecordingError
        When the image is damaged or no depth.
    """
    data = np.asarray(message.data)
    if "compressedDepth" not in message.format:
        return depth_from_counts(decode_image(data, where), scale, where)
    header_size = _COMPRESSED_DEPTH_HEADER.size
    counts = decode_image(data[header_size:], where)
    if not message.format.startswith("32FC1"):
        return depth_from_counts(counts, scale, where)
    # The transport keeps floats as counts of inverse depth: depth = a / (counts - b).
    _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(data[:header_size].tobytes())
    counts_of_one_per_metre = depth_from_counts(counts, 1.0, where)
    with np.errstate(divide="ignore", invalid="ignore"):
        return depth_from_metres(np.float32(a) / (counts_of_one_per_metre - np.float32(b)))


def camera_fields(message: Any, where: str) -> CameraFields:  # noqa: ANN401 - ROS 1 or 2
    """Return the fields of a `CameraInfo` message.

    Parameters
    ----------
    message : sensor_msgs/CameraInfo
        With D, K, R, P of ROS 1, or d, k, r, p of ROS 2.
    where : str
        Bag and topic, for messages.

    Returns
    -------
    CameraFields
        As they stand there, not checked.
    """
    return CameraFields(
        where=where,
        width=int(message.width),
        height=int(message.height),
        model=str(message.distortion_model),
        K=_matrix(message, "K"),
        D=_matrix(message, "D"),
        R=_matrix(message, "R"),
        P=_matrix(message, "P"),
    )


def _matrix(message: Any, name: str) -> FloatArray:  # noqa: ANN401 - ROS 1 or 2
    name_found = name if hasattr(message, name) else name.lower()
    return np.asarray(getattr(message, name_found), dtype=np.float64)


def _lookup(name: str, encodings: dict[str, _Encoding], where: str) -> _Encoding:
    if name not in encodings:
        raise RecordingError(
            f"{where}: encoding {name!r} is not supported, expected one of {', '.join(encodings)}"
        )
    return encodings[name]


def _pixels(message: ImageMessage, encoding: _Encoding, where: str) -> NDArray[Any]:
    """Return a view of the pixels, in native byte order; nothing is allocated before checks."""
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width = int(message.height), int(message.width)
    step, n_bytes = int(message.step), len(message.data)
    row_bytes = width * encoding.n_channels * dtype.itemsize
    if height <= 0 or width <= 0:
        raise RecordingError(f"{where}: the image has no pixels ({width}x{height})")
    if step < row_bytes or n_bytes != step * height:
        raise RecordingError(
            f"{where}: a {message.encoding} image of {width}x{height} with rows of {step} bytes "
            f"needs {max(step, row_bytes) * height} bytes, got {n_bytes}"
        )
    shape = (height, width, encoding.n_channels)
    pixels: NDArray[Any] = np.ndarray(
        shape,
        dtype,
        buffer=np.ascontiguousarray(message.data).data,
        strides=(step, encoding.n_channels * dtype.itemsize, dtype.itemsize),
    )
    if encoding.n_channels == 1:
        pixels = pixels[:, :, 0]
    return np.ascontiguousarray(pixels, dtype=dtype.newbyteorder("="))
