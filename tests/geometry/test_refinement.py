"""Refinement of a pose: derivatives, optimum, covariance, refusal."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.refinement import Refinement, fit_covariance, refine_pose
from gvo.types import BoolArray, Failure, FloatArray
from tests.geometry.scenes import (
    CAMERA,
    all_of,
    derivative,
    matched,
    project,
    random_motion,
    random_points,
    seeds,
    seen_from,
    unproject,
)

SETTINGS = {"huber": 2.8, "gate": 4.0}
# Kernel and gate out of reach leave plain least squares, of which the theory is exact.
WIDE = {"huber": 1e6, "gate": 1e6}
SIGMAS = np.array([0.7, 0.7, 0.3])


def measure(
    rng: np.random.Generator, n: int, noise: float = 1.0, *, sigmas: FloatArray = SIGMAS
) -> tuple[FloatArray, Correspondences]:
    """Return T_reference_current and n matches, measured with noise in both frames."""
    T = random_motion(rng, 0.05, 0.3)
    reference = random_points(rng, n)
    reference_uvd = project(reference) + noise * sigmas * rng.normal(size=(n, 3))
    current_uvd = project(seen_from(T, reference)) + noise * sigmas * rng.normal(size=(n, 3))
    return T, matched(
        unproject(reference_uvd),
        unproject(current_uvd),
        reference_uvd=reference_uvd,
        current_uvd=current_uvd,
        reference_sigmas=sigmas,
        current_sigmas=sigmas,
    )


def measure_current(
    rng: np.random.Generator, noise: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, Correspondences]:
    """Return T_reference_current and matches; noise (n, 3), in sigmas, spoils the current frame."""
    T, exact = measure(rng, len(noise), noise=0.0, sigmas=sigmas)
    current_uvd = exact.current_uvd + sigmas * noise
    return T, replace(
        exact,
        current_points=unproject(current_uvd),
        current_uvd=current_uvd,
        reference_sigmas=np.full_like(noise, 1e-9),
    )


def refine(
    T_start: FloatArray,
    matches: Correspondences,
    settings: dict[str, float] = SETTINGS,
    *,
    inliers: BoolArray | None = None,
) -> Refinement:
    inliers = all_of(matches) if inliers is None else inliers
    result = refine_pose(T_start, matches, inliers, CAMERA, **settings)
    assert isinstance(result, Refinement), result
    return result


def error_of(result: Refinement, T: FloatArray) -> FloatArray:
    """Return the right perturbation between truth and result."""
    return se3.log(np.linalg.inv(T) @ result.T_reference_current)


@given(seed=seeds)
def test_exact_measurements_give_the_exact_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, matches = measure(rng, 40, noise=0.0)
    T_start = T @ se3.exp(0.02 * rng.normal(size=6))
    result = refine(T_start, matches)
    np.testing.assert_allclose(result.T_reference_current, T, atol=1e-7)
    assert result.inliers.all()
    assert np.isfinite(result.covariance).all()


@settings(max_examples=10)
@given(seed=seeds)
def test_the_result_is_the_optimum_that_scipy_finds(seed: int) -> None:
    # Noise in the current frame alone: there the cost's weights do not depend on the pose.
    rng = np.random.default_rng(seed)
    T, matches = measure_current(rng, rng.normal(size=(40, 3)), SIGMAS)
    result = refine(T, matches, WIDE)

    def residuals(xi: FloatArray) -> FloatArray:
        R = Rotation.from_rotvec(xi[:3]).as_matrix()
        predicted = project((matches.reference_points - xi[3:]) @ R)
        return np.asarray(((matches.current_uvd - predicted) / SIGMAS).ravel())

    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
    optimum = least_squares(residuals, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    R = Rotation.from_rotvec(optimum.x[:3]).as_matrix()
    np.testing.assert_allclose(result.T_reference_current[:3, :3], R, atol=2e-6)
    np.testing.assert_allclose(result.T_reference_current[:3, 3], optimum.x[3:], atol=2e-6)
    assert result.scale == pytest.approx(np.sqrt(2 * optimum.cost / (3 * 40 - 6)), rel=1e-4)


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_the_covariance_tells_the_errors_that_are_made(noise: float) -> None:
    # All correlations, not only the overall size: errors whitened by it are uncorrelated.
    rng = np.random.default_rng(12)
    whitened = []
    for _ in range(300):
        T, matches = measure(rng, 60, noise, sigmas=np.array([0.3, 0.3, 0.6]))
        result = refine(T, matches)
        whitened.append(np.linalg.solve(np.linalg.cholesky(result.covariance), error_of(result, T)))
    np.testing.assert_allclose(np.cov(np.array(whitened).T), np.eye(6), atol=0.45)
    assert 0.8 < np.mean(np.square(whitened)) < 1.3


@given(seed=seeds)
def test_outliers_among_the_inliers_are_left_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, matches = measure(rng, 150)
    is_outlier = rng.permutation(150) < 15
    shifts = rng.choice([-1.0, 1.0], size=(15, 3)) * rng.uniform(10, 30, size=(15, 3))
    spoilt_uvd = matches.current_uvd.copy()
    spoilt_uvd[is_outlier] += shifts
    spoilt = replace(matches, current_uvd=spoilt_uvd)
    result = refine(T @ se3.exp(0.005 * rng.normal(size=6)), spoilt)
    clean = refine(T, matches, inliers=~is_outlier)
    assert not result.inliers[is_outlier].any()
    assert result.inliers[~is_outlier].mean() > 0.93
    difference = error_of(result, clean.T_reference_current)
    # Less than the error that the noise makes anyway: 6 is the mean of that.
    assert difference @ np.linalg.solve(clean.covariance, difference) < 6.0


def test_inliers_that_the_sample_missed_are_chosen_again() -> None:
    T, matches = measure(np.random.default_rng(3), 100)
    few = np.arange(100) < 20
    result = refine(T, matches, inliers=few)
    assert result.inliers.sum() > 90
    fewer = refine(T, matches.select(few))
    assert np.trace(result.covariance) < 0.5 * np.trace(fewer.covariance)


def spoil(matches: Correspondences, kind: str) -> Correspondences:
    """Return matches that leave the pose open or make no sense."""
    points, uvd = matches.reference_points.copy(), matches.current_uvd.copy()
    if kind == "one point":
        points[:], uvd[:] = points[0], uvd[0]
    elif kind == "line":
        points = np.linspace(0.0, 1.0, len(points))[:, None] * [0.4, 0.3, 4.0] + [0, 0, 3.0]
        uvd = project(points)
    elif kind == "behind":
        points[:, 2] *= -1.0
    elif kind == "unknown":
        points[3] = np.nan
    elif kind == "unknown measurement":
        uvd[3] = np.nan
    elif kind == "at the camera":
        points[:] = 0.0
    return replace(matches, reference_points=points, current_uvd=uvd)


@pytest.mark.parametrize(
    "kind",
    ["one point", "line", "behind", "unknown", "unknown measurement", "at the camera", "0", "2"],
)
@pytest.mark.parametrize("finish", [refine_pose, fit_covariance])
def test_input_without_an_answer_is_a_failure(kind: str, finish: object) -> None:
    _, matches = measure(np.random.default_rng(0), 30, noise=0.0)
    spoilt = spoil(matches, kind).select(np.arange(int(kind) if kind.isdigit() else 30))
    assert callable(finish)
    result = finish(np.eye(4), spoilt, all_of(spoilt), CAMERA)
    assert isinstance(result, Failure)
    assert not result
    assert result.reason


@given(seed=seeds, size=st.floats(min_value=0.0, max_value=3.0))
def test_a_bad_start_gives_a_failure_or_a_finite_pose(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    T, matches = measure(rng, 12)
    start = T @ se3.exp(size * rng.normal(size=6))
    result = refine_pose(start, matches, rng.random(12) < 0.6, CAMERA, **SETTINGS)
    if isinstance(result, Failure):
        assert result.reason
        return
    assert np.isfinite(result.T_reference_current).all()
    assert np.isfinite(result.covariance).all()
    assert np.linalg.eigvalsh(result.covariance)[0] > 0
    R = result.T_reference_current[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def test_matches_that_a_far_motion_leaves_behind_do_no_harm() -> None:
    # Near points and very far ones, and motions up to hundreds of metres: some points come to
    # lie behind the camera or in its plane, where the projection has no derivative.
    rng = np.random.default_rng(0)
    for _ in range(150):
        uvd = rng.uniform([0, 0, 0.3], [640, 480, 0.6], size=(200, 3))
        uvd[:100, 2] *= 100
        points = unproject(uvd)
        matches = matched(points, points, reference_sigmas=SIGMAS, current_sigmas=SIGMAS)
        T = se3.exp(rng.normal(size=6) * 10.0 ** rng.uniform(-3, 2.5))
        result = refine_pose(T, matches, rng.random(200) < 0.5, CAMERA, **SETTINGS)
        if isinstance(result, Refinement):
            assert np.isfinite(result.T_reference_current).all()
            assert np.linalg.eigvalsh(result.covariance)[0] > 0
            moved = seen_from(result.T_reference_current, points)
            assert moved[result.inliers, 2].min() > 0


def test_an_unrefined_pose_keeps_its_place_and_gets_the_covariance_of_its_residuals() -> None:
    T, matches = measure(np.random.default_rng(8), 100)
    inliers = np.arange(100) % 2 == 0
    result = fit_covariance(T, matches, inliers, CAMERA, huber=2.8)
    assert isinstance(result, Refinement)
    assert result.T_reference_current is T
    np.testing.assert_array_equal(result.inliers, inliers)
    refined = refine(T, matches.select(inliers))
    ratios = np.diag(result.covariance) / np.diag(refined.covariance)
    assert np.all((ratios > 0.5) & (ratios < 2.0))


def test_the_covariance_of_few_matches_is_on_average_that_of_least_squares() -> None:
    # Residuals are smaller than the noise: the pose is fitted to them, here by 8 %.
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(600, 24, 3))
    noise /= np.sqrt(np.mean(noise**2))  # so many runs are enough
    sigmas = 0.1 * SIGMAS
    sizes, nees = [], []
    for each in noise:
        T, matches = measure_current(rng, each, sigmas)
        result = refine(T, matches, WIDE)
        rows = [
            derivative(point) / sigmas[:, None] for point in seen_from(T, matches.reference_points)
        ]
        J, error = np.concatenate(rows), error_of(result, T)
        sizes.append(np.trace(result.covariance @ J.T @ J) / 6)
        nees.append(error @ np.linalg.solve(result.covariance, error) / 6)
    assert 0.94 < np.mean(sizes) < 1.03
    assert 0.85 < np.mean(nees) < 1.25
