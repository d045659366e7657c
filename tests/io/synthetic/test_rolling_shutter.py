"""A rolling shutter: each row is what a camera at the row's own pose sees in it."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.se3 import make_transform
from gvo.io.synthetic import (
    Light,
    Rectangle,
    SensorNoise,
    StillScene,
    SyntheticRecording,
    Texture,
    make_scene,
)
from gvo.io.synthetic.world import WORLDS
from gvo.types import DepthArray, FloatArray

CAMERA = PinholeCamera(fx=525.0, fy=520.0, cx=319.5, cy=239.5, width=640, height=480)
READOUT_S = 0.03


def hand(stamp_s: float) -> FloatArray:
    """Return T_map_cam of a hand that turns by some 90 deg/s about three axes, at 0.8 m/s."""
    R = Rotation.from_rotvec(np.array([0.7, 1.2, -0.6]) * stamp_s).as_matrix()
    return make_transform(np.asarray(R), np.array([0.6, -0.3, 0.4]) * stamp_s)


def pixel_at(point: FloatArray, stamp_s: float) -> FloatArray:
    """Project a point of the map into the camera of one moment, by hand."""
    x, y, z = np.linalg.solve(hand(stamp_s), np.append(point, 1.0))[:3]
    return np.array([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy])


def rolling_pixel(point: FloatArray) -> FloatArray:
    """Find the row that is exposed just when the point is seen in it."""

    def stamp_of(row: float) -> float:
        return READOUT_S * (row / CAMERA.height - 0.5)

    row = brentq(lambda v: pixel_at(point, stamp_of(v))[1] - v, -200.0, 680.0)
    return pixel_at(point, stamp_of(row))


def spot(center: FloatArray) -> Rectangle:
    corner, size = center - [0.06, 0.06, 0.0], 0.12
    edges: Any = {"edge_s": (size, 0, 0), "edge_t": (0, size, 0)}
    return Rectangle(corner=corner, texture="spot", is_stretched=True, **edges)


def blob() -> Texture:
    """Return a bright spot in the middle of a dark square."""
    x = np.linspace(-4.0, 4.0, 65)[:-1] + 0.0625
    wave = 255.0 * np.exp(-0.5 * x**2)
    return Texture(pixels=np.rint(np.outer(wave, wave) / 255.0).astype(np.uint8), size_m=(1.0, 1.0))


def centroid_near(image: DepthArray, pixel: FloatArray, radius: int = 30) -> FloatArray:
    u, v = (round(float(each)) for each in pixel)
    box = slice(v - radius, v + radius + 1), slice(u - radius, u + radius + 1)
    rows, columns = np.mgrid[box]
    weights = image[box] / image[box].sum()
    return np.array([np.sum(weights * columns), np.sum(weights * rows)])


def test_points_are_seen_where_the_pose_of_their_row_puts_them() -> None:
    xyz = [(-0.6, -0.5, 2.0), (0.8, -0.5, 2.5), (-1.0, 0.6, 2.6), (0.2, 0.6, 1.9), (0.1, -0.1, 4)]
    centers = np.array(xyz)
    light = Light(ambient=1.0, direct=0.0, haze_grey=0.0)
    scene = StillScene(make_scene([*map(spot, centers)], {"spot": blob()}, light))
    stamps_s = READOUT_S * (np.arange(CAMERA.height) / CAMERA.height - 0.5)
    image = scene.image(0.0, np.stack([hand(stamp) for stamp in stamps_s]), CAMERA)
    seen = np.array([centroid_near(image, rolling_pixel(center)) for center in centers])
    np.testing.assert_allclose(seen, [rolling_pixel(center) for center in centers], atol=0.05)
    # A shutter that opens all rows at once sees those far from the middle elsewhere.
    shifts = np.linalg.norm(seen - [pixel_at(center, 0.0) for center in centers], axis=1)
    assert shifts[:4].min() > 2.0
    assert shifts[4] < 1.0


@pytest.mark.parametrize(("name", "sensor"), [("driving", "stereo"), ("handheld", "rgbd")])
def test_each_row_is_that_of_an_image_taken_at_its_stamp(name: Any, sensor: Any) -> None:
    recording = SyntheticRecording(
        name, sensor, n_frames=12, noise=SensorNoise.none(), scale=0.25, readout_ms=30.0
    )
    camera, scene = recording.info.camera, WORLDS[name].scene(0)
    loaded = [image.load() for image in list(recording.images())[-2:]]
    stamps_ns = recording.ground_truth().stamps_ns
    for row in (0, camera.height // 3, camera.height - 1):
        elapsed_s = 1e-9 * (stamps_ns[-1] - stamps_ns[0]) + 0.03 * (row / camera.height - 0.5)
        views = [WORLDS[name].motion(0)(np.array([elapsed_s]))[0]]
        if isinstance(camera, StereoCamera):
            shift = np.array([camera.baseline, 0.0, 0.0])
            views.append(views[0] @ make_transform(np.eye(3), shift))
        for stream, view in enumerate(views):
            grey = scene.image(0.0, view, camera)[row]
            np.testing.assert_allclose(loaded[stream][row], grey, atol=1.5)
            depth = scene.depth(0.0, view, camera)[row]
            np.testing.assert_allclose(recording.render_depth(11, stream)[row], depth, rtol=1e-6)
        if sensor == "rgbd":
            np.testing.assert_allclose(loaded[1][row], depth, rtol=1e-5)
