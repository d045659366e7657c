"""A window from its start over what is given up on the way to its next start."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, PositionPrior, Status

STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))
PLACE = PosePrior(T_world_frame=STEP, covariance=1e-4 * np.eye(6))


def edge(reference_id: FrameId, T: FloatArray, sigma: float = 0.01) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def power(n: int) -> FloatArray:
    return se3.normalize(np.linalg.matrix_power(STEP, n))


def go_on(window: SlidingWindow, start: int, stop: int) -> list[Estimate]:
    """Add poses, each seen from the one before."""
    return [
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)] if frame else [])
        for frame in range(start, stop)
    ]


@contextmanager
def failing_updates(*calls: int) -> Iterator[None]:
    original = gtsam.ISAM2.update
    seen: list[int] = []

    def update(self: Any, *arguments: Any) -> Any:
        seen.append(len(seen))
        if seen[-1] in calls:
            raise RuntimeError("Indeterminant linear system detected")
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, "update", update)
        yield


# Another size before, and after, there is anything in the window.


@pytest.mark.parametrize(("before", "after"), [(5, None), (None, 5), (3, 6)])
def test_an_empty_window_takes_another_size_as_if_it_had_begun_with_it(
    before: int | None, after: int | None
) -> None:
    window = SlidingWindow(WindowConfig(size=before))
    window.reconfigure(WindowConfig(size=after))
    go_on(window, 0, 12)
    assert len(window) == (12 if after is None else after)
    assert len(window.pop_finished()) == (0 if after is None else 12 - after)
    window.finish()
    assert (window.polish is not None) == (after is None)


def test_what_the_last_polish_gained_is_not_told_of_the_next_run() -> None:
    window = SlidingWindow(WindowConfig(size=None))
    go_on(window, 0, 4)
    window.finish()
    assert window.polish is not None
    window.reconfigure(WindowConfig(size=3))
    go_on(window, 0, 6)
    assert len(window) == 3
    assert [each.frame_id for each in window.finish()] == list(range(6))
    assert window.polish is None
    # And back: a window that slid can keep everything from its next start on.
    go_on(window, 0, 4)
    window.reconfigure(WindowConfig(size=None))
    window.finish()
    assert window.polish is None
    go_on(window, 0, 4)
    window.finish()
    assert window.polish is not None


def test_a_window_that_finished_knows_nothing_of_the_motion_before() -> None:
    window = SlidingWindow(WindowConfig(size=4))
    go_on(window, 0, 4)
    assert window.add_pose("lost", 4 * STEP_NS, []).status is Status.COASTING
    window.finish()
    first = window.add_pose("a", 0, [])
    assert first.status is Status.OK
    np.testing.assert_allclose(first.T_world_cam, np.eye(4), atol=1e-12)
    second = window.add_pose("b", STEP_NS, [])
    assert second.status is Status.COASTING
    np.testing.assert_allclose(second.T_world_cam, np.eye(4), atol=1e-9)
    assert window.newest == "b"


# Statuses and stamps.


def test_a_status_that_is_given_counts_where_a_measurement_ties_the_pose() -> None:
    window = SlidingWindow(WindowConfig(size=4))
    go_on(window, 0, 2)
    found = window.add_pose(2, 2 * STEP_NS, [edge(1, STEP)], status=Status.RESUMED)
    assert found.status is Status.RESUMED
    found = window.add_pose(3, 3 * STEP_NS, [], status=Status.RESUMED)
    assert found.status is Status.COASTING
    found = window.add_pose(4, 4 * STEP_NS, [], PLACE, status=Status.OK)
    assert found.status is Status.OK
    found = window.add_pose(5, 5 * STEP_NS, [])
    assert found.status is Status.COASTING
    found = window.add_pose(6, 6 * STEP_NS, [edge(5, STEP)])
    assert found.status is Status.RESUMED


def test_a_stamp_may_be_a_number_of_numpy_but_no_truth_value() -> None:
    window = SlidingWindow()
    found = window.add_pose("a", np.int64(7), [])  # type: ignore[arg-type]
    assert type(found.stamp_ns) is int
    assert (found.stamp_ns, window.stamp_ns("a")) == (7, 7)
    for wrong in (True, np.True_, 8.0):
        with pytest.raises(ValueError, match="stamp_ns of 'b' must be an int"):
            window.add_pose("b", wrong, [])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no frame_id"):
        window.add_pose(None, 8, [])
    with pytest.raises(ValueError, match="'a' is in the window already"):
        window.add_pose("a", 8, [])


# What is given up.


def test_an_update_that_fails_takes_all_measurements_of_its_pose_along() -> None:
    window = SlidingWindow(WindowConfig(size=9))
    go_on(window, 0, 5)
    place = PositionPrior(position_world=power(5)[:3, 3], covariance=np.eye(3))
    with failing_updates(0):
        found = window.add_pose(
            5, 5 * STEP_NS, [edge(4, STEP), edge(3, power(2))], place, status=Status.OK
        )
    assert [each.reference_id for each in found.rejected] == [4, 3, None]
    assert {each.reason for each in found.rejected} == {"GTSAM gave up on the update"}
    assert found.status is Status.COASTING
    np.testing.assert_allclose(found.T_world_cam, power(5), atol=1e-6)
    counts = window.counts
    assert (counts.n_edges, counts.n_priors, counts.n_rejected) == (4, 0, 3)
    assert (counts.n_gated, counts.n_coasting, counts.n_poses) == (0, 1, 6)
    assert (counts.n_restored, counts.n_rebuilt) == (1, 0)
    assert window.edges(5) == ()
    assert [each.frame_id for each in window.graph()] == [1, 2, 3, 4]


def test_a_graph_that_is_made_anew_knows_its_poses_and_no_measurements() -> None:
    window = SlidingWindow(WindowConfig(size=9))
    go_on(window, 0, 5)
    before = {frame: window.estimate(frame) for frame in range(5)}
    with failing_updates(0, 1):
        window.add_pose(5, 5 * STEP_NS, [edge(4, STEP)])
    assert (window.counts.n_restored, window.counts.n_rebuilt) == (2, 1)
    assert window.graph() == []
    assert all(window.edges(frame) == () for frame in range(6))
    for frame, each in before.items():
        found = window.estimate(frame)
        np.testing.assert_allclose(found.T_world_cam, each.T_world_cam, atol=1e-9)
        # As told before but for what the poses have in common, which can only be less.
        assert np.all(np.diag(found.covariance) <= np.diag(each.covariance) * (1 + 1e-6))
        np.testing.assert_allclose(np.diag(found.covariance), np.diag(each.covariance), rtol=0.3)
    assert [each.frame_id for each in window.finish()] == list(range(6))


def test_the_first_pose_that_fails_is_the_origin_no_more_but_stays_where_it_is() -> None:
    window = SlidingWindow(WindowConfig(size=9))
    with failing_updates(0):
        first = window.add_pose("a", 0, [], PLACE)
    assert [each.reference_id for each in first.rejected] == [None]
    np.testing.assert_allclose(first.T_world_cam, np.eye(4), atol=1e-12)
    assert (window.counts.n_priors, window.counts.n_rejected) == (0, 1)
    assert first.status is Status.OK
    second = window.add_pose("b", STEP_NS, [edge("a", STEP)])
    np.testing.assert_allclose(second.T_world_cam, STEP, atol=1e-9)


# Relative poses.


def test_a_pose_is_known_for_sure_in_itself() -> None:
    window = SlidingWindow(WindowConfig(size=9))
    go_on(window, 0, 3)
    found = window.relative_pose(2, 2)
    assert found.reference_id == 2
    np.testing.assert_allclose(found.T_reference_frame, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(found.covariance, np.zeros((6, 6)))


def test_keyframes_are_told_oldest_first_until_they_are_released() -> None:
    window = SlidingWindow(WindowConfig(size=2))
    go_on(window, 0, 3)
    window.keep(2)
    window.keep(1)
    assert window.kept() == [1, 2]
    go_on(window, 3, 8)
    assert list(window.poses()) == [1, 2, 6, 7]
    window.release(1)
    assert window.kept() == [2]
    assert 1 in window  # until the next update
    go_on(window, 8, 9)
    assert list(window.poses()) == [2, 7, 8]
