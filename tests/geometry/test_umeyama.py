"""The closed-form rigid fit against scipy and against what a least-squares fit must obey."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry.umeyama import fit_rigid, fit_rigid_batch, fit_rigid_triples
from gvo.types import Failure, FloatArray
from tests.geometry.scenes import move, seeds


def random_transform(rng: np.random.Generator) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = 10.0 * rng.normal(size=3)
    return T


def fit(
    points_a: FloatArray, points_b: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    T = fit_rigid(points_a, points_b, weights=weights)
    assert not isinstance(T, Failure), T
    return T


@given(seed=seeds, n=st.integers(min_value=4, max_value=30))
def test_a_known_transform_is_recovered(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    T, points_b = random_transform(rng), rng.normal(size=(n, 3))
    np.testing.assert_allclose(fit(move(T, points_b), points_b), T, atol=1e-8)


@given(seed=seeds)
def test_the_fit_to_noisy_points_is_that_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points_b, weights = rng.normal(size=(12, 3)), rng.uniform(0.1, 3.0, size=12)
    points_a = move(random_transform(rng), points_b) + 0.05 * rng.normal(size=(12, 3))
    T = fit(points_a, points_b, weights)
    mean_b = np.average(points_b, axis=0, weights=weights)
    mean_a = np.average(points_a, axis=0, weights=weights)
    theirs = Rotation.align_vectors(points_a - mean_a, points_b - mean_b, weights=weights)[0]
    np.testing.assert_allclose(T[:3, :3], theirs.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(T[:3, 3], mean_a - theirs.apply(mean_b), atol=1e-6)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@given(seed=seeds)
def test_a_batch_equals_its_fits_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points_b = rng.normal(size=(2, 3, 6, 3))
    points_a = points_b + 0.1 * rng.normal(size=points_b.shape)
    weights = rng.uniform(0.0, 1.0, size=(2, 3, 6))
    points_b[1, 2] = points_b[1, 2, :1]  # one of them has no answer
    for w in (weights, None):
        T, is_valid = fit_rigid_batch(points_a, points_b, weights=w)
        assert is_valid.tolist() == [[True, True, True], [True, True, False]]
        for index in np.argwhere(is_valid):
            i, j = index
            one = fit(points_a[i, j], points_b[i, j], None if w is None else w[i, j])
            np.testing.assert_allclose(T[i, j], one, atol=1e-9)
        np.testing.assert_array_equal(T[1, 2, :3, :3], np.eye(3))


@given(seed=seeds, repeats=st.lists(st.integers(0, 4), min_size=8, max_size=8))
def test_integer_weights_equal_repeated_points(seed: int, repeats: list[int]) -> None:
    rng = np.random.default_rng(seed)
    counts = np.maximum(repeats, [1, 1, 1, 1, 0, 0, 0, 0])
    points_b = rng.normal(size=(8, 3))
    points_a = move(random_transform(rng), points_b) + 0.1 * rng.normal(size=(8, 3))
    weighted = fit(points_a, points_b, counts.astype(float))
    repeated = fit(np.repeat(points_a, counts, axis=0), np.repeat(points_b, counts, axis=0))
    np.testing.assert_allclose(weighted, repeated, atol=1e-7)


@given(seed=seeds)
def test_points_of_a_plane_are_enough(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.normal(size=(9, 2)), np.zeros(9)])
    points_b = move(random_transform(rng), flat)
    T = random_transform(rng)
    np.testing.assert_allclose(fit(move(T, points_b), points_b), T, atol=1e-7)


@given(seed=seeds, n=st.integers(min_value=3, max_value=10))
def test_points_on_a_line_are_refused(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    points_b = rng.normal(size=3) + rng.normal(size=(n, 1)) * direction
    result = fit_rigid(move(random_transform(rng), points_b), points_b)
    assert isinstance(result, Failure)
    assert not result
    assert "line" in result.reason
    assert result.n_matches == n


@pytest.mark.parametrize("n", [3, 7])
@pytest.mark.parametrize("weighted", [True, False])
def test_one_point_seen_many_times_is_refused(n: int, weighted: bool) -> None:
    # In one set of some hundred, the rounding of the mean looks like a spread.
    rng = np.random.default_rng(0)
    points_b = np.repeat(100 * rng.normal(size=(3000, 1, 3)), n, axis=1)
    points_a = 100 * rng.normal(size=(3000, n, 3))
    weights = rng.uniform(0.1, 1.0, size=(3000, n)) if weighted else None
    assert not fit_rigid_batch(points_a, points_b, weights=weights)[1].any()
    assert not fit_rigid_batch(points_b, points_a, weights=weights)[1].any()


@given(seed=seeds, size=st.sampled_from([1e-3, 1.0, 100.0]))
def test_small_far_sets_of_points_are_not_refused(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    points_b = np.array([0.0, 0.0, 100.0]) + size * rng.normal(size=(6, 3))
    T = random_transform(rng)
    assert np.linalg.norm(fit(move(T, points_b), points_b)[:3, :3] - T[:3, :3]) < 1e-6


@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_points_are_refused(n: int) -> None:
    points = np.random.default_rng(0).normal(size=(n, 3))
    result = fit_rigid(points, points)
    assert isinstance(result, Failure)
    assert result.n_matches == n
    T, is_valid = fit_rigid_batch(points[np.newaxis], points[np.newaxis])
    np.testing.assert_array_equal(T, np.eye(4)[np.newaxis])
    assert is_valid.tolist() == [False]


def test_weights_that_leave_two_points_are_refused() -> None:
    points = np.random.default_rng(1).normal(size=(5, 3))
    assert not isinstance(fit_rigid(points, points, weights=np.array([1.0, 1, 1, 0, 0])), Failure)
    for left in ([1.0, 1, 0, 0, 0], [1.0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0]):
        assert isinstance(fit_rigid(points, points, weights=np.array(left)), Failure)


@given(seed=seeds)
def test_mirrored_points_get_a_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points_b = rng.normal(size=(10, 3))
    mirrored = points_b * [1.0, 1.0, -1.0]
    T = fit(mirrored, points_b)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    # The best of the rotations: no small turn does better.
    cost = np.sum((move(T, points_b) - mirrored) ** 2)
    for turn in Rotation.from_rotvec(1e-3 * rng.normal(size=(20, 3))):
        turned = T[:3, :3] @ turn.as_matrix()
        moved = points_b @ turned.T + mirrored.mean(axis=0) - turned @ points_b.mean(axis=0)
        assert np.sum((moved - mirrored) ** 2) >= cost - 1e-9


def test_unknown_points_are_refused_and_leave_the_others_alone() -> None:
    points_b = np.random.default_rng(2).normal(size=(3, 5, 3))
    points_a = points_b + 1.0
    points_a[1, 2, 0] = np.nan
    T, is_valid = fit_rigid_batch(points_a, points_b)
    assert is_valid.tolist() == [True, False, True]
    np.testing.assert_allclose(T[[0, 2], :3, 3], 1.0)


@pytest.mark.parametrize("shapes", [((4, 3), (5, 3)), ((4, 2), (4, 2))])
def test_arrays_that_do_not_correspond_are_misuse(shapes: tuple[tuple[int, ...], ...]) -> None:
    with pytest.raises(ValueError, match="n, 3"):
        fit_rigid_batch(np.zeros(shapes[0]), np.zeros(shapes[1]))


def test_negative_weights_are_misuse() -> None:
    points = np.eye(3)
    with pytest.raises(ValueError, match="negative"):
        fit_rigid(points, points, weights=np.array([1.0, -1.0, 1.0]))


@given(seed=seeds, noise=st.sampled_from([0.0, 0.1, 1.0, 10.0]))
def test_the_fit_to_triples_is_that_of_scipy(seed: int, noise: float) -> None:
    # Noise up to triangles that have nothing in common.
    rng = np.random.default_rng(seed)
    points_b = rng.normal(size=(5, 3, 3)) + 10.0 * rng.normal(size=3)
    points_a = np.stack([move(random_transform(rng), triple) for triple in points_b])
    points_a += noise * rng.normal(size=(5, 3, 3))
    T, is_valid = fit_rigid_triples(points_a, points_b)
    assert is_valid.all()
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0, 0, 1], (5, 1)))
    for each, b, a in zip(T, points_b, points_a, strict=True):
        theirs = Rotation.align_vectors(a - a.mean(axis=0), b - b.mean(axis=0))[0]
        expected = np.sum((theirs.apply(b - b.mean(axis=0)) - a + a.mean(axis=0)) ** 2)
        cost = np.sum((move(each, b) - a) ** 2)
        assert cost == pytest.approx(expected, rel=1e-6, abs=1e-12)
        np.testing.assert_allclose(each[:3, :3] @ each[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(each[:3, :3]) == pytest.approx(1.0)


def test_triples_without_an_answer_are_told_from_the_others() -> None:
    points_b = 100.0 * np.random.default_rng(4).normal(size=(6, 3, 3))
    points_a = points_b + 1.0
    points_b[1] = points_b[1, 0] + np.outer([0.0, 1.0, 2.5], [1.0, 2.0, 3.0])
    points_a[2] = points_a[2, 0] + np.outer([0.0, 1.0, -2.5], [1.0, 2.0, 3.0])
    points_b[3] = points_b[3, 0]
    points_a[4, 2, 0] = np.nan
    T, is_valid = fit_rigid_triples(points_a, points_b)
    assert is_valid.tolist() == [True, False, False, False, False, True]
    np.testing.assert_allclose(T[[0, 5], :3, 3], 1.0)
    np.testing.assert_array_equal(T[1:4, :3, :3], np.tile(np.eye(3), (3, 1, 1)))


def triangle(rng: np.random.Generator) -> FloatArray:
    angles = rng.uniform(0, 2 * np.pi) + np.arange(3) * 2 * np.pi / 3.0
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])


def both_say(points_a: FloatArray, points_b: FloatArray) -> bool:
    """Return whether three points have an answer; both ways to fit them must agree."""
    _, triples = fit_rigid_triples(points_a[np.newaxis], points_b[np.newaxis])
    is_fit = not isinstance(fit_rigid(points_a, points_b), Failure)
    assert bool(triples[0]) == is_fit
    return is_fit


@given(seed=seeds, size=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_triangle_is_a_line_below_a_thousandth_at_any_size(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    T_b, T_a = random_transform(rng), random_transform(rng)
    for ratio, is_fit in ((1.03e-3, True), (0.97e-3, False)):
        # Standard deviations across and along: of two at the ends and one beside the middle.
        flat = size * np.array([[-1.0, 0, 0], [1.0, 0, 0], [0.0, np.sqrt(3.0) * ratio, 0]])
        flat = flat[rng.permutation(3)]
        T_b[:3, 3], T_a[:3, 3] = size * rng.normal(size=(2, 3))
        assert both_say(move(T_a, flat), move(T_b, flat)) == is_fit


@given(seed=seeds, size=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_triangle_is_a_point_where_its_size_is_rounding(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    flat = size * triangle(rng)
    for distance, is_fit in ((1e6, True), (8e6, False)):
        place = size * distance * np.eye(3)[rng.integers(3)]
        assert both_say(flat + place, flat + place) == is_fit


@settings(max_examples=10)
@given(seed=seeds, size=st.sampled_from([1e-3, 1.0, 1e3]))
def test_the_size_that_makes_a_triangle_a_point_is_told(seed: int, size: float) -> None:
    # Mean squares of coordinates in the plane are half a square of the size, each. The larger
    # counts where sets are fitted, the mean of both where triples are, over 1e-13 of the place.
    flat = size * triangle(np.random.default_rng(seed))
    for square, is_batch, is_triple in (
        (4.5e12, True, True),
        (5.5e12, False, True),
        (9.0e12, False, True),
        (11e12, False, False),
    ):
        there = (flat + np.array([0.0, 0.0, size * np.sqrt(square)]))[np.newaxis]
        assert bool(fit_rigid_batch(there, there)[1][0]) == is_batch
        assert bool(fit_rigid_triples(there, there)[1][0]) == is_triple
