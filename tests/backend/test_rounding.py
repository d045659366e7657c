"""Covariances as GTSAM gives them: with the traces of rounding, and with worse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.isam2 import definite, first_line
from gvo.errors import SmoothingError
from gvo.types import FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)


def correlations(rng: np.random.Generator, least: float) -> FloatArray:
    """Return a matrix with ones on its diagonal and about this least eigenvalue."""
    factor = rng.normal(size=(6, 5))
    flat = factor @ factor.T  # of rank five
    scale = np.sqrt(np.diag(flat))
    flat /= np.outer(scale, scale)
    return np.asarray((flat + least * np.eye(6)) / (1.0 + least))


@settings(deadline=None, max_examples=50)
@given(seed=seeds, exponent=st.floats(-9.0, -7.0))
def test_a_little_less_than_definite_is_mended_and_keeps_what_it_says(
    seed: int, exponent: float
) -> None:
    rng = np.random.default_rng(seed)
    sigmas = 10.0 ** rng.uniform(-4, 4, size=6)
    scale = np.outer(sigmas, sigmas)
    spoilt = correlations(rng, -(10.0**exponent))
    mended = definite(spoilt * scale) / scale
    np.testing.assert_array_equal(mended, mended.T)
    eigenvalues = np.linalg.eigvalsh(mended)
    # As positive as a factorization needs, and no farther off than that.
    assert 0.5e-10 < eigenvalues[0] < 2e-10
    assert np.linalg.norm(mended - spoilt, 2) < 1.5 * 10.0**exponent + 2e-10
    np.testing.assert_allclose(eigenvalues[1:], np.linalg.eigvalsh(spoilt)[1:], atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seed=seeds)
def test_a_definite_one_is_only_made_symmetric(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6))
    covariance = factor @ factor.T + 0.1 * np.eye(6)
    np.testing.assert_array_equal(definite(covariance), 0.5 * (covariance + covariance.T))
    skew = np.triu(rng.normal(size=(6, 6)), 1)
    np.testing.assert_allclose(definite(covariance + 0.01 * (skew - skew.T)), covariance)


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.diag([1.0, 1, np.nan, 1, 1, 1]), "not finite"),
        (np.diag([1.0, 1, np.inf, 1, 1, 1]), "not finite"),
        (np.diag([1.0, 1, 0, 1, 1, 1]), "variance is not positive"),
        (np.diag([1.0, 1, -1e-9, 1, 1, 1]), "variance is not positive"),
        (1.001 * np.eye(6) * 2 - np.ones((6, 6)), "not positive definite"),
        (1.00001 * np.ones((6, 6)) - 1e-5 * np.eye(6), "not positive definite"),
    ],
)
def test_what_is_more_than_rounding_is_refused(covariance: FloatArray, match: str) -> None:
    with pytest.raises(SmoothingError, match=match):
        definite(covariance)


def test_of_an_error_the_first_line_is_told() -> None:
    assert first_line(RuntimeError("\n  one thing\nand more\n")) == "one thing"
    assert first_line(IndexError()) == "IndexError"
