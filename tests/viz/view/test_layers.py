"""ChunkedArray: only what changed, and together the whole."""

from itertools import pairwise
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gvo.types import FloatArray
from gvo.viz.view.scene import ChunkedArray

rows_of_one_number = st.lists(st.integers(0, 3), max_size=20).map(
    lambda values: np.array(values, dtype=np.float64).reshape(-1, 1)
)


@given(st.lists(rows_of_one_number, min_size=1, max_size=5), st.integers(1, 4), st.booleans())
def test_pieces_together_are_the_rows(states: list[FloatArray], size: int, is_line: bool) -> None:
    pieces = ChunkedArray(size, n_shared=int(is_line))
    held: dict[int, FloatArray] = {}
    for rows in states:
        held |= pieces.update(rows)
        items = [held[number] for number in sorted(held)]
        got: list[Any] = [row for piece in items for row in (pairwise(piece) if is_line else piece)]
        want: list[Any] = [*(pairwise(rows) if is_line else rows)]
        assert np.array_equal(np.array(got), np.array(want))


def test_growing_by_one_row_changes_the_last_piece_alone() -> None:
    pieces = ChunkedArray(10, n_shared=1)
    rows = np.arange(60.0).reshape(-1, 2)
    pieces.update(rows[:27])
    assert list(pieces.update(rows[:28])) == [2]
    assert pieces.update(rows[:28]) == {}


def test_rows_are_compared_with_what_they_were() -> None:
    pieces = ChunkedArray(10)
    rows = np.zeros((5, 2))
    pieces.update(rows)
    rows[3] = 1.0
    assert list(pieces.update(rows)) == [0]
