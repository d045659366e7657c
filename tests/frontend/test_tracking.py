"""Corners of drawn squares and of textures; tracks on images whose motion is known exactly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.frontend.tracking import (
    WINDOW_RADIUS_PX,
    detect_corners,
    halve,
    track_pixels,
    track_roughly,
)
from gvo.types import ImageArray
from tests.frontend.analytic import SHAPE, grid, image

N_CORNERS = 250


@settings(max_examples=10)
@given(du=st.floats(-4.0, 4.0), dv=st.floats(-4.0, 4.0))
def test_pixels_are_followed_to_a_small_fraction(du: float, dv: float) -> None:
    pixels = grid()
    tracked, is_tracked = track_pixels(
        (image(), image(du, dv)), pixels, pixels, n_levels=2, is_checked=True
    )
    assert is_tracked.mean() > 0.9
    errors = np.linalg.norm(tracked - pixels - [du, dv], axis=1)[is_tracked]
    assert np.median(errors) < 0.05
    assert np.mean(errors < 0.2) > 0.95


def test_a_rough_track_is_near_enough_for_an_alignment() -> None:
    pixels, motion = grid(), np.array([3.3, -1.6])
    halves = halve(image()), halve(image(*motion))
    tracked, is_tracked = track_roughly(halves, pixels, pixels + motion + 0.8)
    assert is_tracked.mean() > 0.9
    errors = (tracked - pixels - motion)[is_tracked]
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.15
    assert np.all(np.abs(np.median(errors, axis=0)) < 0.05)


def test_the_search_begins_where_it_is_told() -> None:
    pixels, motion = grid(), np.array([17.0, -9.0])
    images = (image(), image(*motion))
    for start, share in ((pixels + motion + 0.8, 0.9), (pixels, 0.0)):
        tracked, is_tracked = track_pixels(images, pixels, start, n_levels=0, is_checked=True)
        is_right = is_tracked & (np.linalg.norm(tracked - pixels - motion, axis=1) < 0.3)
        assert is_right.mean() >= share
        assert is_right.mean() < 0.2 or share > 0


def test_tracks_that_do_not_lead_back_are_dropped() -> None:
    # The second image shows something else: the texture elsewhere.
    pixels = grid()
    _, is_tracked = track_pixels(
        (image(), image(900.0, 500.0)), pixels, pixels, n_levels=0, is_checked=True
    )
    assert is_tracked.mean() < 0.3


def test_tracks_that_leave_the_image_are_dropped() -> None:
    pixels = np.array([[SHAPE[1] - 12.0, 60.0], [100.0, 60.0]])
    start = pixels + np.array([15.0, 0.0])
    _, is_tracked = track_pixels((image(), image(15.0)), pixels, start, n_levels=0, is_checked=True)
    assert is_tracked.tolist() == [False, True]


@pytest.mark.parametrize("place", [-1e6, 1e6, -50.0])
def test_a_start_far_outside_is_no_track(place: float) -> None:
    pixels = grid()
    _, is_tracked = track_pixels(
        (image(), image()), pixels, np.full_like(pixels, place), n_levels=2, is_checked=True
    )
    assert not is_tracked.any()


def test_flat_images_hold_no_tracks() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    pixels = grid()
    _, is_tracked = track_pixels((flat, flat), pixels, pixels, n_levels=2, is_checked=True)
    assert not is_tracked.any()


def test_no_pixels_give_no_tracks() -> None:
    tracked, is_tracked = track_pixels(
        (image(), image()), np.zeros((0, 2)), np.zeros((0, 2)), n_levels=2, is_checked=True
    )
    assert tracked.shape == (0, 2)
    assert is_tracked.shape == (0,)


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
    found = detect_corners(picture, 500, spacing_px=6)
    assert len(found) >= len(corners)
    for u, v in found:
        assert min(max(abs(u - a), abs(v - b)) for a, b in corners) <= 1
    for a, b in corners:
        assert np.abs(found - [a, b]).max(axis=1).min() <= 1


def test_corners_are_whole_pixels_with_room_for_the_window() -> None:
    found = detect_corners(image(), N_CORNERS)
    assert len(found) > 20
    np.testing.assert_array_equal(found, np.rint(found))
    limits = np.array([SHAPE[1], SHAPE[0]]) - 1 - WINDOW_RADIUS_PX
    assert np.all(found >= WINDOW_RADIUS_PX)
    assert np.all(found <= limits)


def test_each_small_cell_gives_one_corner() -> None:
    for size in (8, 20):
        cells = detect_corners(image(), N_CORNERS, spacing_px=size) // size
        assert len(np.unique(cells, axis=0)) == len(cells)


def test_the_budget_is_kept_and_spread() -> None:
    everything = detect_corners(image(), 5000, spacing_px=6)
    found = detect_corners(image(), 50, spacing_px=6)
    assert len(everything) > 100
    assert len(found) == 50
    assert {tuple(corner) for corner in found} <= {tuple(corner) for corner in everything}
    large = {tuple(cell) for cell in found // 40}
    assert large == {tuple(cell) for cell in everything // 40}


@pytest.mark.parametrize("shape", [(4, 4), (12, 300), (300, 12)])
def test_images_without_room_have_no_corners(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    assert detect_corners(noise, N_CORNERS).shape == (0, 2)


def test_a_flat_image_has_no_corners() -> None:
    assert detect_corners(np.full(SHAPE, 77, dtype=np.uint8), N_CORNERS).shape == (0, 2)
