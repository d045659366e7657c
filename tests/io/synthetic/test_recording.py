"""The rendered recordings: geometry, photometry, noise, repeatability."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.geometry.se3 import invert, transform_points
from gvo.io.recording import Source
from gvo.io.synthetic import (
    Light,
    Rectangle,
    RigError,
    SensorNoise,
    StillScene,
    SyntheticRecording,
    Texture,
    World,
    make_scene,
)
from gvo.types import BoolArray, DepthArray, FloatArray
from tests.make.recordings import PERFECT

WORLDS = ["driving", "handheld"]


def perfect(world: Any, sensor: Any = "stereo", **options: Any) -> SyntheticRecording:
    defaults: dict[str, Any] = {"scale": 0.5, "noise": PERFECT}
    return SyntheticRecording(world, sensor, **(defaults | options))


def load(recording: Source, index: int, stream: int = 0) -> NDArray[Any]:
    return list(recording.images())[2 * index + stream].load()


def pixel_grid(image: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    return u, v


def sample(image: NDArray[Any], u: FloatArray, v: FloatArray) -> FloatArray:
    values = map_coordinates(image.astype(np.float64), [v, u], order=1, cval=np.nan)
    return np.asarray(values)


def sample_spline(image: NDArray[Any], u: FloatArray, v: FloatArray) -> FloatArray:
    """Return the image at (u, v); unlike OpenCV's cubic it does not favour whole pixels."""
    values = map_coordinates(image.astype(np.float64), [v, u], order=3, mode="nearest")
    return np.asarray(values)


def shrunk(mask: BoolArray, size: int) -> BoolArray:
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((size, size), np.uint8))
    return np.asarray(eroded, dtype=np.bool_)


def stereo_camera_of(recording: SyntheticRecording) -> StereoCamera:
    camera = recording.info.camera
    assert isinstance(camera, StereoCamera)
    return camera


def unoccluded(
    expected_depth: FloatArray, other_depth: DepthArray, u: FloatArray, v: FloatArray
) -> BoolArray:
    """Tell the pixels whose point is the nearest one in the other image, with its neighbours."""
    is_same = np.abs(sample(other_depth, u, v) - expected_depth) < 0.01 * expected_depth
    return shrunk(is_same, 7)


