"""ROS messages of images and calibrations."""

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.sources.messages import (
    camera_fields,
    decode_compressed,
    decode_compressed_depth,
    decode_depth,
    decode_grey_or_color,
    stamp_of,
)


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


@pytest.mark.parametrize("padding", [0, 1, 7])
@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_padding_after_the_rows_is_left_out(tiny: Any, encoding: str, padding: int) -> None:
    pixels = tiny.texture(1)
    message = _message(pixels, encoding, padding=padding)
    np.testing.assert_array_equal(decode_grey_or_color(message, "/image"), pixels)


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [
        ("bgr8", [0, 1, 2]),
        ("8UC3", [0, 1, 2]),
        ("rgb8", [2, 1, 0]),
        ("bgra8", [0, 1, 2, 0]),
        ("rgba8", [2, 1, 0, 1]),
    ],
)
def test_colours_come_in_the_order_blue_green_red(
    tiny: Any, encoding: str, channels: list[int]
) -> None:
    bgr = tiny.texture(1, is_color=True)
    message = _message(bgr[:, :, channels], encoding, padding=3)
    np.testing.assert_array_equal(decode_grey_or_color(message, "/image"), bgr)


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_sixteen_bit_grey_is_shifted_to_eight(tiny: Any, encoding: str, is_bigendian: bool) -> None:
    grey = tiny.texture(1)
    message = _message(grey * np.uint16(256) + 3, encoding, is_bigendian=is_bigendian)
    np.testing.assert_array_equal(decode_grey_or_color(message, "/image"), grey)


@pytest.mark.parametrize(
    ("encoding", "red", "blue"),
    [
        ("bayer_rggb8", (0, 0), (1, 1)),
        ("bayer_bggr8", (1, 1), (0, 0)),
        ("bayer_gbrg8", (1, 0), (0, 1)),
        ("bayer_grbg8", (0, 1), (1, 0)),
    ],
)
def test_bayer_patterns_give_back_a_plain_colour(
    encoding: str, red: tuple[int, int], blue: tuple[int, int]
) -> None:
    mosaic = np.full((8, 8), 100, np.uint8)  # green
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    mosaic[blue[0] :: 2, blue[1] :: 2] = 30
    pixels = decode_grey_or_color(_message(mosaic, encoding), "/image")
    np.testing.assert_array_equal(pixels[3:5, 3:5], np.full((2, 2, 3), (30, 100, 200)))


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_yuv_without_colour_is_grey(encoding: str, luma: int) -> None:
    pixels = np.full((4, 6, 2), 128, np.uint8)
    pixels[:, :, luma] = 126
    decoded = decode_grey_or_color(_message(pixels, encoding), "/image")
    assert decoded.shape == (4, 6, 3)
    assert np.ptp(decoded) <= 1


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


def test_colour_is_no_depth_and_floats_are_no_grey(tiny: Any) -> None:
    with pytest.raises(RecordingError, match="encoding 'bgr8'"):
        decode_depth(_message(tiny.texture(1, is_color=True), "bgr8"), 1000.0, "/depth")
    with pytest.raises(RecordingError, match="encoding '32FC1'"):
        decode_grey_or_color(_message(tiny.depth(1), "32FC1"), "/image")


def test_compressed_images_are_those_of_files(tiny: Any) -> None:
    pixels = tiny.texture(1, is_color=True)
    _, data = cv2.imencode(".png", pixels)
    message: Any = SimpleNamespace(format="bgr8; png compressed bgr8", data=data.ravel())
    np.testing.assert_array_equal(decode_compressed(message, "/image"), pixels)
    message.data = message.data[:50]
    with pytest.raises(RecordingError, match="/image"):
        decode_compressed(message, "/image")


@pytest.mark.parametrize("format_", ["16UC1; compressedDepth png", "16UC1; png compressed"])
def test_compressed_depth_of_integers_is_exact(tiny: Any, format_: str) -> None:
    _, data = cv2.imencode(".png", tiny.counts(1))
    header = bytes(12) if "compressedDepth" in format_ else b""
    data = np.frombuffer(header + data.tobytes(), np.uint8)
    message: Any = SimpleNamespace(format=format_, data=data)
    depth = decode_compressed_depth(message, 5000.0, "/depth")
    np.testing.assert_array_equal(depth, tiny.depth(1))


def test_compressed_depth_of_floats_is_inverse_depth(tiny: Any) -> None:
    # as the transport writes it: counts = a / depth + b, 0 = unknown
    a, b = 1000.0, 1.0
    depth = tiny.depth(1)
    counts = np.nan_to_num(a / depth + b, nan=0.0).astype(np.uint16)
    _, data = cv2.imencode(".png", counts)
    data = np.frombuffer(struct.pack("<iff", 0, a, b) + data.tobytes(), np.uint8)
    message: Any = SimpleNamespace(format="32FC1; compressedDepth png", data=data)
    decoded = decode_compressed_depth(message, 5000.0, "/depth")
    np.testing.assert_array_equal(np.isnan(decoded), np.isnan(depth))
    np.testing.assert_allclose(decoded, depth, rtol=0.02)


@pytest.mark.parametrize("spell", [str.upper, str.lower])
def test_camera_info_of_either_generation_is_read(spell: Any) -> None:
    matrices = {"D": np.arange(5.0), "K": np.arange(9.0), "R": np.eye(3), "P": np.arange(12.0)}
    spelt = {spell(name): values for name, values in matrices.items()}
    message = SimpleNamespace(width=48, height=32, distortion_model="plumb_bob", **spelt)
    fields = camera_fields(message, "/info")
    for name, values in matrices.items():
        np.testing.assert_array_equal(np.asarray(getattr(fields, name)), values)
    assert (fields.width, fields.height, fields.where) == (48, 32, "/info")


def test_stamps_are_exact() -> None:
    stamp = SimpleNamespace(sec=1403636584, nanosec=763555584)
    header: Any = SimpleNamespace(stamp=stamp, frame_id="")
    assert stamp_of(header) == 1403636584763555584
