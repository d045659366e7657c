"""What is no rigid transform or no covariance, and why; told quickly and at length alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.geometry.se3 import is_definite, is_plain_covariance, is_rigid
from gvo.types import FloatArray
from tests.geometry.scenes import seeds

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
    T = se3.exp(np.random.default_rng(seed).normal(size=6))
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


@given(seed=seeds)
def test_rotations_are_told_one_by_one_and_as_a_stack(seed: int) -> None:
    T = se3.exp(np.random.default_rng(seed).normal(size=(5, 6)))
    T[1, :3, :3] *= 1.01
    T[2, :3, 0] *= -1.0
    T[3, 0, 1] += 1e-4
    for tolerance, expected in ((1e-6, [1, 0, 0, 0, 1]), (1e-3, [1, 0, 0, 1, 1])):
        assert se3.is_rotation(T[:, :3, :3], tolerance=tolerance).tolist() == expected
        assert [is_rigid(each, tolerance=tolerance) for each in T] == expected
        faults = [se3.transform_fault(each, tolerance=tolerance) for each in T]
        assert [not fault for fault in faults] == expected
        assert {*faults} == {"", "holds no rotation"}


def test_a_fault_of_a_transform_is_told() -> None:
    T = np.eye(4)
    assert se3.transform_fault(T) == ""
    assert se3.transform_fault(T[:3]) == "must have shape (4, 4), got (3, 4)"
    for wrong in WRONG:
        for place in ((0, 3), (1, 1), (3, 3)):
            spoilt = T.copy()
            spoilt[place] = wrong
            assert se3.transform_fault(spoilt) == "is not finite"
    assert se3.transform_fault(2.0 * T) == "must have (0, 0, 0, 1) as its last row"


@given(seed=seeds, n=st.sampled_from([3, 6]))
def test_a_fault_of_a_covariance_is_told(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    scales = 10.0 ** rng.uniform(-8, 6, n)
    scale = np.outer(scales, scales)
    for least, fault in ((1e-3, ""), (-1e-3, "is not positive definite")):
        covariance = definite(rng, least)
        axes = np.linalg.eigh(covariance)[1][:, :n]  # keeps the smallest eigenvalue
        smaller = axes.T @ covariance @ axes if n < 6 else covariance
        assert se3.covariance_fault(smaller * scale) == fault
        smaller[0, 1] += 1e-12 * np.sqrt(np.abs(smaller[0, 0] * smaller[1, 1]))
        assert se3.covariance_fault(smaller * scale) == fault
    skewed = np.eye(n)
    skewed[0, 1] = 1e-3
    assert se3.covariance_fault(skewed * scale) == "is not symmetric"
    assert se3.covariance_fault(np.diag(np.r_[np.ones(n - 1), np.inf])) == "is not finite"
