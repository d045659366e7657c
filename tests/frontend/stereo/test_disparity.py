"""Disparities of pixels, on images whose disparities are exact."""

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import StereoConfig
from gvo.frontend.stereo import disparity as stereo
from gvo.types import BoolArray, FloatArray, ImageArray
from tests.frontend.analytic import MIDDLE, SHAPE, grid, image, slanted_pair

CONFIG = StereoConfig()
FACING = np.zeros((len(grid()), 2))
STEPS: dict[str, Any] = {"n_steps": 3, "slopes": FACING}


def measure_disparities(
    images: tuple[ImageArray, ImageArray], pixels: FloatArray, *given: Any
) -> tuple[FloatArray, BoolArray]:
    """Measure where rows of both images are alike."""
    rows = np.zeros(len(pixels))
    return stereo.measure_disparities(images, pixels, *given, row_offsets_px=rows)


def follow_disparities(
    images: tuple[ImageArray, ImageArray], pixels: FloatArray, *given: Any, **options: Any
) -> tuple[FloatArray, BoolArray]:
    """Follow where rows of both images are alike."""
    rows = np.zeros(len(pixels))
    return stereo.follow_disparities(images, pixels, *given, row_offsets_px=rows, **options)


def pair(disparity: FloatArray | float, **right: float) -> tuple[ImageArray, ImageArray]:
    return image(), image(-disparity, **right)


def test_flat_images_hold_no_disparities() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    _, is_valid = measure_disparities((flat, flat), grid(), np.full(len(grid()), 5.0), CONFIG)
    assert not is_valid.any()


@settings(max_examples=15)
@given(disparity=st.floats(0.0, 20.0), error=st.floats(-2.0, 2.0), fraction=st.floats(0.0, 1.0))
def test_the_fine_search_is_right_to_hundredths_wherever_it_starts(
    disparity: float, error: float, fraction: float
) -> None:
    pixels = grid() + fraction
    predicted = np.full(len(pixels), disparity + error)
    found, is_valid = measure_disparities(pair(disparity), pixels, predicted, CONFIG)
    assert is_valid.mean() > 0.9
    errors = found[is_valid] - disparity
    # OpenCV 4 rounds where it interpolates to a 32nd of a pixel.
    assert abs(np.median(errors)) < (0.03 if cv2.__version__.startswith("4.") else 0.02)
    assert np.quantile(np.abs(errors), 0.9) < 0.06


def test_unequal_exposure_does_not_shift_disparities() -> None:
    predicted = np.full(len(grid()), 7.0)
    found, is_valid = measure_disparities(pair(7.3, gain=0.9), grid(), predicted, CONFIG)
    assert abs(np.median(found[is_valid]) - 7.3) < 0.02


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
def test_the_disparity_is_that_of_the_very_pixel(fraction: float) -> None:
    # On a road the disparity grows with the row: between rows it lies between theirs.
    rows = np.arange(SHAPE[0]).astype(float)
    pixels = grid() + np.array([0.0, fraction])
    expected = 2.0 + 0.2 * pixels[:, 1]
    found, is_valid = measure_disparities(pair(2.0 + 0.2 * rows), pixels, np.rint(expected), CONFIG)
    assert is_valid.mean() > 0.8
    assert abs(np.median((found - expected)[is_valid])) < 0.04  # half a row is 0.1


def test_a_best_step_at_the_end_of_the_search_is_no_answer() -> None:
    predicted = np.full(len(grid()), 2.0)
    _, is_valid = measure_disparities(pair(12.0), grid(), predicted, CONFIG)
    assert is_valid.mean() < 0.5
    _, is_valid = measure_disparities(pair(12.0), grid(), predicted + 9.0, CONFIG)
    assert is_valid.mean() > 0.9


