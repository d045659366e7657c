"""The coarse search for disparities, on images whose disparities are exact."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.frontend.stereo.corners import COARSE_ERROR_PX, search_disparities
from gvo.types import FloatArray, ImageArray
from tests.frontend.analytic import SHAPE, grid, image


def pair(disparity: FloatArray | float) -> tuple[ImageArray, ImageArray]:
    return image(), image(-disparity)


@settings(deadline=None, max_examples=10)
@given(disparity=st.floats(0.0, 60.0))
def test_the_coarse_search_finds_any_disparity_to_a_few_pixels(disparity: float) -> None:
    pixels = grid(border=12)
    pixels = pixels[pixels[:, 0] > disparity + 14]
    found, is_found, _ = search_disparities(pair(disparity), pixels, 70.0)
    assert is_found.mean() > 0.9
    is_near = np.abs(found - disparity) <= COARSE_ERROR_PX
    assert is_near[is_found].mean() > 0.9


def test_the_coarse_search_does_not_leave_the_image() -> None:
    found, _, _ = search_disparities(pair(20.0), grid(border=0), 1000.0)
    assert np.all(found <= grid(border=0)[:, 0] + COARSE_ERROR_PX)
    assert np.all(found >= 0)


def test_flat_images_hold_no_disparities() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    _, is_found, _ = search_disparities((flat, flat), grid(), 50.0)
    assert not is_found.any()


@pytest.mark.parametrize("shape", [(3, 3), (8, 200), (200, 8)])
def test_images_smaller_than_a_patch_give_nothing(shape: tuple[int, int]) -> None:
    tiny = np.zeros(shape, dtype=np.uint8)
    assert not search_disparities((tiny, tiny), np.array([[1.0, 1.0]]), 50.0)[1].any()


def test_no_pixels_give_no_disparities() -> None:
    found, is_found, _ = search_disparities(pair(3.0), np.zeros((0, 2)), 50.0)
    assert found.shape == is_found.shape == (0,)
