"""What goes into a between-factor, and what is kept out."""

from typing import Literal

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.backend.noise import check_covariance, check_transform, edge_noise
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    factor = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-4, 0, size=6)
    return np.asarray(factor.T @ factor)


def cost(config: WindowConfig, covariance: FloatArray, xi: FloatArray) -> float:
    """Return the cost of an edge that says identity, between poses a twist apart."""
    noise = edge_noise(covariance, config)
    factor = gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(), noise)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3.Expmap(xi))
    return float(factor.error(values))


@settings(deadline=None)
@given(seed=seeds, size=st.floats(0.01, 30.0), kernel=st.sampled_from(["huber", "none"]))
def test_the_cost_is_quadratic_and_beyond_the_threshold_linear(
    seed: int, size: float, kernel: Literal["huber", "none"]
) -> None:
    rng = np.random.default_rng(seed)
    covariance = random_covariance(rng)
    direction = rng.normal(size=6)
    whitened = np.sqrt(direction @ np.linalg.solve(covariance, direction))
    xi = size * direction / whitened  # of a whitened norm of `size`
    if np.linalg.norm(xi[:3]) > 3.0:  # beyond half a turn the twist is another one
        return
    found = cost(WindowConfig(kernel=kernel, kernel_threshold=3.0), covariance, xi)
    expected = 0.5 * size**2 if kernel == "none" or size <= 3.0 else 3.0 * (size - 1.5)
    assert found == pytest.approx(expected, rel=1e-4)


@settings(deadline=None)
@given(seed=seeds)
def test_every_transform_and_every_covariance_that_is_one_is_let_through(seed: int) -> None:
    rng = np.random.default_rng(seed)
    check_transform(se3.exp(10 * rng.normal(size=6)), "T")
    check_covariance(random_covariance(rng), "C")
    check_covariance(np.diag(10.0 ** rng.uniform(-12, 6, size=6)), "C")


@settings(deadline=None)
@given(seed=seeds)
def test_a_covariance_that_was_moved_to_another_frame_is_let_through(seed: int) -> None:
    # Rounding leaves such products a little asymmetric, above all where they should be zero.
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    plain = 10.0 ** rng.uniform(-8, 0) * np.eye(6)
    check_covariance(se3.compose_covariance(plain, T, plain), "C")
    Ad = se3.adjoint(np.diag([-1.0, -1.0, 1.0, 1.0]) @ T)
    check_covariance(Ad @ plain @ Ad.T, "C")


def changed(T: FloatArray, *index: int, value: float) -> FloatArray:
    T = T.copy()
    T[index] = value
    return T


@pytest.mark.parametrize(
    ("T", "match"),
    [
        (np.eye(3), "4x4"),
        (np.full((4, 4), np.nan), "finite"),
        (changed(np.eye(4), 0, 3, value=np.inf), "finite"),
        (changed(np.eye(4), 0, 0, value=1.001), "rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "rotation"),
        (np.zeros((4, 4)), "rotation"),
        (changed(np.eye(4), 3, 0, value=0.1), "last row"),
        (changed(np.eye(4), 3, 3, value=2.0), "last row"),
    ],
)
def test_what_is_no_transform_is_refused_by_name(T: FloatArray, match: str) -> None:
    with pytest.raises(ValueError, match=f"T_a_b.*{match}"):
        check_transform(T, "T_a_b")


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.eye(5), "6x6"),
        (np.full((6, 6), np.nan), "finite"),
        (np.diag([1.0, 1, 1, 1, 1, np.inf]), "finite"),
        (changed(np.eye(6), 0, 1, value=0.1), "symmetric"),
        (np.zeros((6, 6)), "definite"),
        (np.diag([1.0, 1, 1, 1, 1, 0]), "definite"),
        (np.diag([1.0, 1, 1, 1, 1, -1]), "definite"),
        (np.ones((6, 6)), "definite"),
        (2.0 * np.eye(6) - np.ones((6, 6)), "definite"),
        (-np.eye(6), "definite"),
    ],
)
def test_what_is_no_covariance_is_refused_by_name(covariance: FloatArray, match: str) -> None:
    with pytest.raises(ValueError, match=f"C_ab.*{match}"):
        check_covariance(covariance, "C_ab")