@pytest.mark.parametrize(
    "pixel", [(4.0, 60.0), (235.5, 60.0), (100.0, 4.9), (100.0, 114.5), (14.0, 60.0)]
)
def test_patches_that_leave_an_image_are_not_measured(pixel: tuple[float, float]) -> None:
    pixels, predicted = np.array([pixel, (100.0, 60.0)]), np.full(2, 10.0)
    found, is_valid = measure_disparities(pair(10.0), pixels, predicted, CONFIG)
    assert is_valid.tolist() == [False, True]
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(10.0, abs=0.05)


@pytest.mark.parametrize("shape", [(3, 3), (8, 200), (200, 8)])
def test_images_smaller_than_a_patch_give_nothing(shape: tuple[int, int]) -> None:
    tiny = np.zeros(shape, dtype=np.uint8)
    pixels = np.array([[1.0, 1.0]])
    assert not measure_disparities((tiny, tiny), pixels, np.ones(1), CONFIG)[1].any()


def test_no_pixels_give_no_disparities() -> None:
    nothing = np.zeros((0, 2))
    assert measure_disparities(pair(3.0), nothing, np.zeros(0), CONFIG)[0].shape == (0,)


@settings(max_examples=15)
@given(disparity=st.floats(0.0, 20.0), error=st.floats(-1.5, 1.5), fraction=st.floats(0.0, 1.0))
def test_predicted_steps_lead_to_the_same(disparity: float, error: float, fraction: float) -> None:
    pixels = grid() + fraction
    predicted = np.full(len(pixels), disparity + error)
    found, is_valid = follow_disparities(
        pair(disparity, gain=0.95), pixels, predicted, CONFIG, n_steps=4, slopes=FACING
    )
    assert is_valid.mean() > 0.75
    errors = found[is_valid] - disparity
    assert abs(np.median(errors)) < 0.03
    assert np.quantile(np.abs(errors), 0.8) < 0.1


@pytest.mark.parametrize("slopes", [(0.0, 0.33), (0.25, 0.0), (-0.2, 0.2)])
def test_slanted_surfaces_are_right_with_slopes_wrong_without(slopes: tuple[float, float]) -> None:
    images, _ = slanted_pair(20.0, slopes)
    # At fractions of a pixel, as tracks are.
    pixels = grid() + np.array([0.37, 0.61])
    expected = 20.0 + (pixels - MIDDLE) @ slopes
    all_slopes = np.tile(slopes, (len(pixels), 1))
    found, is_valid = follow_disparities(
        images, pixels, expected + 0.3, CONFIG, n_steps=4, slopes=all_slopes
    )
    facing, _ = follow_disparities(images, pixels, expected + 0.3, CONFIG, n_steps=4, slopes=FACING)
    assert is_valid.mean() > 0.8
    errors, facing_errors = (each[is_valid] - expected[is_valid] for each in (found, facing))
    # OpenCV 4 interpolates at 32nds of a pixel.
    assert abs(np.median(errors)) < 0.015
    assert np.sqrt(np.mean(errors**2)) < 0.02
    assert np.sqrt(np.mean(facing_errors**2)) > 0.2


def test_steps_that_do_not_come_to_rest_are_no_answer() -> None:
    predicted = np.full(len(grid()), 2.0)
    _, is_valid = follow_disparities(
        pair(12.0), grid(), predicted, CONFIG, n_steps=3, slopes=FACING
    )
    assert is_valid.mean() < 0.3
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    found, is_valid = follow_disparities(
        (flat, flat), grid(), predicted, CONFIG, n_steps=3, slopes=FACING
    )
    np.testing.assert_array_equal(found, predicted)  # nothing moves it


def test_whole_disparities_are_found_from_a_prediction_too() -> None:
    config = StereoConfig(subpixel="none")
    predicted = np.full(len(grid()), 6.0)
    found, is_valid = follow_disparities(
        pair(7.3), grid(), predicted, config, n_steps=3, slopes=FACING
    )
    np.testing.assert_array_equal(np.unique(found[is_valid]), [7.0])
