"""Factors against the costs that the kernels' authors give."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from gvo.backend.factors import Factors, Measurement, residual_of
from gvo.config import Kernel, WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, PosePrior, PositionPrior
from tests.backend.walks import edge, seeds, shifted

KERNELS: tuple[Kernel, ...] = ("none", "huber", "cauchy", "geman_mcclure", "dcs")
CONSTANTS: dict[Kernel, float] = {"huber": 3.55, "cauchy": 9.4, "geman_mcclure": 13.6, "dcs": 15.6}


def expected_cost(kernel: Kernel, r: float, k: float) -> float:
    """Return the published costs of a residual of norm r."""
    if kernel == "huber":
        return 0.5 * r**2 if r <= k else k * (r - 0.5 * k)
    if kernel == "cauchy":
        return float(0.5 * k**2 * np.log1p((r / k) ** 2))
    if kernel == "geman_mcclure":
        return 0.5 * k**2 * r**2 / (k**2 + r**2)
    if kernel == "dcs":
        scale = min(1.0, 2.0 * k / (k + r**2))
        return 0.5 * scale**2 * r**2 + 0.5 * k * (1.0 - scale) ** 2
    return 0.5 * r**2


def weight(kernel: Kernel, r: FloatArray, k: float) -> FloatArray:
    """Return the weights that belong to the costs: their slope over r."""
    if kernel == "huber":
        return np.minimum(1.0, k / r)
    if kernel == "cauchy":
        return 1.0 / (1.0 + (r / k) ** 2)
    if kernel == "geman_mcclure":
        return (k**2 / (k**2 + r**2)) ** 2
    return np.minimum(1.0, 2.0 * k / (k + r**2)) ** 2


@given(seed=seeds, size=st.floats(0.01, 40.0), kernel=st.sampled_from(KERNELS))
def test_the_cost_of_an_edge_is_that_of_its_kernel(seed: int, size: float, kernel: Kernel) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-3, -1, size=6)
    covariance = factor.T @ factor
    direction = rng.normal(size=6)
    xi = size * direction / np.sqrt(direction @ np.linalg.solve(covariance, direction))
    if np.linalg.norm(xi[:3]) > 3.0:  # beyond half a turn the twist is another one
        return
    edge = Edge(reference_id=0, T_reference_frame=np.eye(4), covariance=covariance)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3.Expmap(xi))
    for made in (
        Factors(WindowConfig(kernel=kernel)).between(0, 1, Measurement.of(edge)),
        Factors(WindowConfig(kernel="none")).between(
            0, 1, Measurement.of(replace(edge, kernel=kernel))
        ),
    ):
        expected = expected_cost(kernel, size, CONSTANTS.get(kernel, 0.0))
        if kernel != "dcs":  # GTSAM counts the cost of DCS without what is constant in it
            assert made.error(values) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("kernel", [kernel for kernel in KERNELS if kernel != "none"])
def test_the_constants_lose_as_little_of_good_data(kernel: Kernel) -> None:
    # Asymptotic efficiency of an M-estimator of location in six dimensions, of its weights.
    k, p = CONSTANTS[kernel], 6

    def mean(function: FloatArray, r: FloatArray) -> float:
        return float(integrate.trapezoid(function * stats.chi(p).pdf(r), r))

    r = np.linspace(1e-4, 15.0, 60001)
    psi = weight(kernel, r, k) * r
    slope = mean(np.gradient(psi, r) / p + (1.0 - 1.0 / p) * psi / r, r)
    efficiency = slope**2 / (mean(psi**2, r) / p)
    assert efficiency == pytest.approx(0.9984, abs=2e-4)


# Residuals, as a window lists them.


def poses_at(*poses: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    for key, T in enumerate(poses):
        values.insert(key, gtsam.Pose3(T))
    return values


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_residual_names_the_weight_of_its_kernel(kernel: Kernel) -> None:
    far = replace(edge(0, shifted(6.0), 1.0), kernel=kernel)
    factor = Factors(WindowConfig()).between(0, 1, Measurement.of(far))
    residual, found = residual_of(factor, poses_at(np.eye(4), np.eye(4)))
    np.testing.assert_allclose(residual, [0, 0, 0, -6, 0, 0], atol=1e-12)
    expected = 1.0 if kernel == "none" else float(weight(kernel, np.array(6.0), CONSTANTS[kernel]))
    assert found == pytest.approx(expected)


@given(seed=seeds)
def test_residuals_are_twists_from_what_was_measured_in_sigmas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second, measured = (
        se3.exp(np.r_[rng.normal(size=3), 5.0 * rng.normal(size=3)]) for _ in range(3)
    )
    root = rng.normal(size=(6, 6)) * rng.uniform(0.1, 2.0, 6)
    covariance = root @ root.T + 1e-3 * np.eye(6)
    # Which whitens is the upper root of the information.
    R, R_place = (np.linalg.cholesky(np.linalg.inv(C)).T for C in (covariance, covariance[:3, :3]))
    factors, values = Factors(WindowConfig(kernel="none")), poses_at(first, second)
    one = Edge(reference_id=0, T_reference_frame=measured, covariance=covariance)
    there = PosePrior(T_world_frame=measured, covariance=covariance, kernel="huber")
    place = PositionPrior(position_world=rng.normal(size=3), covariance=covariance[:3, :3])
    for factor, expected in (
        (
            factors.between(0, 1, Measurement.of(one)),
            R @ se3.log(np.linalg.inv(first @ measured) @ second),
        ),
        (factors.prior(1, there), R @ se3.log(np.linalg.inv(measured) @ second)),
        # Of a position along the axes of the world.
        (factors.prior(1, place), R_place @ (second[:3, 3] - place.position_world)),
    ):
        found, _ = residual_of(factor, values)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
