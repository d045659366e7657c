"""Logarithmic axes of errors, times and their ratios: a few plain numbers, however short."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LEAST = 1.25
"""Of end over start: less would make much of nothing."""
_MARGIN = 0.06
_SERIES: tuple[tuple[float, ...], ...] = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0))


def logarithmic_axis(
    axes: Axes, which: Literal["x", "y"], *, ends: tuple[float, float], n_ticks: int = 6
) -> None:
    """Make an axis logarithmic, with some labelled ticks.

    Parameters
    ----------
    axes : Axes
    which : {"x", "y"}
    ends : tuple of float
        Least and largest of what is drawn.
    n_ticks : int
        At most so many.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = log_limits(*ends)
    axis = axes.xaxis if which == "x" else axes.yaxis
    if which == "x":
        axes.set_xscale("log")
        axes.set_xlim(low, high)
    else:
        axes.set_yscale("log")
        axes.set_ylim(low, high)
    axis.set_major_locator(FixedLocator(log_ticks(low, high, n_ticks)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def log_limits(low: float, high: float) -> tuple[float, float]:
    """Return ends of an axis around positive numbers, with margins."""
    if not 0.0 < low <= high < np.inf:
        return 0.1, 10.0
    widening = max(0.0, 0.5 * float(np.log(_LEAST * low / high)))
    margin = np.exp(widening + _MARGIN * np.log(max(high / low, _LEAST)))
    return float(low / margin), float(high * margin)


def log_ticks(low: float, high: float, n_most: int) -> list[float]:
    """Return round numbers between the ends of a logarithmic axis, two at least.

    Examples
    --------
    >>> log_ticks(0.02, 30.0, 6)
    [0.1, 1.0, 10.0]
    >>> log_ticks(0.8, 2.1, 6)
    [1.0, 1.5, 2.0]
    """
    from matplotlib.ticker import MaxNLocator

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
