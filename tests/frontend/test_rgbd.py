"""Depth at keypoints against a plain look at every window; depths that contradict a motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import DepthConfig
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.rgbd import (
    check_depths,
    compare_depths,
    grid_points,
    is_seen_again,
    sample_depth,
)
from gvo.geometry import se3
from gvo.io.synthetic import SyntheticRecording
from gvo.types import Contradiction, DepthArray, FloatArray, RelativePose

seeds = st.integers(min_value=0, max_value=2**32 - 1)
SETTINGS = DepthConfig(min_depth_m=0.5, max_depth_m=6.0, max_edge_step=0.1, edge_radius_px=2)
RECORDING = SyntheticRecording("handheld", "rgbd", n_frames=31, scale=1.0)
IMAGES = list(RECORDING.images())
T_WORLD_CAM = RECORDING.ground_truth().T_world_frame
CONFIG = DepthConfig()
CAMERA = as_stereo(RECORDING.info.camera)


def flat(value: float = 2.0) -> DepthArray:
    return np.full((20, 30), value, dtype=np.float32)


def sample(depth: DepthArray, *keypoints: tuple[float, float]) -> tuple[FloatArray, list[bool]]:
    depths, is_valid = sample_depth(depth, np.array(keypoints, dtype=float), SETTINGS)
    return depths, is_valid.tolist()


def inverse_plane(coefficients: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (coefficients[0] + coefficients[1] * u + coefficients[2] * v))


def tilted(seed: int) -> tuple[DepthArray, FloatArray]:
    """Return the depth of a plane in space, and the coefficients of its inverse depth."""
    rng = np.random.default_rng(seed)
    coefficients = np.array([rng.uniform(0.3, 1.5), *rng.uniform(-0.003, 0.003, 2)])
    v, u = np.mgrid[:20, :30].astype(float)
    return inverse_plane(coefficients, u, v).astype(np.float32), coefficients


@settings(max_examples=40)
@given(seed=seeds)
def test_the_depth_of_a_plane_is_exact_between_pixels_and_beside_holes(seed: int) -> None:
    depth, coefficients = tilted(seed)
    rng = np.random.default_rng(seed)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    keypoints = rng.uniform([2.0, 2.0], [27.0, 17.0], size=(40, 2))
    depths, is_valid = sample_depth(depth, keypoints, SETTINGS)
    windows = [depth[v - 2 : v + 3, u - 2 : u + 3] for u, v in np.rint(keypoints).astype(int)]
    is_fitted = is_valid & [np.count_nonzero(~np.isnan(window)) > 12 for window in windows]
    spreads = [[np.nanmin(window), np.nanmax(window)] for window in windows]
    expected = np.clip(inverse_plane(coefficients, *keypoints.T), *np.transpose(spreads))
    assert is_fitted.any()
    np.testing.assert_allclose(depths[is_fitted], expected[is_fitted], rtol=1e-6)


@settings(max_examples=40)
@given(seed=seeds)
def test_noisy_depth_is_that_of_the_least_squares_plane(seed: int) -> None:
    depth, _ = tilted(seed)
    rng = np.random.default_rng(seed)
    depth *= (1.0 + 0.005 * rng.standard_normal(depth.shape)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    keypoints = rng.uniform([0.0, 0.0], [29.0, 19.0], size=(20, 2))
    depths, is_valid = sample_depth(depth, keypoints, SETTINGS)
    for keypoint, value in zip(keypoints[is_valid], depths[is_valid], strict=True):
        column, row = np.rint(keypoint).astype(int)
        rows, columns = np.mgrid[row - 2 : row + 3, column - 2 : column + 3].reshape(2, -1)
        is_inside = (rows >= 0) & (rows < 20) & (columns >= 0) & (columns < 30)
        rows, columns = rows[is_inside], columns[is_inside]
        known = np.flatnonzero(~np.isnan(depth[rows, columns]))
        samples = depth[rows, columns][known].astype(float)
        if len(known) <= 12:  # half of the window
            assert value == depth[row, column]
            continue
        design = np.column_stack([np.ones(len(known)), columns[known], rows[known]])
        solution, *_ = np.linalg.lstsq(design, 1.0 / samples)
        expected = np.clip(inverse_plane(solution, *keypoint), samples.min(), samples.max())
        np.testing.assert_allclose(value, expected, rtol=1e-9)


def test_the_noise_of_the_pixels_around_is_averaged() -> None:
    rng = np.random.default_rng(1)
    clean = 1.0 / np.linspace(0.5, 0.55, 300)[np.newaxis] * np.ones((200, 1))
    noisy = (1.0 / (1.0 / clean + 0.001 * rng.standard_normal(clean.shape))).astype(np.float32)
    keypoints = rng.integers([5, 5], [295, 195], size=(500, 2)).astype(float)
    depths, is_valid = sample_depth(noisy, keypoints, SETTINGS)
    assert is_valid.all()
    truth = clean[0, keypoints[:, 0].astype(int)]
    # By 25 equal pixels, a fifth of 0.001.
    assert np.std(1.0 / depths - 1.0 / truth) < 0.25 * 0.001


def test_depth_is_that_of_the_nearest_pixel_where_most_around_is_unknown() -> None:
    depth, _ = tilted(0)
    depth[:9] = np.nan
    depth[10:] = np.nan
    depths, is_valid = sample(depth, (10.0, 9.0), (10.4, 9.4), (9.6, 8.6))
    assert is_valid == [True] * 3
    np.testing.assert_array_equal(depths, depth[9, 10])


def test_a_plane_beside_a_hole_does_not_leave_what_was_seen() -> None:
    depth = np.full((20, 30), np.nan, dtype=np.float32)
    depth[:, :16] = 1.0 / np.linspace(1.0, 0.25, 16)
    config = SETTINGS.model_copy(update={"max_edge_step": 10.0})
    depths, is_valid = sample_depth(depth, np.array([[15.49, 10.0], [14.5, 10.0]]), config)
    assert is_valid.all()
    np.testing.assert_allclose(depths, [4.0, 1.0 / 0.275], rtol=1e-6)


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


@settings(max_examples=40)
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
            assert known.min() <= value <= known.max()


def depth(index: int) -> DepthArray:
    return IMAGES[2 * index + 1].load()


def compared(reference: DepthArray, current: DepthArray) -> tuple[FloatArray, DepthArray]:
    return grid_points(reference, CAMERA, CONFIG), current


def moved(last: int) -> FloatArray:
    return np.asarray(se3.invert(T_WORLD_CAM[0]) @ T_WORLD_CAM[last])


def result_of(T_reference_current: FloatArray) -> RelativePose:
    return RelativePose(
        T_reference_current=T_reference_current,
        covariance=1e-6 * np.eye(6),
        matches=np.zeros((50, 2), dtype=np.int64),
        inliers=np.ones(50, dtype=np.bool_),
    )


@pytest.mark.parametrize("last", [1, 10, 30])
def test_the_true_motion_passes(last: int) -> None:
    depths = depth(0), depth(last)
    result = result_of(moved(last))
    assert check_depths(result, *compared(*depths), CAMERA, CONFIG) is result
    differences = compare_depths(*compared(*depths), moved(last), CAMERA, CONFIG)
    assert np.mean(differences < -3.0) < 0.1


@pytest.mark.parametrize("metres", [1.0, 1.3])
def test_a_motion_through_free_space_is_refused_with_its_numbers(metres: float) -> None:
    wrong = moved(1) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, metres]))
    refused = check_depths(result_of(wrong), *compared(depth(0), depth(1)), CAMERA, CONFIG)
    assert isinstance(refused, Contradiction)
    assert "free space" in refused.reason
    assert refused.n_matches == 50


def test_what_is_hidden_now_does_not_count() -> None:
    near = np.full_like(depth(1), 0.5)
    result = result_of(moved(1))
    assert check_depths(result, *compared(depth(0), near), CAMERA, CONFIG) is result


def test_without_depth_nothing_is_refused_and_nothing_seen_again() -> None:
    unknown = np.full_like(depth(1), np.nan)
    result = result_of(np.eye(4))
    for depths in ((unknown, depth(1)), (depth(0), unknown)):
        assert check_depths(result, *compared(*depths), CAMERA, CONFIG) is result
        assert not is_seen_again(result, *compared(*depths), CAMERA, CONFIG)


def boxes() -> DepthArray:
    """Return the depth of boxes before a wall, which no step aside shows again."""
    depth = np.full((480, 640), 3.0, dtype=np.float32)
    corners = np.random.default_rng(3).integers([0, 0], [400, 560], size=(12, 2))
    for number, (v, u) in enumerate(corners):
        depth[v : v + 110, u : u + 110] = 1.2 + 0.12 * number
    return depth


@pytest.mark.parametrize(
    ("metres", "turn", "is_seen"),
    [(0.0, 0.0, True), (0.02, 0.01, True), (0.4, 0, False), (0, 0.3, False)],
)
def test_a_place_is_seen_again_from_where_it_was(metres: float, turn: float, is_seen: bool) -> None:
    T = se3.exp(np.array([0.0, turn, 0.0, metres, 0.0, 0.0]))
    points = grid_points(boxes(), CAMERA, CONFIG)
    # The camera has not moved; by the result it has.
    assert is_seen_again(result_of(T), points, boxes(), CAMERA, CONFIG) is is_seen


def test_a_wall_is_no_place() -> None:
    wall = np.full((480, 640), 2.0, dtype=np.float32)
    assert not is_seen_again(result_of(np.eye(4)), *compared(wall, wall), CAMERA, CONFIG)
