"""Consensus over minimal samples, on points projected from known poses."""

from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from gvo.config import RansacConfig
from gvo.geometry import ransac
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import Consensus, draw_samples, find_inliers, ransac_rigid
from gvo.geometry.umeyama import fit_rigid_triples
from gvo.types import BoolArray, Failure, FloatArray
from tests.geometry.scenes import CAMERA, matched, project, random_motion, seeds, seen_from

SETTINGS = RansacConfig(
    n_hypotheses=200,
    inlier_metric="reprojection",
    inlier_threshold_px=2.0,
    inlier_threshold_m=0.1,
    min_inliers=12,
    min_disparity_px=0.0,
)


def configure(**changes: Any) -> RansacConfig:
    return RansacConfig.model_validate(SETTINGS.model_dump() | changes)


def random_points(rng: np.random.Generator, n: int) -> FloatArray:
    return np.column_stack([rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng.uniform(2, 9, n)])


def scene(
    rng: np.random.Generator, n: int, n_outliers: int
) -> tuple[FloatArray, Correspondences, BoolArray]:
    """Return T_reference_current, correspondences and which obey it: the others miss it by far."""
    T = random_motion(rng)
    reference = random_points(rng, n)
    current = seen_from(T, reference)
    is_inlier = rng.permutation(n) >= n_outliers
    wrong = np.stack([random_points(rng, n_outliers) for _ in range(9)])
    missed_px = np.linalg.norm(
        project(wrong.reshape(-1, 3)).reshape(wrong.shape) - project(current[~is_inlier]), axis=2
    )
    is_far = (missed_px > 10.0) & (np.linalg.norm(wrong - current[~is_inlier], axis=2) > 0.5)
    assert is_far.any(axis=0).all()
    current[~is_inlier] = wrong[is_far.argmax(axis=0), np.arange(n_outliers)]
    return T, matched(reference, current), is_inlier


def run(matches: Correspondences, config: RansacConfig, seed: int = 0) -> Consensus | Failure:
    rng = np.random.default_rng(seed)
    return ransac_rigid(matches, CAMERA, config, weights=None, rng=rng)


@given(seed=seeds, metric=st.sampled_from(["reprojection", "distance"]))
def test_the_motion_is_found_among_six_outliers_in_ten(seed: int, metric: str) -> None:
    T, matches, is_inlier = scene(np.random.default_rng(seed), 150, 90)
    result = run(matches, configure(inlier_metric=metric))
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=0.025)
    assert result.inliers[is_inlier].mean() > 0.95
    assert result.inliers[~is_inlier].mean() < 0.05


@given(seed=seeds)
def test_the_same_seed_gives_the_same_result(seed: int) -> None:
    _, matches, _ = scene(np.random.default_rng(seed), 80, 40)
    first, second = run(matches, SETTINGS, seed), run(matches, SETTINGS, seed)
    assert isinstance(first, Consensus)
    assert isinstance(second, Consensus)
    assert first.T_reference_current.tobytes() == second.T_reference_current.tobytes()
    assert first.inliers.tobytes() == second.inliers.tobytes()


@given(seed=seeds, metric=st.sampled_from(["reprojection", "distance"]))
def test_inliers_are_those_within_the_threshold_of_the_metric(seed: int, metric: str) -> None:
    rng = np.random.default_rng(seed)
    _, matches, _ = scene(rng, 40, 10)
    config = configure(inlier_metric=metric, inlier_threshold_px=30.0, inlier_threshold_m=0.4)
    hypotheses = np.stack([random_motion(rng) for _ in range(4)])
    found = find_inliers(hypotheses, matches, CAMERA, config)
    assert found.shape == (4, 40)
    for i, T in enumerate(hypotheses):
        for j in range(40):
            point = seen_from(T, matches.reference_points[j])
            if metric == "distance":
                ratio = np.linalg.norm(point - matches.current_points[j]) / 0.4
            else:
                ratio = np.linalg.norm(project(point[None])[0] - matches.current_uvd[j]) / 30.0
            if abs(ratio - 1.0) > 1e-4:  # single precision decides nearer than this
                assert found[i, j] == (ratio < 1.0)


