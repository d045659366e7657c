"""Descriptor distances and mutual best pairs against plain loops; matches of two frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.config import TemporalConfig
from gvo.frontend.matching import (
    best_ratios,
    descriptor_distances,
    expand_ranges,
    match_temporal,
    mutual_best,
    predict_pixels,
)
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray, IntArray, Observations

seeds = st.integers(min_value=0, max_value=2**32 - 1)
CONFIG = TemporalConfig(max_distance=0.25, max_ratio=1.0)
CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)


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


@given(seed=seeds, n=st.integers(1, 6), m=st.integers(1, 6), ties=st.booleans())
def test_mutual_best_pairs_are_of_the_plain_search(seed: int, n: int, m: int, ties: bool) -> None:
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


@given(
    ranges=st.lists(st.tuples(st.integers(-5, 20), st.integers(-5, 20)), min_size=0, max_size=12)
)
def test_ranges_are_listed_row_by_row(ranges: list[tuple[int, int]]) -> None:
    bounds = np.array(ranges, dtype=np.int64).reshape(-1, 2)
    rows, positions = expand_ranges(bounds[:, 0], bounds[:, 1])
    expected = [(row, p) for row, (a, b) in enumerate(ranges) for p in range(a, b)]
    assert list(zip(rows.tolist(), positions.tolist(), strict=True)) == expected


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
    wide = np.random.default_rng(0).integers(0, 256, (6, 64), dtype=np.uint8)
    part, copy = wide[::2, :32], wide[::2, :32].copy()
    pairs = np.array([[0, 1], [2, 0]])
    np.testing.assert_array_equal(
        descriptor_distances(part, part, pairs), descriptor_distances(copy, copy, pairs)
    )


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


def random_codes(rng: np.random.Generator, n: int) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (n, 32), dtype=np.uint8)


def flip(codes: NDArray[np.uint8], n_bits: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return descriptors with `n_bits` of 256 bits flipped in each."""
    bits = np.unpackbits(codes, axis=1)
    for row in bits:
        row[rng.permutation(256)[:n_bits]] ^= 1
    return np.packbits(bits, axis=1)


def observe(
    keypoints: FloatArray,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8] | None = None,
    points: FloatArray | None = None,
) -> Observations:
    n = len(keypoints)
    return Observations(
        stamp_ns=0,
        keypoints=keypoints,
        disparities=np.full(n, 20.0),
        points_cam=np.tile([0.0, 0.0, 5.0], (n, 1)) if points is None else points,
        sigmas=np.ones((n, 3)),
        descriptors_left=left,
        descriptors_right=right,
    )


def match(reference: Observations, current: Observations, radius: float = 10.0) -> IntArray:
    return match_temporal(
        reference, current, predict_pixels(reference, None, CAMERA), CONFIG, radius_px=radius
    )


