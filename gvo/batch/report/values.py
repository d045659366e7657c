"""The rows of a batch as its report needs them: numbers, names, axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import takewhile
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from gvo._text import visible
from gvo.batch.effects import ERROR, comparable, variant_means
from gvo.batch.inputs import DEFAULT, flatten
from gvo.batch.results import to_frame
from gvo.batch.tasks import BatchRow
from gvo.config import Config
from gvo.types import BoolArray, FloatArray
from gvo.viz.figures import plain

N_LABEL = 40
"""Letters of a name in a picture."""
_LEAST = 1.25
"""Smallest ratio of the ends of an axis."""
_MARGIN = 0.06
_SERIES: tuple[tuple[float, ...], ...] = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0))


class Batch:
    """The rows of a batch, and what its plots share.

    Parameters
    ----------
    rows : sequence of BatchRow, length n

    Attributes
    ----------
    table : DataFrame
        The rows, as `results.csv` holds them.
    means : DataFrame
        A row for each configuration, the best first; see `variant_means`.
    default : str or None
        Name of the configuration whose swept parameters have their defaults.
    labels : dict of str to str
        Short names of the configurations.
    label_words : str
        A sentence on what the short names mean, if they need one.
    """

    def __init__(self, rows: Sequence[BatchRow]) -> None:
        self.rows, self.table = tuple(rows), to_frame(rows)
        self.means = variant_means(self.table)
        self.default = _default_of(rows)
        self.labels, self.label_words = _labels(rows)

    @property
    def is_sweep(self) -> bool:
        """Whether there is more than one configuration."""
        return len(self.means) > 1

    @property
    def has_errors(self) -> bool:
        """Whether any comparable run has an error."""
        return bool(self.is_comparable(ERROR).any())

    def numbers(self, column: str) -> FloatArray:
        """Return a column of the table, shape (n,); NaN where there is no number."""
        return self.table[column].to_numpy(dtype=np.float64, na_value=np.nan)

    def is_comparable(self, measure: str | None = None) -> BoolArray:
        """Tell which runs can be compared, by a measure if given, shape (n,)."""
        return comparable(self.table, measure).to_numpy()

    def is_failed(self) -> BoolArray:
        """Tell which runs failed, shape (n,)."""
        return (self.table["status"] == "failed").to_numpy(dtype=np.bool_)


def _labels(rows: Sequence[BatchRow]) -> tuple[dict[str, str], str]:
    """Name configurations without sections; by their values alone if that is too long."""
    own = {row.variant: row.parameters for row in rows}
    parameters = dict.fromkeys(name for row in rows for name in row.parameters)
    keys = {name: name.rpartition(".")[2] for name in parameters}
    if len(set(keys.values())) < len(keys):
        keys = {name: name for name in parameters}
    labels = {}
    for variant in own:
        labels[variant] = visible(variant)
        for name, key in keys.items():
            labels[variant] = labels[variant].replace(f"{name}=", f"{key}=")
    if max(map(len, labels.values())) <= N_LABEL:
        return labels, ""
    short = {
        variant: " / ".join(map(value_text, values.values())) for variant, values in own.items()
    }
    if len(set(short.values())) < len(short) or max(map(len, short.values())) > N_LABEL:
        return _without_same_ends(labels), ""
    return short, f" Names are the values of {visible(' / '.join(keys.values()))}."


def _without_same_ends(labels: Mapping[str, str]) -> dict[str, str]:
    """Cut what all names begin and end with, if cutting their middles makes equal ones."""
    texts = [*labels.values()]
    if len({shown(text, N_LABEL) for text in texts}) == len(texts):
        return dict(labels)
    n_start = _n_shared(texts)
    n_end = _n_shared([text[n_start:][::-1] for text in texts])
    return {
        variant: f"...{text[n_start : len(text) - n_end]}{'...' if n_end else ''}"
        for variant, text in labels.items()
    }


def _n_shared(texts: Sequence[str]) -> int:
    """Return how many characters all texts begin with."""
    n_distinct = (len(set(column)) for column in zip(*texts, strict=False))
    return sum(1 for _ in takewhile(lambda n: n == 1, n_distinct))


def _default_of(rows: Sequence[BatchRow]) -> str | None:
    own = {row.variant: row.parameters for row in rows}
    if DEFAULT in own:
        return DEFAULT
    defaults = flatten(Config()).items()
    return next(
        (name for name, values in own.items() if values and values.items() <= defaults), None
    )


def shown(text: str, n_most: int) -> str:
    """Return a name as a label of a picture, the middle of a long one left out.

    Examples
    --------
    >>> shown("window.n_links=3", 11)
    'wind...ks=3'
    """
    text = visible(text)
    if len(text) > n_most:
        n_end = (n_most - 3) // 2
        text = f"{text[: n_most - 3 - n_end]}...{text[-n_end:]}"
    return plain(text)


def value_text(value: object) -> str:
    """Return a value as YAML writes it."""
    if value is None or value is pd.NA or value != value:
        return "null"
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else visible(str(value))


def logarithmic_axis(
    axes: Axes, which: Literal["x", "y"], *, ends: tuple[float, float], n_ticks: int = 6
) -> None:
    """Make an axis logarithmic, with a few plain numbers at its ticks.

    Parameters
    ----------
    axes : Axes
    which : {"x", "y"}
    ends : tuple of float
        Least and largest of what is drawn.
    n_ticks : int
        At most.
    """
    low, high = log_limits(*ends)
    axis = axes.xaxis if which == "x" else axes.yaxis
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis.set_major_locator(FixedLocator(log_ticks(low, high, n_ticks)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def log_limits(low: float, high: float) -> tuple[float, float]:
    """Return the ends of an axis that holds two positive numbers, with margins."""
    if not 0.0 < low <= high < np.inf:
        return 0.1, 10.0
    widening = max(0.0, 0.5 * float(np.log(_LEAST * low / high)))
    margin = np.exp(widening + _MARGIN * np.log(max(high / low, _LEAST)))
    return float(low / margin), float(high * margin)


def log_ticks(low: float, high: float, n_most: int) -> list[float]:
    """Return round numbers between the ends of a logarithmic axis, at least two.

    Examples
    --------
    >>> log_ticks(0.02, 30.0, 6)
    [0.1, 1.0, 10.0]
    >>> log_ticks(0.8, 2.1, 6)
    [1.0, 1.5, 2.0]
    """
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    for series in reversed(_SERIES):
        ticks = [float(f"{s}e{n}") for n in range(first, last + 1) for s in series]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if 3 <= len(ticks) <= n_most:
            return ticks
    if len(ticks) > n_most:
        return ticks[:: -(-len(ticks) // n_most)]
    even = MaxNLocator(n_most - 1, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return [float(tick) for tick in even if low <= tick <= high]
