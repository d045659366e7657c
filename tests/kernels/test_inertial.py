"""What an IMU measured, added up by the formula of the docstring."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.kernels.inertial import preintegrate


@pytest.mark.parametrize("n", [0, 1, 20])
def test_measured_motions_are_added_up(n: int) -> None:
    rng = np.random.default_rng(n)
    durations_s, values = rng.uniform(0.0, 0.02, n), rng.normal(0.0, 3.0, (n, 6))
    R, velocity = Rotation.from_rotvec([0.3, -2.0, 1.0]), np.array([0.5, -1.0, 2.0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), [1.0, 2.0, 3.0]
    found, position = velocity.copy(), T[:3, 3].copy()
    for t, w, a in zip(durations_s, values[:, :3], values[:, 3:], strict=True):
        faster = velocity + t * (R * Rotation.from_rotvec(0.5 * t * w)).apply(a)
        position, velocity = position + 0.5 * t * (velocity + faster), faster
        R = R * Rotation.from_rotvec(t * w)
    preintegrate(durations_s, values, T, found)
    np.testing.assert_allclose(found, velocity, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], position, rtol=1e-12)
    np.testing.assert_allclose(T[:3, :3], R.as_matrix(), rtol=1e-9, atol=1e-9)
