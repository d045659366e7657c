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

from gvo.errors import RecordingError
from gvo.io.images import (
    MAX_COUNT,
    GreyRange,
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


def test_sixteen_bits_lose_their_lower_eight(tmp_path: Path, tiny: Any) -> None:
    grey = tiny.texture(1).astype(np.uint16)
    tiny.write_image(tmp_path / "image.png", grey * 256 + 255)
    np.testing.assert_array_equal(read_image(tmp_path / "image.png"), grey)


def test_the_alpha_channel_is_dropped(tiny: Any) -> None:
    color = tiny.texture(1, is_color=True)
    with_alpha = np.dstack([color, tiny.texture(2)])
    np.testing.assert_array_equal(to_8_bit(with_alpha, "image"), color)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_a_truncated_file_is_refused(tmp_path: Path, tiny: Any, suffix: str, share: float) -> None:
    path = tmp_path / f"image{suffix}"
    tiny.write_image(path, tiny.texture(1, is_color=True))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=path.name):
        read_image(path)


def test_a_missing_file_and_a_text_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="missing"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(RecordingError, match="cannot be decoded"):
        read_image(tmp_path / "text.png")


def _encoded(pixels: NDArray[Any], suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def _data(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".pnm"])
@pytest.mark.parametrize("is_color", [False, True])
def test_formats_without_loss_are_decoded_unchanged(tiny: Any, suffix: str, is_color: bool) -> None:
    pixels = tiny.texture(1, is_color=is_color)
    np.testing.assert_array_equal(decode_image(_data(_encoded(pixels, suffix)), "image"), pixels)


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_PNG_COMPRESSION, 6]])
@pytest.mark.parametrize("shape", [(32, 48), (1, 1), (31, 7, 3), (20, 33, 4)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_png_of_any_kind_is_decoded_as_opencv_does(
    dtype: type[np.unsignedinteger[Any]], shape: tuple[int, ...], options: list[int]
) -> None:
    largest = np.iinfo(dtype).max
    pixels = np.random.default_rng(5).integers(0, largest, shape, dtype, endpoint=True)
    decoded = decode_image(cv2.imencode(".png", pixels, options)[1].ravel(), "image")
    assert (decoded.dtype, decoded.shape) == (pixels.dtype, pixels.shape)
    np.testing.assert_array_equal(decoded, pixels)


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


@given(st.binary(max_size=64), st.sampled_from([b"", b"\xff\xd8\xff", b"II*\0", b"BM", b"P5 "]))
def test_any_bytes_are_refused_in_one_line(data: bytes, magic: bytes) -> None:
    with pytest.raises(RecordingError, match="image"):
        decode_image(_data(magic + data), "image")


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
    narrow = GreyRange(black=black, white=white).narrow(np.sort(values))
    assert np.all(np.diff(narrow.astype(int)) >= 0)
    assert np.all(narrow[np.sort(values) <= black] == 0)
    # with fewer than 256 steps the last one begins below 255
    lightest = 256 * (white - black) // (white - black + 1)
    assert np.all(narrow[np.sort(values) >= white] == lightest)


@pytest.mark.parametrize("bits", [9, 10, 12, 14, 16])
def test_a_range_of_whole_bits_is_a_shift(bits: int) -> None:
    values = np.arange(1 << bits, dtype=np.uint16)
    narrow = GreyRange(white=(1 << bits) - 1).narrow(values)
    np.testing.assert_array_equal(narrow, values >> (bits - 8))


@pytest.mark.parametrize(("largest", "white"), [(4095, 4095), (1000, 1023), (700, 1023), (90, 255)])
def test_nearly_black_images_are_refused_with_what_to_set(largest: int, white: int) -> None:
    pixels = np.full((4, 4), largest, np.uint16)
    with pytest.raises(RecordingError, match=f"images.white={white}$"):
        to_8_bit(pixels, "image")
    assert to_8_bit(pixels, "image", GreyRange(white=white)).max() > 64
    assert to_8_bit(pixels + np.uint16(4096), "image").max() >= 16


@pytest.mark.parametrize(("black", "white"), [(-1, 5), (5, 5), (6, 5), (0, 65536)])
def test_what_is_no_range_is_refused(black: int, white: int) -> None:
    with pytest.raises(ValueError, match="black < white"):
        GreyRange(black=black, white=white)


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


@given(
    depth=hnp.arrays(
        np.float32, _SHAPE, elements=st.floats(2**-10, 120, width=32) | st.just(np.nan)
    )
)
def test_counts_that_are_exact_give_every_bit_back(depth: np.ndarray) -> None:
    counts = exact_counts(depth, 1000.0)
    if counts is None:
        rounded, _ = to_counts(depth, 1000.0)
        back = depth_from_counts(rounded, 1000.0, "test")
        assert not np.array_equal(back, depth, equal_nan=True)
    else:
        np.testing.assert_array_equal(depth_from_counts(counts, 1000.0, "test"), depth)


def test_what_is_too_far_is_counted_and_becomes_unknown() -> None:
    depth = np.array([[65.534, 65.6, np.nan, 1e6]], dtype=np.float32)
    counts, n_too_far = to_counts(depth, 1000.0)
    assert counts.tolist() == [[65534, 0, 0, 0]]
    assert n_too_far == 2


def test_depth_between_counts_is_not_in_them() -> None:
    assert not is_in_counts(np.array([[1.0005]], dtype=np.float32), 1000.0)
    assert is_in_counts(np.array([[1.0006]], dtype=np.float32), 5000.0)
    assert not is_in_counts(np.array([[np.nan]], dtype=np.float32), 5000.0)
