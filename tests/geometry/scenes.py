"""A stereo camera, motions, and matches of points that it sees in two frames."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import BoolArray, FloatArray

CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)
seeds = st.integers(min_value=0, max_value=2**32 - 1)


def project(points: FloatArray, camera: StereoCamera = CAMERA) -> FloatArray:
    x, y, z = points.T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return np.stack([u, v, camera.fx * camera.baseline / z], axis=-1)


def unproject(uvd: FloatArray, camera: StereoCamera = CAMERA) -> FloatArray:
    u, v, disparity = uvd.T
    z = camera.fx * camera.baseline / disparity
    x, y = (u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=-1)


def derivative(point: FloatArray, camera: StereoCamera = CAMERA) -> FloatArray:
    """Return that of (u, v, disparity), shape (3, 6), by a motion of the point on the left."""
    x, y, z = point
    fx, fy = camera.fx, camera.fy
    by_point = np.array(
        [[fx, 0, -fx * x / z], [0, fy, -fy * y / z], [0, 0, -fx * camera.baseline / z]]
    )
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.hstack([-by_point @ cross, by_point]) / z)


def move(T: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def seen_from(T_reference_current: FloatArray, points: FloatArray) -> FloatArray:
    """Return points of the reference as the current camera has them."""
    return np.asarray((points - T_reference_current[:3, 3]) @ T_reference_current[:3, :3])


def random_motion(
    rng: np.random.Generator, turn_rad: float = 0.1, shift_m: float = 0.2
) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn_rad * rng.normal(size=3)).as_matrix()
    T[:3, 3] = shift_m * rng.normal(size=3)
    return T


def random_points(rng: np.random.Generator, n: int) -> FloatArray:
    return rng.uniform([-2, -1.5, 3], [2, 1.5, 9], size=(n, 3))


def near_a_line(spread_m: float) -> FloatArray:
    line = np.linspace(0.0, 1.0, 30)[:, np.newaxis] * [1.0, 0.3, 4.0] + [0.5, 0.0, 3.0]
    return np.asarray(line + spread_m * np.random.default_rng(1).normal(size=(30, 3)))


def matched(
    reference: FloatArray,
    current: FloatArray,
    *,
    reference_uvd: FloatArray | None = None,
    current_uvd: FloatArray | None = None,
    reference_sigmas: ArrayLike = 1.0,
    current_sigmas: ArrayLike = 1.0,
) -> Correspondences:
    """Return correspondences of points (n, 3), measured where they are projected by default."""
    sigmas = [np.broadcast_to(each, reference.shape) for each in (reference_sigmas, current_sigmas)]
    return Correspondences(
        reference_points=np.ascontiguousarray(reference),
        current_points=np.ascontiguousarray(current),
        reference_uvd=project(reference) if reference_uvd is None else reference_uvd,
        current_uvd=project(current) if current_uvd is None else current_uvd,
        reference_sigmas=np.array(sigmas[0], dtype=np.float64, order="C"),
        current_sigmas=np.array(sigmas[1], dtype=np.float64, order="C"),
    )


def all_of(matches: Correspondences) -> BoolArray:
    return np.ones(len(matches), dtype=np.bool_)