def test_points_behind_the_camera_are_no_inliers() -> None:
    points = random_points(np.random.default_rng(0), 30)
    mirrored = points * [1.0, 1.0, -1.0]
    nearer = np.column_stack([points[:, :2], np.ones(30)])
    # Behind the camera the formulas of the projection fit as well as in front of it.
    for there, measured, expected in (
        (points, project(points), 1.0),
        (-points, project(-points), 0.0),
        (mirrored, project(points), 0.0),
        (mirrored, project(nearer), 0.0),
    ):
        found = find_inliers(
            np.eye(4)[None],
            matched(there, there, reference_uvd=measured, current_uvd=measured),
            CAMERA,
            SETTINGS,
        )
        assert found.mean() == expected


def test_samples_are_drawn_of_near_points() -> None:
    # One in eight is near, and only those were measured well: three samples suffice.
    rng = np.random.default_rng(7)
    T, matches, _ = scene(rng, 160, 0)
    is_near = np.arange(160) < 20
    spoilt = matches.current_points.copy()
    spoilt[~is_near] = random_points(rng, 140)
    measured = matches.reference_uvd.copy()
    measured[:, 2] = np.where(is_near, 40.0, 5.0)
    far = replace(matches, current_points=spoilt, reference_uvd=measured)
    result = run(far, configure(min_disparity_px=10.0, n_hypotheses=3))
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-8)


@given(seed=seeds, n=st.integers(min_value=3, max_value=40))
def test_samples_are_triples_of_distinct_indices(seed: int, n: int) -> None:
    samples = draw_samples(n, 64, np.random.default_rng(seed))
    assert samples.shape == (64, 3)
    assert samples.min() >= 0
    assert samples.max() < n
    assert all(len(set(sample)) == 3 for sample in samples.tolist())


def test_samples_are_uniform_over_all_ordered_triples() -> None:
    samples = draw_samples(5, 60_000, np.random.default_rng(3))
    counts = dict.fromkeys(permutations(range(5), 3), 0)
    for triple in map(tuple, samples.tolist()):
        counts[triple] += 1
    assert chisquare(list(counts.values())).pvalue > 1e-4


@pytest.mark.parametrize("n", [0, 2, 11])
def test_too_few_matches_are_a_falsy_failure_with_their_number(n: int) -> None:
    _, matches, _ = scene(np.random.default_rng(0), n, 0)
    result = run(matches, SETTINGS)
    assert isinstance(result, Failure)
    assert not result
    assert (result.n_matches, result.n_inliers) == (n, 0)
    assert result.reason == f"{n} matches, 12 are needed (ransac.min_inliers)"


def test_matches_without_a_common_motion_are_a_failure_with_counts() -> None:
    _, matches, _ = scene(np.random.default_rng(0), 60, 60)
    result = run(matches, SETTINGS)
    assert isinstance(result, Failure)
    assert result.n_matches == 60
    assert 1 <= result.n_inliers < 12
    assert f"{result.n_inliers} of 60" in result.reason


@pytest.mark.parametrize("metric", ["reprojection", "distance"])
def test_as_many_inliers_as_are_needed_are_enough(metric: str) -> None:
    rng = np.random.default_rng(3)
    config = configure(inlier_metric=metric)
    T, matches, is_inlier = scene(rng, 15, 3)
    result = run(matches, config)
    assert isinstance(result, Consensus), result
    np.testing.assert_array_equal(result.inliers, is_inlier)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-6)
    _, one_less, _ = scene(rng, 15, 4)
    failure = run(one_less, config)
    assert isinstance(failure, Failure)
    assert (failure.n_matches, failure.n_inliers) == (15, 11)
    exactly = run(matches.select(is_inlier), config)
    assert isinstance(exactly, Consensus)
    assert exactly.inliers.all()


def test_points_on_a_line_are_a_failure() -> None:
    line = np.linspace(2.0, 9.0, 30)[:, np.newaxis] * [0.1, 0.05, 1.0]
    farther = line + np.array([0.0, 0.0, 0.5])
    result = run(matched(line, farther), SETTINGS)
    assert isinstance(result, Failure)
    assert result.n_matches == 30


