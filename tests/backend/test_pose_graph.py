"""The pose graph itself: iterations, marginalization, restoring, covariances."""

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.backend.batch import optimize_batch
from gvo.backend.pose_graph import PoseGraph, definite, first_line
from gvo.errors import SmoothingError
from gvo.types import FloatArray
from tests.backend import walks
from tests.backend.walks import values_of

STEP = gtsam.Pose3(walks.STEP)
ORIGIN = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)


def between(first: int, second: int, T: gtsam.Pose3, sigma: float) -> Any:
    return gtsam.BetweenFactorPose3(first, second, T, gtsam.noiseModel.Isotropic.Sigma(6, sigma))


def factors_of(*factors: Any) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def power(n: int) -> gtsam.Pose3:
    return gtsam.Pose3(walks.power(n))


def chain(n: int, sigma: float = 0.1, *, is_whole: bool = False) -> PoseGraph:
    graph = PoseGraph(is_whole=is_whole)
    factors = factors_of(
        gtsam.PriorFactorPose3(0, gtsam.Pose3(), ORIGIN),
        *(between(key - 1, key, STEP, sigma) for key in range(1, n)),
    )
    graph.update(factors, values_of({key: power(key) for key in range(n)}))
    return graph


def loop_of(n: int, turn_rad: float, sigma: float = 1e-3) -> gtsam.NonlinearFactorGraph:
    """Return an edge from the first pose to the last that turns the chain."""
    turn = gtsam.Pose3.Expmap(np.array([0.0, turn_rad, 0.0, 0.0, 0.0, 0.0]))
    return factors_of(between(0, n - 1, power(n - 1).compose(turn), sigma))


def step_left(graph: PoseGraph) -> float:
    """Return the longest element of the next step of Gauss and Newton."""
    step = graph.factors().linearize(graph.values()).optimize()
    return max(float(np.abs(step.at(key)).max()) for key in graph.values().keys())  # noqa: SIM118


@pytest.mark.parametrize(("turn_rad", "is_far"), [(0.0, False), (0.01, False), (1.0, True)])
def test_a_graph_is_iterated_if_an_update_moved_it_far(turn_rad: float, is_far: bool) -> None:
    graph = chain(6)
    before = {5: graph.pose3(5)}
    graph.update(loop_of(6, turn_rad), gtsam.Values())
    with walks.failing("update", []) as calls:
        answer = graph.iterate(before, {})
    assert answer is is_far
    assert bool(calls) == is_far
    assert len(calls) <= 10
    assert step_left(graph) < 1e-2


def test_a_whole_graph_is_not_iterated_and_may_have_moved() -> None:
    graph = chain(6, is_whole=True)
    with walks.failing("update", []) as calls:
        assert graph.iterate({5: gtsam.Pose3()}, {}) is True
    assert calls == []


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, key: int) -> FloatArray:
    return np.asarray(gtsam.Marginals(graph, values).marginalCovariance(key))


@pytest.mark.parametrize("leaving", [[0], [0, 1], [2, 0], [3, 1, 2]])
@pytest.mark.parametrize("turn_rad", [0.0, 1.0])
def test_what_those_knew_that_leave_outlasts_steps(leaving: Sequence[int], turn_rad: float) -> None:
    n = 6
    graph, twin = chain(n), chain(n)
    factors = loop_of(n, turn_rad)
    factors.add(between(n - 1, n, STEP, 0.1))
    start = {n: graph.pose3(n - 1).compose(STEP)}
    before = {key: graph.pose3(key) for key in (0, n - 1)}
    graph.update(factors, values_of(start), alive=range(n), leaving=leaving)
    graph.iterate(before, start, alive=range(n + 1), leaving=leaving)
    graph.marginalize(leaving)
    twin.update(factors, values_of(start))
    twin.iterate(before, start)
    left = sorted(set(range(n + 1)) - set(leaving))
    assert sorted(graph.values().keys()) == left
    assert len(graph.positions()) == len(left)
    for key in left:
        np.testing.assert_allclose(graph.pose(key), twin.pose(key), atol=1e-4)
        expected = marginals(twin.factors(), twin.values(), key)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(graph.covariance(key) / scale, expected / scale, atol=0.03)


