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
