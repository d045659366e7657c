"""Where an IMU says that it has moved to, and how sure that is.

References
----------
C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, "On-manifold preintegration for real-time
visual-inertial odometry", IEEE T-RO 33(1), 2017, doi:10.1109/TRO.2016.2597321.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import gtsam
import numpy as np

from gvo.backend.imu_buffer import ImuBuffer
from gvo.geometry import se3
from gvo.geometry.imu import Imu
from gvo.types import FloatArray

Motion: TypeAlias = gtsam.PreintegratedCombinedMeasurements
Bias: TypeAlias = gtsam.imuBias.ConstantBias

# Data sheets speak of an IMU that lies still: in use its noise is so many times larger.
_INFLATION = 3.0
# Longer intervals are linearized in pieces, nanoseconds.
_LONGEST_NS = 200_000_000
# The angular velocity at a frame is the mean over so long around it, nanoseconds.
_NOW_NS = 5_000_000
# What the IMU feels at rest, beside so many sigmas of its noise: m/s^2 and rad/s.
_STILL_ACCELERATION, _STILL_TURN, _STILL_SIGMAS = 0.05, 0.02, 5.0
# Eigenvalues of the covariance of a step, relative to the largest, and that relative to the way's.
_LEAST_SHARE = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Front:
    """Where the IMU is at a frame, by what is known at the newest measured one.

    `motion` is what the IMU measured since `since_ns`. `covariance` (17, 17) is that of (rotation
    in its own axes, position, velocity, biases of acceleration and gyro, gravity along
    `gravity_axes`), as seen from the newest measured one.
    """

    stamp_ns: int
    navigation: gtsam.NavState
    covariance: FloatArray
    bias: Bias
    gravity: FloatArray
    gravity_axes: FloatArray
    motion: Motion | None = None
    since_ns: int = 0
    is_resting: bool = False

    @property
    def R_world_imu(self) -> FloatArray:  # noqa: N802 - the field's name
        """Rotation (3, 3)."""
        return np.asarray(self.navigation.attitude().matrix())

    @property
    def T_world_imu(self) -> FloatArray:  # noqa: N802 - the field's name
        """Pose (4, 4)."""
        return np.asarray(self.navigation.pose().matrix())

    @property
    def up(self) -> tuple[FloatArray, float]:
        """The unit vector (3,) against gravity in the axes of the IMU, and its sigma, rad."""
        R, length = self.R_world_imu.T, float(np.linalg.norm(self.gravity))
        up = -R @ self.gravity / length
        J = np.zeros((3, 17))
        J[:, :3], J[:, 15:] = se3.skew(up), -R @ self.gravity_axes / length
        return up, float(np.sqrt((J @ self.covariance @ J.T).diagonal().max()))

    @property
    def speed(self) -> tuple[float, float]:
        """The length of the velocity, m/s, and the sigma of its least certain axis."""
        length = float(np.linalg.norm(self.navigation.velocity()))
        return length, float(np.sqrt(self.covariance.diagonal()[6:9].max()))

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the pose, right perturbation."""
        J = np.eye(6)
        J[3:, 3:] = self.R_world_imu.T
        return np.asarray(J @ self.covariance[:6, :6] @ J.T)


