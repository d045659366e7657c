"""ROS messages of images and calibrations."""

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.io.bag.messages import (
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
)
from tests.make.rvl import encode_rvl


def _message(
    pixels: NDArray[Any], encoding: str, *, padding: int = 0, is_bigendian: bool = False
) -> Any:
    """Serialise pixels row by row, each followed by padding."""
    height, width = pixels.shape[:2]
    dtype = pixels.dtype.newbyteorder(">" if is_bigendian else "<")
    rows = [row.astype(dtype).tobytes() + b"\xaa" * padding for row in pixels]
    return SimpleNamespace(
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(is_bigendian),
        step=len(rows[0]),
        data=np.frombuffer(b"".join(rows), np.uint8),
    )


_CHANNELS = {"bgr": [0, 1, 2], "rgb": [2, 1, 0], "bgra": [0, 1, 2, 0], "rgba": [2, 1, 0, 1]}
_COLOURS = [
    *[(f"{name}{bits}", channels) for name, channels in _CHANNELS.items() for bits in (8, 16)],
    *[(f"{bits}UC3", _CHANNELS["bgr"]) for bits in (8, 16)],
    *[(f"{bits}UC4", _CHANNELS["bgra"]) for bits in (8, 16)],
]


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize(("encoding", "channels"), _COLOURS)
def test_colours_come_in_the_order_blue_green_red(
    tiny: Any, encoding: str, channels: list[int], padding: int, is_bigendian: bool
) -> None:
    bgr = tiny.texture(1, is_color=True)
    stored = bgr[:, :, channels]
    if "16" in encoding:
        stored = stored * np.uint16(256) + 7  # the lower byte is lost
    message = _message(stored, encoding, padding=padding, is_bigendian=is_bigendian)
    np.testing.assert_array_equal(decode_grey_or_color(message, "/image"), bgr)


_PATTERNS = ["rggb", "bggr", "gbrg", "grbg"]


def _patches() -> NDArray[np.uint8]:
    """Return four flat colours, each 16 pixels wide and high, in BGR order."""
    colours = np.array([[(30, 100, 200), (250, 5, 60)], [(0, 255, 10), (90, 80, 70)]], np.uint8)
    return colours.repeat(16, axis=0).repeat(16, axis=1)


def _mosaic(bgr: NDArray[Any], pattern: str) -> NDArray[Any]:
    """Keep of each pixel the colour of its filter; the pattern names two rows of two."""
    mosaic = np.empty_like(bgr[:, :, 0])
    for place, name in enumerate(pattern):
        cells = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        mosaic[cells] = bgr[:, :, "bgr".index(name)][cells]
    return mosaic


def _assert_patches(pixels: NDArray[np.uint8]) -> None:
    assert pixels.shape == (32, 32, 3)
    for top in (0, 16):
        for left in (0, 16):
            inside = (slice(top + 2, top + 14), slice(left + 2, left + 14))
            np.testing.assert_array_equal(pixels[inside], _patches()[inside])


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", _PATTERNS)
def test_bayer_patterns_give_back_flat_colours(pattern: str, bits: int, is_bigendian: bool) -> None:
    mosaic = _mosaic(_patches(), pattern)
    if bits == 16:
        mosaic = mosaic * np.uint16(256)
    message = _message(mosaic, f"bayer_{pattern}{bits}", padding=4, is_bigendian=is_bigendian)
    _assert_patches(decode_grey_or_color(message, "/image"))


