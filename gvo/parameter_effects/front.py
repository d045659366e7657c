"""The front of accuracy against time: the configurations that no other beats in both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvo.parameter_effects.runs import Runs, codes_of
from gvo.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class VariantMean:
    """A configuration beside the others.

    Parameters
    ----------
    name : str
    error_ratio, time_ratio : float or None
        Geometric means over recordings of its error and its time over those of the mean
        configuration; None where it completed none of the recordings that count.
    n_compared, n_recordings : int
        Recordings that it has a comparable run of, and that any configuration has one of.
    is_candidate : bool
        It completed as many recordings as any other: only then it can be on the front.
    is_on_front : bool
        No other candidate is as accurate and as fast, and better in one of the two.
    """

    name: str
    error_ratio: float | None
    time_ratio: float | None
    n_compared: int
    n_recordings: int
    is_candidate: bool
    is_on_front: bool


def accuracy_front(runs: Runs, errors: FloatArray, times: FloatArray) -> list[VariantMean]:
    """Compare the configurations by geometric means of error and time.

    Geometric means of ratios do not depend on which configuration they are taken over [1]_, nor
    on how large the errors of a recording are. A configuration that fails where others succeed
    would look better for it, as hard recordings leave its mean. So only those can be on the front
    that have a comparable run of every recording of which any configuration has one; where none
    has, those that have the most, over the recordings that all of them have. All others are
    placed by the recordings among these that they have, and are never on the front.

    Parameters
    ----------
    runs : Runs
    errors, times : ndarray of float64, shape (n,)
        One that is not positive, or NaN, is none.

    Returns
    -------
    list of VariantMean
        In the order of the configurations' first runs.

    References
    ----------
    .. [1] P. J. Fleming, J. J. Wallace, "How not to lie with statistics: the correct way to
       summarize benchmark results", Communications of the ACM 29(3), 1986,
       doi:10.1145/5666.5673.
    """
    names, variants = codes_of(runs.variants)
    recordings = runs.recording_codes()
    is_used = runs.has(errors) & runs.has(times)
    logs = np.full((2, len(names), int(recordings.max(initial=-1)) + 1), np.nan)
    at = variants[is_used], recordings[is_used]
    logs[0][at], logs[1][at] = np.log(errors[is_used]), np.log(times[is_used])
    is_done = ~np.isnan(logs[0])
    n_done = np.sum(is_done, axis=1)
    is_candidate = (n_done > 0) & (n_done == n_done.max(initial=0))
    means = _means(logs, is_candidate)
    is_on_front = np.zeros(len(names), dtype=np.bool_)
    is_placed = is_candidate & ~np.isnan(means[0])
    is_on_front[is_placed] = is_non_dominated(means[:, is_placed].T)
    n_recordings = int(np.sum(np.any(is_done, axis=0)))
    ratios = [[None if np.isnan(mean) else float(np.exp(mean)) for mean in row] for row in means]
    return [
        VariantMean(
            name=str(name),
            error_ratio=ratios[0][n],
            time_ratio=ratios[1][n],
            n_compared=int(n_done[n]),
            n_recordings=n_recordings,
            is_candidate=bool(is_candidate[n]),
            is_on_front=bool(is_on_front[n]),
        )
        for n, name in enumerate(names)
    ]


def _means(logs: FloatArray, is_candidate: BoolArray) -> FloatArray:
    """Return the means over the candidates' common recordings, shape (2, number of names)."""
    is_common = ~np.any(np.isnan(logs[0][is_candidate]), axis=0) & np.any(is_candidate)
    common = logs[:, :, is_common]
    n_common = np.sum(~np.isnan(common[0]), axis=1)
    if not np.any(n_common):
        return np.full(logs.shape[:2], np.nan)
    ratios = common - common[:, is_candidate].mean(axis=1, keepdims=True)
    sums = np.nansum(ratios, axis=2)
    return np.where(n_common > 0, sums / np.maximum(n_common, 1), np.nan)


def is_non_dominated(costs: FloatArray) -> BoolArray:
    """Tell which of some points no other point dominates: Pareto's front [1]_.

    A point dominates another where it is nowhere larger, and somewhere smaller: of equal points
    none dominates the other.

    Parameters
    ----------
    costs : ndarray of float64, shape (n, k)
        Smaller is better.

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
