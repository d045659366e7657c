"""Where an IMU says that it has moved to, and how sure that is.

References
----------
C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, "On-manifold preintegration for real-time
visual-inertial odometry", IEEE T-RO 33(1), 2017, doi:10.1109/TRO.2016.2597321; Z. Huai, G. Huang,
"Robocentric visual-inertial odometry", IJRR 41(7), 2022, doi:10.1177/0278364919853361 (states in
axes that move along).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple

import numpy as np

from gvo.backend.imu_buffer import ImuBuffer
from gvo.geometry import se3
from gvo.geometry.imu import GRAVITY, Imu
from gvo.types import Edge, FloatArray

# Data sheets speak of an IMU that lies still: in use its noise is so many times larger.
_INFLATION = 3.0
# Longer intervals are linearized in pieces, nanoseconds.
_LONGEST_NS = 100_000_000
# The angular velocity at a frame is the mean over so long around it, nanoseconds.
_NOW_NS = 5_000_000
# What the IMU feels at rest, beside so many sigmas of its noise: m/s^2 and rad/s.
_STILL_ACCELERATION, _STILL_TURN, _STILL_SIGMAS = 0.05, 0.02, 5.0
# Eigenvalues of the covariance of a step, relative to the largest, and that relative to the way's.
_LEAST_SHARE = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Front:
    """Where the IMU is at a frame, by what is known at the newest measured one.

    Parameters
    ----------
    stamp_ns : int
    T_world_imu : ndarray of float64, shape (4, 4)
        In its axes at the newest measured frame.
    velocity : ndarray of float64, shape (3,)
        In its own axes, m/s, as is what follows.
    biases : ndarray of float64, shape (6,)
        Of gyro and accelerometer, rad/s and m/s^2.
    gravity : ndarray of float64, shape (3,)
        m/s^2, downwards.
    covariance : ndarray of float64, shape (18, 18)
        Of the pose (right perturbation), and of the rest in this order.
    is_resting : bool
        The velocity is zero, as long as the IMU feels nothing but gravity.
    is_still : bool
        It felt nothing else on the last piece of the way.
    """

    stamp_ns: int
    T_world_imu: FloatArray
    velocity: FloatArray
    biases: FloatArray
    gravity: FloatArray
    covariance: FloatArray
    is_resting: bool = False
    is_still: bool = False

    @property
    def up(self) -> tuple[FloatArray, float]:
        """The unit vector (3,) against gravity, and its sigma, rad."""
        up = -self.gravity / GRAVITY
        J = se3.skew(up) / GRAVITY
        return up, float(np.sqrt((J @ self.covariance[15:, 15:] @ J.T).diagonal().max()))

    @property
    def speed(self) -> tuple[float, float]:
        """The length of the velocity, m/s, and the sigma of its least certain axis."""
        sigma = float(np.sqrt(self.covariance.diagonal()[6:9].max()))
        return float(np.linalg.norm(self.velocity)), sigma

    def measured(self, step: Edge | None) -> Front:
        """Return the front as the newest measured one: exact, as all is seen from there.

        By a step from the one before, a Kalman filter corrects the rest; without, it stays.
        """
        x, P = np.zeros(18), self.covariance
        if step is not None:
            K = np.linalg.solve(P[:6, :6] + step.covariance, P[:6]).T
            x = K @ se3.log(se3.invert(self.T_world_imu) @ step.T_reference_frame)
            kept = np.eye(18)
            kept[:, :6] -= K
            P = kept @ P @ kept.T + K @ step.covariance @ K.T
        gravity, covariance = self.gravity + x[15:], np.zeros((18, 18))
        covariance[6:, 6:] = P[6:, 6:]
        return replace(
            self,
            T_world_imu=np.eye(4),
            velocity=self.velocity + x[6:9],
            biases=self.biases + x[9:15],
            gravity=GRAVITY * gravity / np.linalg.norm(gravity),
            covariance=covariance,
        )


class Motion(NamedTuple):
    """What was measured during an interval, without gravity.

    Parameters
    ----------
    length_s : float
    T_start_end : ndarray of float64, shape (4, 4)
        Where the IMU is at its end, in the axes at its start, if it had stood there.
    velocity : ndarray of float64, shape (3,)
        How much faster it is then, in the axes at its start, m/s.
    """

    length_s: float
    T_start_end: FloatArray
    velocity: FloatArray


class Preintegrator:
    """Integrates samples between frames."""

    def __init__(self, imu: Imu, buffer: ImuBuffer) -> None:
        self._buffer, self._imu = buffer, imu
        noise = _INFLATION * np.array([imu.gyro_noise, imu.acceleration_noise])
        self._variances = np.repeat(noise**2, 3)
        self._walks = np.repeat([imu.gyro_walk**2, imu.acceleration_walk**2], 3)

    def between(self, start_ns: int, end_ns: int, biases: FloatArray) -> Motion | None:
        """Return what was measured between two stamps; None if a hole is in it."""
        from gvo.kernels.inertial import preintegrate  # loaded where frames are tracked alone

        pieces = self._buffer.between(start_ns, end_ns)
        if pieces is None:
            return None
        durations_s, values = pieces
        T, velocity = np.eye(4), np.zeros(3)
        preintegrate(durations_s, values - biases, T, velocity)
        return Motion(1e-9 * (end_ns - start_ns), T, velocity)

    def twist(self, front: Front) -> tuple[FloatArray, FloatArray] | None:
        """Return angular velocity and velocity (6,) at a front in the axes of the IMU.

        And their covariance (6, 6). None if no sample is near.
        """
        pieces = self._buffer.between(front.stamp_ns - _NOW_NS // 2, front.stamp_ns + _NOW_NS // 2)
        if pieces is None:
            return None
        rate = 1e9 / _NOW_NS * pieces[0] @ pieces[1][:, :3]
        order = [9, 10, 11, 6, 7, 8]
        covariance = front.covariance[np.ix_(order, order)]
        covariance[:3, 3:] *= -1.0  # a rate is what the bias leaves
        covariance[3:, :3] *= -1.0
        covariance[:3, :3] += 1e9 / _NOW_NS * np.diag(self._variances[:3])
        return np.concatenate([rate - front.biases[:3], front.velocity]), covariance

    def advance(self, front: Front, stamp_ns: int) -> Front | None:
        """Return the front at a later stamp; None if a hole comes before it."""
        start_ns, length_ns = front.stamp_ns, stamp_ns - front.stamp_ns
        n_steps = max(-(-length_ns // _LONGEST_NS), 1)
        for each_ns in [start_ns + k * length_ns // n_steps for k in range(1, n_steps + 1)]:
            motion = self.between(front.stamp_ns, each_ns, front.biases)
            if motion is None:
                return None
            front = self._moved(front, each_ns, motion)
        return front

    def _moved(self, front: Front, stamp_ns: int, motion: Motion) -> Front:
        """Return a front moved on by what the IMU measured."""
        is_still = self._is_still(front, motion)
        is_resting = front.is_resting and is_still
        t, step, velocity = motion.length_s, motion.T_start_end.copy(), np.zeros(3)
        if is_resting:
            step[:3, 3] = 0.0
        else:
            step[:3, 3] += t * front.velocity + 0.5 * t * t * front.gravity
            velocity = front.velocity + t * front.gravity + motion.velocity
        R_end_start = step[:3, :3].T
        velocity, gravity = R_end_start @ velocity, R_end_start @ front.gravity
        F = np.eye(18)
        F[:6, :6] = se3.adjoint(se3.invert(step))
        F[3:6, 6:9], F[6:9, 6:9], F[15:, 15:] = t * R_end_start, R_end_start, R_end_start
        # What the gyro and the accelerometer measure too much; axes of their own turn along.
        J = np.zeros((18, 6))
        turns = J[:, :3]
        turns[:3], turns[6:9], turns[15:] = np.eye(3), se3.skew(velocity), se3.skew(gravity)
        turns *= -t
        if not is_resting:
            F[3:6, 15:], F[6:9, 15:] = 0.5 * t * t * R_end_start, t * R_end_start
            # In a short interval both hardly change.
            turned = R_end_start @ se3.skew(motion.velocity)
            halfway = 0.5 * (R_end_start + np.eye(3))
            turns[3:6] += t * t / 6.0 * turned
            turns[6:9] += 0.5 * t * turned
            J[3:6, 3:], J[6:9, 3:] = -0.5 * t * t * halfway, -t * halfway
        F[:, 9:15] += J
        Q = (J * self._variances / t) @ J.T
        Q[range(9, 15), range(9, 15)] += t * self._walks
        return replace(
            front,
            stamp_ns=stamp_ns,
            T_world_imu=front.T_world_imu @ step,
            velocity=velocity,
            gravity=gravity,
            covariance=F @ front.covariance @ F.T + Q,
            is_resting=is_resting,
            is_still=is_still,
        )

    def _is_still(self, front: Front, motion: Motion) -> bool:
        """Tell whether the IMU felt nothing but gravity after a front."""
        t, imu = motion.length_s, self._imu
        n_sigmas = _STILL_SIGMAS / sqrt(t)
        felt = sqrt(np.sum((motion.velocity / t + front.gravity) ** 2))
        if felt > _STILL_ACCELERATION + n_sigmas * imu.acceleration_noise:
            return False
        turn = float(se3.rotation_angle(motion.T_start_end)) / t
        return turn < _STILL_TURN + n_sigmas * imu.gyro_noise


def step_covariance(before: FloatArray, T_step: FloatArray, after: FloatArray) -> FloatArray:
    """Return the covariance of a step with which those of the way before and after it add up.

    Parameters
    ----------
    before, after : ndarray of float64, shape (6, 6)
        Of the way to the start and to the end of the step, right perturbations.
    T_step : ndarray of float64, shape (4, 4)
        From its start to its end.

    Returns
    -------
    ndarray of float64, shape (6, 6)
        Positive definite: along what became more certain on the way, the step is nearly exact.
    """
    step = after - se3.transport_covariance(before, se3.invert(T_step))
    sigmas = np.sqrt(after.diagonal())
    scale = np.outer(sigmas, sigmas)
    eigenvalues, vectors = np.linalg.eigh(step / scale)
    least = _LEAST_SHARE * max(float(eigenvalues[-1]), _LEAST_SHARE)
    return np.asarray((vectors * np.maximum(eigenvalues, least)) @ vectors.T * scale)