def _bgr_of_yuv(yuv: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Convert by the formula of ITU-R BT.601 for values of 16 to 235."""
    y, u, v = (yuv[..., k].astype(float) - offset for k, offset in enumerate((16, 128, 128)))
    b, g, r = 2.018 * u, -0.391 * u - 0.813 * v, 1.596 * v
    return np.clip(np.stack([b, g, r], axis=-1) + 1.164 * y[..., np.newaxis], 0, 255)


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_pixels_that_share_colour_by_twos_follow_the_formula(encoding: str, padding: int) -> None:
    yuv = np.random.default_rng(0).integers(16, 236, (6, 8, 3), dtype=np.uint8)
    yuv[:, 1::2, 1:] = yuv[:, ::2, 1:]
    luma = 1 if encoding in ("yuv422", "uyvy") else 0
    stored = np.empty((6, 8, 2), np.uint8)
    stored[:, :, luma] = yuv[:, :, 0]
    stored[:, ::2, 1 - luma], stored[:, 1::2, 1 - luma] = yuv[:, ::2, 1], yuv[:, ::2, 2]
    decoded = decode_grey_or_color(_message(stored, encoding, padding=padding), "/image")
    assert np.abs(decoded - _bgr_of_yuv(yuv)).max() <= 1.5


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_planes_of_colour_below_grey_follow_the_formula(encoding: str, padding: int) -> None:
    rng = np.random.default_rng(0)
    grey = rng.integers(16, 236, (6, 8), dtype=np.uint8)
    chroma = rng.integers(0, 256, (3, 4, 2), dtype=np.uint8)
    order = [0, 1] if encoding == "nv12" else [1, 0]
    message = _message(
        np.vstack([grey, chroma[:, :, order].reshape(3, 8)]), encoding, padding=padding
    )
    message.height = 6
    yuv = np.dstack([grey, chroma.repeat(2, axis=0).repeat(2, axis=1)])
    assert np.abs(decode_grey_or_color(message, "/image") - _bgr_of_yuv(yuv)).max() <= 1.5


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_depth_is_counts_or_metres(tiny: Any, is_bigendian: bool) -> None:
    for encoding in ("16UC1", "mono16"):
        message = _message(tiny.counts(1), encoding, is_bigendian=is_bigendian, padding=2)
        np.testing.assert_array_equal(decode_depth(message, 5000.0, "/depth"), tiny.depth(1))
    message = _message(tiny.depth(1), "32FC1", is_bigendian=is_bigendian)
    np.testing.assert_array_equal(decode_depth(message, 5000.0, "/depth"), tiny.depth(1))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"encoding": "jpeg2000"}, "encoding 'jpeg2000' is not supported"),
        ({"width": 0}, "no pixels"),
        ({"height": 0}, "no pixels"),
        ({"width": 2**31}, "needs"),
        ({"height": 2**31}, "needs"),
        ({"step": 1}, "needs"),
        ({"step": 2**31}, "needs"),
        ({"step": 0, "data": np.zeros(5, np.uint8)}, "rows of 0 bytes .* got 5"),
        ({"data": np.zeros(5, np.uint8)}, "got 5"),
        ({"data": np.zeros(0, np.uint8)}, "got 0"),
    ],
)
def test_an_image_whose_header_does_not_fit_its_data_is_refused(
    tiny: Any, changes: dict[str, Any], text: str
) -> None:
    message = _message(tiny.texture(1), "mono8")
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(RecordingError, match=f"/image: .*{text}"):
        decode_grey_or_color(message, "/image")


@pytest.mark.parametrize("encoding", ["mono8", "rgb8"])
def test_rows_are_packed_where_a_driver_leaves_the_step_zero(tiny: Any, encoding: str) -> None:
    message = _message(tiny.texture(1, is_color=encoding == "rgb8"), encoding)
    expected = decode_grey_or_color(message, "/image")
    message.step = 0
    np.testing.assert_array_equal(decode_grey_or_color(message, "/image"), expected)


def _compressed(pixels: NDArray[Any], format_: str, suffix: str = ".png") -> Any:
    """Encode pixels in BGR order as a file does."""
    _, data = cv2.imencode(suffix, pixels)
    return SimpleNamespace(format=format_, data=data.ravel())


@pytest.mark.parametrize(
    ("encoding", "formats"),
    [
        ("mono8", ["png", "mono8; png compressed ", "mono8;png"]),
        ("mono16", ["png", "mono16; png compressed "]),
        ("bgr8", ["png", "bgr8; png compressed bgr8", "rgb8; png compressed bgr8", "bgr8; png"]),
        ("bgr16", ["bgr16; png compressed bgr16"]),
        ("bgra8", ["bgra8; png compressed bgr8"]),
        *[(f"bayer_{p}8", [f"bayer_{p}8; png compressed "]) for p in _PATTERNS],
        *[(f"bayer_{p}16", [f"bayer_{p}16; png compressed "]) for p in _PATTERNS],
    ],
)
def test_png_changes_no_bit_of_a_raw_image(tiny: Any, encoding: str, formats: list[str]) -> None:
    stored = tiny.texture(1, is_color="bgr" in encoding)
    if encoding == "bgra8":
        stored = np.dstack([stored, tiny.texture(2)])
    if "16" in encoding:
        stored = stored * np.uint16(257)
    raw = decode_grey_or_color(_message(stored, encoding), "/image")
    for format_ in formats:
        pixels = decode_compressed(_compressed(stored, format_), "/image")
        np.testing.assert_array_equal(pixels, raw)


@pytest.mark.parametrize(
    ("stored", "format_"),
    [
        ("bgr", "jpeg"),
        ("bgr", "jpg"),
        ("bgr", "rgb8; jpeg compressed bgr8"),
        ("bgr", "bgr8; jpeg compressed bgr8"),
        ("bgr", "bayer_rggb8; jpeg compressed bgr8"),
        ("bgr", "yuv422; jpeg compressed bgr8"),
        ("rgb", "rgb8; jpeg compressed rgb8"),
        ("rgb", "bgr8; jpeg compressed rgb8"),
    ],
)
def test_jpeg_colours_are_right_in_every_form_of_the_transport(stored: str, format_: str) -> None:
    pixels = _patches() if stored == "bgr" else _patches()[:, :, ::-1]
    decoded = decode_compressed(_compressed(pixels, format_, ".jpg"), "/image")
    inside = (slice(4, 12), slice(4, 12))  # one of the four colours is enough
    assert np.abs(decoded[inside].astype(int) - _patches()[inside]).max() <= 8


def test_damaged_and_foreign_compressed_images_are_refused_with_their_format(tiny: Any) -> None:
    message: Any = _compressed(tiny.texture(1), "mono8; png compressed ")
    message.data = message.data[:50]
    with pytest.raises(RecordingError, match="/image"):
        decode_compressed(message, "/image")
    message = SimpleNamespace(format="h264", data=np.arange(100, dtype=np.uint8))
    with pytest.raises(RecordingError, match=r"/image \(h264\): .*expected PNG, JPEG"):
        decode_compressed(message, "/image")


@pytest.mark.parametrize(
    ("format_", "n_header"),
    [
        ("16UC1; compressedDepth png", 12),
        ("16UC1; compressedDepth", 12),
        ("mono16; compressedDepth", 12),
        ("16UC1; compressedDepth png", 0),  # from writers that forget the header
        ("16UC1; png compressed ", 0),
        ("png", 0),
    ],
)
def test_compressed_depth_of_integers_is_exact(tiny: Any, format_: str, n_header: int) -> None:
    message = _compressed(tiny.counts(1), format_)
    message.data = np.concatenate([np.zeros(n_header, np.uint8), message.data])
    depth = decode_compressed_depth(message, 5000.0, "/depth")
    np.testing.assert_array_equal(depth, tiny.depth(1))


@pytest.mark.parametrize("coder", ["png", "rvl"])
def test_compressed_depth_of_floats_is_inverse_depth(tiny: Any, coder: str) -> None:
    # as the transport writes it: counts = a / depth + b, 0 = unknown
    quantization, largest = 100.0, 10.0
    a = quantization * (quantization + 1.0)
    b = 1.0 - a / largest
    depth = tiny.depth(1)
    counts = np.nan_to_num(a / depth + b, nan=0.0).astype(np.uint16)
    code = cv2.imencode(".png", counts)[1].tobytes() if coder == "png" else encode_rvl(counts)
    data = np.frombuffer(struct.pack("<iff", 0, a, b) + code, np.uint8)
    message: Any = SimpleNamespace(format=f"32FC1; compressedDepth {coder}", data=data)
    decoded = decode_compressed_depth(message, 5000.0, "/depth")
    np.testing.assert_array_equal(np.isnan(decoded), np.isnan(depth))
    # rounding down by one count: depth^2 / a
    is_known = np.isfinite(depth)
    errors = (decoded - depth)[is_known]
    assert errors.min() > -1e-5
    assert np.all(errors < 1.01 * depth[is_known] ** 2 / a + 1e-5)
