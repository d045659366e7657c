"""What is let into the graph, and what is kept out and why."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.backend.factors import (
    check_places,
    covariance_fault,
    definite,
    find_faults,
    first_line,
    prior_fault,
    transform_fault,
)
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior
from tests.backend.walks import seeds


def random_covariance(rng: np.random.Generator) -> FloatArray:
    factor = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-4, 0, size=6)
    return np.asarray(factor.T @ factor)


def edge(T: FloatArray, covariance: FloatArray) -> Edge:
    return Edge(reference_id="a", T_reference_frame=T, covariance=covariance)


@given(seed=seeds, n=st.integers(1, 4))
def test_whatever_is_a_transform_and_a_covariance_is_let_through(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    edges = [edge(se3.exp(10 * rng.normal(size=6)), random_covariance(rng)) for _ in range(n)]
    edges.append(edge(np.eye(4), np.diag(10.0 ** rng.uniform(-15, 11, size=6))))
    assert find_faults(edges) == [""] * (n + 1)


@given(seed=seeds)
def test_a_covariance_that_was_moved_to_another_frame_is_let_through(seed: int) -> None:
    # Rounding leaves such products a little asymmetric, above all where they should be zero.
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    plain = 10.0 ** rng.uniform(-8, 0) * np.eye(6)
    assert covariance_fault(se3.compose_covariance(plain, T, plain)) == ""
    Ad = se3.adjoint(np.diag([-1.0, -1.0, 1.0, 1.0]) @ T)
    assert covariance_fault(Ad @ plain @ Ad.T) == ""


def changed(array: FloatArray, *index: int, value: float) -> FloatArray:
    array = array.copy()
    array[index] = value
    return array


TRANSFORMS = [
    (np.full((4, 4), np.nan), "not finite"),
    (changed(np.eye(4), 0, 3, value=np.inf), "not finite"),
    (changed(np.eye(4), 1, 3, value=-1e300), "beyond 1e.08 m"),
    (changed(np.eye(4), 2, 3, value=1.01e8), "beyond 1e.08 m"),
    (changed(np.eye(4), 0, 0, value=1.001), "rotation"),
    (changed(np.eye(4), 0, 0, value=1e200), "rotation"),
    (np.diag([1.0, 1.0, -1.0, 1.0]), "rotation"),
    (np.diag([0.0, 0.0, 0.0, 1.0]), "rotation"),
    (changed(np.eye(4), 3, 0, value=0.1), "last row"),
    (changed(np.eye(4), 3, 3, value=2.0), "last row"),
]
COVARIANCES = [
    (np.full((6, 6), np.nan), "not finite"),
    (np.diag([1.0, 1, 1, 1, 1, np.inf]), "not finite"),
    (changed(np.eye(6), 0, 1, value=0.1), "not symmetric"),
    (np.zeros((6, 6)), "definite"),
    (np.diag([1.0, 1, 1, 1, 1, 0]), "definite"),
    (np.diag([1.0, 1, 1, 1, 1, -1]), "definite"),
    (np.ones((6, 6)), "definite"),
    (2.0 * np.eye(6) - np.ones((6, 6)), "definite"),
    (changed(changed(np.eye(6), 0, 1, value=1e200), 1, 0, value=1e200), "definite"),
    (1e-20 * np.eye(6), "sigma 1e-10"),
    (1e20 * np.eye(6), r"sigma 1e\+10"),
]


@pytest.mark.parametrize(
    ("T", "covariance", "match"),
    [
        *((T, np.eye(6), match) for T, match in TRANSFORMS),
        *((np.eye(4), covariance, match) for covariance, match in COVARIANCES),
    ],
)
def test_what_is_no_transform_or_no_covariance_is_refused_with_its_reason(
    T: FloatArray, covariance: FloatArray, match: str
) -> None:
    good = edge(np.eye(4), np.eye(6))
    faults = find_faults([good, edge(T, covariance), good])
    assert [bool(fault) for fault in faults] == [False, True, False]
    assert re.search(match, faults[1])
    prior = PosePrior(T_world_frame=T, covariance=covariance)
    assert prior_fault(prior) == faults[1] == (transform_fault(T) or covariance_fault(covariance))


@pytest.mark.parametrize(
    ("prior", "match"),
    [
        (PositionPrior(position_world=np.array([0, np.nan, 0]), covariance=np.eye(3)), "position"),
        (PositionPrior(position_world=np.array([0, 0, 1e9]), covariance=np.eye(3)), r"1e\+09 m"),
        (PositionPrior(position_world=np.zeros(3), covariance=np.zeros((3, 3))), "definite"),
    ],
)
def test_a_position_that_is_none_is_refused_with_its_reason(prior: Prior, match: str) -> None:
    assert re.search(match, prior_fault(prior))


def assert_both_doors_say(one: Edge, is_good: bool) -> None:
    """Check that the quick look at all edges and the long one at each agree."""
    fault = transform_fault(one.T_reference_frame) or covariance_fault(one.covariance)
    assert [bool(found) for found in find_faults([one])] == [bool(fault)] == [not is_good]


@given(seed=seeds, size=st.sampled_from([2e-5, -2e-5]))
def test_a_rotation_that_is_off_in_any_one_way_is_refused(seed: int, size: float) -> None:
    T = se3.exp(np.random.default_rng(seed).normal(size=6))
    for row in range(3):
        for column in range(3):
            # A row too long or too short; two rows that are not square to each other.
            stretch = np.eye(4)
            stretch[row, column] += size
            assert_both_doors_say(edge(stretch @ T, np.eye(6)), is_good=False)
            stretch[row, column] = float(row == column) + 1e-8
            assert_both_doors_say(edge(stretch @ T, np.eye(6)), is_good=True)
        mirror = np.eye(4)
        mirror[row, row] = -1.0
        assert_both_doors_say(edge(mirror @ T, np.eye(6)), is_good=False)


@given(seed=seeds)
def test_the_bounds_of_what_is_let_in_are_those_that_are_told(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    axis, sign = int(rng.integers(3)), float(rng.choice([-1.0, 1.0]))
    for factor, is_good in ((0.999, True), (1.001, False)):
        far = changed(T, axis, 3, value=sign * factor * 1e8)
        assert_both_doors_say(edge(far, np.eye(6)), is_good)
        place = changed(np.zeros(3), axis, value=sign * factor * 1e8)
        known = PositionPrior(position_world=place, covariance=np.eye(3))
        assert bool(prior_fault(known)) == (not is_good)
        for sigma in (1e-8 / factor, 1e6 * factor):
            variances = changed(np.ones(6), int(rng.integers(6)), value=sigma**2)
            assert_both_doors_say(edge(T, np.diag(variances)), is_good)
        # Correlations: of eigenvalues just above and just below what rounding leaves.
        row, column = rng.choice(6, size=2, replace=False)
        sigmas = np.diag(10.0 ** rng.uniform(-4, 2, size=6))
        least = 1e-11 if is_good else -1e-11
        C = changed(np.eye(6), row, column, value=sign * (1.0 - least))
        C = changed(C, column, row, value=sign * (1.0 - least))
        assert_both_doors_say(edge(T, sigmas @ C @ sigmas), is_good)
        skewed = changed(np.eye(6), row, column, value=0.999e-6 if is_good else 1.001e-6)
        assert_both_doors_say(edge(T, sigmas @ skewed @ sigmas), is_good)


def test_a_result_that_is_nowhere_is_told_and_no_edges_have_no_faults() -> None:
    # A prior at the border may be moved a little: twice as far is still a place.
    check_places(np.array([[0.0, -1.99e8, 3.0], [1.0, 2.0, 3.0]]))
    check_places(np.array([2.0 * 1e8, 0.0, 0.0]))
    check_places(np.eye(4))
    with pytest.raises(RuntimeError, match=r"^a pose diverged to 2\.01e\+08 m$"):
        check_places(np.array([1.0, -2.01e8, 3.0]))
    for entry in (np.nan, np.inf, -1e9, np.nextafter(2e8, 3e8)):
        with pytest.raises(RuntimeError, match="diverged"):
            check_places(changed(np.eye(4), 1, 1, value=entry))
    assert find_faults([]) == []


# Covariances as GTSAM gives them: with the traces of rounding, and with worse.


def correlations(rng: np.random.Generator, least: float) -> FloatArray:
    """Return a matrix with ones on its diagonal and about this least eigenvalue."""
    factor = rng.normal(size=(6, 5))
    flat = factor @ factor.T  # of rank five
    scale = np.sqrt(np.diag(flat))
    flat /= np.outer(scale, scale)
    return np.asarray((flat + least * np.eye(6)) / (1.0 + least))


@given(seed=seeds, exponent=st.floats(-9.0, -7.0))
def test_a_little_less_than_definite_is_mended_in_what_it_lacks(seed: int, exponent: float) -> None:
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
    with pytest.raises(RuntimeError, match=match):
        definite(covariance)


def test_of_an_error_the_first_line_is_told() -> None:
    assert first_line(RuntimeError("\n  one thing\nand more\n")) == "one thing"
    assert first_line(IndexError()) == "IndexError"
