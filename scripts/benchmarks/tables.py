"""Tables in Markdown, so that a page of documentation can take them over."""

from collections.abc import Iterable, Sequence

import numpy as np

from gvo.types import FloatArray


class Table:
    """Prints its header, then rows as they come; the first column is as wide as its names."""

    def __init__(self, header: Sequence[str], names: Iterable[str] = ()) -> None:
        self._widths = [max(map(len, [header[0], *names])), *map(len, header[1:])]
        rules = ["-" * self._widths[0], *("-" * (width - 1) + ":" for width in self._widths[1:])]
        print()
        self.add(header)
        self.add(rules)

    def add(self, cells: Sequence[str]) -> None:
        """Print a row, names to the left, numbers to the right."""
        aligned = [cells[0].ljust(self._widths[0]), *map(str.rjust, cells[1:], self._widths[1:])]
        print(f"| {' | '.join(aligned)} |", flush=True)


def number(value: float | None, n_decimals: int) -> str:
    """Return a number with so many decimals, "-" where there is none."""
    return "-" if value is None or np.isnan(value) else f"{value:.{n_decimals}f}"


def median_and_worst(rows: Sequence[FloatArray | Sequence[float]]) -> dict[str, list[float]]:
    """Return the median and the largest value of each column, of those that are known."""
    columns = [column[np.isfinite(column)] for column in np.array(rows, dtype=np.float64).T]
    return {
        name: [float(summary(column)) if column.size else np.nan for column in columns]
        for name, summary in (("median", np.median), ("worst", np.max))
    }
