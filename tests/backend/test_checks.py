"""What is let into the graph, and what is kept out and why."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.checks import covariance_fault, find_faults, prior_fault, transform_fault
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior, Prior

seeds = st.integers(min_value=0, max_value=2**32 - 1)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    factor = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-4, 0, size=6)
    return np.asarray(factor.T @ factor)


def edge(T: FloatArray, covariance: FloatArray) -> Edge:
    return Edge(reference_id="a", T_reference_frame=T, covariance=covariance)


@settings(deadline=None)
@given(seed=seeds, n=st.integers(1, 4))
def test_whatever_is_a_transform_and_a_covariance_is_let_through(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    edges = [edge(se3.exp(10 * rng.normal(size=6)), random_covariance(rng)) for _ in range(n)]
    edges.append(edge(np.eye(4), np.diag(10.0 ** rng.uniform(-15, 11, size=6))))
    assert find_faults(edges) == [""] * (n + 1)


@settings(deadline=None)
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


@pytest.mark.parametrize(("T", "match"), TRANSFORMS)
def test_what_is_no_transform_is_refused_with_its_reason(T: FloatArray, match: str) -> None:
    good = edge(np.eye(4), np.eye(6))
    faults = find_faults([good, edge(T, np.eye(6)), good])
    assert [bool(fault) for fault in faults] == [False, True, False]
    assert re.search(match, transform_fault(T))
    prior = PosePrior(T_world_frame=T, covariance=np.eye(6))
    assert prior_fault(prior) == faults[1] == transform_fault(T)


@pytest.mark.parametrize(("covariance", "match"), COVARIANCES)
def test_what_is_no_covariance_is_refused_with_its_reason(
    covariance: FloatArray, match: str
) -> None:
    good = edge(np.eye(4), np.eye(6))
    faults = find_faults([good, edge(np.eye(4), covariance), good])
    assert [bool(fault) for fault in faults] == [False, True, False]
    assert re.search(match, faults[1])
    prior = PosePrior(T_world_frame=np.eye(4), covariance=covariance)
    assert prior_fault(prior) == faults[1]


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


def test_a_position_anywhere_on_earth_is_let_through() -> None:
    position = np.array([3.9e6, -1.2e5, 6.3e6])
    assert prior_fault(PositionPrior(position_world=position, covariance=4.0 * np.eye(3))) == ""
