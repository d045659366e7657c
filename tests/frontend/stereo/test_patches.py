"""Patches of left and right: cut, correlated, compared."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.frontend.stereo.patches import (
    Likeness,
    correlate_rows,
    sample_patches,
    squared_differences,
)
from gvo.types import FloatArray, ImageArray
from tests.frontend.analytic import SHAPE, grid, image

RADIUS = 5


def compare(
    images: tuple[ImageArray, ImageArray], pixels: FloatArray, disparities: FloatArray | float
) -> Likeness:
    u, v = pixels.T
    left = sample_patches(images[0], u, v, RADIUS, RADIUS)
    return Likeness.of(left, sample_patches(images[1], u - disparities, v, RADIUS, RADIUS))


def test_a_patch_is_cut_out_around_its_pixel() -> None:
    whole = image()
    (patch,) = sample_patches(whole, np.array([40.0]), np.array([30.0]), 3, 2)
    np.testing.assert_array_equal(patch, whole[28:33, 37:44])


def test_beyond_the_edge_its_last_pixels_go_on() -> None:
    whole = image()
    (patch,) = sample_patches(whole, np.array([0.0]), np.array([SHAPE[0] - 1.0]), 1, 1)
    np.testing.assert_array_equal(patch[:2], whole[-2:, [0, 0, 1]])
    np.testing.assert_array_equal(patch[2], patch[1])


def test_between_pixels_a_patch_is_interpolated() -> None:
    whole = image()
    (patch,) = sample_patches(whole, np.array([40.25]), np.array([30.5]), 3, 2)
    expected = cv2.getRectSubPix(whole, (7, 5), (40.25, 30.5), patchType=cv2.CV_32F)
    np.testing.assert_allclose(patch, expected, atol=1.0)  # rounded to grey values


def test_patches_are_alike_at_the_right_disparity_whatever_the_exposure() -> None:
    for gain in (0.9, 1.0):
        assert compare((image(), image(-7.0, gain=gain)), grid(), 7.0).are_alike.all()
    images = image(), image(-7.0)
    assert compare(images, grid(), 10.0).are_alike.mean() < 0.1
    is_there = np.arange(len(grid())) % 2 == 0
    is_alike = compare(images, grid(), 7.0).where(is_there).are_alike
    np.testing.assert_array_equal(is_alike, is_there)


def test_patches_across_a_step_of_depth_are_not_alike() -> None:
    rows = np.arange(SHAPE[0])
    images = image(), image(-np.where(rows < 60, 4.0, 9.0))
    pixels = grid(step=3)
    is_at_step = np.abs(pixels[:, 1] - 59.5) < 4
    is_alike = compare(images, pixels, np.where(pixels[:, 1] < 60, 4.0, 9.0)).are_alike
    assert is_alike[is_at_step].mean() < 0.3
    is_far = np.abs(pixels[:, 1] - 59.5) > 8
    assert is_alike[is_far].mean() > 0.95


def test_what_is_shown_twice_is_its_own_rival() -> None:
    """Stripes of a period of 12 pixels, at disparity 5: 17 is as good, 11 half a period off."""
    stripes = np.tile(128 + 60 * np.sin(2 * np.pi * np.arange(160.0) / 12), (120, 1))
    images = stripes.astype(np.uint8), np.roll(stripes, -5, axis=1).astype(np.uint8)
    pixels = np.column_stack([np.linspace(50, 120, 20), np.linspace(30, 90, 20)])
    found, second, between = (compare(images, pixels, d) for d in (5.0, 17.0, 11.0))
    assert found.are_alike.all()
    assert second.rivals(found).all()
    assert not between.rivals(found).any()
    assert not second.where(np.zeros(20, dtype=np.bool_)).rivals(found).any()
    some = np.array([3, 1])
    np.testing.assert_array_equal(second.select(some).unlike, second.unlike[some])


def random_patches() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(0)
    return (
        rng.normal(size=(7, 5, 5)).astype(np.float32),
        rng.normal(size=(7, 5, 12)).astype(np.float32),
    )


def test_patches_are_correlated_with_every_place_of_a_strip() -> None:
    patches, strips = random_patches()
    expected = [
        [np.sum(p * s[:, k : k + 5]) for k in range(8)]
        for p, s in zip(patches, strips, strict=True)
    ]
    np.testing.assert_allclose(correlate_rows(patches, strips), expected, atol=1e-5)


def test_squared_differences_are_those_about_their_mean() -> None:
    patches, strips = random_patches()
    expected = [
        [25 * np.var(p - s[:, k : k + 5]) for k in range(8)]
        for p, s in zip(patches, strips, strict=True)
    ]
    np.testing.assert_allclose(squared_differences(patches, strips), expected, rtol=1e-4)
