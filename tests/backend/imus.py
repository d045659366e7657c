"""An IMU and a camera carried along sines, whose rates and accelerations are known by formula."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.backend.inertial import InertialEstimator
from gvo.geometry.imu import Imu, ImuSamples
from gvo.types import Edge, FloatArray, IntArray

START_NS = 1_403_636_584_763_555_584
"""The stamp at zero seconds: as large as they are, so that a float would not hold it."""
UP = np.array([0.0, 0.0, 9.81])
FRAMES_HZ, SAMPLES_HZ = 20, 200
EXACT = Imu(T_camera_imu=np.eye(4), delay_s=0.0)
ADIS16448 = {
    "gyro_noise": 1.6968e-4,
    "gyro_walk": 1.9393e-5,
    "acceleration_noise": 2e-3,
    "acceleration_walk": 3e-3,
}
CHEAP = {
    "gyro_noise": 1e-3,
    "gyro_walk": 1e-4,
    "acceleration_noise": 1e-2,
    "acceleration_walk": 5e-3,
}


def ns(time_s: float) -> int:
    return START_NS + round(1e9 * time_s)


def transform(turn: Any, shift: Any) -> FloatArray:
    """Return the transform of a rotation vector and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return T


def errors_of(T: FloatArray, T_true: FloatArray) -> tuple[float, float]:
    """Return how far a pose is from the true one, metres and degrees."""
    R = Rotation.from_matrix(T[:3, :3].T @ T_true[:3, :3])
    return float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), float(np.degrees(R.magnitude()))


def adjoint(T: Any) -> FloatArray:
    """Return what takes twists (turn, shift) behind a transform to before it."""
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[R, np.zeros((3, 3))], [cross @ R, R]])


@dataclass(frozen=True, kw_only=True)
class Hand:
    """Yaw, pitch, roll (rad) and position (m, z up): of each an amplitude, a rate (Hz), a phase.

    It may come to rest within a second and be still for a while.
    """

    angles: FloatArray
    shifts: FloatArray
    rest_s: tuple[float, float] | None = None

    def _phase(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the time by which it moves, with two derivatives: it passes slower, then not."""
        if self.rest_s is None:
            return times_s, np.ones_like(times_s), np.zeros_like(times_s)
        start_s, end_s = self.rest_s
        out = np.clip(times_s - start_s + 1.0, 0.0, 1.0)
        back = np.clip(times_s - end_s, 0.0, 1.0)
        rate = 0.5 * (1.0 + np.cos(np.pi * out)) + 0.5 * (1.0 - np.cos(np.pi * back))
        change = 0.5 * np.pi * (np.sin(np.pi * back) - np.sin(np.pi * out))
        passed_s = np.minimum(times_s, start_s - 1.0) + np.maximum(times_s - end_s - 1.0, 0.0)
        passed_s += 0.5 * (out + np.sin(np.pi * out) / np.pi)
        passed_s += 0.5 * (back - np.sin(np.pi * back) / np.pi)
        return passed_s, rate, change

    def _waves(self, rows: FloatArray, times_s: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values (n, 3) with two derivatives."""
        phase, rate, change = (each[..., np.newaxis] for each in self._phase(np.asarray(times_s)))
        size, w = rows[:, 0], 2.0 * np.pi * rows[:, 1]
        sine, cosine = np.sin(w * phase + rows[:, 2]), np.cos(w * phase + rows[:, 2])
        first, second = size * w * cosine, -size * w * w * sine
        return size * sine, first * rate, second * rate**2 + first * change

    def imu_pose(self, time_s: float) -> FloatArray:
        T = np.eye(4)
        T[:3, :3] = self.rotations(time_s).as_matrix()
        T[:3, 3] = self._waves(self.shifts, time_s)[0]
        return T

    def rotations(self, times_s: Any) -> Rotation:
        return Rotation.from_euler("ZYX", self._waves(self.angles, times_s)[0])

    def velocity(self, time_s: float) -> FloatArray:
        return self._waves(self.shifts, time_s)[1]

    def gyro(self, times_s: Any) -> FloatArray:
        (_, pitch, roll), rates, _ = (
            np.moveaxis(each, -1, 0) for each in self._waves(self.angles, times_s)
        )
        yaw_rate, pitch_rate, roll_rate = rates
        return np.stack(
            [
                roll_rate - yaw_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
                yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll),
            ],
            axis=-1,
        )

    def force(self, times_s: Any) -> FloatArray:
        acceleration = self._waves(self.shifts, times_s)[2]
        return np.asarray(self.rotations(times_s).inv().apply(acceleration + UP))