class Preintegrator:
    """Integrates samples between frames."""

    def __init__(self, imu: Imu, buffer: ImuBuffer) -> None:
        self._buffer, self._imu = buffer, imu
        # Gravity is added where it is known.
        self._parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(0.0)
        unit = np.eye(3)
        self._parameters.setGyroscopeCovariance((_INFLATION * imu.gyro_noise) ** 2 * unit)
        noise = _INFLATION * imu.acceleration_noise
        self._parameters.setAccelerometerCovariance(noise**2 * unit)
        self._parameters.setBiasOmegaCovariance(imu.gyro_walk**2 * unit)
        self._parameters.setBiasAccCovariance(imu.acceleration_walk**2 * unit)
        self._parameters.setIntegrationCovariance(1e-8 * unit)

    def between(self, start_ns: int, end_ns: int, bias: Bias) -> Motion | None:
        """Return what was measured between two stamps; None if a hole is in it."""
        pieces = self._buffer.between(start_ns, end_ns)
        if pieces is None:
            return None
        durations_s, rates, accelerations = pieces
        # GTSAM turns an acceleration as at the start of its interval: it is meant in the middle.
        halves = 0.5 * durations_s[:, np.newaxis] * (rates - bias.gyroscope())
        turned = (se3.skew(halves) @ accelerations[..., np.newaxis])[..., 0]
        accelerations = accelerations + turned
        motion = Motion(self._parameters, bias)
        for acceleration, rate, duration_s in zip(accelerations, rates, durations_s, strict=True):
            motion.integrateMeasurement(acceleration, rate, duration_s)
        return motion

    def twist(self, front: Front) -> tuple[FloatArray, FloatArray] | None:
        """Return angular velocity and velocity (6,) at a front in the axes of the IMU.

        And their covariance (6, 6). None if no sample is near.
        """
        rate = self._buffer.mean_rate(front.stamp_ns - _NOW_NS // 2, front.stamp_ns + _NOW_NS // 2)
        if rate is None:
            return None
        R, J = front.R_world_imu.T, np.zeros((6, 17))
        velocity = R @ front.navigation.velocity()
        J[:3, 12:15], J[3:, :3], J[3:, 6:9] = -np.eye(3), se3.skew(velocity), R
        covariance = J @ front.covariance @ J.T
        covariance[:3, :3] += 1e9 / _NOW_NS * self._parameters.getGyroscopeCovariance()
        return np.concatenate([rate - front.bias.gyroscope(), velocity]), covariance

    def advance(self, front: Front, stamp_ns: int) -> Front | None:
        """Return the front at a later stamp; None if a hole comes before it."""
        start_ns, length_ns = front.stamp_ns, stamp_ns - front.stamp_ns
        n_steps = max(-(-length_ns // _LONGEST_NS), 1)
        for each_ns in [start_ns + k * length_ns // n_steps for k in range(1, n_steps + 1)]:
            motion = self.between(front.stamp_ns, each_ns, front.bias)
            if motion is None:
                return None
            is_resting = front.is_resting and self.is_still(front, motion)
            front = _moved(front, each_ns, motion, is_resting=is_resting)
        return front

    def is_still(self, front: Front, motion: Motion) -> bool:
        """Tell whether the IMU felt nothing but gravity."""
        t, imu = motion.deltaTij(), self._imu
        acceleration = front.R_world_imu @ motion.deltaVij() / t + front.gravity
        turn, n_sigmas = se3.rotation_angle(rotation_of(motion)) / t, _STILL_SIGMAS / np.sqrt(t)
        most = _STILL_ACCELERATION + n_sigmas * imu.acceleration_noise
        is_still = np.linalg.norm(acceleration) < most
        return bool(is_still and turn < _STILL_TURN + n_sigmas * imu.gyro_noise)


def _moved(front: Front, stamp_ns: int, motion: Motion, *, is_resting: bool) -> Front:
    """Return a front moved on by what the IMU measured (Forster 2017, section VI)."""
    t, g = motion.deltaTij(), front.gravity
    predicted = motion.predict(front.navigation, front.bias)
    F, Q = _linearize(front, motion)
    if is_resting:
        F[3:9, :3] = F[3:9, 9:] = 0.0
        Q[3:9] = Q[:, 3:9] = 0.0
        position, velocity = front.navigation.position(), np.zeros(3)
    else:
        position = predicted.position() + 0.5 * t * t * g
        velocity = predicted.velocity() + t * g
    return replace(
        front,
        stamp_ns=stamp_ns,
        navigation=gtsam.NavState(gtsam.Pose3(predicted.attitude(), position), velocity),
        covariance=F @ front.covariance @ F.T + Q,
        motion=motion,
        since_ns=front.stamp_ns,
        is_resting=is_resting,
    )


def rotation_of(motion: Motion) -> FloatArray:
    """Return the rotation (3, 3) of a motion."""
    return np.asarray(motion.deltaRij().matrix())


def _linearize(front: Front, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Return how errors before an interval act after it, and the covariance it adds, (17, 17)."""
    t, R = motion.deltaTij(), front.R_world_imu
    F, axes = np.eye(17), np.eye(17)
    axes[3:6, 3:6] = axes[6:9, 6:9] = R
    axes[9:15, 9:15] = -np.eye(6)  # GTSAM counts biases by how much they fall
    F[:3, :3] = rotation_of(motion).T
    F[3:6, :3] = -R @ se3.skew(motion.deltaPij())
    F[6:9, :3] = -R @ se3.skew(motion.deltaVij())
    F[3:6, 6:9] = t * np.eye(3)
    F[3:6, 15:] = 0.5 * t * t * front.gravity_axes
    F[6:9, 15:] = t * front.gravity_axes
    F[:9, 9:15] = axes[:9, :9] @ _bias_effects(motion)
    Q = np.zeros((17, 17))
    Q[:15, :15] = motion.preintMeasCov()
    return F, axes @ Q @ axes.T


def _bias_effects(motion: Motion) -> FloatArray:
    """Return derivatives (9, 6) of rotation (right), position and velocity by both biases.

    Of a short interval, during which acceleration and rate hardly change.
    """
    t, effects = motion.deltaTij(), np.zeros((9, 6))
    halfway = 0.5 * (np.eye(3) + rotation_of(motion))
    turned = se3.skew(motion.deltaVij() / t)
    effects[:3, 3:] = -t * np.eye(3)
    effects[3:6, :3], effects[3:6, 3:] = -0.5 * t**2 * halfway, t**3 / 6.0 * turned
    effects[6:, :3], effects[6:, 3:] = -t * halfway, 0.5 * t**2 * turned
    return effects


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