def test_where_near_points_lie_on_a_line_far_ones_tell() -> None:
    rng = np.random.default_rng(5)
    line = np.linspace(2.0, 3.0, 20)[:, np.newaxis] * [0.1, 0.05, 1.0]
    far = 8.0 * random_points(rng, 60) + np.array([0.0, 0.0, 20.0])
    reference, T = np.vstack([line, far]), random_motion(rng)
    matches = matched(reference, seen_from(T, reference))
    is_near = matches.reference_uvd[:, 2] >= 5.0
    assert is_near[:20].all()
    assert not is_near[20:].any()
    result = run(matches, configure(min_disparity_px=5.0))
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-6)


def test_far_points_are_counted_but_not_fitted() -> None:
    T, matches, _ = scene(np.random.default_rng(4), 80, 0)
    depths = matches.reference_points[:, 2]
    is_far = matches.reference_uvd[:, 2] < 25.0
    assert 20 < is_far.sum() < 60
    # Far points all too near by a tenth: fitted, they would pull the motion along.
    spoilt = matches.current_points.copy()
    spoilt[is_far] *= 0.9
    spoilt_matches = replace(matches, current_points=spoilt)
    result = run(spoilt_matches, configure(min_disparity_px=30.0, inlier_threshold_px=5.0))
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-8)
    assert result.inliers[depths > 5.0].all()


def test_weights_enter_the_last_fit() -> None:
    T, matches, _ = scene(np.random.default_rng(6), 60, 0)
    shifted = matches.current_points.copy()
    shifted[30:] += 0.05
    noisy = replace(matches, current_points=shifted)
    config = configure(inlier_metric="distance", inlier_threshold_m=1.0)
    weights = np.repeat([1.0, 1e-12], 30)
    result = ransac_rigid(noisy, CAMERA, config, weights=weights, rng=np.random.default_rng(0))
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-8)


def count_hypotheses(
    monkeypatch: pytest.MonkeyPatch, matches: Correspondences, config: RansacConfig
) -> int:
    """Return how many triples a search fits."""
    n_fitted = []

    def fit(points_a: FloatArray, points_b: FloatArray) -> tuple[FloatArray, BoolArray]:
        n_fitted.append(len(points_a))
        return fit_rigid_triples(points_a, points_b)

    monkeypatch.setattr(ransac, "fit_rigid_triples", fit)
    run(matches, config)
    return sum(n_fitted)


def test_the_search_stops_when_a_better_sample_is_no_longer_to_be_expected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    numbers = {}
    for n_outliers in (0, 60, 120, 200):
        _, matches, _ = scene(np.random.default_rng(1), 200, n_outliers)
        config = configure(n_hypotheses=1000)
        numbers[n_outliers] = count_hypotheses(monkeypatch, matches, config)
        share = 1.0 - n_outliers / 200
        if share > 0:
            # log(0.001) / log(1 - share^3), in blocks, and all hypotheses have some luck.
            needed = np.log(1e-3) / np.log1p(-(min(share, 0.999) ** 3))
            assert 0.8 * needed <= numbers[n_outliers] <= 1.2 * needed + 80
    assert numbers[0] == numbers[60] < numbers[120] < numbers[200] == 1000


def test_only_near_inliers_shorten_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    # All far points agree, two of three near ones do not: samples are drawn of those.
    _, matches, is_inlier = scene(np.random.default_rng(2), 200, 60)
    is_near = ~is_inlier | (np.cumsum(is_inlier) <= 30)
    measured = matches.reference_uvd.copy()
    measured[:, 2] = np.where(is_near, 100.0, 5.0)
    near = replace(matches, reference_uvd=measured)
    config = configure(n_hypotheses=1000)
    everywhere = count_hypotheses(monkeypatch, near, config)
    config = config.model_copy(update={"min_disparity_px": 8.0})
    assert everywhere <= 64 < count_hypotheses(monkeypatch, near, config)


@pytest.mark.parametrize("n", [1, 63, 64, 65, 200])
def test_hypotheses_are_as_many_as_configured(monkeypatch: pytest.MonkeyPatch, n: int) -> None:
    _, matches, _ = scene(np.random.default_rng(3), 60, 60)
    assert count_hypotheses(monkeypatch, matches, configure(n_hypotheses=n)) == n


