"""Descriptor distances and mutual best pairs against plain loops."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.frontend.matching import (
    best_ratios,
    descriptor_distances,
    expand_ranges,
    mutual_best,
)
from gvo.types import FloatArray, IntArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)


def random_pairs(rng: np.random.Generator, n: int, m: int) -> IntArray:
    """Return a random subset of all pairs, in random order."""
    every = np.stack(np.meshgrid(np.arange(n), np.arange(m), indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(rng.permutation(every)[: rng.integers(0, n * m + 1)])


def slow_mutual_best(pairs: IntArray, distances: FloatArray) -> set[tuple[int, int]]:
    """Keep a pair if no other pair of either member is better, or equal and earlier."""
    kept = set()
    for k, (i, j) in enumerate(pairs):
        rivals = [other for other, (a, b) in enumerate(pairs) if other != k and (a == i or b == j)]
        if all((distances[k], k) < (distances[other], other) for other in rivals):
            kept.add((int(i), int(j)))
    return kept


@settings(deadline=None)
@given(seed=seeds, n=st.integers(1, 6), m=st.integers(1, 6), ties=st.booleans())
def test_mutual_best_pairs_are_those_of_the_plain_search(
    seed: int, n: int, m: int, ties: bool
) -> None:
    rng = np.random.default_rng(seed)
    pairs = random_pairs(rng, n, m)
    distances = rng.integers(0, 3, len(pairs)) / 2.0 if ties else rng.random(len(pairs))
    chosen = mutual_best(pairs, distances, n, m)
    found = [(int(i), int(j)) for i, j in pairs[chosen]]
    assert set(found) == slow_mutual_best(pairs, distances)
    assert [i for i, _ in found] == sorted({i for i, _ in found})
    assert len({j for _, j in found}) == len(found)


def test_the_best_of_one_side_alone_is_no_match() -> None:
    pairs = np.array([[0, 0], [1, 0], [1, 1]])
    # 0 likes 0 best, but 0 likes 1 better; 1 likes 0 best.
    assert mutual_best(pairs, np.array([0.2, 0.1, 0.3]), 2, 2).tolist() == [1]


def test_no_pairs_give_no_matches() -> None:
    none = np.zeros((0, 2), dtype=np.int64)
    assert mutual_best(none, np.zeros(0), 3, 4).shape == (0,)
    assert mutual_best(none, np.zeros(0), 0, 0).shape == (0,)


@settings(deadline=None)
@given(
    ranges=st.lists(st.tuples(st.integers(-5, 20), st.integers(-5, 20)), min_size=0, max_size=12)
)
def test_ranges_are_listed_row_by_row(ranges: list[tuple[int, int]]) -> None:
    bounds = np.array(ranges, dtype=np.int64).reshape(-1, 2)
    rows, positions = expand_ranges(bounds[:, 0], bounds[:, 1])
    expected = [(row, p) for row, (a, b) in enumerate(ranges) for p in range(a, b)]
    assert list(zip(rows.tolist(), positions.tolist(), strict=True)) == expected


@settings(deadline=None)
@given(seed=seeds, n_bytes=st.sampled_from([8, 32, 64]))
def test_binary_distances_are_shares_of_differing_bits(seed: int, n_bytes: int) -> None:
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, (5, n_bytes), dtype=np.uint8)
    second = rng.integers(0, 256, (4, n_bytes), dtype=np.uint8)
    pairs = random_pairs(rng, 5, 4)
    expected = [
        sum(bin(int(a) ^ int(b)).count("1") for a, b in zip(first[i], second[j], strict=True))
        / (8 * n_bytes)
        for i, j in pairs
    ]
    np.testing.assert_array_equal(descriptor_distances(first, second, pairs), expected)


def test_binary_distances_reach_from_zero_to_one() -> None:
    zeros = np.zeros((1, 32), dtype=np.uint8)
    pairs = np.array([[0, 0]])
    assert descriptor_distances(zeros, zeros, pairs).tolist() == [0.0]
    assert descriptor_distances(zeros, ~zeros, pairs).tolist() == [1.0]


def test_binary_descriptors_may_be_a_part_of_a_larger_array() -> None:
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (6, 64), dtype=np.uint8)
    part, copy = wide[::2, :32], wide[::2, :32].copy()
    pairs = np.array([[0, 1], [2, 0]])
    np.testing.assert_array_equal(
        descriptor_distances(part, part, pairs), descriptor_distances(copy, copy, pairs)
    )


@settings(deadline=None)
@given(seed=seeds)
def test_real_distances_are_euclidean_within_zero_and_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    raw = rng.random((2, 4, 128))
    # Descriptors of SIFT have the length 512.
    first, second = (512 * raw / np.linalg.norm(raw, axis=2, keepdims=True)).astype(np.float32)
    pairs = random_pairs(rng, 4, 4)
    distances = descriptor_distances(first, second, pairs)
    expected = [np.sqrt(sum((first[i] - second[j]) ** 2)) / 724.07734 for i, j in pairs]
    np.testing.assert_allclose(distances, expected, rtol=1e-4)
    assert np.all((distances >= 0) & (distances <= 1))
    # No entry is negative: two descriptors are farthest apart where they share none.
    apart = np.zeros((2, 128), dtype=np.float32)
    apart[0, 3] = apart[1, 7] = 512.0
    assert descriptor_distances(apart, apart, np.array([[0, 1]]))[0] == pytest.approx(1.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_no_pairs_have_no_distances(dtype: type) -> None:
    descriptors: Any = np.zeros((3, 32), dtype=dtype)
    none = np.zeros((0, 2), dtype=np.int64)
    assert descriptor_distances(descriptors, descriptors[:0], none).shape == (0,)


@given(st.integers(0, 30), st.integers(1, 6), st.integers(0, 2**16))
def test_the_ratio_is_that_of_the_two_best_candidates(k: int, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    members = rng.integers(n, size=k)
    distances = rng.integers(4, size=k) / 4.0
    ratios = best_ratios(members, distances, n)
    for member in range(n):
        two = sorted(distances[members == member].tolist())[:2]
        expected = 0.0 if len(two) < 2 else 1.0 if two[1] == 0 else two[0] / two[1]
        assert ratios[member] == expected
