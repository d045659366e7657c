"""The renderer, against rays intersected one by one and pixels known in advance."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import make_transform
from gvo.io.synthetic import Light, Rectangle, StillScene, Texture, make_scene
from gvo.types import DepthArray, FloatArray

CAMERA = PinholeCamera(fx=50.0, fy=55.0, cx=31.3, cy=23.6, width=64, height=48)
HERE: FloatArray = np.eye(4)
EVEN_LIGHT = Light(ambient=1.0, direct=0.0, haze_grey=7.0)


Triple = tuple[float, float, float]


def texture_of(pixels: Any, size_m: tuple[float, float] = (1.0, 1.0), mask: Any = None) -> Texture:
    return Texture(pixels=np.asarray(pixels, dtype=np.uint8), size_m=size_m, mask=mask)


def noise_texture() -> Texture:
    return texture_of(np.random.default_rng(5).integers(0, 256, (64, 64)))


def screen(z: float, *, half: float = 2.0, texture: str = "t", **options: Any) -> Rectangle:
    return Rectangle(
        corner=(-half, -half, z),
        edge_s=(2 * half, 0, 0),
        edge_t=(0, 2 * half, 0),
        texture=texture,
        **options,
    )


def scene_of(*rectangles: Rectangle, light: Light = EVEN_LIGHT, **textures: Texture) -> StillScene:
    return StillScene(make_scene(rectangles, textures or {"t": noise_texture()}, light))


def image_of(scene: StillScene, T: FloatArray = HERE, camera: PinholeCamera = CAMERA) -> DepthArray:
    return scene.image(0.0, T, camera)


def depth_of(scene: StillScene, T: FloatArray = HERE, camera: PinholeCamera = CAMERA) -> DepthArray:
    return scene.depth(0.0, T, camera)


def intersect_one_by_one(
    rectangle: Rectangle, T_map_cam: FloatArray, camera: PinholeCamera
) -> tuple[FloatArray, FloatArray]:
    """Solve corner + a edge_s + b edge_t = z ray for each pixel; NaN outside of the rectangle."""
    depth = np.full((camera.height, camera.width), np.nan)
    margin = np.full(depth.shape, np.nan)
    R, t = T_map_cam[:3, :3], T_map_cam[:3, 3]
    for v in range(camera.height):
        for u in range(camera.width):
            ray = R @ [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
            A = np.column_stack([np.asarray(rectangle.edge_s), np.asarray(rectangle.edge_t), -ray])
            a, b, z = np.linalg.solve(A, t - np.asarray(rectangle.corner))
            margin[v, u] = min(a, 1 - a, b, 1 - b) if z > 0 else -1.0
            if margin[v, u] >= 0:
                depth[v, u] = z
    return depth, margin


@settings(max_examples=12)
@given(
    angles=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    position=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
)
def test_depth_is_that_of_rays_intersected_one_by_one(angles: Triple, position: Triple) -> None:
    R = Rotation.from_rotvec(angles).as_matrix()
    rectangle = Rectangle(
        corner=R @ [-1.5, -1.0, 0.0] + [0, 0, 4.0],
        edge_s=R @ [3.0, 0, 0],
        edge_t=R @ [0, 2.0, 0],
        texture="t",
        is_two_sided=True,
    )
    T_map_cam = make_transform(
        Rotation.from_rotvec(0.2 * np.array(angles)).as_matrix(), np.array(position)
    )
    depth = depth_of(scene_of(rectangle), T_map_cam)
    expected, margin = intersect_one_by_one(rectangle, T_map_cam, CAMERA)
    is_clear = np.abs(margin) > 1e-5
    np.testing.assert_allclose(depth[is_clear], expected[is_clear], rtol=2e-6)


def test_a_surface_is_not_seen_from_behind_unless_it_has_two_sides() -> None:
    turned = make_transform(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 5.0]))
    for is_two_sided in (False, True):
        scene = scene_of(screen(2.0, is_two_sided=is_two_sided))
        assert np.any(np.isfinite(depth_of(scene, turned))) == is_two_sided


@pytest.mark.parametrize("axis", [0, 1])
def test_edges_are_mixed_by_the_share_of_the_pixel_they_cover(axis: int) -> None:
    camera = PinholeCamera(fx=100.0, fy=100.0, cx=31.5, cy=31.5, width=64, height=64)
    scene = scene_of(screen(1.0, half=0.1), t=texture_of(np.full((8, 8), 200)))
    half_a_pixel = make_transform(np.eye(3), 0.005 * np.eye(3)[axis])
    image = image_of(scene, half_a_pixel, camera)  # from 21 to 41 along the axis
    line = image[:, 28] if axis else image[28]
    assert line[20] == 7.0
    assert line[21] == pytest.approx((200 + 7) / 2)
    assert line[22] == 200.0


def test_what_a_mask_leaves_out_shows_what_is_behind() -> None:
    is_left = np.zeros((64, 64), dtype=bool)
    is_left[:, :32] = True
    scene = scene_of(
        screen(2.0, half=0.5, is_stretched=True, texture="cut"),
        screen(4.0, half=9.0),
        cut=texture_of(np.full((64, 64), 99), mask=is_left),
        t=noise_texture(),
    )
    depth = depth_of(scene)
    center = round(CAMERA.cx)
    assert np.all(depth[20:28, center - 8 : center - 1] == 2.0)
    assert np.all(depth[20:28, center + 2 : center + 8] == 4.0)
