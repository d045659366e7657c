"""Long arrays in pieces, so that only what changed is sent to the page."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Pieces:
    """Cuts rows into pieces of equal size and tells which of them differ from before.

    Parameters
    ----------
    size : int
        Rows of a piece.
    n_shared : int
        Rows that a piece shares with the next: 1 where the rows are corners of a line.
    """

    def __init__(self, size: int, *, n_shared: int = 0) -> None:
        self._size = size
        self._n_shared = n_shared
        self._rows: NDArray[Any] | None = None

    def update(self, rows: NDArray[Any]) -> dict[int, NDArray[Any]]:
        """Return the pieces that changed, by number; an empty one went away.

        Parameters
        ----------
        rows : ndarray, shape (n, m)
        """
        before, self._rows = self._rows, rows.copy()
        if before is None:
            before = rows[:0]
        n_same = _common_prefix(before, rows)
        if n_same == len(before) == len(rows):
            return {}
        first = max(0, n_same - self._n_shared) // self._size
        last = (max(len(before), len(rows)) - 1) // self._size
        return {number: self._piece(rows, number) for number in range(first, last + 1)}

    def _piece(self, rows: NDArray[Any], number: int) -> NDArray[Any]:
        start = number * self._size
        piece = rows[start : start + self._size + self._n_shared]
        return piece if len(piece) > self._n_shared else piece[:0]


def _common_prefix(before: NDArray[Any], after: NDArray[Any]) -> int:
    n = min(len(before), len(after))
    differs = np.any(before[:n] != after[:n], axis=1)
    return int(np.argmax(differs)) if differs.any() else n