@pytest.mark.parametrize("seed", range(6))
def test_the_sample_that_is_no_line_is_found_however_late(seed: int) -> None:
    # In a block of 64 samples there may well be none: the search goes on.
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    reference = np.column_stack(
        [np.linspace(-1, 1, 400), np.linspace(-1, 0.5, 400), np.full(400, 5.0)]
    )
    reference[rng.integers(400)] += [0.0, 2.0, 1.0]
    current = seen_from(T, reference)
    result = run(matched(reference, current), configure(n_hypotheses=3000), 100 + seed)
    assert isinstance(result, Consensus)
    assert result.inliers.all()
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-6)


def test_a_fit_that_its_weights_spoil_takes_no_inlier_away() -> None:
    # All weight on three neighbours, each off by less than the threshold: the fit turns far.
    rng = np.random.default_rng(5)
    config = configure(inlier_metric="distance")
    reference = random_points(rng, 30)
    reference[:3] = [0.0, 0.0, 5.0] + 0.1 * np.eye(3)
    current = reference.copy()
    current[:3] += 0.08 * np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    matches = matched(reference, current)
    weights = np.where(np.arange(30) < 3, 1.0, 1e-9)
    result = ransac_rigid(matches, CAMERA, config, weights=weights, rng=rng)
    assert isinstance(result, Consensus)
    assert result.inliers[3:].all()
    at_fit = find_inliers(result.T_reference_current[np.newaxis], matches, CAMERA, config)[0]
    assert np.count_nonzero(at_fit) < config.min_inliers


@pytest.mark.parametrize("metric", ["reprojection", "distance"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_as_far_as_the_threshold_is_no_inlier(metric: str, axis: int) -> None:
    # Of numbers that single precision holds: two pixels, or half a metre.
    camera = replace(CAMERA, fy=500.0, baseline=0.25)
    config = configure(inlier_metric=metric, inlier_threshold_m=0.5)
    point, measured = np.array([[0.0, 0.0, 4.0]]), np.array([[320.0, 240.0, 31.25]])
    for share, expected in ((0.0, True), (0.999, True), (1.0, False), (-1.0, False)):
        seen, there = measured.copy(), point.copy()
        seen[0, axis] += 2.0 * share
        there[0, axis] += 0.5 * share
        matches = matched(point, there, reference_uvd=seen, current_uvd=seen)
        found = find_inliers(np.eye(4)[None], matches, camera, config)
        assert found.tolist() == [[expected]]


@pytest.mark.parametrize("depth", [0.0011, 0.01, 0.5, 1.0])
def test_what_is_near_the_camera_is_still_in_front_of_it(depth: float) -> None:
    points = np.array([[0.0, 0.0, depth]])
    found = find_inliers(np.eye(4)[None], matched(points, points), CAMERA, SETTINGS)
    assert found.tolist() == [[True]]


def test_three_matches_are_enough_where_three_are_asked_for() -> None:
    T, matches, _ = scene(np.random.default_rng(0), 3, 0)
    config = configure(min_inliers=3)
    result = run(matches, config)
    assert isinstance(result, Consensus)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-6)
    two = run(matches.select(np.arange(2)), config)
    assert isinstance(two, Failure)
    assert two.reason == "2 matches, 3 are needed (ransac.min_inliers)"


@pytest.mark.parametrize(("n_near", "is_fitted_alone"), [(11, False), (12, True)])
def test_near_points_are_fitted_alone_where_they_are_as_many_as_are_needed(
    n_near: int, is_fitted_alone: bool
) -> None:
    # Of disparities at the bound and a little less; the far ones are all a little off.
    T, matches, _ = scene(np.random.default_rng(9), 40, 0)
    is_near = np.arange(40) < n_near
    measured = matches.reference_uvd.copy()
    measured[:, 2] = np.where(is_near, 20.0, 19.999)
    current_uvd = matches.current_uvd.copy()
    current_uvd[:, 2] = 30.0
    current = matches.current_points.copy()
    current[~is_near] += 0.01
    near = replace(matches, reference_uvd=measured, current_uvd=current_uvd, current_points=current)
    config = configure(inlier_metric="distance", min_disparity_px=20.0)
    for each in (near, replace(near, reference_uvd=current_uvd, current_uvd=measured)):
        result = run(each, config)
        assert isinstance(result, Consensus)
        assert result.inliers.all()
        assert (np.abs(result.T_reference_current - T).max() < 1e-8) == is_fitted_alone
