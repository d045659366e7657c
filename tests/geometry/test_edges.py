from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from gvo.geometry import se3
from gvo.geometry.edges import chi2, fuse, inverse, then
from gvo.types import Edge, FloatArray

SEEDS = st.integers(0, 2**32 - 1)


def edge_of(seed: int, reference_id: object = "a", *, sigma: float = 1e-3) -> Edge:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    return Edge(
        reference_id=reference_id,
        T_reference_frame=se3.exp(rng.normal(size=6) * [0.5, 0.5, 0.5, 2.0, 2.0, 2.0]),
        covariance=sigma**2 * (root @ root.T + np.eye(6)),
        effects=rng.normal(size=(6, 2)),
    )


def hat(xi: FloatArray) -> FloatArray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = se3.skew(xi[:3])
    matrix[:3, 3] = xi[3:]
    return matrix


def samples(edge: Edge, rng: np.random.Generator, n: int) -> FloatArray:
    errors = rng.multivariate_normal(np.zeros(6), edge.covariance, size=n)
    moved = np.array([expm(hat(error)) for error in errors], dtype=np.float64)
    poses: FloatArray = edge.T_reference_frame @ moved
    return poses


def spread(T: FloatArray, about: FloatArray) -> FloatArray:
    logs = [np.real(logm(np.linalg.inv(about) @ each)) for each in T]
    errors = np.array([[m[2, 1], m[0, 2], m[1, 0], *m[:3, 3]] for m in logs])
    return np.asarray(errors.T @ errors / len(errors))


@given(SEEDS)
def test_one_edge_after_another_and_back_is_no_motion(seed: int) -> None:
    edge = edge_of(seed)
    back = then(edge, inverse(edge, "b"))
    assert back.reference_id == "a"
    np.testing.assert_allclose(back.T_reference_frame, np.eye(4), atol=1e-12)
    # what goes and comes by independent measurements is twice as uncertain as either
    np.testing.assert_allclose(back.covariance, 2.0 * inverse(edge, "b").covariance, rtol=1e-9)


@given(SEEDS)
def test_the_order_of_joining_does_not_matter(seed: int) -> None:
    a, b, c = (edge_of(seed + k) for k in range(3))
    left, right = then(then(a, b), c), then(a, then(b, c))
    np.testing.assert_allclose(left.T_reference_frame, right.T_reference_frame, atol=1e-12)
    np.testing.assert_allclose(left.covariance, right.covariance, rtol=1e-9, atol=1e-18)


@given(SEEDS)
def test_an_edge_turned_twice_is_itself(seed: int) -> None:
    edge = edge_of(seed)
    twice = inverse(inverse(edge, "b"), "a")
    assert (inverse(edge, "b").reference_id, twice.reference_id) == ("b", "a")
    np.testing.assert_allclose(twice.T_reference_frame, edge.T_reference_frame, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, edge.covariance, rtol=1e-9, atol=1e-18)


def test_covariances_are_those_of_samples() -> None:
    rng = np.random.default_rng(0)
    first, second = edge_of(1, sigma=2e-3), edge_of(2, "b", sigma=2e-3)
    pairs = samples(first, rng, 400), samples(second, rng, 400)
    joined, turned = then(first, second), inverse(first, "b")
    for edge, sampled in (
        (joined, pairs[0] @ pairs[1]),
        (turned, np.asarray(np.linalg.inv(pairs[0]), dtype=np.float64)),
    ):
        expected = spread(sampled, edge.T_reference_frame)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((edge.covariance - expected) / scale).max() < 0.2


