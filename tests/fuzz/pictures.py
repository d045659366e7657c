"""Pictures: as messages hold them, encoded, and RVL."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.io.bag.image_encodings import DEPTHS, IMAGES, decode_rvl
from gvo.io.bag.messages import (
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
)
from gvo.io.images import GreyRange
from tests.fuzz.mutations import mutate_picture
from tests.fuzz.target import Choices, Target
from tests.make.rvl import encode_rvl

_FORMATS = (
    *("jpeg", "png", "rgb8; jpeg compressed bgr8", "rgb8; tiff compressed rgb8"),
    *("bayer_rggb8; png compressed ", "bayer_gbrg16; png compressed ", "16UC1; compressedDepth"),
    *("16UC1; compressedDepth png", "16UC1; compressedDepth rvl", "32FC1; compressedDepth png"),
    *("32FC1; compressedDepth rvl", ""),
)
_RANGES = (GreyRange(), GreyRange(white=4095))


def _raw_image(data: bytes) -> None:
    choices = Choices(data)
    is_depth = choices.below(2) == 1
    encoding = choices.pick([*DEPTHS] if is_depth else [*IMAGES, "", "h264"])
    height, width = choices.integer(1), choices.integer(1)
    is_true = choices.below(4) > 0
    if choices.below(8) == 7:
        height, width = choices.integer(4), choices.integer(4)
    known = {**IMAGES, **DEPTHS}.get(encoding)
    pixel = known.n_channels * int(known.dtype[1]) if known else 1
    step = width * pixel + choices.below(4) if is_true else choices.integer(4)
    rows = height * (known.rows_per_two if known else 2) // 2
    n_bytes = min(step * rows, 1 << 20) if is_true else choices.below(4096)
    start = choices.rest
    content = (start * (n_bytes // max(len(start), 1) + 1))[:n_bytes] if start else bytes(n_bytes)
    message: Any = SimpleNamespace(
        encoding=encoding,
        height=height,
        width=width,
        step=step,
        is_bigendian=choices.below(2),
        data=np.frombuffer(content, dtype=np.uint8),
    )
    if is_depth:
        decode_depth(message, 1000.0, "/depth")
    else:
        decode_grey_or_color(message, "/image", choices.pick(_RANGES))


def _raw_seeds() -> list[bytes]:
    return [
        bytes([is_depth, number, 8, 6, is_true, 0, 0, 0]) + bytes(range(40, 70))
        for is_depth in (0, 1)
        for number in range(3 if is_depth else len(IMAGES) + 2)
        for is_true in (0, 1)
    ]


def _encoded_image(data: bytes) -> None:
    choices = Choices(data)
    number, is_depth = choices.below(len(_FORMATS)), choices.below(2) == 1
    content = np.frombuffer(choices.rest, dtype=np.uint8)
    message: Any = SimpleNamespace(format=_FORMATS[number], data=content)
    if is_depth:
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
    Target(name="raw_images", run=_raw_image, seeds=_raw_seeds),
    Target(name="encoded_images", run=_encoded_image, seeds=_encoded_seeds, mutate=mutate_picture),
    Target(
        name="rvl", run=lambda data: decode_rvl(np.frombuffer(data, np.uint8), ""), seeds=_rvl_seeds
    ),
)
