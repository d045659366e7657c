"""The covariance of a refined pose, and the rounds that lead to it, match by match."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from gvo.geometry import se3
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.refinement import Refinement, adjust, descend, fit_covariance, refine_pose
from gvo.geometry.residuals import StereoResiduals
from gvo.types import BoolArray, Failure, FloatArray
from tests.geometry.scenes import (
    CAMERA,
    all_of,
    derivative,
    matched,
    near_a_line,
    project,
    random_motion,
    random_points,
    seeds,
    seen_from,
)

HUBER = 1.9
SETTINGS = {"huber": HUBER, "gate": 4.0}


def measure(rng: np.random.Generator, errors: FloatArray) -> tuple[FloatArray, Correspondences]:
    """Return T_reference_current and matches; errors (n, 3) in sigmas, in the current frame."""
    n = len(errors)
    T = random_motion(rng, 0.05, 0.3)
    reference = random_points(rng, n)
    current = seen_from(T, reference)
    sigmas = rng.uniform(0.2, 1.0, size=(n, 3))
    uvd = project(current) + sigmas * errors
    return T, matched(
        reference, current, current_uvd=uvd, reference_sigmas=0.0, current_sigmas=sigmas
    )


@dataclass(frozen=True, kw_only=True)
class Sums:
    """What the covariance is made of, summed in loops."""

    H: FloatArray
    """Of the weighted matches."""
    curvature: FloatArray
    """Second derivative of the robust cost, as far as it comes of the residuals' own."""
    spread: FloatArray
    """Of the gradient."""
    gradient: FloatArray
    scale: float

    def covariance(self, *, is_curved: bool = True) -> FloatArray:
        inverse = np.linalg.inv(self.curvature if is_curved else self.H)
        return np.asarray(inverse @ self.spread @ inverse.T)


def add_up(T: FloatArray, matches: Correspondences) -> Sums:
    """Return the sums over all matches, by the formulas of Huber and White."""
    n = len(matches)
    H, curvature, seen = (np.zeros((6, 6)) for _ in range(3))
    total, squares = np.zeros(6), 0.0
    for i in range(n):
        point = seen_from(T, matches.reference_points[i])
        J = derivative(point) / matches.current_sigmas[i][:, np.newaxis]
        r = (matches.current_uvd[i] - project(point)) / matches.current_sigmas[i]
        length = float(np.linalg.norm(r))
        weight = min(1.0, HUBER / length)
        along = np.outer(r, r) / length**2 if length > HUBER else np.zeros((3, 3))
        H += weight * J.T @ J
        curvature += weight * J.T @ (np.eye(3) - along) @ J
        gradient = weight * J.T @ r
        seen += np.outer(gradient, gradient)
        total += gradient
        squares += weight * length**2
    scale = max(float(np.sqrt(squares / (3 * n - 6))), 0.1)
    seen *= n / max(n - 2, 1)
    spread = (n * seen + 24 * scale**2 * H) / (n + 24) + 0.1**2 * H
    return Sums(H=H, curvature=curvature, spread=spread, gradient=total, scale=scale)


def covariance_of(T: FloatArray, matches: Correspondences) -> Refinement:
    found = fit_covariance(T, matches, all_of(matches), CAMERA, huber=HUBER)
    assert isinstance(found, Refinement), found
    return found


@given(seed=seeds, n=st.integers(8, 60), size=st.sampled_from([0.02, 0.5, 1.0, 1.5]))
def test_the_covariance_is_of_the_robust_cost_by_match(seed: int, n: int, size: float) -> None:
    # Some residuals are beyond the kernel's threshold, along all axes.
    rng = np.random.default_rng(seed)
    T, matches = measure(rng, size * rng.normal(size=(n, 3)))
    expected = add_up(T, matches)
    loss = np.diag(np.linalg.inv(expected.curvature)) / np.diag(np.linalg.inv(expected.H))
    if not np.all((loss > 0) & (loss < 9)):
        return
    found = covariance_of(T, matches)
    assert found.scale == pytest.approx(expected.scale, rel=1e-9)
    covariance = expected.covariance()
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(found.covariance / scale, covariance / scale, atol=1e-6)
    np.testing.assert_array_equal(found.covariance, found.covariance.T)


def test_three_matches_have_a_covariance() -> None:
    T, matches = measure(np.random.default_rng(4), np.full((3, 3), 0.5))
    expected = add_up(T, matches)
    found = covariance_of(T, matches)
    np.testing.assert_allclose(found.covariance, expected.covariance(), rtol=1e-6)
    assert found.scale == pytest.approx(expected.scale)


def loss_of(T: FloatArray, matches: Correspondences) -> float:
    """Return by how much the curvature of long residuals raises a variance, at most."""
    sums = add_up(T, matches)
    variances, promised = np.linalg.inv(sums.curvature), np.linalg.inv(sums.H)
    return float(np.max(np.diag(variances) / np.diag(promised)))


