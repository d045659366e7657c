"""How much each swept parameter changes a measure: marginal means and shares of the variance."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from gvo.parameter_effects.additive import AdditiveModel, Solution
from gvo.parameter_effects.runs import Runs, codes_of, student_quantile
from gvo.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ValueEffect:
    """What one value of a parameter does.

    Parameters
    ----------
    value : hashable
    ratio : float or None
        Marginal mean of the measure over that of all values (but those that only one of several
        recordings tells of), means being geometric; None where it cannot be told.
    low, high : float or None
        Ends of its 95 % interval; None where fewer than two recordings tell of it.
    n_compared, n_set_aside, n_failed : int
        Runs with this value: those the ratio rests on, those that are too short or have no
        measure, and those that failed.
    """

    value: Hashable
    ratio: float | None
    low: float | None
    high: float | None
    n_compared: int
    n_set_aside: int
    n_failed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterEffect:
    """What one parameter does.

    Parameters
    ----------
    name : str
    values : tuple of ValueEffect
        Numbers in rising order, all others as they came.
    share : float or None
        What its main effect explains of the variance of the measure's logarithm about the
        recordings' means, 0 to 1; None where its values cannot be told apart.
    chance_share : float or None
        What a parameter without any effect would seem to explain, on average.
    n_recordings : int
        Those with comparable runs of at least two of its values.
    """

    name: str
    values: tuple[ValueEffect, ...]
    share: float | None
    chance_share: float | None
    n_recordings: int

    @property
    def span(self) -> float | None:
        """The worst ratio over the best."""
        ratios = [each.ratio for each in self.values if each.ratio is not None]
        return max(ratios) / min(ratios) if ratios else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Factor:
    """A parameter, with the number of each run's value among the effects of all parameters."""

    name: str
    values: list[Hashable]
    codes: IntArray
    n_before: int

    def columns(self, n_effects: int) -> BoolArray:
        """Tell which of all effects are those of its values."""
        numbers = np.arange(n_effects) - self.n_before
        return (numbers >= 0) & (numbers < len(self.values))

    def counts(self, is_counted: BoolArray) -> IntArray:
        """Return how many of some runs have each of its values."""
        codes = self.codes[is_counted] - self.n_before
        return np.bincount(codes, minlength=len(self.values))


def parameter_effects(runs: Runs, measures: FloatArray) -> list[ParameterEffect]:
    """Compare the values of each parameter, within recordings only.

    The measures of recordings differ by orders of magnitude, so their logarithms are modelled: a
    level of the recording plus an effect of each parameter's value, by least squares [1]_. Where
    every configuration ran on every recording, the effect of a value is the plain mean of the log
    ratios to the recording's geometric mean: over the runs of a recording that have the value,
    then over recordings. Where runs are missing, plain means would mix in the effects of the
    other parameters and the ease of the recordings; the model takes both out. What a failed run
    would have measured nobody knows: it is counted beside the ratio, to be read with it.

    The interval is Student's [2]_ over the recordings that have the value and another one. Runs
    of one recording are not independent: the variance is that of leaving out one recording at a
    time [3]_, which is the paired one where nothing is missing. The share is eta squared [4]_: by
    how much the explained sum of squares drops where the parameter is left out.

    Parameters
    ----------
    runs : Runs
    measures : ndarray of float64, shape (n,)
        Errors or times; one that is not positive, or NaN, is none.

    Returns
    -------
    list of ParameterEffect
        The largest share first, those that cannot be told last.

    References
    ----------
    .. [1] S. R. Searle, F. M. Speed, G. A. Milliken, "Population marginal means in the linear
       model: an alternative to least squares means", The American Statistician 34(4), 1980,
       doi:10.1080/00031305.1980.10483031.
    .. [2] Student, "The probable error of a mean", Biometrika 6(1), 1908,
       doi:10.1093/biomet/6.1.1.
    .. [3] A. C. Cameron, D. L. Miller, "A practitioner's guide to cluster-robust inference",
       Journal of Human Resources 50(2), 2015, doi:10.3368/jhr.50.2.317.
    .. [4] J. T. E. Richardson, "Eta squared and partial eta squared as measures of effect size in
       educational research", Educational Research Review 6(2), 2011,
       doi:10.1016/j.edurev.2010.12.001.

    Examples
    --------
    >>> runs = Runs(
    ...     recordings=["a", "a", "b", "b"],
    ...     variants=["slow", "fast", "slow", "fast"],
    ...     parameters={"speed": [1, 2, 1, 2]},
    ...     is_failed=np.zeros(4, dtype=np.bool_),
    ...     n_poses=np.full(4, 10.0),
    ... )
    >>> [effect] = parameter_effects(runs, np.array([0.1, 0.4, 50.0, 200.0]))
    >>> [round(each.ratio, 6) for each in effect.values], round(effect.share, 6)
    ([0.5, 2.0], 1.0)
    """
    factors = _factors(runs)
    if not factors:
        return []
    is_used = runs.has(measures)
    if not np.any(is_used):
        return [_untold(factor, runs, is_used) for factor in factors]
    codes = [factor.codes[is_used] for factor in factors]
    values = np.log(measures[is_used])
    n_effects = factors[-1].n_before + len(factors[-1].values)
    model = AdditiveModel.of(codes, runs.recording_codes()[is_used], values, n_effects=n_effects)
    parts = model.solve_without_each()
    effects = [_effect(factor, runs, is_used, model, parts) for factor in factors]
    return sorted(effects, key=lambda effect: (effect.share is None, -(effect.share or 0.0)))


