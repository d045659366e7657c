"""Depth at keypoints against a plain look at every window."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import DepthConfig
from gvo.frontend.rgbd import sample_depth
from gvo.types import DepthArray, FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)
SETTINGS = DepthConfig(min_depth_m=0.5, max_depth_m=6.0, max_edge_step=0.1, edge_radius_px=2)


def flat(value: float = 2.0) -> DepthArray:
    return np.full((20, 30), value, dtype=np.float32)


def sample(depth: DepthArray, *keypoints: tuple[float, float]) -> tuple[FloatArray, list[bool]]:
    depths, is_valid = sample_depth(depth, np.array(keypoints, dtype=float), SETTINGS)
    return depths, is_valid.tolist()


def test_depth_is_read_at_the_nearest_pixel() -> None:
    depth = 2.0 + 1e-4 * np.arange(600, dtype=np.float32).reshape(20, 30)
    depths, is_valid = sample(depth, (10.0, 5.0), (10.4, 5.4), (9.6, 4.6))
    assert is_valid == [True] * 3
    np.testing.assert_allclose(depths, depth[5, 10])


@pytest.mark.parametrize("value", [np.nan, 0.0, 0.49, 6.01, np.inf, -1.0])
def test_unknown_depth_and_depth_out_of_range_is_refused(value: float) -> None:
    assert sample(flat(value), (10.0, 5.0))[1] == [False]


@pytest.mark.parametrize("value", [0.5, 6.0])
def test_the_limits_of_the_range_are_valid(value: float) -> None:
    assert sample(flat(value), (10.0, 5.0))[1] == [True]


def test_a_break_of_depth_within_the_radius_is_refused() -> None:
    depth = flat()
    depth[:, 15:] = 2.3
    columns = [11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0]
    is_valid = sample(depth, *[(column, 10.0) for column in columns])[1]
    assert is_valid == [True, True, False, False, False, False, True, True]


def test_a_slope_within_the_step_is_accepted() -> None:
    depth = flat() + np.float32(0.04) * np.arange(30, dtype=np.float32)
    # Four columns of 4 cm across the window, a tenth of 2 m allowed.
    assert sample(depth, (10.0, 10.0))[1] == [True]
    depth = flat() + np.float32(0.06) * np.arange(30, dtype=np.float32)
    assert sample(depth, (10.0, 10.0))[1] == [True]
    assert sample(depth, (2.0, 10.0))[1] == [False]


def test_unknown_neighbours_do_not_matter() -> None:
    depth = flat()
    depth[9:12, 8:10] = np.nan
    assert sample(depth, (10.0, 10.0), (9.0, 10.0))[1] == [True, False]


def test_borders_are_read_and_pixels_beyond_are_refused() -> None:
    corners = [(0.0, 0.0), (29.0, 0.0), (0.0, 19.0), (29.0, 19.0)]
    assert sample(flat(), *corners)[1] == [True] * 4
    outside = [(-1.0, 5.0), (5.0, -1.0), (30.0, 5.0), (5.0, 20.0), (1e6, 1e6)]
    assert sample(flat(), *outside)[1] == [False] * 5


def test_no_keypoints_give_nothing() -> None:
    depths, is_valid = sample_depth(flat(), np.zeros((0, 2)), SETTINGS)
    assert depths.shape == is_valid.shape == (0,)


def test_a_radius_of_zero_looks_at_the_pixel_alone() -> None:
    depth = np.where(np.indices((20, 30)).sum(axis=0) % 2, 1.0, 5.0).astype(np.float32)
    config = SETTINGS.model_copy(update={"edge_radius_px": 0})
    assert sample_depth(depth, np.array([[10.0, 5.0]]), config)[1].all()
    assert not sample_depth(depth, np.array([[10.0, 5.0]]), SETTINGS)[1].any()


@settings(deadline=None, max_examples=40)
@given(seed=seeds, radius=st.integers(0, 3))
def test_what_is_valid_is_what_a_plain_loop_finds(seed: int, radius: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 7.0) * (1.0 + 0.03 * rng.random((12, 15)))
    depth[rng.random((12, 15)) < 0.2] = np.nan
    depth[rng.random((12, 15)) < 0.02] = 0.1
    keypoints = rng.uniform([-3, -3], [18, 15], size=(60, 2))
    config = SETTINGS.model_copy(update={"max_edge_step": 0.025, "edge_radius_px": radius})
    depths, is_valid = sample_depth(depth.astype(np.float32), keypoints, config)
    for (u, v), value, valid in zip(keypoints, depths, is_valid, strict=True):
        column, row = round(u), round(v)
        expected = False
        if 0 <= column < 15 and 0 <= row < 12:
            centre = np.float32(depth[row, column])
            window = depth.astype(np.float32)[
                max(row - radius, 0) : row + radius + 1,
                max(column - radius, 0) : column + radius + 1,
            ]
            known = window[~np.isnan(window)]
            expected = bool(
                not np.isnan(centre)
                and 0.5 <= centre <= 6.0
                and known.max() - known.min() <= 0.025 * float(centre)
            )
        assert valid == expected
        if valid:
            assert value == np.float32(depth[row, column])