def wrong_depths(length: float) -> tuple[FloatArray, Correspondences]:
    """Return 26 matches; the disparities of all but two are wrong by this many sigmas."""
    rng = np.random.default_rng(10)
    errors = np.full((26, 3), 1e-9)
    errors[2:, 2] = length * rng.choice([-1.0, 1.0], 24)
    T, matches = measure(rng, errors)
    shares = np.array([200.0, 200.0, 1.0])  # pixels tell nothing of the depth
    uvd = project(matches.current_points) + 0.1 * errors
    return T, replace(matches, current_uvd=uvd, current_sigmas=np.tile(0.1 * shares, (26, 1)))


@pytest.mark.parametrize(("loss", "is_curved"), [(9.9, True), (10.1, False)])
def test_the_curvature_counts_where_it_loses_under_90_percent(loss: float, is_curved: bool) -> None:
    length = brentq(lambda length: loss_of(*wrong_depths(length)) - loss, 1.0001 * HUBER, 100.0)
    T, matches = wrong_depths(float(length))
    assert loss_of(T, matches) == pytest.approx(loss, rel=1e-6)
    expected = add_up(T, matches).covariance(is_curved=is_curved)
    np.testing.assert_allclose(covariance_of(T, matches).covariance, expected, rtol=1e-5)


# Where a direction is open.


def seen_near_a_line(spread_m: float) -> Correspondences:
    points = near_a_line(spread_m)
    return matched(points, points, reference_sigmas=0.0)


def inflation_of(matches: Correspondences) -> float:
    """Return the largest variance as a multiple of what it is with the other parameters known."""
    J = np.concatenate([derivative(point) for point in matches.reference_points])
    # By QR of the derivatives themselves: half of the digits that their product loses.
    R_inverse = np.linalg.inv(np.linalg.qr(J, mode="r"))
    return float(np.max(np.sum(J**2, axis=0) * np.sum(R_inverse**2, axis=1)))


@pytest.mark.parametrize(("inflation", "is_open"), [(0.7e10, False), (1.4e10, True)])
def test_a_direction_is_open_beyond_100000_sigmas(inflation: float, is_open: bool) -> None:
    spread = 1e-4 * np.sqrt(inflation_of(seen_near_a_line(1e-4)) / inflation)
    matches = seen_near_a_line(float(spread))
    assert inflation_of(matches) == pytest.approx(inflation, rel=0.05)
    found = fit_covariance(np.eye(4), matches, all_of(matches), CAMERA, huber=HUBER)
    assert isinstance(found, Failure if is_open else Refinement)


# The rounds of a refinement.


def residuals_of(T: FloatArray, matches: Correspondences) -> StereoResiduals:
    return StereoResiduals.of(T, matches, CAMERA, huber=HUBER)


def every(residuals: StereoResiduals) -> BoolArray:
    return np.ones(len(residuals.points), dtype=np.bool_)


def steps_from(T: FloatArray, residuals: StereoResiduals, n: int) -> FloatArray | None:
    return descend(T, residuals, every(residuals), n_iterations=n)


def test_steps_end_where_they_are_a_thirtieth_of_a_sigma() -> None:
    rng = np.random.default_rng(1)
    T, matches = measure(rng, 1e-3 * rng.normal(size=(40, 3)))
    sums = add_up(T, matches)
    for start_sigmas, n_steps in ((0.02, 1), (0.05, 2), (0.9, 2)):
        direction = np.linalg.solve(np.linalg.cholesky(sums.H).T, np.eye(6)[0])
        start = T @ se3.exp(start_sigmas * direction)
        residuals = residuals_of(start, matches)
        ends = [steps_from(start, residuals, n) for n in range(n_steps - 1, 5)]
        assert not np.array_equal(ends[0], ends[1])  # type: ignore[arg-type]
        assert all(np.array_equal(ends[1], end) for end in ends[2:])  # type: ignore[arg-type]


@pytest.mark.parametrize(("n_wrong", "n_kept"), [(0, 10), (10, 10), (11, 10), (12, 22), (25, 35)])
def test_a_choice_that_loses_half_of_the_inliers_is_not_taken(n_wrong: int, n_kept: int) -> None:
    # The wrong ones are so unsure that they do not move the pose, and beyond the gate.
    rng = np.random.default_rng(3)
    errors = np.zeros((10 + n_wrong, 3))
    errors[10:] = 10.0
    T, matches = measure(rng, errors)
    sigmas = np.full((10 + n_wrong, 3), 1.0)
    sigmas[:10] = 1e-3
    uvd = project(matches.current_points) + sigmas * errors
    matches = replace(matches, current_uvd=uvd, current_sigmas=sigmas)
    found = refine_pose(T, matches, all_of(matches), CAMERA, **SETTINGS)
    assert isinstance(found, Refinement)
    assert np.count_nonzero(found.inliers) == n_kept
    assert found.inliers[:10].all()


