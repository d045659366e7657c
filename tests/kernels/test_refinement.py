"""Refinement of a pose and of constants, against sums over stacked matrices."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.kernels import refinement as kernels
from gvo.types import FloatArray
from tests.geometry.scenes import move, project, random_motion, seen_from
from tests.kernels.matches import (
    PARAMETERS,
    Matches,
    by_reference,
    random_matches,
    rows_of,
)

HUBER = 1.5


def moved(T: FloatArray, step: FloatArray) -> FloatArray:
    right = np.eye(4)
    right[:3, :3], right[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6]
    return T @ right


def solved(H: FloatArray, g: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(H, g), dtype=np.float64)


def descended(matches: Matches, T: FloatArray, n_steps: int) -> FloatArray:
    """Return the pose after steps of Gauss and Newton, until they are short."""
    for _ in range(n_steps):
        Js, rs, _ = rows_of(matches, T, HUBER)
        J, r = np.concatenate(Js), np.concatenate(rs)
        step = solved(J.T @ J, J.T @ r)
        T = moved(T, step)
        if step @ J.T @ r < 1e-3:
            break
    return T


def away(rng: np.random.Generator, T: FloatArray, size: float = 0.01) -> FloatArray:
    return moved(T, size * rng.normal(size=6))


@pytest.mark.parametrize("n_steps", [0, 1, 3, 20])
@pytest.mark.parametrize("seed", [0, 1])
def test_steps_are_those_of_gauss_and_newton(n_steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matches = random_matches(rng, 30)
    start = away(rng, matches.T)
    T = start.copy()
    assert kernels.descend(T, *matches.arrays, PARAMETERS, HUBER, n_steps) == kernels.DONE
    np.testing.assert_allclose(T, descended(matches, start, n_steps), rtol=1e-9, atol=1e-12)


def run(kernel: str, matches: Matches) -> int:
    """Return how a kernel ends, with two constants where it takes any."""
    rng = np.random.default_rng(3)
    sensitivities = rng.normal(size=(2, 2, len(matches.points), 3))
    common = matches.T.copy(), *matches.arrays[:3], matches.is_used.copy()
    out6, out2, values = np.empty((6, 6)), np.empty((2, 2)), np.zeros(2)
    arguments = {
        "descend": (PARAMETERS, HUBER, 5),
        "refine": (PARAMETERS, HUBER, 4.0),
        "write_covariance": (PARAMETERS, HUBER, out6, np.empty(1)),
        "write_effects": (sensitivities, PARAMETERS, HUBER, np.empty((2, 6))),
        "eliminate_pose": (sensitivities, PARAMETERS, HUBER, out2, values),
        "adjust": (
            *(sensitivities, PARAMETERS, HUBER, 1.0, 2),
            *(values, out2, np.empty((2, 6))),
        ),
    }
    ended = getattr(kernels, kernel)(*common, *arguments[kernel])
    return int(ended)


KERNELS = ("descend", "refine", "write_covariance", "write_effects", "eliminate_pose", "adjust")


@pytest.mark.parametrize("kernel", KERNELS)
def test_matches_that_tell_no_motion_are_said_to_be_so(kernel: str) -> None:
    whole = replace(random_matches(np.random.default_rng(2), 12), is_used=np.ones(12, np.bool_))
    assert run(kernel, whole) == kernels.DONE
    nothing = random_matches(np.random.default_rng(2), 0)
    assert run(kernel, nothing) == kernels.OPEN
    for n in (0, 1):
        few = np.arange(12) < n
        assert run(kernel, replace(whole, is_used=few)) == kernels.OPEN
    for depth in (-1.0, 0.0009, np.nan):
        points = whole.points.copy()
        points[4] = whole.T[:3, :3] @ [0.0, 0.0, depth] + whole.T[:3, 3]
        spoilt = replace(whole, points=points)
        assert run(kernel, spoilt) == kernels.BEHIND
        unused = replace(spoilt, is_used=np.arange(12) != 4)
        assert run(kernel, unused) == kernels.DONE


def test_a_refinement_chooses_its_inliers_after_two_steps() -> None:
    rng = np.random.default_rng(4)
    matches = random_matches(rng, 60)
    matches.uvd[:8] += 30.0  # outliers, some of them used
    T, is_used = away(rng, matches.T), matches.is_used.copy()
    rough = descended(matches, T.copy(), 2)
    every = replace(matches, is_used=np.ones(60, np.bool_))
    lengths = [float(np.linalg.norm(r)) for r in rows_of(every, rough, 1e9)[1]]
    near = np.array(lengths) < 3.0
    expected = descended(replace(matches, is_used=near), rough, 10)
    arrays = (*matches.arrays[:3], is_used)
    assert kernels.refine(T, *arrays, PARAMETERS, HUBER, 3.0) == kernels.DONE
    np.testing.assert_array_equal(is_used, near)
    assert not near[:8].any()
    np.testing.assert_allclose(T, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)


def test_a_choice_that_loses_more_than_half_is_not_taken() -> None:
    matches = random_matches(np.random.default_rng(5), 40)
    T, is_used = matches.T.copy(), matches.is_used.copy()
    arrays = (*matches.arrays[:3], is_used)
    assert kernels.refine(T, *arrays, PARAMETERS, HUBER, 1e-6) == kernels.DONE
    np.testing.assert_array_equal(is_used, matches.is_used)


def seen_along_the_axis(matches: Matches, error_px: float) -> Matches:
    """Return matches of which only disparities tell how far the camera went ahead: wrong ones."""
    current = seen_from(matches.T, matches.points) * [0.01, 0.01, 1.0]
    n, factors = len(current), np.tile([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], (len(current), 1))
    uvd = project(current) + np.column_stack([np.zeros((n, 2)), np.resize([1, -1], n) * error_px])
    return replace(matches, points=move(matches.T, current), uvd=uvd, factors=factors)


@pytest.mark.parametrize("errors", [0.01, 1.0, 2.5, 40.0])
def test_the_covariance_is_the_sandwich_of_curvature_and_scores(errors: float) -> None:
    is_wide = errors < 5.0
    matches = random_matches(np.random.default_rng(6), 50, errors=errors)
    matches = matches if is_wide else seen_along_the_axis(matches, errors)
    Js, rs, _ = rows_of(matches, matches.T, HUBER)
    n, (H, A, S) = len(Js), np.zeros((3, 6, 6))
    for J, r in zip(Js, rs, strict=True):
        score, squared = J.T @ r, r @ r
        H += J.T @ J
        A += J.T @ J - (np.outer(score, score) / squared if squared > HUBER**2 else 0.0)
        S += np.outer(score, score)
    scale = max(float(np.sqrt(sum(r @ r for r in rs) / (3 * n - 6))), 0.1)
    # Two matches' worth of freedom; 24 pseudo-observations; a tenth of a sigma at least.
    S = (n * n / (n - 2) * S + 24 * scale**2 * H) / (n + 24) + 0.01 * H
    inverse, without = np.linalg.inv(A), np.linalg.inv(H)
    # Where long residuals alone tell of a direction, their curvature is no measure.
    is_sane = np.all(np.linalg.eigvalsh(A) > 0) and np.all(np.diag(inverse) < 10 * np.diag(without))
    assert is_sane == is_wide
    inverse = inverse if is_sane else without
    covariance, found_scale = np.empty((6, 6)), np.empty(1)
    out = PARAMETERS, HUBER, covariance, found_scale
    assert kernels.write_covariance(matches.T.copy(), *matches.arrays, *out) == kernels.DONE
    sizes = np.sqrt(np.diag(inverse @ S @ inverse))
    whitened = covariance / np.outer(sizes, sizes)
    np.testing.assert_allclose(
        whitened, inverse @ S @ inverse / np.outer(sizes, sizes), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_array_equal(covariance, covariance.T)
    assert found_scale[0] == pytest.approx(scale, rel=1e-9)


def constants_of(
    matches: Matches, T: FloatArray, sensitivities: FloatArray, Ws: list[FloatArray]
) -> list[FloatArray]:
    """Return the whitened derivatives (3, k) of the residuals of those used by constants."""
    before, now = sensitivities[:, 0, matches.is_used], sensitivities[:, 1, matches.is_used]
    points = matches.points[matches.is_used]
    return [
        W @ (now[:, i].T - by_reference(T, point) @ before[:, i].T)
        for i, (W, point) in enumerate(zip(Ws, points, strict=True))
    ]


@pytest.mark.parametrize("n_constants", [1, 3])
def test_constants_are_what_no_motion_explains(n_constants: int) -> None:
    rng = np.random.default_rng(7)
    matches = random_matches(rng, 40)
    sensitivities = rng.normal(size=(n_constants, 2, 40, 3))
    Js, rs, Ws = rows_of(matches, matches.T, HUBER)
    J, C = np.concatenate(Js), constants_of(matches, matches.T, sensitivities, Ws)
    effects = np.linalg.solve(J.T @ J, J.T @ np.concatenate(C))
    left = [c - each @ effects for c, each in zip(C, Js, strict=True)]
    score = sum(each.T @ r for each, r in zip(left, rs, strict=True))
    information = sum(each.T @ each for each in left)
    found = np.empty((n_constants,) * 2), np.empty(n_constants)
    arguments = sensitivities, PARAMETERS, HUBER, *found
    assert kernels.eliminate_pose(matches.T.copy(), *matches.arrays, *arguments) == kernels.DONE
    moved_by = np.empty((n_constants, 6))
    of_effects = sensitivities, PARAMETERS, HUBER, moved_by
    assert kernels.write_effects(matches.T.copy(), *matches.arrays, *of_effects) == kernels.DONE
    for each, expected in zip((*found, moved_by), (information, score, effects.T), strict=True):
        np.testing.assert_allclose(each, expected, rtol=1e-8)


def test_a_constant_that_acts_as_a_motion_tells_nothing() -> None:
    rng = np.random.default_rng(8)
    matches = random_matches(rng, 40)
    matches = replace(matches, is_used=np.ones(40, np.bool_), T=np.eye(4))
    matches = replace(matches, points=seen_from(random_motion(rng, 0.01, 0.01), matches.points))
    Js, _, Ws = rows_of(matches, matches.T, 1e9)
    sensitivities = np.zeros((1, 2, 40, 3))
    sensitivities[0, 1] = [np.linalg.solve(W, J[:, 4]) for W, J in zip(Ws, Js, strict=True)]
    information, score, effects = np.empty((1, 1)), np.empty(1), np.empty((1, 6))
    arguments = sensitivities, PARAMETERS, HUBER
    ends = (matches.T.copy(), *matches.arrays, *arguments)
    assert kernels.eliminate_pose(*ends, information, score) == kernels.DONE
    assert kernels.write_effects(*ends, effects) == kernels.DONE
    alone = sum(float(J[:, 4] @ J[:, 4]) for J in Js)
    assert abs(information[0, 0]) < 1e-9 * alone
    np.testing.assert_allclose(effects[0], np.eye(6)[4], atol=1e-9)


@pytest.mark.parametrize("n_steps", [1, 4])
def test_pose_and_constants_are_adjusted_together(n_steps: int) -> None:
    rng, weight = np.random.default_rng(9), 2.5
    matches, sensitivities = random_matches(rng, 40), rng.normal(size=(2, 2, 40, 3))
    start = away(rng, matches.T, 0.003)
    T, x = start.copy(), np.zeros(2)
    whole = replace(matches, is_used=np.ones(40, np.bool_))
    # Derivatives by the constants are those at the start.
    unwhitened = constants_of(whole, start, sensitivities, [np.eye(3)] * 40)
    for _ in range(n_steps):
        uvd = matches.uvd - np.array([each @ x for each in unwhitened])
        Js, rs, Ws = rows_of(replace(matches, uvd=uvd), T, HUBER)
        C = constants_of(matches, start, sensitivities, Ws)
        rows = np.hstack([np.concatenate(Js), np.concatenate(C)])
        prior = np.diag([0.0] * 6 + [weight] * 2)
        H = rows.T @ rows + prior
        step = solved(H, rows.T @ np.concatenate(rs) - prior[:, 6:] @ x)
        T, x = moved(T, step), x + step[6:]
    found = start.copy()
    values, covariance, effects = np.zeros(2), np.empty((2, 2)), np.empty((2, 6))
    arguments = sensitivities, PARAMETERS, HUBER, weight, n_steps, values, covariance, effects
    assert kernels.adjust(found, *matches.arrays, *arguments) == kernels.DONE
    np.testing.assert_allclose(found, T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(values, x, rtol=1e-9)
    np.testing.assert_allclose(covariance, weight * np.linalg.inv(H)[6:, 6:], rtol=1e-9)
    np.testing.assert_allclose(effects.T, -np.linalg.solve(H[:6, :6], H[:6, 6:]), rtol=1e-8)
