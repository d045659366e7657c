"""Patches aligned through a warp: against analytic images, and against projected planes."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.frontend.tracking import Templates, detect_corners, move_slopes, patch_warps, track_pixels
from gvo.geometry.camera import StereoCamera
from gvo.types import FloatArray
from tests.frontend import analytic
from tests.geometry.scenes import move, project, unproject

CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)
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
    found, is_found = templates.align(brightened, start, warps)
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
    templates = Templates.of(analytic.image(), pixels)
    noise = np.random.default_rng(0).integers(0, 256, analytic.SHAPE, dtype=np.uint8)
    flat = np.full(analytic.SHAPE, 120, dtype=np.uint8)
    for other in (noise, flat, analytic.image()[::-1].copy()):
        _, is_found = templates.align(other, pixels, warps)
        assert np.mean(is_found) < 0.1
    # What is still on its way is none either.
    _, is_found = templates.align(analytic.image(3.8, 3.8), pixels, warps)
    assert np.mean(is_found) < 0.05


def test_some_of_the_patches_are_those_and_none_are_none() -> None:
    pixels, image = analytic.grid(), analytic.image()
    templates = Templates.of(image, pixels)
    chosen = np.array([7, 2, 11])
    taken, cut = templates.take(chosen), Templates.of(image, pixels[chosen])
    np.testing.assert_array_equal(taken.values, cut.values)
    np.testing.assert_array_equal(taken.gradients, cut.gradients)
    np.testing.assert_array_equal(taken.inverses, cut.inverses)
    found, is_found = Templates.of(image, np.zeros((0, 2))).align(
        image, np.zeros((0, 2)), np.zeros((0, 2, 2))
    )
    assert found.shape == (0, 2)
    assert is_found.shape == (0,)


def test_patches_at_the_border_and_in_flat_images_are_finite() -> None:
    corners = np.array([[0.0, 0.0], [239.0, 119.0]])
    flat = np.full(analytic.SHAPE, 80, dtype=np.uint8)
    for image in (analytic.image(), flat):
        found, _ = Templates.of(image, corners).align(image, corners, np.tile(np.eye(2), (2, 1, 1)))
        np.testing.assert_allclose(found, corners, atol=0.05)


def numeric(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Return the derivative of pixels by pixels, shape (2, 2)."""
    steps = 1e-3 * np.eye(2)
    return np.stack([(function(at + h) - function(at - h)) / 2e-3 for h in steps], axis=1)


@given(
    pixel=st.tuples(st.floats(20, 620), st.floats(20, 460)),
    disparity=st.floats(5.0, 50.0),
    slopes=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    turn=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    shift=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
)
def test_a_warp_is_the_derivative_of_where_the_points_of_a_plane_go(
    pixel: tuple[float, float],
    disparity: float,
    slopes: tuple[float, float],
    turn: tuple[float, ...],
    shift: tuple[float, ...],
) -> None:
    T, at = np.eye(4), np.array(pixel)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift

    def on_plane(slope: FloatArray) -> Callable[[FloatArray], FloatArray]:
        def target(pixel: FloatArray) -> FloatArray:
            uvd = np.append(pixel, disparity + slope @ (pixel - at))
            return project(move(T, unproject(uvd[np.newaxis], CAMERA)), CAMERA)[0, :2]

        return target

    uvd = np.array([[*pixel, disparity]])
    found = patch_warps(uvd, np.array([slopes]), T, CAMERA)[0]
    expected = numeric(on_plane(np.array(slopes)), at)
    np.testing.assert_allclose(found, expected, atol=2e-4, rtol=2e-4)


@given(
    slopes=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    shift=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)
def test_slopes_are_those_of_three_points_of_the_plane_in_the_target(
    slopes: tuple[float, float], turn: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    uvd = np.array([[u, v, 30.0] for u in (100.0, 300.0, 500.0) for v in (80.0, 240.0, 400.0)])
    beside = [uvd + 1e-3 * np.array(step) for step in ((1, 0, slopes[0]), (0, 1, slopes[1]))]
    seen, *others = (project(move(T, unproject(each, CAMERA)), CAMERA) for each in (uvd, *beside))
    changes = np.stack([each - seen for each in others], axis=1)
    expected = np.linalg.solve(changes[:, :, :2], changes[:, :, 2:])[:, :, 0]
    moved = move_slopes(uvd, np.tile(slopes, (len(uvd), 1)), T, CAMERA)
    np.testing.assert_allclose(moved, np.clip(expected, -0.75, 0.75), atol=1e-3)


def test_planes_that_are_seen_from_behind_have_finite_slopes() -> None:
    # A wall of the street, and a camera that drove through it.
    T = np.eye(4)
    T[:3, 3] = 5.0, 0.0, -5.0
    moved = move_slopes(np.array([[100.0, 240.0, 30.0]]), np.array([[-0.2, 0.0]]), T, CAMERA)
    assert np.abs(moved).max() <= 0.75