def test_a_refined_pose_is_a_rotation_to_the_last_digit() -> None:
    rng = np.random.default_rng(5)
    T, matches = measure(rng, rng.normal(size=(40, 3)))
    spoilt = T.copy()
    spoilt[:3, :3] *= 1.0 + 1e-6
    found = refine_pose(spoilt, matches, all_of(matches), CAMERA, **SETTINGS)
    assert isinstance(found, Refinement)
    R = found.T_reference_current[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


# Steps alone.


def test_descending_leads_where_a_refinement_leads() -> None:
    rng = np.random.default_rng(6)
    T, matches = measure(rng, rng.normal(size=(40, 3)))
    start = T @ se3.exp(0.02 * rng.normal(size=6))
    residuals = residuals_of(start, matches)
    found = steps_from(start, residuals, 20)
    refined = refine_pose(start, matches, all_of(matches), CAMERA, huber=HUBER, gate=1e6)
    assert found is not None
    assert isinstance(refined, Refinement)
    np.testing.assert_allclose(found, refined.T_reference_current, atol=1e-4)
    # One step of Gauss and Newton, and the turn of it that OpenCV makes.
    one = steps_from(start, residuals, 1)
    assert one is not None
    sums = add_up(start, matches)
    # Ours is a motion of the camera, the sums' one of the points.
    step = -np.linalg.solve(sums.H, sums.gradient)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = cv2.Rodrigues(step[:3])[0], step[3:]
    np.testing.assert_allclose(one, start @ expected, atol=1e-9)


def test_descending_from_nowhere_leads_nowhere() -> None:
    matches = seen_near_a_line(0.0)
    assert steps_from(np.eye(4), residuals_of(np.eye(4), matches), 5) is None
    behind = replace(matches, reference_points=-matches.reference_points)
    assert steps_from(np.eye(4), residuals_of(np.eye(4), behind), 5) is None


@pytest.mark.parametrize("is_refined", [True, False])
def test_numbers_that_overflow_on_the_way_are_no_warning(is_refined: bool) -> None:
    # Measured beyond what squares hold: the residuals are infinite.
    _, matches = measure(np.random.default_rng(7), np.full((12, 3), 1e160))
    residuals = residuals_of(np.eye(4), matches)
    if is_refined:
        answer = refine_pose(np.eye(4), matches, all_of(matches), CAMERA, **SETTINGS)
        assert isinstance(answer, Failure)
    else:
        assert steps_from(np.eye(4), residuals, 3) is None


def with_constants(
    rng: np.random.Generator, values: FloatArray, noise: float
) -> tuple[FloatArray, StereoResiduals]:
    """Return T_reference_current, and residuals of matches that errors of constants moved."""
    T, matches = measure(rng, noise * rng.normal(size=(200, 3)))
    sensitivities = {f"c{k}": rng.normal(size=(2, 200, 3)) for k in range(len(values))}
    for value, (_, in_current) in zip(values, sensitivities.values(), strict=True):
        matches = replace(matches, current_uvd=matches.current_uvd + value * in_current)
    zero = np.zeros((200, 3))
    sensitivities = {name: np.stack([zero, each[1]]) for name, each in sensitivities.items()}
    return T, residuals_of(T, replace(matches, sensitivities=sensitivities))


def test_constants_are_estimated_beside_the_pose() -> None:
    values = np.array([0.6, -1.1, 0.2])
    T, residuals = with_constants(np.random.default_rng(6), values, noise=0.0)
    start = T @ se3.exp(np.full(6, 0.01))
    found = adjust(start, residuals, every(residuals), n_iterations=6)
    assert found is not None
    # Each is around zero by a sigma of one: so many matches outweigh that by far.
    np.testing.assert_allclose(found.values, values, rtol=0.01)
    np.testing.assert_allclose(found.T_reference_current, T, atol=1e-3)


def test_the_covariance_of_constants_is_that_of_their_errors() -> None:
    squares, rng = [], np.random.default_rng(8)
    for _ in range(60):
        values = rng.normal(size=3)
        T, residuals = with_constants(rng, values, noise=1.0)
        found = adjust(T, residuals, every(residuals), n_iterations=4)
        assert found is not None
        error = found.values - values
        squares.append(error @ np.linalg.solve(found.covariance, error) / 3.0)
    assert 0.7 < np.mean(squares) < 1.5


def test_effects_tell_how_the_pose_follows_what_is_taken_off() -> None:
    rng = np.random.default_rng(9)
    T, residuals = with_constants(rng, np.zeros(2), noise=0.3)
    found = adjust(T, residuals, every(residuals), n_iterations=8)
    assert found is not None
    # Known to be so much, in place of what was estimated.
    for k in range(2):
        known = found.values + 0.05 * np.eye(2)[k]
        uvd = residuals.uvd - np.einsum("kni,k->ni", residuals.sensitivities[:, 1], known)
        moved = steps_from(found.T_reference_current, replace(residuals, uvd=uvd), 8)
        assert moved is not None
        step = se3.log(se3.invert(found.T_reference_current) @ moved)
        expected = 0.05 * found.effects[k]
        np.testing.assert_allclose(step, expected, atol=0.05 * np.abs(expected).max())


def test_constants_of_points_behind_the_camera_are_not_estimated() -> None:
    T, residuals = with_constants(np.random.default_rng(7), np.zeros(1), noise=0.0)
    behind = T @ se3.make_transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    assert adjust(behind, residuals, every(residuals), n_iterations=2) is None
