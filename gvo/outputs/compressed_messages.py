"""Messages of compressed images, written to bags of ROS 1 or ROS 2."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.outputs.bag_messages import BagWriter, Header
from gvo.outputs.depth_counts import MILLIMETRES, exact_counts
from gvo.sources.topics import COMPRESSED_TYPE
from gvo.types import DepthArray

# The transport's header: how the depth is quantised, of which counts of 16 bits make no use.
_DEPTH_HEADER = struct.pack("<iff", 0, 0.0, 0.0)


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


def write_compressed(bag: BagWriter, topic: str, pixels: NDArray[np.uint8], header: Header) -> None:
    """Write an image as PNG, without loss.

    Parameters
    ----------
    bag : BagWriter
        Open.
    topic : str
        Where to; ends in `/compressed`.
    pixels : ndarray of uint8, shape (h, w) or (h, w, 3)
        Grey, or colour in BGR order.
    header : Header
        Stamp and frame.
    """
    encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    kind = f"{encoding}; png compressed {'' if pixels.ndim == 2 else encoding}"
    _write(bag, topic, kind, encode_png(pixels), header)


def write_compressed_depth(bag: BagWriter, topic: str, depth: DepthArray, header: Header) -> None:
    """Write depth without loss: in whole millimetres as the transport `compressedDepth` does.

    Parameters
    ----------
    bag : BagWriter
        Open.
    topic : str
        Where to; ends in `/compressedDepth`.
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown; as TIFF where it is not of whole millimetres, or beyond 65.5 m.
    header : Header
        Stamp and frame.
    """
    counts = exact_counts(depth, MILLIMETRES)
    if counts is None:
        _write(bag, topic, "32FC1; tiff compressed ", _encode(".tiff", depth), header)
    else:
        _write(bag, topic, "16UC1; compressedDepth", _DEPTH_HEADER + encode_png(counts), header)


def _encode(suffix: str, pixels: NDArray[Any]) -> bytes:
    is_encoded, data = cv2.imencode(suffix, pixels)
    if not is_encoded:
        raise RecordingError(
            f"an image of {pixels.dtype} {pixels.shape} cannot be written as {suffix[1:].upper()}"
        )
    return data.tobytes()


def _write(bag: BagWriter, topic: str, kind: str, data: bytes, header: Header) -> None:
    message = bag.make(
        COMPRESSED_TYPE,
        header=bag.header(header),
        format=kind,
        data=np.frombuffer(data, dtype=np.uint8),
    )
    bag.write(topic, COMPRESSED_TYPE, message, header.stamp_ns)