def _factors(runs: Runs) -> list[_Factor]:
    factors: list[_Factor] = []
    n_before = 0
    for name, values in runs.parameters.items():
        distinct = _ordered(codes_of(values)[0])
        codes = codes_of([*distinct, *values])[1][len(distinct) :] + n_before
        factors.append(_Factor(name=name, values=distinct, codes=codes, n_before=n_before))
        n_before += len(distinct)
    return factors


def _ordered(values: list[Hashable]) -> list[Hashable]:
    numbers = [value for value in values if isinstance(value, (int, float))]
    return [*sorted(numbers)] if len(numbers) == len(values) else values


def _effect(
    factor: _Factor, runs: Runs, is_used: BoolArray, model: AdditiveModel, parts: list[Solution]
) -> ParameterEffect:
    whole = model.solve()
    contrasts = _contrasts(factor, whole, parts, factor.counts(is_used))
    if contrasts is None:
        return _untold(factor, runs, is_used)
    has_value = _presence(factor, runs, is_used)
    logs = whole.of(contrasts)
    without_each = np.array([part.of(contrasts) for part in parts])
    reaches = _reaches(logs, without_each, has_value & ~np.isnan(logs))
    share, chance_share = model.shares_of(factor.columns(model.n_effects))
    return ParameterEffect(
        name=factor.name,
        values=_value_effects(factor, runs, is_used, (logs, logs - reaches, logs + reaches)),
        share=share,
        chance_share=chance_share,
        n_recordings=int(np.sum(np.sum(has_value, axis=1) > 1)),
    )


def _contrasts(
    factor: _Factor, whole: Solution, parts: list[Solution], n_compared: IntArray
) -> FloatArray | None:
    """Return each value's effect less the mean of those that can be told from the commonest.

    One that hangs on a single recording stays out of the mean: all intervals would hang on it.
    None where nothing can be told: each value came with a value of another parameter of its own,
    or no two values ran on the same recording.
    """
    n_effects = len(whole.effects)
    own = np.eye(n_effects)[factor.columns(n_effects)]
    differences = own - own[np.argmax(n_compared)]
    is_told = ~np.isnan(whole.of(differences))
    if np.sum(is_told) < 2:
        return None
    is_steady = is_told & ~np.any([np.isnan(part.of(differences)) for part in parts], axis=0)
    is_meant = is_steady if np.sum(is_steady) > 1 else is_told
    return np.asarray(own - own[is_meant].mean(axis=0))


def _presence(factor: _Factor, runs: Runs, is_used: BoolArray) -> BoolArray:
    """Tell which recordings have comparable runs of which values, shape (R, number of values)."""
    recordings = np.unique(runs.recording_codes()[is_used], return_inverse=True)[1]
    has_value = np.zeros((recordings.max() + 1, len(factor.values)), dtype=np.bool_)
    has_value[recordings, factor.codes[is_used] - factor.n_before] = True
    return has_value


def _reaches(logs: FloatArray, without_each: FloatArray, has_value: BoolArray) -> FloatArray:
    """Return half the widths of the intervals, NaN where there is none."""
    tells = has_value & (np.sum(has_value, axis=1, keepdims=True) > 1)
    n = np.sum(tells, axis=0)
    variances = np.maximum(n - 1, 0) / np.maximum(n, 1)
    variances = variances * np.sum((without_each - logs) ** 2, axis=0)
    quantiles = [student_quantile(int(count) - 1) if count > 1 else np.nan for count in n]
    return np.asarray(quantiles * np.sqrt(variances))


def _untold(factor: _Factor, runs: Runs, is_used: BoolArray) -> ParameterEffect:
    nothing = np.full(len(factor.values), np.nan)
    return ParameterEffect(
        name=factor.name,
        values=_value_effects(factor, runs, is_used, (nothing, nothing, nothing)),
        share=None,
        chance_share=None,
        n_recordings=0,
    )


def _value_effects(
    factor: _Factor, runs: Runs, is_used: BoolArray, logs: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[ValueEffect, ...]:
    n_compared, n_failed = factor.counts(is_used), factor.counts(runs.is_failed)
    n_set_aside = factor.counts(~is_used & ~runs.is_failed)
    numbers = [[None if np.isnan(log) else float(np.exp(log)) for log in each] for each in logs]
    return tuple(
        ValueEffect(
            value=value,
            ratio=numbers[0][n],
            low=numbers[1][n],
            high=numbers[2][n],
            n_compared=int(n_compared[n]),
            n_set_aside=int(n_set_aside[n]),
            n_failed=int(n_failed[n]),
        )
        for n, value in enumerate(factor.values)
    )
