"""Pictures: encoded, and RVL."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.io.bag.image_encodings import decode_rvl
from gvo.io.bag.messages import (
    decode_compressed,
    decode_compressed_depth,
)
from tests.fuzz.mutations import mutate_picture
from tests.fuzz.target import Target
from tests.make.rvl import encode_rvl

_FORMATS = (
    *("jpeg", "png", "rgb8; jpeg compressed bgr8", "rgb8; tiff compressed rgb8"),
    *("bayer_rggb8; png compressed ", "bayer_gbrg16; png compressed ", "16UC1; compressedDepth"),
    *("16UC1; compressedDepth png", "16UC1; compressedDepth rvl", "32FC1; compressedDepth png"),
    *("32FC1; compressedDepth rvl", ""),
)


def _encoded_image(data: bytes) -> None:
    """Take the first byte for the format, the second for depth or not."""
    number, is_depth = data.ljust(2, b"\0")[:2]
    content = np.frombuffer(data[2:], dtype=np.uint8)
    message: Any = SimpleNamespace(format=_FORMATS[number % len(_FORMATS)], data=content)
    if is_depth % 2:
        decode_compressed_depth(message, 1000.0, "/depth")
    else:
        decode_compressed(message, "/image")


def _encoded_files() -> list[bytes]:
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 255, (6, 8), dtype=np.uint8)
    colour = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    counts = rng.integers(0, 60000, (6, 8), dtype=np.uint16)
    metres = rng.uniform(0, 9, (6, 8)).astype(np.float32)
    kinds: list[tuple[str, NDArray[Any]]] = [
        (".png", grey),
        (".png", colour),
        (".png", counts),
        (".jpg", grey),
        (".jpg", colour),
        (".tiff", grey),
        (".tiff", metres),
        (".tiff", colour.astype(np.float64)),
        (".bmp", colour),
        (".pgm", grey),
        (".ppm", colour),
        (".pbm", grey & 1),
    ]
    return [cv2.imencode(suffix, pixels)[1].tobytes() for suffix, pixels in kinds]


def _encoded_seeds() -> list[bytes]:
    header = np.array([0], "<i4").tobytes() + np.array([2.0, 0.1], "<f4").tobytes()
    png, rvl = _encoded_files()[2], encode_rvl(np.arange(48, dtype=np.uint16).reshape(6, 8))
    plain = [
        bytes([number, is_depth]) + file
        for number, file in enumerate(_encoded_files())
        for is_depth in (0, 1)
    ]
    return [
        *plain,
        *(bytes([number, 1]) + header + png for number in (6, 7, 9)),
        *(bytes([number, 1]) + header + rvl for number in (8, 10)),
    ]


def _rvl_seeds() -> list[bytes]:
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 60000, (5, 7), dtype=np.uint16) for _ in range(3)]
    images[1][::2] = 0
    images[2][:] = 0
    return [encode_rvl(image) for image in images]


TARGETS = (
    Target(name="encoded_images", run=_encoded_image, seeds=_encoded_seeds, mutate=mutate_picture),
    Target(
        name="rvl", run=lambda data: decode_rvl(np.frombuffer(data, np.uint8), ""), seeds=_rvl_seeds
    ),
)
