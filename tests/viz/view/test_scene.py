"""Covariances become ellipsoids."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.types import FloatArray
from gvo.viz.view.scene import position_ellipsoids, position_sigmas, unit_sphere


def pose_and_covariance(seed: int) -> tuple[FloatArray, FloatArray]:
    """A pose, and a covariance (6, 6) with correlations."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    root = rng.normal(size=(6, 6)) * rng.uniform(0.01, 3.0, size=6)
    return T, root @ root.T


@given(st.integers(0, 10_000))
def test_points_on_the_ellipsoid_have_the_mahalanobis_distance_of_its_sigmas(seed: int) -> None:
    T, covariance = pose_and_covariance(seed)
    half_axes, quaternions = position_ellipsoids(T[np.newaxis], covariance[np.newaxis], 3.0)
    R_world_axes = Rotation.from_quat(np.roll(quaternions[0], -1)).as_matrix()
    sphere, _ = unit_sphere()
    points = (sphere * half_axes[0]) @ R_world_axes.T
    # by small motions exp(xi) of the camera: the position moves by R t
    R = T[:3, :3]
    world = R @ covariance[3:, 3:] @ R.T
    distances = np.einsum("ni,ni->n", points, np.linalg.solve(world, points.T).T)
    np.testing.assert_allclose(np.sqrt(distances), 3.0, rtol=1e-6)


def test_sigmas_are_those_of_drawn_poses() -> None:
    T, covariance = pose_and_covariance(4)
    covariance *= 1e-4
    xi = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, size=20_000)
    drawn = (T @ se3.exp(xi))[:, :3, 3].std(axis=0)
    np.testing.assert_allclose(position_sigmas(T, covariance), drawn, rtol=0.05)


def test_the_sphere_is_closed_and_faces_outwards() -> None:
    corners, faces = unit_sphere()
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 1.0)
    a, b, c = corners[faces].transpose(1, 0, 2)
    volume = np.sum(np.einsum("ni,ni->n", a, np.cross(b, c))) / 6.0
    assert 0.9 * 4 / 3 * np.pi < volume < 4 / 3 * np.pi
