"""Image files, ranges of grey, and depth as counts, both ways."""

import resource
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from gvo.config import ImagesConfig
from gvo.errors import RecordingError
from gvo.io.images import (
    MAX_COUNT,
    decode_image,
    depth_from_counts,
    depth_from_metres,
    exact_counts,
    is_in_counts,
    read_depth,
    read_image,
    to_8_bit,
    to_counts,
)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_a_truncated_file_is_refused(tmp_path: Path, tiny: Any, suffix: str, share: float) -> None:
    path = tmp_path / f"image{suffix}"
    tiny.write_image(path, tiny.texture(1, is_color=True))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=path.name):
        read_image(path)


def _encoded(pixels: NDArray[Any], suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def _data(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".pnm"])
@pytest.mark.parametrize("is_color", [False, True])
def test_formats_without_loss_are_decoded_unchanged(tiny: Any, suffix: str, is_color: bool) -> None:
    pixels = tiny.texture(1, is_color=is_color)
    np.testing.assert_array_equal(decode_image(_data(_encoded(pixels, suffix)), "image"), pixels)


def _bomb(suffix: str, pixels: NDArray[Any]) -> bytes:
    """Encode an image and let its header claim 60000 x 60000 pixels."""
    data = bytearray(_encoded(pixels, suffix))
    if suffix == ".png":
        data[16:24] = (60000).to_bytes(4, "big") * 2
    elif suffix == ".jpg":
        frame = data.index(b"\xff\xc0")
        data[frame + 5 : frame + 9] = (60000).to_bytes(2, "big") * 2
    elif suffix == ".bmp":
        data[18:26] = (60000).to_bytes(4, "little") * 2
    elif suffix == ".pgm":
        data = bytearray(data.replace(b"48 32", b"# wide\n60000 60000"))
    else:
        start = int.from_bytes(data[4:8], "little") + 2
        for entry in range(start, start + 12 * data[start - 2], 12):
            if int.from_bytes(data[entry : entry + 2], "little") in (256, 257):
                n_bytes = 2 if data[entry + 2] == 3 else 4
                data[entry + 8 : entry + 8 + n_bytes] = (60000).to_bytes(n_bytes, "little")
    return bytes(data)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm"])
def test_an_absurd_size_in_the_header_is_refused_before_memory_is_taken(
    tiny: Any, suffix: str
) -> None:
    data = _data(_bomb(suffix, tiny.texture(1)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match=r"60000x60000|cannot be decoded"):
        decode_image(data, "image")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_formats_whose_size_is_not_checked_are_refused(tiny: Any) -> None:
    with pytest.raises(RecordingError, match=r"expected PNG, JPEG, TIFF, BMP or PNM, but .*RIFF"):
        decode_image(_data(_encoded(tiny.texture(1), ".webp")), "image")


@pytest.mark.parametrize("n_zeros", [0, 10, 5000])
def test_a_jpeg_may_be_padded_by_zeros_and_fill_bytes(tiny: Any, n_zeros: int) -> None:
    data = _encoded(tiny.texture(1), ".jpg")
    padded = data[:2] + b"\xff\xff" + data[2:] + bytes(n_zeros)
    expected = decode_image(_data(data), "image")
    np.testing.assert_array_equal(decode_image(_data(padded), "image"), expected)


@given(black=st.integers(0, 65534), span=st.integers(1, 65535), seed=st.integers(0, 1000))
def test_a_range_keeps_order_and_has_black_and_white(black: int, span: int, seed: int) -> None:
    white = min(black + span, 65535)
    values = np.sort(np.random.default_rng(seed).integers(0, 65536, 50)).astype(np.uint16)
    values[[0, -1]] = black, white
    narrow = to_8_bit(np.sort(values), "image", ImagesConfig(black=black, white=white))
    assert np.all(np.diff(narrow.astype(int)) >= 0)
    assert np.all(narrow[np.sort(values) <= black] == 0)
    # with fewer than 256 steps the last one begins below 255
    lightest = 256 * (white - black) // (white - black + 1)
    assert np.all(narrow[np.sort(values) >= white] == lightest)


@pytest.mark.parametrize(("largest", "white"), [(4095, 4095), (1000, 1023), (700, 1023), (90, 255)])
def test_nearly_black_images_are_refused_with_what_to_set(largest: int, white: int) -> None:
    pixels = np.full((4, 4), largest, np.uint16)
    with pytest.raises(RecordingError, match=f"images.white={white}$"):
        to_8_bit(pixels, "image")
    assert to_8_bit(pixels, "image", ImagesConfig(white=white)).max() > 64
    assert to_8_bit(pixels + np.uint16(4096), "image").max() >= 16


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 6553.5])
def test_every_count_is_rounded_once_and_only_its_ends_are_unknown(scale: float) -> None:
    counts = np.arange(65536, dtype=np.uint16).reshape(128, 512)
    expected = [np.float32(count) / np.float32(scale) for count in range(65536)]
    expected[0] = expected[-1] = np.float32(np.nan)
    depth = depth_from_counts(counts, scale, "depth")
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth.ravel(), np.array(expected, dtype=np.float32))


def test_depth_of_which_all_unknown_is_marked_is_not_copied() -> None:
    marked = np.array([[0.5, np.nan], [65.0, 1e-3]], dtype=np.float32)
    assert depth_from_metres(marked) is marked
    for wrong in (0.0, -0.5, np.inf, -np.inf):
        spoilt = marked.copy()
        spoilt[0, 0] = wrong
        depth = depth_from_metres(spoilt)
        np.testing.assert_array_equal(depth, [[np.nan, np.nan], *marked[1:]])
        assert spoilt[0, 0] == wrong


def test_depth_of_eight_bits_or_in_colour_is_refused(tmp_path: Path, tiny: Any) -> None:
    for is_color in (False, True):
        tiny.write_image(tmp_path / "depth.png", tiny.texture(1, is_color=is_color))
        with pytest.raises(RecordingError, match="16-bit grey"):
            read_depth(tmp_path / "depth.png", 5000.0)


_SHAPE = (3, 4)
_COUNTS = hnp.arrays(np.uint16, _SHAPE)
_SCALES = st.sampled_from([1000.0, 5000.0, 256.0])


@given(counts=_COUNTS, scale=_SCALES)
def test_counts_come_back_but_for_what_is_unknown(counts: np.ndarray, scale: float) -> None:
    depth = depth_from_counts(counts, scale, "test")
    found, n_too_far = to_counts(depth, scale)
    np.testing.assert_array_equal(found, np.where(counts == 65535, 0, counts))
    assert n_too_far == 0
    assert is_in_counts(depth, scale) == bool(np.any((counts > 0) & (counts <= MAX_COUNT)))
    np.testing.assert_array_equal(exact_counts(depth, scale), found)
