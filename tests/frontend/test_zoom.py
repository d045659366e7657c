"""A zoom is told by points that a motion does not move, and a motion is not taken for one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.frontend.zoom import find_zoom
from gvo.geometry.correspondences import Correspondences
from gvo.types import FloatArray
from tests.geometry.scenes import (
    CAMERA,
    project,
    random_motion,
    random_points,
    seeds,
    seen_from,
    unproject,
)


def seen(
    rng: np.random.Generator, T: FloatArray, ratio: float = 1.0, n: int = 80
) -> Correspondences:
    """Return points before and after a motion and a zoom; a seventh of the matches is wrong."""
    points = random_points(rng, n)
    uvd = (
        project(points),
        project(seen_from(T, points), replace(CAMERA, fx=ratio * CAMERA.fx, fy=ratio * CAMERA.fy)),
    )
    uvd[1][:, :2] += 0.2 * rng.standard_normal((n, 2))
    uvd[1][: n // 7, :2] += rng.uniform(-60, 60, (n // 7, 2))
    sigmas = np.full((2, n, 3), 0.3)
    return Correspondences(
        reference_points=points,
        current_points=unproject(uvd[1]),
        reference_uvd=uvd[0],
        current_uvd=uvd[1],
        reference_sigmas=sigmas[0],
        current_sigmas=sigmas[1],
    )


@given(seed=seeds, ratio=st.floats(0.8, 1.25).filter(lambda ratio: abs(ratio - 1.0) > 0.04))
def test_a_zoom_is_told_beside_the_motion_that_goes_on(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    T = random_motion(rng, turn_rad=0.03)
    change = random_motion(rng, turn_rad=0.001, shift_m=0.002)
    assert find_zoom(seen(rng, T @ change, ratio), T, CAMERA) == pytest.approx(ratio, rel=1e-2)


@given(seed=seeds)
def test_what_the_step_before_foretells_is_no_zoom(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, change = random_motion(rng), random_motion(rng, turn_rad=0.01, shift_m=0.02)
    assert find_zoom(seen(rng, T @ change), T, CAMERA) is None


@given(seed=seeds, ahead_m=st.sampled_from([-1.0, 0.5, 1.0]))
def test_a_leap_ahead_is_no_zoom_as_near_points_grow_more(seed: int, ahead_m: float) -> None:
    rng, leap = np.random.default_rng(seed), np.eye(4)
    leap[2, 3] = ahead_m
    assert find_zoom(seen(rng, leap), np.eye(4), CAMERA) is None


def test_a_few_tracks_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    assert find_zoom(seen(rng, np.eye(4), 1.2, n=29), np.eye(4), CAMERA) is None
    assert find_zoom(seen(rng, np.eye(4), 1.2, n=30), np.eye(4), CAMERA) is not None
