"""Depth coded by runs of zeros and differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.io.bag.image_encodings import decode_rvl
from tests.make.rvl import encode_rvl

_COUNTS = st.one_of(st.just(0), st.integers(0, 65535), st.integers(990, 1010), st.just(65535))


def _data(code: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(code, np.uint8)


@given(arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=_COUNTS))
def test_every_image_comes_back(counts: NDArray[np.uint16]) -> None:
    decoded = decode_rvl(_data(encode_rvl(counts)), "/depth")
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, counts)


def test_a_code_written_by_hand_is_read() -> None:
    # 2 zeros, 2 values: +5 (zigzag 10 = 2 | 1 << 3) and -1 (zigzag 1); the image is 2 x 2
    nibbles = [2, 2, 8 | 2, 1, 1, 0, 0, 0]
    word = int("".join(f"{nibble:x}" for nibble in nibbles), 16)
    code = bytes([2, 0, 0, 0, 2, 0, 0, 0]) + word.to_bytes(4, "little")
    assert decode_rvl(_data(code), "/depth").tolist() == [[0, 0], [5, 4]]


@given(st.integers(0, 200), st.integers(0, 2**32 - 1))
def test_a_truncated_or_damaged_code_is_an_image_or_refused(n_bytes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 3000, (8, 10)).astype(np.uint16) * (rng.random((8, 10)) < 0.8)
    code = bytearray(encode_rvl(counts))
    code[8 + n_bytes % (len(code) - 8)] ^= 0xFF
    for data in (bytes(code), bytes(code[: 8 + n_bytes])):
        try:
            assert decode_rvl(_data(data), "/depth").shape == (8, 10)
        except RecordingError as error:
            assert "/depth" in str(error)  # noqa: PT017 - either is right


def test_a_number_too_large_for_any_image_is_refused() -> None:
    # one zero, then a length of 30 nibbles that overflows
    word_1, word_2 = 0x1FFFFFFF.to_bytes(4, "little"), 0xFFFFFFFF.to_bytes(4, "little")
    code = encode_rvl(np.zeros((30, 40), np.uint16))[:8] + word_1 + 2 * word_2 + bytes(4)
    with pytest.raises(RecordingError, match=r"damaged at pixel 1$"):
        decode_rvl(_data(code), "/depth")


def test_random_bytes_end() -> None:
    rng = np.random.default_rng(0)
    head = encode_rvl(np.zeros((30, 40), np.uint16))[:8]
    for _ in range(100):
        data = _data(head + rng.integers(0, 256, 400, dtype=np.uint8).tobytes())
        with pytest.raises(RecordingError, match="/depth: the RVL image is"):
            decode_rvl(data, "/depth")


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (2**31, 2**31), (20_000, 20_000)])
def test_an_absurd_size_is_refused(size: tuple[int, int]) -> None:
    head = np.array(size, dtype="<u4").tobytes()
    with pytest.raises(RecordingError, match=f"claims {size[0]}x{size[1]} pixels"):
        decode_rvl(_data(head + bytes(40)), "/depth")
