"""Gravity, velocity and the bias of the gyro, from frames that are registered one after the other.

References
----------
R. Mur-Artal, J. D. Tardos, "Visual-inertial monocular SLAM with map reuse", IEEE RA-L 2(2), 2017,
doi:10.1109/LRA.2017.2653359 (section IV, without the scale, which is known here).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gvo.backend.imu_motion import Front, Motion, Preintegrator
from gvo.geometry import se3
from gvo.geometry.imu import GRAVITY
from gvo.types import Edge, Failure, FloatArray

# Lengths of gravity, m/s^2: with others, samples are not what they seem.
_LEAST_GRAVITY, _MOST_GRAVITY = 8.5, 11.5
# Sigmas of positions and velocities by the frames, m and m/s: only their ratio matters.
_POSITION, _VELOCITY = 0.002, 0.01
# Of what is found: of velocity (m/s), biases of gyro and accelerometer (rad/s, m/s^2), and of the
# direction of gravity (rad).
_SIGMAS, _TILT = np.repeat([1.0, 0.05, 0.3], 3), 0.1


def find_start(
    stamps_ns: Sequence[int], steps: Sequence[Edge], integrate: Preintegrator
) -> Front | Failure:
    """Find where the first frame is by linear least squares, moving or not.

    Parameters
    ----------
    stamps_ns : sequence of int
        Of n + 1 frames.
    steps : sequence of Edge
        From each frame to the next, of the IMU.
    integrate : Preintegrator
    """
    biases = np.zeros(6)
    motions = [integrate.between(*span, biases) for span in pairwise(stamps_ns)]
    turned, length_s = np.zeros(3), 1e-9 * (stamps_ns[-1] - stamps_ns[0])
    for motion, step in zip(motions, steps, strict=True):
        if motion is None:
            return Failure(reason="it has no samples at some frames: a hole, or another clock")
        turned += se3.log(se3.invert(step.T_reference_frame) @ motion.T_start_end)[:3]
    biases[:3] = turned / length_s
    motions = [integrate.between(*span, biases) for span in pairwise(stamps_ns)]
    T = [np.eye(4)]
    for step in steps:
        T.append(T[-1] @ step.T_reference_frame)
    velocity, gravity = _solve(np.array(T), [motion for motion in motions if motion is not None])
    if not _LEAST_GRAVITY < (length := float(np.linalg.norm(gravity))) < _MOST_GRAVITY:
        return Failure(reason=f"the accelerometer feels a gravity of {length:.2f} m/s^2")
    covariance, down = np.zeros((18, 18)), gravity / length
    covariance[6:15, 6:15] = np.diag(_SIGMAS**2)
    covariance[15:, 15:] = (GRAVITY * _TILT) ** 2 * (np.eye(3) - np.outer(down, down))
    return Front(
        stamp_ns=stamps_ns[0],
        T_world_imu=np.eye(4),
        velocity=velocity,
        biases=biases,
        gravity=GRAVITY * down,
        covariance=covariance,
    )


def _solve(T_world_imu: FloatArray, motions: Sequence[Motion]) -> tuple[FloatArray, FloatArray]:
    """Return the first velocity and gravity; the velocities of all frames are unknown.

    Least squares of p' - p = v t + g t^2 / 2 + R dp and v' - v = g t + R dv.
    """
    n, unit = len(motions), np.eye(3)
    A, b = np.zeros((n, 2, 3, n + 2, 3)), np.zeros((n, 2, 3))
    for k, motion in enumerate(motions):
        t, R = motion.length_s, T_world_imu[k, :3, :3]
        A[k, 0, :, k], A[k, 0, :, -1] = t * unit, 0.5 * t * t * unit
        A[k, 1, :, k], A[k, 1, :, k + 1], A[k, 1, :, -1] = -unit, unit, -t * unit
        b[k, 0] = T_world_imu[k + 1, :3, 3] - T_world_imu[k, :3, 3] - R @ motion.T_start_end[:3, 3]
        b[k, 1] = R @ motion.velocity
    A[:, 0], b[:, 0] = A[:, 0] / _POSITION, b[:, 0] / _POSITION
    A[:, 1], b[:, 1] = A[:, 1] / _VELOCITY, b[:, 1] / _VELOCITY
    solution = np.linalg.lstsq(A.reshape(6 * n, -1), b.ravel(), rcond=None)[0].reshape(-1, 3)
    return solution[0], solution[-1]
