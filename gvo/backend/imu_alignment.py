"""How an IMU sits in the camera and how late it is, by its gyro and visual rotations.

References
----------
P. Furgale, J. Rehder, R. Siegwart, "Unified temporal and spatial calibration for multi-sensor
systems", IROS 2013, doi:10.1109/IROS.2013.6696514 (what is sought); W. Kabsch, "A solution for the
best rotation to relate two sets of vectors", Acta Cryst. A32, 1976,
doi:10.1107/S0567739476001873 (for a given delay).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from gvo.backend.imu_buffer import ImuBuffer
from gvo.geometry import se3
from gvo.geometry.edges import source_ns
from gvo.geometry.imu import Imu
from gvo.types import Edge, FloatArray, IntArray

MAX_DELAY_S = 0.1
"""Delays are sought between minus this and this."""

# Distance of the delays that are tried first, and by which the error's bend is found, seconds.
_GRID_S, _BEND_S = 0.005, 0.0025
# Steps are added up over so long, and so many of these sums tell at least.
_SPAN_NS, _FEWEST = 200_000_000, 8
# Slower turns are not compared, rad/s.
_LEAST_RATE = 0.02
# After how many more steps it is tried again, and the most that are kept for it.
_AGAIN, _MOST = 30, 900
# Steps that differ by more than so many times the median difference are wrong.
_OUTLIER = 3.0
# Sigmas from which on a rotation (rad) and a delay (s) are known. Errors of steps that follow each
# other are alike: their number counts for less.
_SURE_TURN, _SURE_DELAY_S = np.radians(1.0), 0.002
_ALIKE = 2.0
# Lengths of gyro over visual rates, beyond which one of them is something else.
_SCALES = 0.8, 1.25


class Turns(NamedTuple):
    """Rotations that vision saw: from stamps to stamps (n,), as rotation vectors (n, 3), rad."""

    start_ns: IntArray
    end_ns: IntArray
    turns: FloatArray

    @classmethod
    def of(cls, steps: Iterable[tuple[int, Edge]]) -> Turns:
        """Return those of steps, given with the stamps of their ends, in sums over 0.2 s.

        Of steps that follow each other, what is wrong with the frame between them cancels.
        """
        spans: list[list[int]] = []
        turns: list[FloatArray] = []
        for end_ns, step in steps:
            start_ns, turn = source_ns(step), se3.log(step.T_reference_frame)[:3]
            if spans and spans[-1][1] == start_ns and start_ns - spans[-1][0] < _SPAN_NS:
                spans[-1][1] = end_ns
                turns[-1] = turns[-1] + turn
            else:
                spans.append([start_ns, end_ns])
                turns.append(turn)
        start, end = np.array(spans, dtype=np.int64).reshape(-1, 2).T
        return cls(start, end, np.array(turns).reshape(-1, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned:
    """What gyro and vision say together.

    Parameters
    ----------
    R_camera_imu : ndarray of float64, shape (3, 3)
    delay_s : float
        Added to stamps of the IMU.
    sigma_turn, sigma_delay_s : float
        Of the rotation's least certain axis, rad, and of the delay; infinite if nothing turns.
    scale : float
        Length of the rates of the gyro over that of visual ones: one, if both are in rad/s.
    """

    R_camera_imu: FloatArray
    delay_s: float
    sigma_turn: float
    sigma_delay_s: float
    scale: float

    @property
    def is_sound(self) -> bool:
        """Tell whether both turn by the same angles."""
        return _SCALES[0] < self.scale < _SCALES[1]


def align(
    seen: Turns,
    stamps_ns: IntArray,
    gyro: FloatArray,
    *,
    R_camera_imu: FloatArray | None = None,
    delay_s: float | None = None,
) -> Aligned | None:
    """Find rotation, delay and bias by which the gyro turns as the camera does.

    Parameters
    ----------
    seen : Turns
    stamps_ns : ndarray of int64, shape (m,)
        Of the IMU, increasing.
    gyro : ndarray of float64, shape (m, 3)
        Angular velocity, rad/s.
    R_camera_imu : ndarray of float64, shape (3, 3), optional
        Sought if omitted.
    delay_s : float, optional
        Sought within `MAX_DELAY_S` if omitted.

    Returns
    -------
    Aligned or None
        None if too few rotations lie within the samples, or the delay would be longer.
    """
    fit = _Fit.of(seen, stamps_ns, gyro, R_camera_imu)
    if fit is None:
        return None
    if delay_s is None:
        grid = np.arange(-MAX_DELAY_S, MAX_DELAY_S + _BEND_S, _GRID_S)
        best = float(grid[np.argmin([fit.error(each) for each in grid])])
        bounds = best - _GRID_S, best + _GRID_S
        delay_s = float(minimize_scalar(fit.error, bounds=bounds, method="bounded").x)
        if abs(delay_s) > MAX_DELAY_S:
            return None
    return fit.result(delay_s)


class _Solved(NamedTuple):
    """The fit for one delay: rad/s by the gyro's unit, its rates in rad/s, and the differences."""

    R_camera_imu: FloatArray
    unit: float
    rates: FloatArray
    differences: FloatArray


