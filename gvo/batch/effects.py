"""What the values of swept parameters change: medians of error and time."""

from __future__ import annotations

from typing import Literal

import pandas as pd
from pandas.api.types import is_numeric_dtype

ERROR = "ate_smoothed_m"
TIME = "frame_ms"
MIN_SHARE_OF_POSES = 0.95
"""Of the most poses that any run of a recording has; with fewer a run is not compared."""
_MEASURES = {"error": ERROR, "time": TIME}
_QUANTILES = {"low": 0.25, "median": 0.5, "high": 0.75}


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
        in rising order, others as they came. Columns `(measure, quantile)` of the measures
        `error` and `time` and the quantiles `low`, `median` and `high` (quartiles), and
        `("runs", kind)` of the kinds `compared`, `set aside` (too short, or not measured) and
        `failed`.
    """
    is_used = {name: comparable(table, column) for name, column in _MEASURES.items()}
    ratios = pd.DataFrame(
        {name: relative(table, each).where(is_used[name]) for name, each in _MEASURES.items()}
    )
    main = "error" if is_used["error"].any() else "time"
    is_failed = table["status"] == "failed"
    is_set_aside = ~is_used[main] & ~is_failed
    counts = {"compared": is_used[main], "set aside": is_set_aside, "failed": is_failed}
    runs = pd.DataFrame(counts)
    effects = {name: _by_value(table[name], ratios, runs) for name in swept(table)}
    return dict(sorted(effects.items(), key=lambda effect: -span(effect[1], main)))


def _by_value(values: pd.Series, ratios: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    is_number = is_numeric_dtype(values)
    grouped = ratios.groupby(values, dropna=False, sort=is_number)
    parts = {name: grouped.quantile(share) for name, share in _QUANTILES.items()}
    quantiles = pd.concat(parts, axis=1).swaplevel(axis=1)
    n_runs = runs.groupby(values, dropna=False, sort=is_number).sum()
    return pd.concat([quantiles, pd.concat({"runs": n_runs}, axis=1)], axis=1)


def span(effect: pd.DataFrame, measure: str) -> float:
    """Return the largest median of a measure over the smallest; 0 where there is none."""
    medians = effect[measure, "median"].dropna()
    return float(medians.max() / medians.min()) if len(medians) else 0.0
