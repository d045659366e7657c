"""Disparities of corners, and the coarse search, on images whose disparities are exact."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import StereoConfig
from gvo.frontend.stereo.disparity import (
    CornerDisparities,
    measure_corners,
    search_disparities,
)
from gvo.frontend.tracking import halve
from gvo.kernels.stereo import COARSE_ERROR_PX
from gvo.types import FloatArray, ImageArray
from tests.frontend.analytic import SHAPE, grid, image, slanted_pair

CONFIG = StereoConfig()


def measure(
    images: tuple[ImageArray, ImageArray],
    corners: FloatArray | None = None,
    *,
    row_offset_px: float = 0.0,
    config: StereoConfig = CONFIG,
) -> CornerDisparities:
    chosen = grid() if corners is None else corners
    return measure_corners(
        images,
        halved(images),
        chosen,
        config,
        max_disparity=40.0,
        row_offsets_px=np.full(len(chosen), row_offset_px),
    )


def halved(images: tuple[ImageArray, ImageArray]) -> tuple[ImageArray, ImageArray]:
    return halve(images[0]), halve(images[1])


@settings(max_examples=15)
@given(disparity=st.floats(0.0, 20.0), gain=st.floats(0.95, 1.0))
def test_they_are_right_to_hundredths_without_a_prediction(disparity: float, gain: float) -> None:
    found = measure((image(), image(-disparity, gain=gain)))
    assert found.are_reliable.mean() > 0.6
    errors = found.disparities[found.are_reliable] - disparity
    assert abs(np.median(errors)) < 0.03
    assert np.quantile(np.abs(errors), 0.8) < 0.1


@pytest.mark.parametrize("slopes", [(0.0, 0.33), (0.1, 0.0), (-0.2, 0.2), (0.25, 0.0), (0.0, -0.3)])
def test_slanted_surfaces_are_measured_with_their_slopes(slopes: tuple[float, float]) -> None:
    images, disparities = slanted_pair(20.0, slopes)
    columns, rows = grid().astype(int).T
    found = measure(images)
    chosen = found.are_reliable
    assert chosen.mean() > 0.6
    errors = (found.disparities - disparities[rows, columns])[chosen]
    assert abs(np.median(errors)) < 0.01
    assert np.quantile(np.abs(errors), 0.9) < 0.02
    slope_errors = found.slopes[chosen] - slopes
    assert np.quantile(np.abs(slope_errors), 0.9) < 0.01


def test_what_is_less_sharp_on_the_right_is_not_taken_for_slanted() -> None:
    right = np.asarray(cv2.GaussianBlur(image(-7.3), (7, 7), 0.5), dtype=np.uint8)
    found = measure((image(), right))
    chosen = found.are_reliable
    assert np.sqrt(np.mean((found.disparities[chosen] - 7.3) ** 2)) < 0.022
    assert np.sqrt(np.mean(found.slopes[chosen, 0] ** 2)) < 0.01


def test_whole_disparities_are_whole() -> None:
    config = StereoConfig(subpixel="none")
    found = measure((image(), image(-7.3)), config=config)
    np.testing.assert_array_equal(np.unique(found.disparities[found.are_reliable]), [7.0])


def test_nothing_is_measured_in_flat_images() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    found = measure((flat, flat))
    assert not found.are_reliable.any()
    assert np.isnan(found.disparities).all()
    assert np.isnan(found.row_shifts_px).all()


@pytest.mark.parametrize("shape", [(3, 3), (12, 200), (200, 12), (40, 40)])
def test_no_corners_and_small_images_are_no_fault(shape: tuple[int, int]) -> None:
    tiny = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    assert not measure((tiny, tiny), np.array([[1.0, 1.0], [2.0, 2.0]])).are_reliable.any()
    nothing = measure((tiny, tiny), np.zeros((0, 2)))
    assert nothing.disparities.shape == nothing.are_reliable.shape == (0,)


def test_patches_that_leave_an_image_are_not_measured() -> None:
    corners = np.array([(4.0, 60.0), (100.0, 4.0), (100.0, 116.0), (14.0, 60.0), (100.0, 60.0)])
    found = measure((image(), image(-10.0)), corners)
    assert np.isnan(found.disparities[:4]).all()
    assert found.disparities[4] == pytest.approx(10.0, abs=0.05)
    assert found.are_reliable.tolist() == [False] * 4 + [True]


def test_what_the_right_image_shows_twice_is_not_reliable() -> None:
    """Stripes of a period of 24 pixels: every disparity is as good 24 pixels farther away."""
    columns = np.arange(240.0)
    rng = np.random.default_rng(0)
    stripes = np.tile(128 + 50 * np.sin(2 * np.pi * columns / 24), (120, 1))
    stripes += rng.normal(0.0, 1.0, stripes.shape)
    images = stripes.astype(np.uint8), np.roll(stripes, -8, axis=1).astype(np.uint8)
    inner = grid()[(grid()[:, 0] > 60) & (grid()[:, 0] < 180)]
    assert measure(images, inner).are_reliable.mean() < 0.1
    assert measure((image(), image(-8.0)), inner).are_reliable.mean() > 0.7


def test_a_copy_is_found_behind_what_only_resembles_it() -> None:
    """The small images prefer two windows that differ, half a small pixel nearer to their own."""
    left, right = image(), image(-8.0)
    corners = grid()[grid()[:, 0] == 184.0]
    seen = right[:, 164:189].astype(float)
    speckles = np.random.default_rng(0).choice([-25.0, 25.0], size=seen.shape)
    for column in (60, 100):
        right[:, column : column + 25] = np.clip(seen + speckles, 0, 255)
    assert measure((left, right), corners).are_reliable.mean() > 0.7
    right[:, 138:163] = seen
    halves = halved((left, right))
    rough, _, rivals = search_disparities(halves, corners, 160.0)
    copied = np.abs(rivals - 34.0) < COARSE_ERROR_PX
    assert np.all(np.abs(rough - 8.0) < COARSE_ERROR_PX)
    assert copied[:, 1:].any()
    assert copied.any(axis=1).all()
    rows = np.zeros(len(corners))
    found = measure_corners(
        (left, right), halves, corners, CONFIG, max_disparity=160.0, row_offsets_px=rows
    )
    assert not found.are_reliable.any()


def test_corners_across_a_step_of_depth_are_not_reliable() -> None:
    rows = np.arange(SHAPE[0])
    corners = grid(step=3)
    found = measure((image(), image(-np.where(rows < 60, 4.0, 9.0))), corners)
    is_at_step = np.abs(corners[:, 1] - 59.5) < 4
    assert found.are_reliable[is_at_step].mean() < 0.3
    assert found.are_reliable[np.abs(corners[:, 1] - 59.5) > 10].mean() > 0.6


@pytest.mark.parametrize("shift", [-1.2, -0.4, 0.0, 0.3, 1.0])
def test_rows_that_differ_are_measured_and_taken_off(shift: float) -> None:
    images, known = (image(), image(-7.3, shift)), 0.0
    for _ in range(3):
        known += float(np.nanmedian(measure(images, row_offset_px=known).row_shifts_px))
    assert known == pytest.approx(shift, abs=0.03)


def pair(disparity: FloatArray | float) -> tuple[ImageArray, ImageArray]:
    return image(), image(-disparity)


@settings(max_examples=10)
@given(disparity=st.floats(0.0, 60.0))
def test_the_coarse_search_finds_any_disparity_to_a_few_pixels(disparity: float) -> None:
    pixels = grid(border=12)
    pixels = pixels[pixels[:, 0] > disparity + 14]
    found, is_found, _ = search_disparities(halved(pair(disparity)), pixels, 70.0)
    assert is_found.mean() > 0.9
    is_near = np.abs(found - disparity) <= COARSE_ERROR_PX
    assert is_near[is_found].mean() > 0.9


def test_the_coarse_search_does_not_leave_the_image() -> None:
    found, _, _ = search_disparities(halved(pair(20.0)), grid(border=0), 1000.0)
    assert np.all(found <= grid(border=0)[:, 0] + COARSE_ERROR_PX)
    assert np.all(found >= 0)


def test_flat_images_hold_no_disparities() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    _, is_found, _ = search_disparities(halved((flat, flat)), grid(), 50.0)
    assert not is_found.any()


@pytest.mark.parametrize("shape", [(3, 3), (8, 200), (200, 8)])
def test_images_smaller_than_a_patch_give_nothing(shape: tuple[int, int]) -> None:
    tiny = np.zeros(shape, dtype=np.uint8)
    assert not search_disparities(halved((tiny, tiny)), np.array([[1.0, 1.0]]), 50.0)[1].any()


def test_no_pixels_give_no_disparities() -> None:
    found, is_found, _ = search_disparities(halved(pair(3.0)), np.zeros((0, 2)), 50.0)
    assert found.shape == is_found.shape == (0,)