class _Fit(NamedTuple):
    """Rates of gyro and camera over the same spans, for any delay.

    `seen` (n, 3) are those of the camera, rad/s, `angles` (m, 3) what the gyro adds up to, rad. `R`
    is the rotation, if it is known.
    """

    spans_s: FloatArray
    seen: FloatArray
    stamps_s: FloatArray
    angles: FloatArray
    R: FloatArray | None

    @classmethod
    def of(
        cls, seen: Turns, stamps_ns: IntArray, gyro: FloatArray, R: FloatArray | None
    ) -> _Fit | None:
        """Return the fit to what lies within the samples for all delays."""
        origin_ns = stamps_ns[0] if len(stamps_ns) else 0
        stamps_s = 1e-9 * (stamps_ns - origin_ns)
        spans_s = 1e-9 * (np.stack([seen.start_ns, seen.end_ns], axis=1) - origin_ns)
        last_s = stamps_s[-1] if len(stamps_s) else 0.0
        within = (spans_s[:, 0] > MAX_DELAY_S) & (spans_s[:, 1] < last_s - MAX_DELAY_S)
        rates = seen.turns / np.diff(spans_s, axis=1)
        within &= np.linalg.norm(rates, axis=1) > _LEAST_RATE  # rest would decide what is usual
        if np.count_nonzero(within) < _FEWEST:
            return None
        spans_s, rates = spans_s[within], rates[within]
        angles = np.zeros_like(gyro)
        means = 0.5 * (gyro[1:] + gyro[:-1])
        np.cumsum(means * np.diff(stamps_s)[:, np.newaxis], axis=0, out=angles[1:])
        return cls(spans_s, rates, stamps_s, angles, R)

    def _rates(self, delay_s: float) -> FloatArray:
        """Return mean rates (n, 3) of the gyro over the spans."""
        at_s = self.spans_s - delay_s
        angles = [np.interp(at_s, self.stamps_s, column) for column in self.angles.T]
        return np.stack([np.diff(each, axis=1)[:, 0] for each in angles], axis=1) / np.diff(at_s)

    def _solve(self, delay_s: float) -> _Solved:
        rates, seen = self._rates(delay_s), self.seen
        sizes = np.linalg.norm(self._solve_all(rates, seen).differences, axis=1)
        is_good = sizes <= _OUTLIER * np.median(sizes)
        return self._solve_all(rates[is_good], seen[is_good])

    def _solve_all(self, rates: FloatArray, seen: FloatArray) -> _Solved:
        """Fit the rates of the gyro less their mean, in a unit of its own, to those that were seen.

        A bias is in the mean.
        """
        turned, seen = rates - rates.mean(axis=0), seen - seen.mean(axis=0)
        R = se3.nearest_rotation(seen.T @ turned) if self.R is None else self.R
        unit = float(np.sum(turned @ R.T * seen) / max(np.sum(turned**2), 1e-12))
        return _Solved(R, unit, unit * turned, seen - unit * turned @ R.T)

    def error(self, delay_s: float) -> float:
        """Return the mean squared difference."""
        differences = self._solve(delay_s).differences
        return float((differences**2).sum() / len(differences))

    def result(self, delay_s: float) -> Aligned:
        """Return what a delay leads to, and how sure it is."""
        R, unit, rates, differences = self._solve(delay_s)
        variance = _ALIKE**2 * max(float((differences**2).mean()), 1e-12)
        scatter = rates.T @ rates
        least = float(np.linalg.eigvalsh(np.trace(scatter) * np.eye(3) - scatter)[0])
        around = [self.error(delay_s + step) for step in (-_BEND_S, 0.0, _BEND_S)]
        bend = len(rates) * (around[0] - 2.0 * around[1] + around[2]) / (2.0 * _BEND_S**2)
        return Aligned(
            R_camera_imu=R,
            delay_s=delay_s,
            sigma_turn=float(np.sqrt(variance / least)) if least > 0.0 else np.inf,
            sigma_delay_s=float(np.sqrt(variance / bend)) if bend > 0.0 else np.inf,
            scale=1.0 / unit if unit > 0.0 else np.inf,
        )


class Alignment:
    """Learns, while a run goes, what is not known of an IMU.

    Parameters
    ----------
    imu : Imu
        Of which the rotation, the delay or both are None.

    Attributes
    ----------
    steps : list of (int, Edge)
        With the stamps that they lead to, in turn.
    """

    def __init__(self, imu: Imu) -> None:
        self._imu = imu
        self.steps: list[tuple[int, Edge]] = []
        self._n_new = 0

    def follow(self, step: Edge | None, stamp_ns: int, buffer: ImuBuffer) -> Imu | None:
        """Take the next frame and its visual step; return the IMU once all is known."""
        if step is not None:
            self.steps.append((stamp_ns, step))
            self._n_new += 1
        if self._n_new < _AGAIN:
            return None
        self._n_new, self.steps = 0, self.steps[-_MOST:]
        T, delay_s = self._imu.T_camera_imu, self._imu.delay_s
        found = align(
            Turns.of(self.steps),
            buffer.stamps_ns,
            buffer.gyro,
            R_camera_imu=None if T is None else T[:3, :3],
            delay_s=delay_s,
        )
        if found is None or not found.is_sound:
            return None
        is_turn_sure = T is not None or found.sigma_turn < _SURE_TURN
        if not is_turn_sure or (delay_s is None and found.sigma_delay_s > _SURE_DELAY_S):
            return None
        placed = se3.make_transform(found.R_camera_imu, np.zeros(3)) if T is None else T
        return replace(self._imu, T_camera_imu=placed, delay_s=found.delay_s)

    def oldest_ns(self, stamp_ns: int) -> int:
        """Return from when on samples are needed after a frame."""
        first_ns = source_ns(self.steps[0][1]) if self.steps else stamp_ns
        return first_ns - round(2e9 * MAX_DELAY_S)