def test_the_joint_covariance_comes_in_the_order_asked_for() -> None:
    graph = chain(4)
    for first, second in ((1, 3), (3, 1)):
        joint = graph.joint_covariance(first, second)
        assert joint.shape == (12, 12)
        np.testing.assert_allclose(joint[:6, :6], graph.covariance(first), atol=1e-12)
        np.testing.assert_allclose(joint[6:, 6:], graph.covariance(second), atol=1e-12)


def test_factors_that_left_make_room_for_others() -> None:
    graph = chain(3)
    sizes = []
    for key in range(3, 40):
        start = {key: power(key)}
        factors = factors_of(between(key - 1, key, STEP, 0.1))
        graph.update(factors, values_of(start), alive=range(key - 3, key), leaving=[key - 3])
        graph.marginalize([key - 3])
        sizes.append(graph.factors().size())
    assert max(sizes[10:]) == max(sizes[-10:]) < 12


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_hardened_graph_has_the_same_poses_and_stays_hardened(is_whole: bool) -> None:
    graph = chain(4, is_whole=is_whole)
    hardened = graph.hardened()
    assert (graph.is_hardened, hardened.is_hardened) == (False, True)
    np.testing.assert_allclose(hardened.positions(), graph.positions(), atol=1e-9)
    for key in range(4):
        np.testing.assert_allclose(
            hardened.covariance(key), graph.covariance(key), rtol=1e-6, atol=1e-12
        )
    moved = values_of({key: power(key + 1) for key in range(4)})
    for each in (graph, hardened):
        assert each.moved(moved).is_hardened is each.is_hardened


@pytest.mark.parametrize(
    ("error", "thrown"),
    [
        (RuntimeError, SmoothingError),
        (IndexError, SmoothingError),
        (KeyboardInterrupt, KeyboardInterrupt),
        (ValueError, ValueError),
    ],
)
def test_whatever_interrupts_an_update_leaves_the_graph_as_it_was(
    error: type[BaseException], thrown: type[BaseException]
) -> None:
    graph = chain(3)
    before = graph.positions()

    def interrupted_update() -> None:
        with graph.restored_on_error():
            graph.update(loop_of(3, 1.0), gtsam.Values())
            raise error("one thing\nand more")

    with pytest.raises(thrown) as caught:
        interrupted_update()
    np.testing.assert_array_equal(graph.positions(), before)
    assert graph.factors().size() == 3
    if thrown is SmoothingError:
        assert str(caught.value) == "GTSAM: one thing"


def go_on(graph: PoseGraph, key: int, *, is_whole: bool) -> None:
    """Add a pose that wobbles, with a loop now and then; of a windowed graph the fourth leaves."""
    wobble = gtsam.Pose3.Expmap(0.02 * np.sin(key * np.arange(1.0, 7.0)))
    start = {key: graph.pose3(key - 1).compose(STEP).compose(wobble)}
    factors = factors_of(between(key - 1, key, STEP.compose(wobble), 0.1))
    if key % 7 == 0:
        factors.add(between(key - 3, key, power(3), 0.02))
    before = {key - 1: graph.pose3(key - 1)}
    alive, leaving = (list(range(key - 4, key)), [key - 4]) if not is_whole else ([], [])
    with graph.restored_on_error():
        graph.update(factors, values_of(start), alive=alive, leaving=leaving)
        graph.iterate(before, start, alive=[*alive, key], leaving=leaving)
        graph.marginalize(leaving)


def fail_to_add(graph: PoseGraph, factor: Any) -> None:
    with graph.restored_on_error():
        graph.update(factors_of(factor), gtsam.Values())
        raise RuntimeError("no")


