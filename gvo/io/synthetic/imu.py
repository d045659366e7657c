"""An IMU that moves along with a rendered camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal, get_args

import numpy as np

from gvo.geometry import se3
from gvo.geometry.imu import GRAVITY, Imu, ImuSamples
from gvo.types import FloatArray

ImuKind = Literal["adis16448", "cheap"]

# Seconds by which positions are shifted for their derivatives.
_STEP_S = 1e-3
# Samples before the first and after the last image, seconds.
_BESIDE_S = 0.1
_N_AT_ONCE = 200
_T_CAMERA_IMU: Final = se3.exp(np.array([1.2, -1.1, 1.3, 0.06, -0.02, 0.05]))
_ADIS16448: Final = Imu(
    T_camera_imu=_T_CAMERA_IMU,
    delay_s=0.0,
    gyro_noise=1.6968e-4,
    gyro_walk=1.9393e-5,
    acceleration_noise=2e-3,
    acceleration_walk=3e-3,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedImu:
    """What a rendered IMU is, and how wrong it measures.

    Parameters
    ----------
    imu : Imu
        What the recording says of it: its densities are true. Where `T_camera_imu` or `delay_s` is
        None, the recording does not tell.
    T_camera_imu : ndarray of float64, shape (4, 4)
        Where it is: maps its coordinates to those of the camera, metres.
    delay_s : float
        What must be added to its stamps, seconds.
    rate_hz : float
        Samples per second.
    gyro_bias, acceleration_bias : float
        Standard deviations of the first biases, rad/s and m/s^2.
    scale, misalignment : float
        Standard deviations of the scale of each axis, and of the turn of both triads in radians.
    share_missing : float
        Of the samples, at random.
    """

    imu: Imu
    T_camera_imu: FloatArray = field(default_factory=_T_CAMERA_IMU.copy)
    delay_s: float = 0.0
    rate_hz: float = 200.0
    gyro_bias: float = 0.05
    acceleration_bias: float = 0.1
    scale: float = 0.0
    misalignment: float = 0.0
    share_missing: float = 0.0

    def samples(
        self, move: Callable[[FloatArray], FloatArray], start_ns: int, length_s: float, seed: int
    ) -> Iterator[ImuSamples]:
        """Yield what it measures along a motion.

        Parameters
        ----------
        move : callable
            Seconds since the start, shape (n,), to T_map_cam, shape (n, 4, 4), with z up.
        start_ns : int
            Stamp of the first image.
        length_s : float
            Time to the last image, seconds.
        seed : int
            Of noise and biases.
        """
        period_s, rng = 1.0 / self.rate_hz, np.random.default_rng([seed, 31])
        times_s = np.arange(-_BESIDE_S, length_s + _BESIDE_S + self.delay_s, period_s)
        gyro, acceleration = self._true(move, times_s)
        known = self.imu
        gyro = self._spoilt(gyro, known.gyro_noise, known.gyro_walk, self.gyro_bias, rng)
        walk = known.acceleration_walk, self.acceleration_bias
        acceleration = self._spoilt(acceleration, known.acceleration_noise, *walk, rng)
        stamps_ns = start_ns + np.round(1e9 * (times_s - self.delay_s)).astype(np.int64)
        is_there = rng.random(len(times_s)) >= self.share_missing
        for start in range(0, len(times_s), _N_AT_ONCE):
            part = np.flatnonzero(is_there[start : start + _N_AT_ONCE]) + start
            yield ImuSamples(
                stamps_ns=stamps_ns[part], gyro=gyro[part], acceleration=acceleration[part]
            )

    def _true(
        self, move: Callable[[FloatArray], FloatArray], times_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return angular velocity and specific force (n, 3) in the axes of the IMU."""
        before, now, after = (
            move(times_s + step_s) @ self.T_camera_imu for step_s in (-_STEP_S, 0.0, _STEP_S)
        )
        position = [T[:, :3, 3] for T in (before, now, after)]
        acceleration = (position[0] - 2.0 * position[1] + position[2]) / _STEP_S**2
        force = acceleration + np.array([0.0, 0.0, GRAVITY])
        turn = se3.log(se3.invert(before) @ after)[:, :3] / (2.0 * _STEP_S)
        R_imu_map = np.swapaxes(now[:, :3, :3], 1, 2)
        return turn, (R_imu_map @ force[..., np.newaxis])[..., 0]

    def _spoilt(
        self,
        values: FloatArray,
        noise: float,
        walk: float,
        bias: float,
        rng: np.random.Generator,
    ) -> FloatArray:
        """Return measured values (n, 3) of true ones."""
        turn = np.concatenate([rng.normal(0.0, self.misalignment, 3), np.zeros(3)])
        M = se3.exp(turn)[:3, :3] * (1.0 + rng.normal(0.0, self.scale, 3))
        white = rng.normal(0.0, noise * np.sqrt(self.rate_hz), values.shape)
        steps = rng.normal(0.0, walk / np.sqrt(self.rate_hz), values.shape)
        drift = rng.normal(0.0, bias, 3) + np.cumsum(steps, axis=0)
        return np.asarray(values @ M.T + drift + white)


def rendered_imu(kind: ImuKind = "adis16448") -> RenderedImu:
    """Return an IMU of one of the usual kinds; the recording tells its place and delay.

    Parameters
    ----------
    kind : {"adis16448", "cheap"}
        As on the drone of the EuRoC data set, or as in a telephone: scales wrong by 1 %, axes by
        half a degree, and noise five times as large.
    """
    if kind not in get_args(ImuKind):
        raise ValueError(f"kind must be one of {get_args(ImuKind)}, got {kind!r}")
    if kind == "adis16448":
        return RenderedImu(imu=_ADIS16448)
    known = replace(
        _ADIS16448, gyro_noise=1e-3, gyro_walk=1e-4, acceleration_noise=1e-2, acceleration_walk=5e-3
    )
    return RenderedImu(
        imu=known,
        gyro_bias=0.02,
        acceleration_bias=0.3,
        scale=0.01,
        misalignment=float(np.radians(0.5)),
    )
