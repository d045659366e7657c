"""Corners predicted in another frame: where, how warped, on which slope; by projected planes."""

from collections.abc import Callable

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import StereoCamera
from gvo.kernels.prediction import predict
from gvo.types import FloatArray, IntArray
from tests.geometry.scenes import project, seen_from, unproject

CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)


def predicted(
    uvd: FloatArray, slopes: FloatArray, T: FloatArray, *, offset_px: float = 0.0
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return indices, what is seen, warps and slopes."""
    n = len(uvd)
    indices, seen, warps = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 2, 2))
    moved = np.empty((n, 2))
    n_seen = predict(
        *(
            uvd,
            slopes,
            T,
            np.eye(11)[0] * offset_px,
            np.zeros((2, 6)),
            np.zeros(2),
            CAMERA.parameters,
        ),
        *(indices, seen, warps, moved),
    )
    return indices[:n_seen], seen[:n_seen], warps[:n_seen], moved[:n_seen]


@given(
    turn=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    shift=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    offset_px=st.floats(-0.3, 0.3),
)
def test_what_is_seen_are_projected_points_in_view_and_in_front(
    turn: tuple[float, ...], shift: tuple[float, ...], offset_px: float
) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    uvd = np.random.default_rng(0).uniform([0, 0, 5], [640, 480, 60], (200, 3))
    points = seen_from(T, unproject(uvd - [0.0, 0.0, offset_px], CAMERA))
    expected = project(points, CAMERA) + np.array([0.0, 0.0, offset_px])
    is_seen = points[:, 2] > 1e-3
    is_seen &= np.all((expected >= 0) & (expected <= [639, 479, np.inf]), axis=1)
    is_clear = np.abs(expected[:, :2] - [[320, 240]] - [[319, 239]]).min(axis=1) > 1e-6
    indices, seen, *_ = predicted(uvd, np.zeros((200, 2)), T, offset_px=offset_px)
    np.testing.assert_array_equal(np.isin(np.arange(200), indices)[is_clear], is_seen[is_clear])
    np.testing.assert_allclose(seen, expected[indices], rtol=1e-9, atol=1e-7)


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
        def current(pixel: FloatArray) -> FloatArray:
            uvd = np.append(pixel, disparity + slope @ (pixel - at))
            return project(seen_from(T, unproject(uvd[np.newaxis], CAMERA)), CAMERA)[0, :2]

        return current

    uvd = np.array([[*pixel, disparity]])
    _, _, warps, _ = predicted(uvd, np.array([slopes]), T)
    if len(warps) == 0:  # out of view
        return
    expected = numeric(on_plane(np.array(slopes)), at)
    np.testing.assert_allclose(warps[0], expected, atol=2e-4, rtol=2e-4)


@given(
    slopes=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    shift=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)
def test_slopes_are_those_of_three_points_of_the_plane_in_the_current_frame(
    slopes: tuple[float, float], turn: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    uvd = np.array([[u, v, 30.0] for u in (100.0, 300.0, 500.0) for v in (80.0, 240.0, 400.0)])
    beside = [uvd + 1e-3 * np.array(step) for step in ((1, 0, slopes[0]), (0, 1, slopes[1]))]
    seen, *others = (
        project(seen_from(T, unproject(each, CAMERA)), CAMERA) for each in (uvd, *beside)
    )
    changes = np.stack([each - seen for each in others], axis=1)
    expected = np.linalg.solve(changes[:, :, :2], changes[:, :, 2:])[:, :, 0]
    indices, _, _, moved = predicted(uvd, np.tile(slopes, (len(uvd), 1)), T)
    np.testing.assert_allclose(moved, np.clip(expected, -0.75, 0.75)[indices], atol=1e-3)


def test_planes_that_are_seen_from_behind_have_finite_slopes() -> None:
    # A wall of the street, and a camera that drove through it.
    T = np.eye(4)
    T[:3, 3] = -1.5, 0.0, 1.0
    uvd = np.array([[100.0, 240.0, 30.0]])
    _, seen, _, moved = predicted(uvd, np.array([[-0.2, 0.0]]), T)
    assert len(seen) == 1
    assert np.abs(moved).max() <= 0.75
