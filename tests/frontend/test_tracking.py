"""Tracks on images whose motion is known to a fraction of a pixel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import KltConfig
from gvo.frontend.tracking import track_pixels
from tests.frontend.analytic import SHAPE, grid, image

CONFIG = KltConfig(window_radius_px=6)


@settings(deadline=None, max_examples=10)
@given(du=st.floats(-4.0, 4.0), dv=st.floats(-4.0, 4.0))
def test_pixels_are_followed_to_a_small_fraction(du: float, dv: float) -> None:
    pixels = grid()
    tracked, is_tracked = track_pixels(
        (image(), image(du, dv)), pixels, pixels, CONFIG, n_levels=2, is_checked=True
    )
    assert is_tracked.mean() > 0.9
    errors = np.linalg.norm(tracked - pixels - [du, dv], axis=1)[is_tracked]
    assert np.median(errors) < 0.05
    assert np.mean(errors < 0.2) > 0.95


def test_the_search_begins_where_it_is_told() -> None:
    pixels, motion = grid(), np.array([17.0, -9.0])
    images = (image(), image(*motion))
    for start, share in ((pixels + motion + 0.8, 0.9), (pixels, 0.0)):
        tracked, is_tracked = track_pixels(
            images, pixels, start, CONFIG, n_levels=0, is_checked=True
        )
        is_right = is_tracked & (np.linalg.norm(tracked - pixels - motion, axis=1) < 0.3)
        assert is_right.mean() >= share
        assert is_right.mean() < 0.2 or share > 0


def test_tracks_that_do_not_lead_back_are_dropped() -> None:
    # The second image shows something else: the texture elsewhere.
    pixels = grid()
    _, is_tracked = track_pixels(
        (image(), image(900.0, 500.0)), pixels, pixels, CONFIG, n_levels=0, is_checked=True
    )
    assert is_tracked.mean() < 0.3


def test_tracks_that_leave_the_image_are_dropped() -> None:
    pixels = np.array([[SHAPE[1] - 12.0, 60.0], [100.0, 60.0]])
    start = pixels + np.array([15.0, 0.0])
    _, is_tracked = track_pixels(
        (image(), image(15.0)), pixels, start, CONFIG, n_levels=0, is_checked=True
    )
    assert is_tracked.tolist() == [False, True]


@pytest.mark.parametrize("place", [-1e6, 1e6, -50.0])
def test_a_start_far_outside_is_no_track(place: float) -> None:
    pixels = grid()
    _, is_tracked = track_pixels(
        (image(), image()), pixels, np.full_like(pixels, place), CONFIG, n_levels=2, is_checked=True
    )
    assert not is_tracked.any()


def test_flat_images_hold_no_tracks() -> None:
    flat = np.full(SHAPE, 90, dtype=np.uint8)
    pixels = grid()
    _, is_tracked = track_pixels((flat, flat), pixels, pixels, CONFIG, n_levels=2, is_checked=True)
    assert not is_tracked.any()


def test_no_pixels_give_no_tracks() -> None:
    tracked, is_tracked = track_pixels(
        (image(), image()), np.zeros((0, 2)), np.zeros((0, 2)), CONFIG, n_levels=2, is_checked=True
    )
    assert tracked.shape == (0, 2)
    assert is_tracked.shape == (0,)
