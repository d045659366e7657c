"""An IMU: where it sits, how noisy it is, and what it measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gvo.config import ImuConfig
from gvo.geometry import se3
from gvo.types import BoolArray, FloatArray, IntArray

# Sound stamps do not go back so far, nanoseconds.
_FAR_NS = 10_000_000_000

LARGEST_DENSITY = 10.0
"""Of noise and random walk, in SI units."""

MAX_SHIFT_S = 60.0
"""Stamps of an IMU that are given as later by more are of another clock, seconds."""

HOLE_S = 0.1
"""Longer without samples, what an IMU measured is lost, seconds."""

GRAVITY = 9.81
"""What every accelerometer at rest measures, m/s^2; on Earth within 0.03."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Imu:
    """What is known of an IMU; the defaults are those of a cheap one.

    Parameters
    ----------
    T_camera_imu : ndarray of float64, shape (4, 4), optional
        Maps coordinates of the IMU to the rectified left or colour camera, metres. None: its
        rotation is learnt, and the IMU is taken to sit in the camera.
    delay_s : float, optional
        What is added to stamps of the IMU to get those of images taken at the same time, seconds.
        None: it is learnt.
    gyro_noise, acceleration_noise : float
        Densities of white noise, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    gyro_walk, acceleration_walk : float
        Of the random walk of the biases, rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz).

    Raises
    ------
    ValueError
        Where the transform is none, a density is not positive or above 10, or the delay is longer
        than a minute.
    """

    T_camera_imu: FloatArray | None = None
    delay_s: float | None = None
    gyro_noise: float = 3e-4
    gyro_walk: float = 3e-5
    acceleration_noise: float = 3e-3
    acceleration_walk: float = 3e-3

    def __post_init__(self) -> None:
        """Check the values."""
        if self.T_camera_imu is not None:
            T = np.array(self.T_camera_imu, dtype=np.float64)
            if fault := se3.transform_fault(T):
                raise ValueError(f"T_camera_imu {fault}")
            T.setflags(write=False)
            object.__setattr__(self, "T_camera_imu", T)
        for name in ("gyro_noise", "gyro_walk", "acceleration_noise", "acceleration_walk"):
            if not 0.0 < getattr(self, name) <= LARGEST_DENSITY:
                most = f"positive and at most {LARGEST_DENSITY:g}"
                raise ValueError(f"{name} must be {most}, got {getattr(self, name)}")
        if self.delay_s is not None and not abs(self.delay_s) <= MAX_SHIFT_S:
            raise ValueError(f"delay_s must be within {MAX_SHIFT_S:g}, got {self.delay_s}")

    def with_settings(self, config: ImuConfig) -> Imu:
        """Return the IMU with what is configured of it."""
        names = "gyro_noise", "gyro_walk", "acceleration_noise", "acceleration_walk"
        given = {name: getattr(config, name) for name in names}
        given["delay_s"] = None if config.delay_ms is None else 1e-3 * config.delay_ms
        return replace(self, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSamples:
    """What an IMU measured, in its own axes.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        By the clock of the IMU, nanoseconds.
    gyro : ndarray of float64, shape (n, 3)
        Angular velocity, rad/s.
    acceleration : ndarray of float64, shape (n, 3)
        Specific force, m/s^2: at rest 9.81 upwards.

    Raises
    ------
    ValueError
        Where the shapes do not fit.
    """

    stamps_ns: IntArray
    gyro: FloatArray
    acceleration: FloatArray

    def __post_init__(self) -> None:
        """Check the shapes."""
        n = len(self.stamps_ns)
        if self.stamps_ns.shape != (n,) or self.stamps_ns.dtype != np.int64:
            raise ValueError("stamps_ns must be a row of int64")
        for name in ("gyro", "acceleration"):
            if (shape := getattr(self, name).shape) != (n, 3):
                raise ValueError(f"{name} must have shape ({n}, 3) as its stamps, got {shape}")

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamps_ns)

    @classmethod
    def of(cls, stamps_ns: ArrayLike, gyro: ArrayLike, acceleration: ArrayLike) -> ImuSamples:
        """Return samples of anything that becomes such arrays.

        Raises
        ------
        ValueError
            Where stamps are no whole numbers, as seconds are, or the shapes do not fit.
        """
        stamps = np.atleast_1d(np.asarray(stamps_ns))
        if len(stamps) > 0 and stamps.dtype.kind not in "iu":
            raise ValueError(f"stamps_ns must be whole nanoseconds, got {stamps.dtype}")
        vectors = [np.atleast_2d(np.asarray(each, float)) for each in (gyro, acceleration)]
        vectors = [each if each.size else np.zeros((0, 3)) for each in vectors]
        return cls(stamps_ns=stamps.astype(np.int64), gyro=vectors[0], acceleration=vectors[1])


def are_in_order(stamps_ns: IntArray) -> BoolArray:
    """Tell which stamps (n,) are later than all before, but for damaged ones in the far future.

    Such a stamp is known by the next one, which is far before it and after the one before it.
    """
    if (stamps_ns[1:] > stamps_ns[:-1]).all():
        return np.ones(len(stamps_ns), dtype=np.bool_)
    ends = np.iinfo(np.int64)
    before = np.concatenate([[ends.min], stamps_ns])[:-1]
    after = np.concatenate([stamps_ns, [ends.max]])[1:]
    is_damaged = (before < after) & (after < stamps_ns - _FAR_NS)
    latest = np.maximum.accumulate(np.where(is_damaged, ends.min, stamps_ns))
    is_later = latest > np.concatenate([[ends.min], latest])[:-1]
    return np.asarray(is_later & ~is_damaged)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuStream:
    """The IMU of a recording.

    Parameters
    ----------
    name : str
        Topic or folder.
    imu : Imu
    samples : callable
        Yields its samples in the order of the recording, some at a time; those before a stamp, in
        nanoseconds by the clock of the IMU, may be left out. Raises `RecordingError` where they
        cannot be read on.
    """

    name: str
    imu: Imu
    samples: Callable[[int], Iterator[ImuSamples]]
