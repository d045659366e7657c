"""What swept parameters change: medians by value, and the Pareto front."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from gvo.types import BoolArray, FloatArray

ERROR = "ate_smoothed_m"
TIME = "frame_ms"
MIN_SHARE_OF_POSES = 0.95
"""Of the most poses that any run of a recording has; with fewer a run is not compared."""
MIN_RUNS = 3
"""Runs of which the spread is told: of two it says nothing."""
_MEASURES = {"error": ERROR, "time": TIME}
_QUANTILES = {"low": 0.25, "median": 0.5, "high": 0.75}
COUNTS = ("compared", "set aside", "failed")
"""Kinds of runs; set aside are those too short, or not measured."""


def comparable(table: pd.DataFrame, measure: str | None = None) -> pd.Series[bool]:
    """Tell which runs can be compared with others, by a column of the table where one is named.

    A run that lost the camera where others did not has an error over the easy part only: it needs
    as many poses as the best run of its recording, but for 5 %.
    """
    n_poses = (table["frames"] * table["coverage_percent"]).astype("float64")
    is_long = n_poses >= MIN_SHARE_OF_POSES * n_poses.groupby(table["recording"]).transform("max")
    return is_long & (table[measure] > 0.0) if measure else is_long


def relative(
    table: pd.DataFrame, measure: str, to: Literal["median", "min"] = "median"
) -> pd.Series[float]:
    """Return a measure over the median (or least) of the comparable runs of its recording."""
    compared = table[measure].where(comparable(table, measure))
    return table[measure].div(compared.groupby(table["recording"]).transform(to))


def swept(table: pd.DataFrame) -> list[str]:
    """Return the columns that are parameters: `section.key`."""
    return [name for name in table.columns if "." in name]


def value_medians(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Compare the values of each swept parameter.

    The errors of recordings differ by orders of magnitude: each run counts by its measure over the
    median of its recording. What a failed run would have measured nobody knows; failures are
    counted beside the medians, to be read with them.

    Parameters
    ----------
    table : DataFrame
        As `results.csv` holds it.

    Returns
    -------
    dict of str to DataFrame
        By parameter, that with the largest ratio of medians first, a row for each value: numbers
        in rising order, others as they came. Columns `(measure, quantile)` of `error` and `time`
        and of `low`, `median` and `high` (quartiles, NaN of fewer than `MIN_RUNS` runs), and
        `("runs", kind)` of `COUNTS`.
    """
    is_used = pd.DataFrame({name: comparable(table, each) for name, each in _MEASURES.items()})
    ratios = pd.DataFrame({name: relative(table, each) for name, each in _MEASURES.items()})
    main = "error" if is_used["error"].any() else "time"
    is_failed = table["status"] == "failed"
    kinds = is_used[main], ~is_used[main] & ~is_failed, is_failed
    runs = ratios.where(is_used).assign(**dict(zip(COUNTS, kinds, strict=True)))
    effects = {name: _by_value(table[name], runs) for name in swept(table)}
    return dict(sorted(effects.items(), key=lambda effect: -span(effect[1], main)))


def _by_value(values: pd.Series, runs: pd.DataFrame) -> pd.DataFrame:
    grouped = runs.groupby(values, dropna=False, sort=is_numeric_dtype(values))
    numbers = {}
    for measure in _MEASURES:
        has_spread = grouped[measure].count() >= MIN_RUNS
        for name, share in _QUANTILES.items():
            quantile = grouped[measure].quantile(share)
            numbers[measure, name] = quantile if name == "median" else quantile.where(has_spread)
    return pd.DataFrame(numbers | {("runs", kind): grouped[kind].sum() for kind in COUNTS})


def span(effect: pd.DataFrame, measure: str) -> float:
    """Return the largest median of a measure over the smallest; 0 where there is none."""
    medians = effect[measure, "median"].dropna()
    return float(medians.max() / medians.min()) if len(medians) else 0.0


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
    logs = {name: np.log(table[each].where(is_used)) for name, each in _MEASURES.items()}
    cells, variants = table[["variant", "recording"]].assign(**logs), table["variant"].unique()
    grids = {
        name: cells.pivot(index="variant", columns="recording", values=name).reindex(variants)
        for name in _MEASURES
    }
    is_done = grids["error"].notna()
    n_done = is_done.sum(axis=1)
    is_candidate = (n_done > 0) & (n_done == n_done.max())
    is_common = is_done[is_candidate].all(axis=0) & is_candidate.any()
    means = pd.DataFrame(index=is_done.index)
    for name, grid in grids.items():
        common = grid.loc[:, is_common]
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
    is_dominated = [
        np.any(np.all(costs <= point, axis=1) & np.any(costs < point, axis=1)) for point in costs
    ]
    return ~np.array(is_dominated, dtype=np.bool_)
