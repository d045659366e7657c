"""Kernels of PNG against the filters of its specification, by which files are written."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.kernels import png as kernels
from tests.make.png import Bytes, filter_rows


def unfilter(filtered: Bytes, n_pixel: int) -> tuple[bool, Bytes]:
    height, n_bytes = len(filtered), filtered.shape[1] - 1
    rows = np.full((height + 1, n_bytes), 7, dtype=np.uint8)
    rows[0] = 0
    is_sound = kernels.unfilter(filtered, n_pixel, rows)
    assert not np.any(rows[0])
    return is_sound, rows[1:]


@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.integers(0, 4), max_size=12),
    n_pixel=st.sampled_from([1, 2, 3, 4, 6, 8]),
    width=st.integers(1, 20),
)
def test_filtered_rows_become_what_they_were(
    seed: int, kinds: list[int], n_pixel: int, width: int
) -> None:
    rng = np.random.default_rng(seed)
    # Extreme values, and equal neighbours, between which filters have to choose.
    values = rng.choice([0, 1, 127, 128, 254, 255], size=(len(kinds), width * n_pixel))
    rows = np.where(rng.random(values.shape) < 0.5, values, rng.integers(0, 256, values.shape))
    is_sound, found = unfilter(filter_rows(rows.astype(np.uint8), n_pixel, kinds), n_pixel)
    assert is_sound
    np.testing.assert_array_equal(found, rows)


def test_each_triple_of_neighbours_is_predicted_as_specified() -> None:
    """Of left, above and above to the left, in steps of five and beside the ends."""
    steps = np.unique(np.r_[0:256:5, 1, 2, 127, 128, 254, 255])
    corner, above, left = (each.ravel() for each in np.meshgrid(steps, steps, steps))
    rows = np.array([[corner, above], [left, left]]).transpose(0, 2, 1).reshape(2, -1)
    for kind in range(5):
        kinds = [0, kind]
        filtered = filter_rows(rows.astype(np.uint8), 1, kinds)
        np.testing.assert_array_equal(unfilter(filtered, 1)[1], rows)


@pytest.mark.parametrize("kind", [5, 255])
@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_filter_that_is_none_is_told(kind: int, row: int) -> None:
    filtered = filter_rows(np.full((3, 4), 9, dtype=np.uint8), 1, [0, 1, 2])
    filtered[row, 0] = kind
    assert not unfilter(filtered, 1)[0]
