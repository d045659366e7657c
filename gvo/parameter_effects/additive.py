"""The additive model of a batch: a level of each recording, an effect of each value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvo.types import BoolArray, FloatArray, IntArray

_SINGULAR = 1e-9
_ESTIMABLE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Least squares where not all is determined.

    Parameters
    ----------
    effects : ndarray of float64, shape (p,)
        The shortest of all solutions.
    open_directions : ndarray of float64, shape (p, k)
        Orthonormal; adding any of them fits as well.
    """

    effects: FloatArray
    open_directions: FloatArray

    @property
    def rank(self) -> int:
        """Number of directions that the runs determine."""
        return len(self.effects) - int(self.open_directions.shape[1])

    def of(self, contrasts: FloatArray) -> FloatArray:
        """Return contrasts, shape (m, p), of the effects, shape (m,); NaN where undetermined."""
        is_open = np.any(np.abs(contrasts @ self.open_directions) > _ESTIMABLE, axis=1)
        return np.where(is_open, np.nan, contrasts @ self.effects)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdditiveModel:
    """Normal equations of the effects, a set for each of R recordings, the levels eliminated.

    Parameters
    ----------
    matrices : ndarray of float64, shape (R, p, p)
    vectors : ndarray of float64, shape (R, p)
    sum_of_squares : float
        Of what is to be explained, about the recordings' means.
    n_free : int
        Its degrees of freedom: runs less recordings.
    """

    matrices: FloatArray
    vectors: FloatArray
    sum_of_squares: float
    n_free: int

    @classmethod
    def of(
        cls,
        codes: Sequence[IntArray],
        recordings: IntArray,
        values: FloatArray,
        *,
        n_effects: int,
    ) -> AdditiveModel:
        """Set up the equations.

        Parameters
        ----------
        codes : sequence of ndarray of int64, each of shape (n,)
            For each parameter the number, among all effects, of the value that a run has.
        recordings : ndarray of int64, shape (n,)
            Number of each run's recording.
        values : ndarray of float64, shape (n,)
            To be explained.
        n_effects : int
            Values of all parameters, p.
        """
        columns = np.zeros((len(values), n_effects))
        for code in codes:
            columns[np.arange(len(values)), code] = 1.0
        matrices, vectors, squares = [], [], 0.0
        for recording in np.unique(recordings):
            is_of_it = recordings == recording
            x = columns[is_of_it] - columns[is_of_it].mean(axis=0)
            y = values[is_of_it] - values[is_of_it].mean()
            matrices.append(x.T @ x)
            vectors.append(x.T @ y)
            squares += float(y @ y)
        return cls(
            matrices=np.array(matrices),
            vectors=np.array(vectors),
            sum_of_squares=squares,
            n_free=len(values) - len(matrices),
        )

    @property
    def n_effects(self) -> int:
        """Number of all effects, p."""
        return int(self.vectors.shape[1])

    def solve(self, *, left_out: int | None = None, kept: BoolArray | None = None) -> Solution:
        """Return the effects.

        Parameters
        ----------
        left_out : int, optional
            A recording that does not count.
        kept : ndarray of bool, shape (p,), optional
            All other effects are taken for none.
        """
        matrix, vector = self.matrices.sum(axis=0), self.vectors.sum(axis=0)
        if left_out is not None:
            matrix, vector = matrix - self.matrices[left_out], vector - self.vectors[left_out]
        if kept is not None:
            matrix, vector = matrix * np.outer(kept, kept), vector * kept
        values, directions = np.linalg.eigh(matrix)
        is_open = values <= _SINGULAR * max(float(values[-1]), 1.0)
        inverse = np.where(is_open, 0.0, 1.0 / np.where(is_open, 1.0, values))
        return Solution(
            effects=directions @ (inverse * (directions.T @ vector)),
            open_directions=directions[:, is_open],
        )

    def solve_without_each(self) -> list[Solution]:
        """Return the effects with one recording left out each."""
        return [self.solve(left_out=recording) for recording in range(len(self.matrices))]

    def shares_of(self, columns: BoolArray) -> tuple[float, float]:
        """Return which share of the variance some effects explain, and would by chance.

        What the others explain as well is not theirs. By chance every degree of freedom explains
        as much as any other.
        """
        full, rest = self.solve(), self.solve(kept=~columns)
        right = self.vectors.sum(axis=0)
        explained = float((full.effects - rest.effects) @ right)
        if self.sum_of_squares <= 0.0 or self.n_free == 0:
            return 0.0, 0.0
        chance = (full.rank - rest.rank) / self.n_free
        return min(1.0, max(0.0, explained / self.sum_of_squares)), chance
