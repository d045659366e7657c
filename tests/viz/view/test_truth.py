"""The truth is laid into the world of an estimate that grows."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from gvo.viz.view.page import TruthPath

STEP_NS = 100_000_000
N = 20
STAMPS_NS: IntArray = STEP_NS * np.arange(N, dtype=np.int64)
TWISTS = arrays(np.float64, 6, elements=st.floats(-2.0, 2.0))


def spiral() -> FloatArray:
    steps = np.array([0.02, 0.15, 0.0, 0.05, 0.01, 0.4]) * np.arange(float(N))[:, np.newaxis]
    return np.asarray(se3.exp(steps))


def truth_at(T: FloatArray, stamps_ns: IntArray = STAMPS_NS) -> Trajectory:
    return Trajectory(stamps_ns=stamps_ns, T_world_cam=T @ spiral())


def drawn(path: TruthPath, rows: Sequence[int] | slice = slice(None)) -> FloatArray:
    return path.until(STAMPS_NS[rows], spiral()[rows][:, :3, 3])


@given(TWISTS)
@settings(max_examples=20)
def test_the_pose_of_the_first_frame_lays_the_truth(twist: FloatArray) -> None:
    path = TruthPath(truth_at(se3.exp(twist)))
    np.testing.assert_allclose(drawn(path), spiral()[:, :3, 3], atol=1e-9)


@given(TWISTS)
@settings(max_examples=20)
def test_positions_alone_are_fitted(twist: FloatArray) -> None:
    moved = truth_at(se3.exp(twist))
    path = TruthPath(Trajectory.of_positions(moved.stamps_ns, moved.positions))
    np.testing.assert_allclose(drawn(path), spiral()[:, :3, 3], atol=1e-6)


def test_a_drift_shows_where_the_first_pose_is_known_and_is_shared_out_where_not() -> None:
    estimate = spiral()[:, :3, 3] * 1.2
    truth = truth_at(np.eye(4))
    laid = TruthPath(truth).until(STAMPS_NS, estimate)
    fitted = TruthPath(Trajectory.of_positions(STAMPS_NS, truth.positions)).until(
        STAMPS_NS, estimate
    )
    errors = [np.linalg.norm(estimate - positions, axis=1) for positions in (laid, fitted)]
    assert errors[0][0] < 1e-9
    assert errors[0][-1] > errors[1][-1]
    assert errors[1][0] > 1e-3


@pytest.mark.parametrize("n", [1, 5, N])
def test_it_is_drawn_as_far_as_the_estimate_has_come(n: int) -> None:
    path = TruthPath(truth_at(np.eye(4)))
    np.testing.assert_allclose(drawn(path, slice(0, n)), spiral()[:n, :3, 3], atol=1e-9)


def test_another_first_frame_is_another_world() -> None:
    path = TruthPath(truth_at(np.eye(4)))
    assert len(drawn(path)) == N
    later = path.until(STAMPS_NS[3:], spiral()[3:, :3, 3])
    expected = (se3.invert(spiral()[3]) @ spiral()[3:])[:, :3, 3]
    np.testing.assert_allclose(later, expected, atol=1e-9)


def test_a_truth_that_begins_later_is_fitted() -> None:
    T = se3.exp(np.array([0.1, -0.4, 0.2, 3.0, 1.0, -2.0]))
    truth = truth_at(T).select(slice(4, None))
    np.testing.assert_allclose(drawn(TruthPath(truth)), spiral()[4:, :3, 3], atol=1e-6)


def test_nothing_is_drawn_where_nothing_is_known() -> None:
    path = TruthPath(truth_at(np.eye(4)))
    assert path.until(STAMPS_NS[:0], np.zeros((0, 3))).shape == (0, 3)
    elsewhere = Trajectory.of_positions(STAMPS_NS + 10**15, spiral()[:, :3, 3])
    assert drawn(TruthPath(elsewhere)).shape == (0, 3)
