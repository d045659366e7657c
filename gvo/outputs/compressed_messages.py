"""Messages of compressed images, written to bags of ROS 1 or ROS 2."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from gvo.outputs.bag_messages import BagWriter, Header
from gvo.outputs.depth_counts import exact_counts
from gvo.outputs.image_files import encode_jpeg, encode_png, encode_tiff
from gvo.sources.pixels import MILLIMETRES
from gvo.sources.topics import COMPRESSED_TYPE
from gvo.types import DepthArray, ImageArray

# The transport's header: how the depth is quantised, of which counts of 16 bits make no use.
_DEPTH_HEADER = struct.pack("<iff", 0, 0.0, 0.0)


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
        _write(bag, topic, "32FC1; tiff compressed ", encode_tiff(depth), header)
    else:
        _write(bag, topic, "16UC1; compressedDepth", _DEPTH_HEADER + encode_png(counts), header)


def write_picture(bag: BagWriter, topic: str, header: Header, image: ImageArray) -> None:
    """Write a picture as JPEG.

    Parameters
    ----------
    bag : BagWriter
        Open.
    topic : str
        Where to; by convention it ends in `/compressed`.
    header : Header
        Stamp and frame of the camera.
    image : ndarray of uint8, shape (height, width, 3)
        BGR.
    """
    _write(bag, topic, "jpeg", encode_jpeg(image), header)


def _write(bag: BagWriter, topic: str, kind: str, data: bytes, header: Header) -> None:
    message = bag.make(
        COMPRESSED_TYPE,
        header=bag.header(header),
        format=kind,
        data=np.frombuffer(data, dtype=np.uint8),
    )
    bag.write(topic, COMPRESSED_TYPE, message, header.stamp_ns)
