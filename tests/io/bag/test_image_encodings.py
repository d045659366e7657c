"""Depth coded by runs of zeros and differences."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

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
