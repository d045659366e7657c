"""Patches aligned through a warp, against analytic images."""

import numpy as np
import pytest

from gvo.frontend.tracking import Templates, detect_corners, track_pixels
from gvo.types import FloatArray
from tests.frontend import analytic

TURN = np.deg2rad(12.0)
WARPS = {
    "turned": np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]),
    "nearer": np.diag([1.15, 1.15]),
    "slanted": np.array([[0.82, 0.0], [0.06, 1.0]]),
}
SHIFT = np.array([0.37, -0.61])


def seen_at(pixels: FloatArray, warp: FloatArray) -> FloatArray:
    return np.asarray((pixels - analytic.MIDDLE) @ warp.T + analytic.MIDDLE + SHIFT)


def align(warp: FloatArray, *, brighter: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return the errors of patches found from a start that is off by a pixel, and of tracks."""
    corners, rng = detect_corners(analytic.image(), 250), np.random.default_rng(2)
    pixels = corners[np.all(np.abs(corners - analytic.MIDDLE) < [85.0, 35.0], axis=1)]
    truth = seen_at(pixels, warp)
    start = truth + rng.uniform(-0.9, 0.9, truth.shape)
    image = analytic.warped_image(warp, SHIFT)
    brightened = np.minimum(image.astype(int) + brighter, 255).astype(np.uint8)
    warps = np.tile(warp, (len(pixels), 1, 1))
    templates = Templates.of(analytic.image(), pixels)
    found, is_found = templates.align(brightened, np.arange(len(pixels)), start, warps)
    assert np.mean(is_found) > 0.95
    tracked, is_tracked = track_pixels(
        (analytic.image(), image), pixels, start, n_levels=2, is_checked=False
    )
    errors, of_tracks = (np.linalg.norm(each - truth, axis=1) for each in (found, tracked))
    return errors[is_found], of_tracks[is_tracked]


@pytest.mark.parametrize("warp", WARPS.values(), ids=WARPS)
def test_a_patch_that_is_warped_is_found_where_a_track_is_off(warp: FloatArray) -> None:
    found, tracked = align(warp)
    assert np.median(found) < 0.03
    assert np.quantile(found, 0.95) < 0.07
    assert np.median(tracked) > 0.2


def test_a_brighter_image_moves_no_patch() -> None:
    found, _ = align(WARPS["turned"], brighter=20)
    assert np.median(found) < 0.03


def test_what_does_not_look_like_the_patch_is_not_found() -> None:
    pixels, warps = analytic.grid(), np.tile(np.eye(2), (len(analytic.grid()), 1, 1))
    templates, every = Templates.of(analytic.image(), pixels), np.arange(len(pixels))
    noise = np.random.default_rng(0).integers(0, 256, analytic.SHAPE, dtype=np.uint8)
    flat = np.full(analytic.SHAPE, 120, dtype=np.uint8)
    for other in (noise, flat, analytic.image()[::-1].copy()):
        _, is_found = templates.align(other, every, pixels, warps)
        assert np.mean(is_found) < 0.1
    # What is still on its way is none either.
    _, is_found = templates.align(analytic.image(3.8, 3.8), every, pixels, warps)
    assert np.mean(is_found) < 0.05


def test_some_of_the_patches_are_those_and_none_are_none() -> None:
    pixels, image = analytic.grid(), analytic.image()
    templates = Templates.of(image, pixels)
    chosen, warps = np.array([7, 2, 11]), np.tile(np.eye(2), (3, 1, 1))
    other, start = analytic.image(0.4, 0.2), pixels[chosen] + 0.3
    some = templates.align(other, chosen, start, warps)
    alone = Templates.of(image, pixels[chosen]).align(other, np.arange(3), start, warps)
    np.testing.assert_array_equal(some[0], alone[0])
    np.testing.assert_array_equal(some[1], alone[1])
    nothing = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2))
    found, is_found = templates.align(image, *nothing)
    assert found.shape == (0, 2)
    assert is_found.shape == (0,)


def test_patches_at_the_border_and_in_flat_images_are_finite() -> None:
    corners = np.array([[0.0, 0.0], [239.0, 119.0]])
    flat = np.full(analytic.SHAPE, 80, dtype=np.uint8)
    for image in (analytic.image(), flat):
        warps = np.tile(np.eye(2), (2, 1, 1))
        found, _ = Templates.of(image, corners).align(image, np.arange(2), corners, warps)
        np.testing.assert_allclose(found, corners, atol=0.05)