@pytest.mark.parametrize("is_whole", [False, True])
def test_a_graph_is_seldom_copied_and_restored_all_the_same(
    is_whole: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies, original = [], gtsam.ISAM2

    def counted_copy(argument: Any) -> gtsam.ISAM2:
        copies.append(isinstance(argument, original))
        return original(argument)

    graph, twin = chain(4, is_whole=is_whole), chain(4, is_whole=is_whole)
    for key in range(4, 120):
        go_on(graph, key, is_whole=is_whole)
        with pytest.raises(SmoothingError):
            fail_to_add(graph, between(key - 2, key, power(5), 1e-3))
        with monkeypatch.context() as patch:
            patch.setattr(gtsam, "ISAM2", counted_copy)
            go_on(twin, key, is_whole=is_whole)
        np.testing.assert_allclose(graph.positions(), twin.positions(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(graph.covariance(key), twin.covariance(key), rtol=1e-9)
    assert 5 < sum(copies) < 20  # of 116 poses, which are up to three steps each


def test_a_batch_goes_on_until_the_error_converges() -> None:
    graph = chain(6)
    factors = graph.factors()
    factors.push_back(loop_of(6, 1.5))
    optimum, found = optimize_batch(factors, graph.values())
    assert found.error_before > found.error_after > 1.0
    again, second = optimize_batch(factors, optimum)
    assert second.error_before == found.error_after == pytest.approx(factors.error(optimum))
    assert second.error_after == pytest.approx(found.error_after, rel=1e-9)
    assert factors.error(again) <= factors.error(optimum)


# Covariances as GTSAM gives them: with the traces of rounding, and with worse.


def correlations(rng: np.random.Generator, least: float) -> FloatArray:
    """Return a matrix with ones on its diagonal and about this least eigenvalue."""
    factor = rng.normal(size=(6, 5))
    flat = factor @ factor.T  # of rank five
    scale = np.sqrt(np.diag(flat))
    flat /= np.outer(scale, scale)
    return np.asarray((flat + least * np.eye(6)) / (1.0 + least))


@given(seed=walks.seeds, exponent=st.floats(-9.0, -7.0))
def test_a_little_less_than_definite_is_mended_in_what_it_lacks(seed: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    sigmas = 10.0 ** rng.uniform(-4, 4, size=6)
    scale = np.outer(sigmas, sigmas)
    spoilt = correlations(rng, -(10.0**exponent))
    mended = definite(spoilt * scale) / scale
    np.testing.assert_array_equal(mended, mended.T)
    eigenvalues = np.linalg.eigvalsh(mended)
    # As positive as a factorization needs, and no farther off than that.
    assert 0.5e-10 < eigenvalues[0] < 2e-10
    assert np.linalg.norm(mended - spoilt, 2) < 1.5 * 10.0**exponent + 2e-10
    np.testing.assert_allclose(eigenvalues[1:], np.linalg.eigvalsh(spoilt)[1:], atol=1e-12)


@given(seed=walks.seeds)
def test_a_definite_one_is_only_made_symmetric(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6))
    covariance = factor @ factor.T + 0.1 * np.eye(6)
    np.testing.assert_array_equal(definite(covariance), 0.5 * (covariance + covariance.T))
    skew = np.triu(rng.normal(size=(6, 6)), 1)
    np.testing.assert_allclose(definite(covariance + 0.01 * (skew - skew.T)), covariance)


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.diag([1.0, 1, np.nan, 1, 1, 1]), "not finite"),
        (np.diag([1.0, 1, np.inf, 1, 1, 1]), "not finite"),
        (np.diag([1.0, 1, 0, 1, 1, 1]), "variance is not positive"),
        (np.diag([1.0, 1, -1e-9, 1, 1, 1]), "variance is not positive"),
        (1.001 * np.eye(6) * 2 - np.ones((6, 6)), "not positive definite"),
        (1.00001 * np.ones((6, 6)) - 1e-5 * np.eye(6), "not positive definite"),
    ],
)
def test_what_is_more_than_rounding_is_refused(covariance: FloatArray, match: str) -> None:
    with pytest.raises(SmoothingError, match=match):
        definite(covariance)


def test_of_an_error_the_first_line_is_told() -> None:
    assert first_line(RuntimeError("\n  one thing\nand more\n")) == "one thing"
    assert first_line(IndexError()) == "IndexError"