@settings(max_examples=40)
@given(seed=seeds, n=st.integers(1, 60))
def test_known_correspondences_are_found_and_nothing_else(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    codes = random_codes(rng, n)
    keypoints = rng.uniform(0, [640, 480], (n, 2))
    order = rng.permutation(n)
    shifts = rng.uniform(-6, 6, (n, 2))
    reference = observe(keypoints, codes)
    # Each point twice more than once flipped; one in three vanishes and another takes its place.
    current_codes = flip(codes, 20, rng)
    is_gone = rng.random(n) < 0.3
    current_codes[is_gone] = random_codes(rng, int(is_gone.sum()))
    current = observe((keypoints + shifts)[order], current_codes[order])
    expected = {(int(order[j]), j) for j in range(n) if not is_gone[order[j]]}
    matches = match(reference, current)
    assert set(map(tuple, matches.tolist())) == expected
    assert len(matches) == len(expected)


@settings(max_examples=40)
@given(seed=seeds, radius=st.floats(1.0, 50.0))
def test_equal_descriptors_match_within_the_radius_and_one_to_one(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    same = np.zeros((40, 32), dtype=np.uint8)
    first, second = rng.uniform(0, 200, (2, 40, 2))
    matches = match(observe(first, same), observe(second, same), radius)
    distances = np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1)
    assert np.all(distances <= radius)
    assert len(set(matches[:, 0].tolist())) == len(set(matches[:, 1].tolist())) == len(matches)
    nearest = np.linalg.norm(first[:, None] - second[None], axis=2).min()
    assert (len(matches) > 0) == (nearest <= radius)


@pytest.mark.parametrize(
    ("shift", "n_bits", "found"),
    [(0.0, 0, [[0, 0]]), (9.9, 0, [[0, 0]]), (10.1, 0, []), (0.0, 64, [[0, 0]]), (0.0, 65, [])],
)
def test_the_radius_and_the_largest_distance_are_respected(
    shift: float, n_bits: int, found: list[list[int]]
) -> None:
    rng = np.random.default_rng(0)
    code, pixel = random_codes(rng, 1), np.array([[100.0, 50.0]])
    other = observe(pixel + shift * np.array([0.6, 0.8]), flip(code, n_bits, rng))
    assert match(observe(pixel, code), other).tolist() == found


def test_the_right_descriptors_decide_where_the_left_ones_are_alike() -> None:
    rng = np.random.default_rng(1)
    left = np.repeat(random_codes(rng, 1), 2, axis=0)
    right = random_codes(rng, 2)
    keypoints = np.array([[100.0, 50.0], [103.0, 50.0]])
    reference = observe(keypoints, left, right)
    assert match(reference, observe(keypoints, left, right[::-1])).tolist() == [[0, 1], [1, 0]]
    assert match(reference, observe(keypoints, left, right)).tolist() == [[0, 0], [1, 1]]


def test_the_left_descriptors_decide_where_the_right_ones_are_alike() -> None:
    rng = np.random.default_rng(1)
    right = np.repeat(random_codes(rng, 1), 2, axis=0)
    left = random_codes(rng, 2)
    keypoints = np.array([[100.0, 50.0], [103.0, 50.0]])
    reference = observe(keypoints, left, right)
    assert match(reference, observe(keypoints, left[::-1], right)).tolist() == [[0, 1], [1, 0]]


def test_the_distance_is_the_mean_of_left_and_right() -> None:
    rng = np.random.default_rng(2)
    left, right = random_codes(rng, 1), random_codes(rng, 1)
    pixel = np.array([[100.0, 50.0]])
    reference = observe(pixel, left, right)
    worse = flip(right, 108, rng)  # with 20 on the left: 64 on average
    assert len(match(reference, observe(pixel, flip(left, 20, rng), worse))) == 1
    assert len(match(reference, observe(pixel, flip(left, 21, rng), worse))) == 0


def test_frames_without_right_descriptors_are_matched_by_the_left_ones() -> None:
    rng = np.random.default_rng(3)
    codes, keypoints = random_codes(rng, 5), rng.uniform(0, 400, (5, 2))
    both = observe(keypoints, codes, random_codes(rng, 5))
    for current in (both, replace(both, descriptors_right=None)):
        reference = replace(both, descriptors_right=None)
        assert match(reference, current).tolist() == [[i, i] for i in range(5)]


@pytest.mark.parametrize(("n", "m"), [(0, 3), (3, 0), (0, 0)])
def test_nothing_to_match_gives_no_matches(n: int, m: int) -> None:
    rng = np.random.default_rng(0)
    reference = observe(np.zeros((n, 2)), random_codes(rng, n))
    assert match(reference, observe(np.zeros((m, 2)), random_codes(rng, m))).shape == (0, 2)


@settings(max_examples=40)
@given(seed=seeds)
def test_a_prediction_is_the_projection_into_the_current_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 0.5], [3, 3, 9], (30, 3))
    T_reference_current = np.eye(4)
    T_reference_current[:3, :3] = Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix()
    T_reference_current[:3, 3] = rng.normal(size=3) + np.array([0.0, 0.0, 2.0])
    reference = observe(np.zeros((30, 2)), random_codes(rng, 30), points=points)
    pixels, indices = predict_pixels(reference, T_reference_current, CAMERA)
    T_current_reference = np.linalg.inv(T_reference_current)
    moved = points @ T_current_reference[:3, :3].T + T_current_reference[:3, 3]
    assert set(np.flatnonzero(moved[:, 2] > 0.01)) <= set(indices.tolist())
    assert set(indices.tolist()) <= set(np.flatnonzero(moved[:, 2] > 0))
    homogeneous = moved[indices] @ CAMERA.K.T
    np.testing.assert_allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-6)


def test_matches_of_a_prediction_keep_the_indices_of_the_reference() -> None:
    codes = random_codes(np.random.default_rng(4), 3)
    points = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 6.0], [0.0, 0.5, 8.0]])
    reference = observe(np.zeros((3, 2)), codes, points=points)
    T_reference_current = np.eye(4)
    T_reference_current[2, 3] = 2.0  # the first point falls behind
    pixels = np.array([[500 * 0.5 / 4 + 320, 240.0], [320.0, 480 * 0.5 / 6 + 240]])
    current = observe(pixels, codes[1:])
    predicted = predict_pixels(reference, T_reference_current, CAMERA)
    matches = match_temporal(reference, current, predicted, CONFIG, radius_px=2.0)
    assert matches.tolist() == [[1, 0], [2, 1]]


@pytest.mark.parametrize(("max_ratio", "is_found"), [(1.0, True), (0.51, True), (0.49, False)])
def test_a_match_must_stand_out_from_the_second_best(max_ratio: float, is_found: bool) -> None:
    rng = np.random.default_rng(0)
    code = random_codes(rng, 1)
    reference = observe(np.array([[100.0, 50.0]]), code)
    codes = np.concatenate([flip(code, 10, rng), flip(code, 20, rng)])
    current = observe(np.array([[101.0, 50.0], [102.0, 50.0]]), codes)
    found = match_temporal(
        reference,
        current,
        predict_pixels(reference, None, CAMERA),
        CONFIG.model_copy(update={"max_ratio": max_ratio}),
        radius_px=10.0,
    )
    assert found.tolist() == ([[0, 0]] if is_found else [])