HAND = Hand(
    angles=np.array([[0.45, 0.3, 0.4], [0.25, 0.23, 1.0], [0.25, 0.31, 2.2]]),
    shifts=np.array([[0.4, 0.27, 0.0], [0.3, 0.35, 1.3], [0.15, 0.5, 2.1]]),
)
STILL = Hand(angles=0.0 * HAND.angles, shifts=0.0 * HAND.shifts)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """How an IMU measures: its biases and densities, its delay, and what is missing."""

    gyro_bias: Any = 0.0
    acceleration_bias: Any = 0.0
    densities: dict[str, float] | None = None
    delay_s: float = 0.0
    share_missing: float = 0.0
    hole_s: tuple[float, float] = (0.0, 0.0)
    gyro_unit: float = 1.0
    rate_hz: float = SAMPLES_HZ
    seed: int = 0

    def measure(self, hand: Hand, end_s: float, start_s: float = -0.2) -> ImuSamples:
        times_s = np.arange(start_s, end_s, 1.0 / self.rate_hz)
        rng, shape = np.random.default_rng(self.seed), (len(times_s), 3)
        gyro = self.gyro_unit * hand.gyro(times_s) + self.gyro_bias
        force = hand.force(times_s) + self.acceleration_bias
        if self.densities is not None:
            each = self.densities
            gyro += _noise(rng, shape, each["gyro_noise"], each["gyro_walk"])
            force += _noise(rng, shape, each["acceleration_noise"], each["acceleration_walk"])
        is_there = rng.random(len(times_s)) >= self.share_missing
        is_there &= (times_s < self.hole_s[0]) | (times_s >= self.hole_s[1])
        stamps_ns = START_NS + np.round(1e9 * (times_s - self.delay_s)).astype(np.int64)
        return ImuSamples.of(stamps_ns[is_there], gyro[is_there], force[is_there])


def _noise(rng: np.random.Generator, shape: Any, white: float, walk: float) -> FloatArray:
    steps = rng.normal(0.0, walk / np.sqrt(SAMPLES_HZ), shape)
    noise = rng.normal(0.0, white * np.sqrt(SAMPLES_HZ), shape)
    return np.asarray(noise + np.cumsum(steps, axis=0))


class Ride:
    """Samples and frames in turn, as a run gives them to an estimator.

    A step of the camera is exact where no sigmas (rad, m) are given.
    """

    def __init__(
        self,
        estimator: InertialEstimator,
        hand: Hand = HAND,
        sensor: Sensor | None = None,
        *,
        T_camera_imu: FloatArray | None = None,
        sigmas: tuple[float, float] | None = None,
        seed: int = 0,
        length_s: float = 20.0,
    ) -> None:
        self.estimator, self.hand = estimator, hand
        self._T_imu_camera = np.linalg.inv(np.eye(4) if T_camera_imu is None else T_camera_imu)
        self._rng = np.random.default_rng([seed, 1])
        self._is_exact = sigmas is None
        self._sigmas = np.repeat(sigmas or (1e-5, 1e-4), 3)
        self._samples = (sensor or Sensor()).measure(hand, length_s)
        self._n_fed = 0
        self.frame = -1

    @property
    def time_s(self) -> float:
        return self.frame / FRAMES_HZ

    @property
    def newest_ns(self) -> int:
        return ns(self.time_s)

    def camera_pose(self, time_s: float) -> FloatArray:
        return self.hand.imu_pose(time_s) @ self._T_imu_camera

    def true_step(self, start_s: float, end_s: float) -> FloatArray:
        return np.linalg.inv(self.camera_pose(start_s)) @ self.camera_pose(end_s)

    def step_to(self, time_s: float, *, since_s: float, wrong: FloatArray | None = None) -> Edge:
        """Return what the camera measures, or something else behind it."""
        T = self.true_step(since_s, time_s) @ (np.eye(4) if wrong is None else wrong)
        if not self._is_exact:
            noise = self._sigmas * self._rng.normal(size=6)
            T = T @ transform(noise[:3], noise[3:])
        return Edge(
            reference_id=ns(since_s), T_reference_frame=T, covariance=np.diag(self._sigmas**2)
        )

    def feed(self, until_s: float) -> None:
        """Add the samples up to a time, and those of 0.2 s more."""
        n = int(np.searchsorted(self._samples.stamps_ns, ns(until_s + 0.2)))
        part = slice(self._n_fed, n)
        self._n_fed = max(n, self._n_fed)
        samples = self._samples
        self.estimator.add(
            ImuSamples.of(
                samples.stamps_ns[part],
                samples.gyro[part].reshape(-1, 3),
                samples.acceleration[part].reshape(-1, 3),
            )
        )

    def go(
        self, until_s: float, *, is_seen: bool = True, wrong: FloatArray | None = None
    ) -> Iterator[float]:
        """Take frames up to a time, and give the time of each."""
        while (self.frame + 1) / FRAMES_HZ <= until_s + 1e-9:
            before_s, self.frame = self.time_s, self.frame + 1
            self.feed(self.time_s)
            is_measured = is_seen and self.frame > 0
            step = self.step_to(self.time_s, since_s=before_s, wrong=wrong) if is_measured else None
            self.estimator.follow(self.newest_ns, step)
            yield self.time_s

    def ride(self, until_s: float, **options: Any) -> Ride:
        for _ in self.go(until_s, **options):
            pass
        return self

    def carry(self, span_s: float) -> Edge | None:
        """Return where it says that the camera goes from the newest frame on."""
        end_s = self.time_s + span_s
        self.feed(end_s)
        return self.estimator.carry(self.newest_ns, ns(end_s))

    def carried(self, span_s: float) -> tuple[float, float]:
        """Return the errors of that, metres and degrees."""
        edge = self.carry(span_s)
        assert edge is not None
        return errors_of(edge.T_reference_frame, self.true_step(self.time_s, self.time_s + span_s))


def stamps_of(n: int, *, every_s: float = 1.0 / FRAMES_HZ) -> IntArray:
    return np.array([ns(k * every_s) for k in range(n)], dtype=np.int64)
