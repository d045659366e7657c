"""Depth as counts of 16 bits."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gvo.io.images import MAX_COUNT, depth_from_counts, exact_counts, is_in_counts, to_counts

_SHAPE = (3, 4)
_COUNTS = hnp.arrays(np.uint16, _SHAPE)
_SCALES = st.sampled_from([1000.0, 5000.0, 256.0])


@given(counts=_COUNTS, scale=_SCALES)
def test_counts_come_back_as_they_were_but_for_what_is_unknown(
    counts: np.ndarray, scale: float
) -> None:
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
