"""Accuracy against time: the configurations that no other beats in both."""

from __future__ import annotations

import numpy as np
import pandas as pd

from gvo.batch.effects import ERROR, TIME, comparable
from gvo.types import BoolArray, FloatArray


def variant_means(table: pd.DataFrame) -> pd.DataFrame:
    """Compare the configurations by geometric means of error and time over recordings.

    Geometric means of ratios do not depend on which configuration they are taken over [1]_, nor
    on how large the errors of a recording are. A configuration that fails on hard recordings would
    look better for it: only those can be on the front that have a comparable run of as many
    recordings as any other, and these are compared on the recordings that all of them have. The
    others are placed by those of these recordings that they have.

    Parameters
    ----------
    table : DataFrame
        As `results.csv` holds it.

    Returns
    -------
    DataFrame
        A row for each configuration, those with the most comparable runs first, of these the most
        accurate; without errors the best covered first. Columns: `error` and `time` over those of
        the mean candidate, NaN without a run of the common recordings; `n_compared` of
        `n_recordings`, with a comparable run of it and of any; `is_candidate`, `is_on_front`.

    References
    ----------
    .. [1] P. J. Fleming, J. J. Wallace, "How not to lie with statistics: the correct way to
       summarize benchmark results", Communications of the ACM 29(3), 1986,
       doi:10.1145/5666.5673.
    """
    is_used = comparable(table, ERROR) & comparable(table, TIME)
    errors, times = (_log_grid(table, table[name].where(is_used)) for name in (ERROR, TIME))
    is_done = errors.notna()
    n_done = is_done.sum(axis=1)
    is_candidate = (n_done > 0) & (n_done == n_done.max())
    is_common = is_done[is_candidate].all(axis=0) & is_candidate.any()
    means = pd.DataFrame(index=errors.index)
    for name, logs in (("error", errors), ("time", times)):
        common = logs.loc[:, is_common]
        means[name] = np.exp((common - common[is_candidate].mean(axis=0)).mean(axis=1))
    costs = means[["error", "time"]].where(is_candidate)
    means = means.assign(
        n_compared=n_done,
        n_recordings=int(is_done.any(axis=0).sum()),
        is_candidate=is_candidate,
        is_on_front=is_non_dominated(costs.to_numpy()) & costs["error"].notna(),
    )
    coverages = table["coverage_percent"].fillna(0.0).groupby(table["variant"]).mean()
    keys = means.assign(n=-n_done, coverage=-coverages, ms=table.groupby("variant")[TIME].sum())
    return means.loc[keys.sort_values(["n", "error", "coverage", "ms"]).index]


def _log_grid(table: pd.DataFrame, values: pd.Series[float]) -> pd.DataFrame:
    """Return logarithms, a row for each configuration, a column for each recording."""
    cells = table[["variant", "recording"]].assign(log=np.log(values))
    grid = cells.pivot(index="variant", columns="recording", values="log")
    return grid.reindex(table["variant"].unique())


def is_non_dominated(costs: FloatArray) -> BoolArray:
    """Tell which of some points no other point dominates: Pareto's front [1]_.

    A point dominates another where it is nowhere larger, and somewhere smaller: of equal points
    none dominates the other.

    Parameters
    ----------
    costs : ndarray of float64, shape (n, k)
        Smaller is better; points with a NaN dominate nothing.

    Returns
    -------
    ndarray of bool, shape (n,)

    References
    ----------
    .. [1] H. T. Kung, F. Luccio, F. P. Preparata, "On finding the maxima of a set of vectors",
       Journal of the ACM 22(4), 1975, doi:10.1145/321906.321910.

    Examples
    --------
    >>> is_non_dominated(np.array([[1.0, 3.0], [2.0, 2.0], [2.0, 3.0]])).tolist()
    [True, True, False]
    """
    found = np.ones(len(costs), dtype=np.bool_)
    for n, point in enumerate(costs):
        is_as_good = np.all(costs <= point, axis=1)
        found[n] = not np.any(is_as_good & np.any(costs < point, axis=1))
    return found