@given(SEEDS, st.integers(2, 5))
def test_fusing_adds_information_and_finds_the_least_squares(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    truth = edge_of(seed)
    edges = [
        Edge(
            reference_id="a",
            T_reference_frame=truth.T_reference_frame @ se3.exp(1e-6 * rng.normal(size=6)),
            covariance=edge_of(seed + k).covariance,
        )
        for k in range(n)
    ]
    fused = fuse(edges)
    informations = [np.linalg.inv(edge.covariance) for edge in edges]
    information = np.sum(informations, axis=0)
    np.testing.assert_allclose(np.linalg.inv(fused.covariance), information, rtol=1e-6, atol=1e-3)
    T = truth.T_reference_frame
    twists = [se3.log(se3.invert(T) @ edge.T_reference_frame) for edge in edges]
    mean = np.linalg.solve(
        information, sum(W @ twist for W, twist in zip(informations, twists, strict=True))
    )
    found = se3.log(se3.invert(T) @ fused.T_reference_frame)
    np.testing.assert_allclose(found, mean, atol=1e-9)


def test_one_edge_alone_is_fused_to_itself() -> None:
    edge = edge_of(3)
    np.testing.assert_array_equal(fuse([edge]).T_reference_frame, edge.T_reference_frame)
    np.testing.assert_array_equal(fuse([edge]).covariance, edge.covariance)


@given(SEEDS)
def test_chi2_counts_squared_sigmas_and_is_the_same_from_either_end(seed: int) -> None:
    edge, rng = edge_of(seed), np.random.default_rng(seed)
    error = np.linalg.cholesky(edge.covariance) @ rng.normal(size=6)
    T = edge.T_reference_frame @ se3.exp(error)
    expected = error @ np.linalg.solve(edge.covariance, error)
    assert chi2(edge, T) == pytest.approx(expected, rel=1e-6)
    assert chi2(inverse(edge, "b"), se3.invert(T)) == pytest.approx(expected, rel=1e-2)
    # an uncertainty of the known pose as large as the edge's halves it
    assert chi2(edge, T, edge.covariance) == pytest.approx(expected / 2.0, rel=1e-6)


def test_an_edge_that_differs_more_has_a_larger_chi2() -> None:
    edge = edge_of(5)
    steps = [chi2(edge, edge.T_reference_frame @ se3.exp(s * np.ones(6))) for s in (0, 0.01, 0.1)]
    assert all(a < b for a, b in pairwise(steps))


STEP = 1e-6


def bent(edge: Edge, of_one: FloatArray) -> Edge:
    """Return the edge as shared errors move it; its own effects are gone."""
    assert edge.effects is not None
    T = edge.T_reference_frame @ se3.exp(STEP * edge.effects @ of_one)
    return replace(edge, T_reference_frame=T, effects=None)


def assert_moved(found: Edge, exact: Edge, of_one: FloatArray) -> None:
    assert found.effects is not None
    twist = se3.log(se3.invert(found.T_reference_frame) @ exact.T_reference_frame)
    np.testing.assert_allclose(found.effects @ of_one, twist / STEP, rtol=1e-3, atol=1e-3)


@given(SEEDS)
def test_shared_errors_move_what_becomes_of_edges_as_they_move_these(seed: int) -> None:
    first, second, of_one = edge_of(seed), edge_of(seed + 1, "b"), np.array([0.7, -0.4])
    both = bent(first, of_one), bent(second, of_one)
    assert_moved(then(first, second), then(*both), of_one)
    assert_moved(inverse(first, "b"), inverse(both[0], "b"), of_one)
    near = first.T_reference_frame @ se3.exp(1e-6 * np.ones(6))
    other = replace(second, reference_id="a", T_reference_frame=near)
    assert_moved(fuse([first, other]), fuse([both[0], bent(other, of_one)]), of_one)


@given(SEEDS)
def test_an_edge_without_effects_is_not_moved(seed: int) -> None:
    first, second, of_one = edge_of(seed), edge_of(seed + 1, "b"), np.array([0.7, -0.4])
    still = replace(second, effects=None)
    assert_moved(then(first, still), then(bent(first, of_one), still), of_one)
    assert_moved(then(still, first), then(still, bent(first, of_one)), of_one)
    near = first.T_reference_frame @ se3.exp(1e-6 * np.ones(6))
    other = replace(second, reference_id="a", T_reference_frame=near, effects=None)
    assert_moved(fuse([first, other]), fuse([bent(first, of_one), other]), of_one)
    assert_moved(fuse([other, first]), fuse([other, bent(first, of_one)]), of_one)
    for edge in (then(still, still), inverse(still, "c"), fuse([still, still])):
        assert edge.effects is None
