"""Factors against the costs that the kernels' authors give."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from gvo.backend.factors import Factors, Measurement
from gvo.config import Kernel, WindowConfig
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


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_residual_names_the_weight_of_its_kernel(kernel: Kernel) -> None:
    far = replace(edge("a", shifted(6.0), 1.0), kernel=kernel)
    found = Factors(WindowConfig()).residual_of_edge(far, "b", np.eye(4), np.eye(4))
    np.testing.assert_allclose(found.residual, [0, 0, 0, -6, 0, 0], atol=1e-12)
    expected = 1.0 if kernel == "none" else float(weight(kernel, np.array(6.0), CONSTANTS[kernel]))
    assert found.weight == pytest.approx(expected)
    assert found.chi2 == pytest.approx(36.0)


def test_a_position_weighs_along_the_axes_of_the_world() -> None:
    prior = PositionPrior(position_world=np.zeros(3), covariance=np.diag([1.0, 4.0, 9.0]))
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, 0.4, 0.5), np.array([1.0, 2.0, 3.0]))
    values = gtsam.Values()
    values.insert(7, T)
    factors = Factors(WindowConfig())
    assert factors.prior(7, prior).error(values) == pytest.approx(1.5)
    found = factors.residual_of_prior(prior, "a", T.matrix())
    np.testing.assert_allclose(found.residual, [1.0, 1.0, 1.0])


@given(seed=seeds)
def test_residuals_are_those_of_gtsam_in_the_axes_of_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second, measured = (
        gtsam.Pose3.Expmap(np.r_[rng.normal(size=3), 5.0 * rng.normal(size=3)]) for _ in range(3)
    )
    covariance = np.diag(rng.uniform(0.1, 2.0, 6) ** 2)
    sigmas = np.sqrt(np.diag(covariance))
    edge = Edge(reference_id="a", T_reference_frame=measured.matrix(), covariance=covariance)
    factors = Factors(WindowConfig(kernel="none"))
    found = factors.residual_of_edge(edge, "b", first.matrix(), second.matrix())
    expected = gtsam.Pose3.Logmap(first.compose(measured).inverse().compose(second))
    np.testing.assert_allclose(found.residual, expected / sigmas, atol=1e-7)
    assert (found.reference_id, found.frame_id, found.weight) == ("a", "b", 1.0)
    assert found.T_reference_frame is edge.T_reference_frame

    prior = PosePrior(T_world_frame=measured.matrix(), covariance=covariance)
    found = factors.residual_of_prior(prior, "b", second.matrix())
    expected = gtsam.Pose3.Logmap(measured.inverse().compose(second))
    np.testing.assert_allclose(found.residual, expected / sigmas, atol=1e-7)
    assert (found.reference_id, found.frame_id) == (None, "b")
    made = factors.prior(3, prior)
    values = gtsam.Values()
    values.insert(3, second)
    whitened = found.residual @ found.residual
    assert made.error(values) == pytest.approx(0.5 * whitened, rel=1e-6)

    place = PositionPrior(position_world=rng.normal(size=3), covariance=covariance[:3, :3])
    at = factors.residual_of_prior(place, "b", second.matrix())
    np.testing.assert_allclose(
        at.residual, (second.translation() - place.position_world) / sigmas[:3], atol=1e-9
    )
    np.testing.assert_allclose(at.T_reference_frame[:3, :3], second.rotation().matrix())
    np.testing.assert_array_equal(at.T_reference_frame[:3, 3], place.position_world)


def test_a_residual_is_whitened_by_the_upper_root_of_the_information() -> None:
    factor = np.random.default_rng(2).normal(size=(3, 3))
    covariance = factor @ factor.T
    place = PositionPrior(position_world=np.zeros(3), covariance=covariance)
    T = np.eye(4)
    T[:3, 3] = [0.3, -0.2, 0.5]
    found = Factors(WindowConfig()).residual_of_prior(place, "a", T)
    R = np.linalg.cholesky(np.linalg.inv(covariance)).T
    np.testing.assert_allclose(found.residual, R @ T[:3, 3], rtol=1e-9)
