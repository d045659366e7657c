"""Decimation for display, held to what must stay visible."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz.report.sheets import display_path, kept_of_curve, kept_of_dots, simplified


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 3000))
def test_each_column_keeps_its_least_and_largest_value(seed: int, n_columns: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.exponential(size=n)), rng.standard_cauchy(size=n)
    kept = kept_of_curve(x, y, n_columns=n_columns)
    assert len(kept) <= 5 * n_columns
    assert np.all(np.diff(kept) > 0)
    assert {0, n - 1} <= {*kept.tolist()}
    edges = np.linspace(x[0], x[-1], n_columns + 1)
    edges[0], edges[-1] = -np.inf, np.inf
    for low, high in itertools.pairwise(edges):
        inside, shown = (x >= low) & (x < high), (x[kept] >= low) & (x[kept] < high)
        if np.any(inside) and n > 5 * n_columns:
            assert y[inside].min() == y[kept][shown].min()
            assert y[inside].max() == y[kept][shown].max()


def test_an_outlier_of_one_frame_and_a_gap_stay_visible() -> None:
    y = np.zeros(100_000)
    y[[12_345, 77_777]] = 1.0, -1.0
    y[50_000] = np.nan
    kept = kept_of_curve(np.arange(100_000.0), y)
    assert len(kept) <= 5000
    assert {12_345, 50_000, 77_777} <= {*kept.tolist()}


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1.0))
def test_no_point_lies_off_a_simplified_line(seed: int, tolerance: float) -> None:
    points = np.cumsum(np.random.default_rng(seed).normal(size=(60, 3)), axis=0)
    kept = simplified(points, tolerance)
    assert (kept[0], kept[-1]) == (0, 59)
    for start, end in itertools.pairwise(kept):
        # the truth by brute force: the nearest of many points of the segment
        line = np.linspace(points[start], points[end], 400)
        for point in points[start : end + 1]:
            nearest = np.linalg.norm(line - point, axis=1).min()
            assert nearest <= tolerance + np.linalg.norm(line[1] - line[0])


def test_a_straight_line_needs_its_ends_only() -> None:
    assert [*simplified(np.linspace([0.0, 0, 0], [5.0, 1, 2], 1000), 1e-9)] == [0, 999]
    assert len(simplified(np.empty((0, 3)), 1.0)) == 0


def path_of(positions: FloatArray, stamps_ns: FloatArray) -> Trajectory:
    T = se3.make_transform(np.tile(np.eye(3), (len(positions), 1, 1)), positions)
    return Trajectory(stamps_ns=stamps_ns.astype(np.int64), T_world_frame=T)


def test_long_noisy_paths_become_short_ones_that_keep_outliers_and_gaps() -> None:
    positions = np.random.default_rng(0).normal(size=(100_000, 3))
    positions[40_000] = 100.0, 0.0, 0.0
    stamps_ns = np.arange(100_000.0)
    stamps_ns[60_000:] += 1000.0
    points = display_path(path_of(positions, stamps_ns))
    assert len(points) < 6000
    assert np.count_nonzero(np.isnan(points[:, 0])) == 1
    assert np.any(np.all(points == positions[40_000], axis=1))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_short_paths_are_kept_whole(n: int) -> None:
    positions = np.arange(3.0 * n).reshape(n, 3)
    np.testing.assert_array_equal(
        display_path(path_of(positions, np.arange(float(n)) * 1e9)), positions
    )


@given(st.integers(0, 2**32 - 1))
def test_each_dot_lies_near_one_that_is_drawn(seed: int) -> None:
    x, y = np.random.default_rng(seed).normal(size=(2, 500))
    kept = kept_of_dots(x, y, n_columns=20, n_rows=10)
    assert len(kept) <= 21 * 11
    near_x = np.abs(x[:, np.newaxis] - x[kept]) <= np.ptp(x) / 20 + 1e-12
    near_y = np.abs(y[:, np.newaxis] - y[kept]) <= np.ptp(y) / 10 + 1e-12
    assert np.all(np.any(near_x & near_y, axis=1))


def test_a_climb_seen_from_above_keeps_its_bends() -> None:
    heights = np.linspace(0.0, 100.0, 400)
    positions = np.stack([np.sin(heights / 5.0), np.cos(heights / 7.0), heights], axis=1)
    shown = display_path(path_of(positions, np.arange(400.0) * 1e8))
    for axis in (0, 1):
        drawn = np.interp(heights, shown[:, 2], shown[:, axis])
        np.testing.assert_allclose(drawn, positions[:, axis], atol=2.0 / 500)
