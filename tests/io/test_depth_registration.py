"""Depth warped from its own camera into that of the colour images."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.geometry.se3 import make_transform
from gvo.io.depth_registration import DepthRegistration
from gvo.io.recording import DepthView
from gvo.io.synthetic.rendering import StillScene
from gvo.io.synthetic.worlds.motion import look_around
from gvo.io.synthetic.worlds.room import room
from gvo.types import DepthArray, FloatArray

_COLOR = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
_HALF = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
_TURN = Rotation.from_rotvec([0.005, -0.01, 0.004]).as_matrix()


def _registration(
    camera: PinholeCamera, T_color_depth: FloatArray, color: PinholeCamera = _COLOR
) -> DepthRegistration:
    view = DepthView(calibration=Calibration.from_camera(camera), T_color_depth=T_color_depth)
    return DepthRegistration(Calibration.from_camera(color), view)


def _spread(depth: DepthArray, size: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the least and the largest depth around each pixel."""
    window = np.ones((size, size), np.uint8)
    return np.asarray(cv2.erode(depth, window)), np.asarray(cv2.dilate(depth, window))


@pytest.mark.parametrize(
    ("camera", "t"),
    [
        (_COLOR, (0.025, 0.0, 0.0)),
        (_HALF, (-0.05, 0.003, 0.004)),
        (
            PinholeCamera(fx=920, fy=920, cx=639.5, cy=359.5, width=1280, height=720),
            (0.03, 0.02, -0.01),
        ),
    ],
    ids=["as fine", "coarser", "finer"],
)
def test_registered_depth_is_what_the_colour_camera_would_measure(
    camera: PinholeCamera, t: tuple[float, float, float]
) -> None:
    T_map_color = look_around(np.array([1.0]))[0]
    T_color_depth = make_transform(_TURN, np.array(t))
    scene = StillScene(room(0))
    truth = scene.depth(0.0, T_map_color, _COLOR)
    depth = scene.depth(0.0, T_map_color @ T_color_depth, camera)
    registered = _registration(camera, T_color_depth)(depth)
    assert registered.dtype == np.float32

    nearest, farthest = _spread(truth, 7)
    is_smooth = farthest < 1.03 * nearest
    is_known = np.isfinite(registered)
    errors = np.abs(registered - truth)[is_smooth & is_known]
    assert np.median(errors) < 0.002
    assert np.percentile(errors / truth[is_smooth & is_known], 95) < 0.01
    # 720 rows at this focal length see less than the colour camera does
    assert np.mean(is_known[80:-80, 60:-60]) > 0.97

    # Beside a step either surface may win, but nothing in between or beyond them comes up.
    nearest, farthest = _spread(truth, 5)
    is_off = is_known & ((registered < 0.97 * nearest) | (registered > 1.03 * farthest))
    assert np.mean(is_off) < 2e-4


@settings(max_examples=40)
@given(
    t=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    coarseness=st.floats(0.5, 3.0),
    near=st.floats(0.5, 1.5),
    turn=st.tuples(*[st.floats(-0.02, 0.02)] * 3),
)
def test_no_background_shines_through_a_nearer_surface(
    t: tuple[float, float, float], coarseness: float, near: float, turn: tuple[float, float, float]
) -> None:
    color = PinholeCamera(fx=120.0, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
    width, height = int(160 / coarseness), int(120 / coarseness)
    camera = PinholeCamera(
        fx=120.0 / coarseness,
        fy=120.0 / coarseness,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        width=width,
        height=height,
    )
    T_color_depth = make_transform(Rotation.from_rotvec(turn).as_matrix(), np.array(t))
    # a square of 0.3 m side before a wall, both facing the colour camera
    depth = _square_before_wall(camera, T_color_depth, near=near)
    registered = _registration(camera, T_color_depth, color)(depth)
    half = int(120 * 0.15 / near - 1.5 * coarseness - 1)  # the border is as fine as the depth
    inside = registered[60 - half : 60 + half, 80 - half : 80 + half]
    np.testing.assert_allclose(inside, near, rtol=1e-4)


def _square_before_wall(
    camera: PinholeCamera, T_color_depth: FloatArray, *, near: float
) -> DepthArray:
    """Measure by intersecting the rays of the depth camera with planes of the colour camera."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    directions = camera.unproject(np.stack([u, v], axis=-1)) @ T_color_depth[:3, :3].T
    origin = T_color_depth[:3, 3]
    depth = (4.0 - origin[2]) / directions[..., 2]
    depth_of_square = (near - origin[2]) / directions[..., 2]
    hits = origin[:2] + directions[..., :2] * depth_of_square[..., np.newaxis]
    is_hit = np.all(np.abs(hits) < 0.15, axis=-1)
    return np.asarray(np.where(is_hit, depth_of_square, depth), dtype=np.float32)


_LENSES: list[tuple[str, list[float]]] = [
    ("plumb_bob", [-0.3, 0.1, 0.002, -0.001, 0.0]),
    ("plumb_bob", [0.26, -0.95, -0.005, 0.003, 1.16]),
    ("rational_polynomial", [0.6, -0.2, 1e-4, -2e-4, -0.01, 0.9, -0.1, -0.05]),
    ("equidistant", [-0.01, 0.02, -0.01, 0.002]),
]


@pytest.mark.parametrize(("model", "D"), _LENSES)
def test_raw_depth_is_undistorted(model: Any, D: list[float]) -> None:
    R = Rotation.from_rotvec([0.01, 0.02, -0.005]).as_matrix()
    raw = replace(
        Calibration.from_camera(_HALF), D=np.array(D), R=R, is_rectified=False, model=model
    )
    T_color_depth = make_transform(_TURN, np.array([0.03, -0.01, 0.005]))
    registration = DepthRegistration(
        Calibration.from_camera(_HALF), DepthView(calibration=raw, T_color_depth=T_color_depth)
    )
    # A slanted plane n . p = 2 m of the colour camera, seen along rays that OpenCV undistorts.
    normal = np.array([0.3, -0.4, 0.9])
    T_color_raw = T_color_depth @ make_transform(R, np.zeros(3))
    rays = _undistorted_by_opencv(raw, model) @ T_color_raw[:3, :3].T
    depth = ((2.0 - normal @ T_color_raw[:3, 3]) / (rays @ normal)).astype(np.float32)
    registered = registration(depth.reshape(240, 320))
    v, u = np.mgrid[:240, :320].astype(np.float64)
    expected = 2.0 / (_HALF.unproject(np.stack([u, v], axis=-1)) @ normal)
    middle = (slice(50, -50), slice(75, -75))
    # half a pixel on this plane is a thousandth of the depth
    np.testing.assert_allclose(registered[middle], expected[middle], rtol=3e-3)


def _undistorted_by_opencv(raw: Calibration, model: str) -> FloatArray:
    v, u = np.mgrid[: raw.height, : raw.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model == "equidistant" else cv2.undistortPoints
    xy = np.asarray(undistort(pixels, raw.K, raw.D)).reshape(-1, 2)
    return np.hstack([xy, np.ones((len(xy), 1))])
