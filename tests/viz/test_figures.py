"""What figures share: gaps, lone points, labels, thinned paths."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.figures import broken, gaps_before
from gvo.viz.report.paths import lines_of


@given(st.integers(2, 50), st.integers(1, 49))
def test_a_line_is_broken_where_a_step_is_long(n: int, at: int) -> None:
    at = min(at, n - 1)
    seconds = np.arange(float(n))
    seconds[at:] += 1000.0
    points = broken(seconds, np.column_stack([seconds, seconds]))
    if n > 3:  # of fewer poses, the long step is among the usual ones
        assert gaps_before(seconds).tolist() == [at]
        assert np.flatnonzero(np.isnan(points[:, 0])).tolist() == [at]


@pytest.mark.parametrize(("n", "n_gaps"), [(0, 0), (1, 0), (2, 0), (100_000, 1)])
def test_long_paths_become_short_ones_that_keep_their_gaps(n: int, n_gaps: int) -> None:
    positions = np.arange(3.0 * n).reshape(n, 3)
    stamps_ns = np.arange(n, dtype=np.int64) * 1_000_000_000
    stamps_ns[60_000:] += 1_000_000_000_000
    T = se3.make_transform(np.tile(np.eye(3), (n, 1, 1)), positions)
    (line,) = lines_of(None, {"raw": Trajectory(stamps_ns=stamps_ns, T_world_frame=T)})
    assert len(line.points) <= 6000
    assert np.count_nonzero(np.isnan(line.points[:, 0])) == n_gaps
    if n:
        np.testing.assert_array_equal(line.points[[0, -1]], positions[[0, -1]])
