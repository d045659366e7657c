"""Corners of drawn squares and of textures."""

import numpy as np
import pytest

from gvo.config import KltConfig
from gvo.frontend.tracking import detect_corners
from gvo.types import ImageArray
from tests.frontend.analytic import SHAPE, image


def squares() -> tuple[ImageArray, set[tuple[int, int]]]:
    """Return squares of twenty pixels and their corners."""
    picture = np.full((160, 240), 60, dtype=np.uint8)
    corners = set()
    for row in (30, 90):
        for column in (30, 90, 150):
            picture[row : row + 20, column : column + 20] = 180
            corners |= {(column + du, row + dv) for du in (0, 19) for dv in (0, 19)}
    return picture, corners


def test_the_corners_of_squares_are_found_and_no_others() -> None:
    picture, corners = squares()
    found = detect_corners(picture, KltConfig(min_distance_px=6, n_corners=500))
    assert len(found) >= len(corners)
    for u, v in found:
        assert min(max(abs(u - a), abs(v - b)) for a, b in corners) <= 1
    for a, b in corners:
        assert np.abs(found - [a, b]).max(axis=1).min() <= 1


def test_corners_are_whole_pixels_with_room_for_the_window() -> None:
    config = KltConfig(window_radius_px=9)
    found = detect_corners(image(), config)
    assert len(found) > 20
    np.testing.assert_array_equal(found, np.rint(found))
    limits = np.array([SHAPE[1], SHAPE[0]]) - 1 - 9
    assert np.all(found >= 9)
    assert np.all(found <= limits)


def test_each_small_cell_gives_one_corner() -> None:
    for size in (8, 20):
        cells = detect_corners(image(), KltConfig(min_distance_px=size)) // size
        assert len(np.unique(cells, axis=0)) == len(cells)


def test_the_budget_is_kept_and_spread() -> None:
    everything = detect_corners(image(), KltConfig(n_corners=5000, min_distance_px=6))
    config = KltConfig(n_corners=50, min_distance_px=6, cell_size_px=40)
    found = detect_corners(image(), config)
    assert len(everything) > 100
    assert len(found) == 50
    assert {tuple(corner) for corner in found} <= {tuple(corner) for corner in everything}
    large = {tuple(cell) for cell in found // 40}
    assert large == {tuple(cell) for cell in everything // 40}


@pytest.mark.parametrize("shape", [(4, 4), (12, 300), (300, 12)])
def test_images_without_room_have_no_corners(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    assert detect_corners(noise, KltConfig(window_radius_px=5)).shape == (0, 2)


def test_a_flat_image_has_no_corners() -> None:
    assert detect_corners(np.full(SHAPE, 77, dtype=np.uint8), KltConfig()).shape == (0, 2)
