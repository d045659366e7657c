"""What is told at little cost is what takes longer to tell."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.geometry.validity import is_definite, is_plain_covariance, is_rigid
from gvo.types import FloatArray

seeds = st.integers(0, 2**32 - 1)
WRONG = [np.nan, np.inf, -np.inf]


def definite(rng: np.random.Generator, least: float = 1e-3) -> FloatArray:
    """Return a matrix with this smallest eigenvalue, shape (6, 6)."""
    vectors = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    eigenvalues = np.r_[rng.uniform(0.1, 2.0, 5), least]
    symmetric = (vectors * rng.permutation(eigenvalues)) @ vectors.T
    return np.asarray(0.5 * (symmetric + symmetric.T))


@given(seed=seeds)
def test_what_is_definite_is_told_as_eigenvalues_tell_it(seed: int) -> None:
    for least, expected in ((1e-3, True), (-1e-3, False)):
        symmetric = definite(np.random.default_rng(seed), least)
        assert is_definite(symmetric) is expected
        assert is_plain_covariance(symmetric) is expected


@given(seed=seeds)
def test_sigmas_of_any_size_are_plain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sigmas = 10.0 ** rng.uniform(-8, 6, 6)
    covariance = definite(rng, 0.05) * np.outer(sigmas, sigmas)
    assert is_plain_covariance(np.tril(covariance) + np.tril(covariance, -1).T)


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("place", [(row, column) for row in range(6) for column in range(row + 1)])
def test_no_number_that_is_none_is_plain(wrong: float, place: tuple[int, int]) -> None:
    for covariance in (np.eye(6), definite(np.random.default_rng(0))):
        covariance[place] = covariance[place[::-1]] = wrong
        assert not is_plain_covariance(covariance)


def test_what_is_only_nearly_symmetric_is_not_plain() -> None:
    covariance = definite(np.random.default_rng(1))
    assert is_plain_covariance(covariance)
    covariance[0, 1] = np.nextafter(covariance[0, 1], 1.0)
    assert not is_plain_covariance(covariance)


@given(seed=seeds)
def test_a_rigid_transform_is_told_from_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    assert is_rigid(T)
    for row, column in np.ndindex(4, 4):
        for wrong in WRONG:
            spoilt = T.copy()
            spoilt[row, column] = wrong
            assert not is_rigid(spoilt)
        spoilt = T.copy()
        spoilt[row, column] += 0.1
        assert is_rigid(spoilt) == (column == 3 and row < 3)
    assert not is_rigid(T @ np.diag([1.0, 1.0, -1.0, 1.0]))
    assert not is_rigid(T @ np.diag([2.0, 2.0, 2.0, 1.0]))
