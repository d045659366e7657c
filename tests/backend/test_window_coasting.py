"""A pose without a usable edge goes on by an edge that an IMU, say, leads it along."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, PosePrior, PositionPrior, Status
from tests.backend.imus import adjoint
from tests.backend.walks import STEP, STEP_NS, edge, failing, go_on, power, shifted, walk

CONFIG = WindowConfig(size=20)
# Another way than the last velocity.
AWAY = se3.exp(np.array([0.0, -0.2, 0.05, -0.3, 0.1, 0.2]))


def begun(n: int = 5) -> SlidingWindow:
    return walk(CONFIG, n)


def carried(window: SlidingWindow, start: int, stop: int, T: Any = AWAY) -> list[Estimate]:
    """Add poses that nothing but a coasting edge leads to."""
    return [
        window.add_pose(k, k * STEP_NS, [], coasting=edge(k - 1, T, 0.05))
        for k in range(start, stop)
    ]


def by_velocity(n: int = 5) -> Estimate:
    """Return the pose after some steps, by the last velocity."""
    return begun(n).add_pose(n, n * STEP_NS, [])


def test_without_an_edge_a_pose_goes_where_the_coasting_edge_leads() -> None:
    window = begun()
    estimate = carried(window, 5, 6)[0]
    np.testing.assert_allclose(estimate.T_world_frame, window.pose(4) @ AWAY, atol=1e-9)
    assert estimate.status is Status.COASTING
    assert estimate.rejected == ()
    assert [each.reference_id for each in window.edges(5)] == [4]
    np.testing.assert_array_equal(window.edges(5)[0].T_reference_frame, AWAY)
    assert np.linalg.norm(by_velocity().T_world_frame - estimate.T_world_frame) > 0.2


def test_its_covariance_is_that_of_the_edge_after_the_one_before() -> None:
    window = begun()
    before = window.covariance(4)
    estimate = carried(window, 5, 6)[0]
    back = adjoint(np.linalg.inv(AWAY))
    expected = back @ before @ back.T + 0.05**2 * np.eye(6)
    np.testing.assert_allclose(estimate.covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(window.covariance(4), before, rtol=1e-6, atol=1e-12)


def test_a_carried_pose_is_never_lost_but_one_that_nothing_carries_is() -> None:
    window = begun()
    assert {each.status for each in carried(window, 5, 65)} == {Status.COASTING}
    after = [window.add_pose(k, k * STEP_NS, []).status for k in range(65, 90)]
    assert after[:20] == [Status.COASTING] * 20
    assert after[20:] == [Status.LOST] * 5
    assert window.counts.n_coasting == 85
    assert go_on(window, 90, 91)[0].status is Status.RESUMED


def faulty() -> list[Any]:
    bad, nowhere = -np.eye(6), np.full((4, 4), np.nan)
    return [
        pytest.param(replace(edge(4, AWAY), covariance=bad), id="negative_covariance"),
        pytest.param(replace(edge(4, AWAY), T_reference_frame=nowhere), id="nan"),
        pytest.param(edge("elsewhere", AWAY), id="unknown_reference"),
        pytest.param(edge(5, AWAY), id="to_itself"),
    ]


@pytest.mark.parametrize("coasting", faulty())
def test_where_the_coasting_edge_is_invalid_the_last_velocity_goes_on(coasting: Edge) -> None:
    window, expected = begun(), by_velocity()
    estimate = window.add_pose(5, 5 * STEP_NS, [], coasting=coasting)
    np.testing.assert_array_equal(estimate.T_world_frame, expected.T_world_frame)
    np.testing.assert_array_equal(estimate.covariance, expected.covariance)
    assert estimate.status is Status.COASTING
    assert not window.edges(5) or window.edges(5)[0] is not coasting


def test_where_its_reference_has_left_the_last_velocity_goes_on() -> None:
    windows = [walk(WindowConfig(size=3), 8) for _ in range(2)]
    assert 1 not in windows[0]
    coasting = edge(1, AWAY)
    estimate = windows[0].add_pose(8, 8 * STEP_NS, [], coasting=coasting)
    expected = windows[1].add_pose(8, 8 * STEP_NS, [])
    np.testing.assert_array_equal(estimate.T_world_frame, expected.T_world_frame)


def test_what_is_no_edge_is_refused_and_changes_nothing() -> None:
    window: Any = begun()
    with pytest.raises(ValueError, match="Edge"):
        window.add_pose(5, 5 * STEP_NS, [], coasting=AWAY)
    assert 5 not in window


@pytest.mark.parametrize("n_edges", [1, 2])
def test_with_usable_edges_it_changes_nothing(n_edges: int) -> None:
    results = []
    for coasting in (None, AWAY):
        window, estimates = begun(), []
        for k in range(5, 15):
            edges = [edge(k - 1, STEP), edge(k - 3, power(3) @ shifted(x=0.01))][:n_edges]
            other = None if coasting is None else edge(k - 1, coasting)
            estimates.append(window.add_pose(k, k * STEP_NS, edges, coasting=other))
        results.append((estimates, window.finish()))
    for one, other in zip(*(each[0] + each[1] for each in results), strict=True):
        np.testing.assert_array_equal(one.T_world_frame, other.T_world_frame)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert one.status is other.status is Status.OK


def test_where_all_edges_are_unusable_it_leads_and_they_are_refused() -> None:
    window = begun()
    estimate = window.add_pose(
        5, 5 * STEP_NS, [edge("elsewhere", STEP)], coasting=edge(4, AWAY, 0.05)
    )
    np.testing.assert_allclose(estimate.T_world_frame, window.pose(4) @ AWAY, atol=1e-9)
    assert [each.reference_id for each in estimate.rejected] == ["elsewhere"]
    assert estimate.status is Status.COASTING


def test_one_that_is_offered_among_the_edges_too_does_not_make_a_pose_measured() -> None:
    window, offered = begun(), edge(4, AWAY, 0.05)
    lone = window.add_pose(5, 5 * STEP_NS, [offered], coasting=offered)
    assert lone.status is Status.COASTING
    offered = edge(5, AWAY, 0.05)
    both = window.add_pose(6, 6 * STEP_NS, [edge(4, AWAY @ AWAY, 0.05), offered], coasting=offered)
    assert both.status is Status.RESUMED
    assert len(window.edges(6)) == 2


def test_after_it_ends_the_velocity_is_that_of_the_carried_poses() -> None:
    window = begun()
    carried(window, 5, 9)
    estimate = window.add_pose(9, 9 * STEP_NS, [])
    np.testing.assert_allclose(estimate.T_world_frame, window.pose(8) @ AWAY, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.001, 0.05, 1.0])
def test_with_a_pose_prior_a_carried_pose_is_measured_and_lies_between_both(sigma: float) -> None:
    window = begun()
    T = window.pose(4) @ AWAY @ shifted(x=0.03)
    prior = PosePrior(T_world_frame=T, covariance=sigma**2 * np.eye(6))
    coasting = edge(4, AWAY, 0.05)
    estimate = window.add_pose(5, 5 * STEP_NS, [], prior, coasting=coasting)
    assert estimate.status is Status.OK
    shift = (np.linalg.inv(window.pose(4) @ AWAY) @ estimate.T_world_frame)[:3, 3]
    assert -1e-6 < shift[0] < 0.03 + 1e-6
    if sigma == 0.001:
        np.testing.assert_allclose(estimate.T_world_frame, T, atol=1e-4)
    if sigma == 1.0:
        assert shift[0] < 0.001
    assert np.abs(shift[1:]).max() < 1e-3


def test_with_a_position_prior_its_rotation_is_that_of_the_edge() -> None:
    window = begun()
    T = window.pose(4) @ AWAY
    prior = PositionPrior(position_world=T[:3, 3] + 0.01, covariance=1e-8 * np.eye(3))
    estimate = window.add_pose(5, 5 * STEP_NS, [], prior, coasting=edge(4, AWAY, 0.05))
    np.testing.assert_allclose(estimate.T_world_frame[:3, 3], T[:3, 3] + 0.01, atol=1e-4)
    np.testing.assert_allclose(estimate.T_world_frame[:3, :3], T[:3, :3], atol=0.02)


def test_where_gtsam_fails_with_it_the_last_velocity_goes_on() -> None:
    window, expected = begun(), by_velocity()
    with failing("update", {0, 1, 2}):
        estimate = window.add_pose(5, 5 * STEP_NS, [], coasting=edge(4, AWAY, 0.05))
    np.testing.assert_allclose(estimate.T_world_frame, expected.T_world_frame, atol=1e-9)
    assert estimate.status is Status.COASTING
    assert [each.reference_id for each in estimate.rejected] == [4]
    after = [window.add_pose(k, k * STEP_NS, []).status for k in range(6, 30)]
    assert after.index(Status.LOST) == 25 - 6  # two seconds after the last measured one