def right_seen_from_left(
    recording: SyntheticRecording, index: int, offset: float = 0.0
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return left, right moved by the exact disparity, and where both see the same."""
    camera = stereo_camera_of(recording)
    left, right = load(recording, index), load(recording, index, 1)
    depth = recording.render_depth(index).astype(np.float64)
    u, v = pixel_grid(depth)
    u_right = u - camera.fx * camera.baseline / depth - offset
    is_same = unoccluded(depth, recording.render_depth(index, 1), u_right, v)
    return left.astype(np.float64), sample_spline(right, u_right, v), is_same


def residual_disparities(
    left: FloatArray, moved: FloatArray, is_same: BoolArray, size: int = 15
) -> FloatArray:
    """Return what is left of the disparity of textured patches, by least squares."""

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(cv2.boxFilter(values, -1, (size, size), normalize=False))

    slope = np.gradient(0.5 * (left + moved), axis=1)
    energy = total(slope * slope)
    shifts = total(slope * (moved - left)) / (energy + 1e-9)
    return shifts[shrunk(is_same, size) & (energy > 30.0 * size**2)]


@pytest.mark.parametrize("offset", [-0.5, 0.4])
def test_a_planted_offset_makes_every_disparity_larger(offset: float) -> None:
    recording = perfect("handheld", n_frames=2, rig_error=RigError(constants={"d0": offset}))
    assert recording.info.camera == perfect("handheld", n_frames=2).info.camera
    assert abs(np.mean(residual_disparities(*right_seen_from_left(recording, 0, offset)))) < 0.02


@pytest.mark.parametrize("world", WORLDS)
def test_points_of_one_frame_lie_where_the_true_motion_puts_them_in_another(world: str) -> None:
    recording = perfect(world, "rgbd", n_frames=12)
    truth = recording.ground_truth().T_world_frame
    camera = recording.info.camera
    depth = recording.render_depth(3).astype(np.float64)
    u, v = pixel_grid(depth)
    points = camera.unproject(np.stack([u, v], axis=-1)) * depth[..., np.newaxis]
    T_later_earlier = invert(truth[6]) @ truth[3]
    moved = transform_points(T_later_earlier, points.reshape(-1, 3)).reshape(points.shape)
    z = np.maximum(moved[..., 2], 0.1)
    pixels = camera.project(np.concatenate([moved[..., :2], z[..., np.newaxis]], axis=-1))
    later_depth = recording.render_depth(6)
    is_same = unoccluded(z, later_depth, pixels[..., 0], pixels[..., 1])
    assert is_same.mean() > 0.3
    seen = sample(later_depth, pixels[..., 0], pixels[..., 1])
    assert np.median(np.abs(seen - z)[is_same] / z[is_same]) < 1e-3
    grey = sample(load(recording, 6), pixels[..., 0], pixels[..., 1])
    assert np.median(np.abs(grey - load(recording, 3))[is_same]) < 5.0


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_a_recording_announces_what_it_yields(world: Any, sensor: Any) -> None:
    recording: Source = SyntheticRecording(world, sensor, n_frames=3, scale=0.25)
    info, images = recording.info, list(recording.images())
    assert (info.sensor, info.n_images, len(images)) == (sensor, 3, 6)
    assert [image.stream for image in images] == [0, 1] * 3
    assert all(a.stamp_ns == b.stamp_ns for a, b in zip(images[::2], images[1::2], strict=True))
    rate_hz = {"driving": 10, "handheld": 30}[world]
    assert np.all(np.diff([image.stamp_ns for image in images[::2]]) // 10 == 10**8 // rate_hz)
    size = (info.camera.height, info.camera.width)
    left, second = images[0].load(), images[1].load()
    assert left.shape == second.shape == size
    assert left.dtype == np.uint8
    assert second.dtype == (np.uint8 if sensor == "stereo" else np.float32)
    truth = recording.ground_truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.stamps_ns, [image.stamp_ns for image in images[::2]])


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_the_same_seed_gives_the_same_bytes_in_any_order_and_thread(sensor: Any) -> None:
    first = list(SyntheticRecording("handheld", sensor, n_frames=4, scale=0.1, seed=3).images())
    again = list(SyntheticRecording("handheld", sensor, n_frames=9, scale=0.1, seed=3).images())
    expected = [image.load().tobytes() for image in first]
    with ThreadPoolExecutor(2) as pool:
        loaded = list(pool.map(lambda image: image.load().tobytes(), again[7::-1]))
    assert loaded[::-1] == expected
    assert len(set(expected)) == 8


def before(*planes: Rectangle, noise: SensorNoise) -> NDArray[Any]:
    """Return measured depth of a still RGB-D camera of 320 x 240 before planes."""
    grey = Texture(pixels=np.full((8, 8), 99, dtype=np.uint8), size_m=(1.0, 1.0))
    scene = StillScene(make_scene(planes, {"grey": grey}, Light()))
    world = World(
        name="planes",
        scene=lambda _: scene,
        motion=lambda _: lambda stamps_s: np.broadcast_to(np.eye(4), (len(stamps_s), 4, 4)),
        camera=PinholeCamera(fx=160.0, fy=160.0, cx=159.5, cy=119.5, width=320, height=240),
        baseline_m=0.1,
        rate_hz=10,
        max_depth_m=20.0,
    )
    return load(SyntheticRecording(world, "rgbd", n_frames=1, noise=noise), 0, 1)


def plane(z: float, *, left: float = -9e3, top: float = -9e3) -> Rectangle:
    edges: Any = {"edge_s": (2e4, 0, 0), "edge_t": (0, 2e4, 0)}
    return Rectangle(corner=(left, top, z), texture="grey", **edges)


def test_depth_noise_grows_with_the_square_of_the_depth() -> None:
    noise = replace(PERFECT, depth_sigma=0.002)
    for z in (1.0, 2.0, 4.0):
        assert before(plane(z), noise=noise).std() == pytest.approx(0.002 * z**2, rel=0.03)
    far = before(plane(500.0), noise=noise)
    assert 0.05 < np.isnan(far).mean() < 0.3
    assert np.nanmin(far) > 0


def test_depth_is_unknown_out_of_range_in_blobs_and_at_steps() -> None:
    planes = plane(3.0), plane(2.0, left=0.0), plane(0.3, top=0.2)
    exact = before(*planes, noise=PERFECT)
    assert {round(float(z), 3) for z in np.unique(exact)} == {0.3, 2.0, 3.0}
    in_range = before(*planes, noise=replace(PERFECT, min_depth_m=0.4, max_depth_m=2.5))
    np.testing.assert_array_equal(np.isnan(in_range), (exact > 2.5) | (exact < 0.4))
    blobs = np.isnan(before(plane(2.0), noise=replace(PERFECT, hole_share=0.1)))
    assert blobs.mean() == pytest.approx(0.1, abs=0.002)
    n_blobs = cv2.connectedComponents(blobs.astype(np.uint8))[0] - 1
    assert n_blobs < 0.02 * np.count_nonzero(blobs)
    edges = np.isnan(before(*planes[:2], noise=replace(PERFECT, edge_radius_px=2)))
    assert np.all(edges[:, 157:163])
    assert not np.any(edges[:, 10:150])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"world": "moon"}, "world must be one of"),
        ({"n_frames": 0}, "n_frames must be positive"),
        ({"seed": -1}, "seed not negative"),
        ({"scale": 0.0}, "scale must be in"),
    ],
)
def test_a_recording_nobody_can_render_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SyntheticRecording(**options)
