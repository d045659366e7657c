"""An IMU beside the window: it says how the camera moved where nothing else does."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from gvo.backend.imu_alignment import Alignment
from gvo.backend.imu_buffer import ImuBuffer
from gvo.backend.imu_motion import Front, Preintegrator, step_covariance
from gvo.backend.imu_start import find_start
from gvo.geometry import se3
from gvo.geometry.imu import Imu, ImuSamples
from gvo.types import Edge, Failure, FloatArray, InertialState

_LOGGER = logging.getLogger(__name__)

# Registered frames that it starts from.
_N_START = 15
# A step contradicts the IMU from so many sigmas on, per degree of freedom; after so many in a row
# it is the IMU that is wrong.
_GATE, _N_CONTRADICTIONS = 5.0, 6
# So long after the newest measured frame nothing is known any more, nanoseconds.
_FORGOTTEN_NS = 60_000_000_000
# A camera that moves no faster, m/s, or not more sigmas than this, may be at rest.
_REST_SPEED, _REST_SIGMAS = 0.02, 3.0


class InertialEstimator:
    """Estimates velocity, gravity and biases from visual steps and an IMU; predicts motions.

    A Kalman filter, whose state is told in the axes of the IMU at the newest measured frame: only
    motions are measured, and only motions are asked for. Nothing here acts on the window but what
    `carry` returns. It begins anew where the IMU has a hole, where steps contradict it one after
    the other, and after a minute without any.

    Parameters
    ----------
    imu : Imu
        A rotation or delay that is not known is learnt before it starts.
    max_coast_s : float
        See there.

    Attributes
    ----------
    max_coast_s : float
        From the newest measured frame, seconds; what is asked later is unknown.
    carried_ns : int
        The latest frame that it carried the camera to, as the window says; 0 before the first.
    imu : Imu
        With what was learnt.
    n_restarts : int
    reason : str
        Why it has not started, or began anew the last time.
    """

    def __init__(self, imu: Imu, *, max_coast_s: float) -> None:
        self.max_coast_s = max_coast_s
        self._buffer = ImuBuffer()
        self._integrate = Preintegrator(imu, self._buffer)
        self._audit = _Audit()
        self._n_contradictions = 0
        self.n_restarts = self.carried_ns = 0
        self._place(imu)
        self._begin()

    def _place(self, imu: Imu) -> None:
        """Take the IMU where it is and as late as it is, or begin to learn that."""
        self.imu = imu
        self._alignment: Alignment | None = None
        if imu.T_camera_imu is None or imu.delay_s is None:
            self._alignment = Alignment(imu)
            self.reason = "the camera has not turned enough to learn how it sits and how late it is"
            return
        self.reason = f"no {_N_START} frames in a row could be registered"
        self._T_camera_imu = imu.T_camera_imu
        self._buffer.delay_ns = round(1e9 * imu.delay_s)

    def _begin(self) -> None:
        # Frames registered one after the other, with the steps that lead to them: until it starts.
        self._waiting: list[tuple[int, Edge | None]] = []
        # Afterwards: where the newest measured frame is, and those after it.
        self._fronts: list[Front] = []
        self._audit.begin(None)

    @property
    def state(self) -> InertialState | None:
        """What is known of the camera at the newest frame; None where nothing is."""
        if not self._fronts or self._is_too_late(self._fronts[-1].stamp_ns):
            return None
        front, T = self._fronts[-1], self._T_camera_imu
        found = self._integrate.twist(front)
        if found is None:
            return None
        twist, covariance = found
        up, sigma = front.up
        biases = np.sqrt(front.covariance.diagonal()[9:15].reshape(2, 3).max(axis=1))
        return InertialState(
            stamp_ns=front.stamp_ns,
            twist=se3.adjoint(T) @ twist,
            twist_covariance=se3.transport_covariance(covariance, T),
            up=T[:3, :3] @ up,
            gyro_bias=front.biases[:3],
            acceleration_bias=front.biases[3:],
            sigmas=np.array([sigma, *biases]),
        )

    def add(self, samples: ImuSamples) -> None:
        """Add samples, before the frames that they lead to."""
        self._buffer.add(samples)

    def follow(self, stamp_ns: int, step: Edge | None) -> None:
        """Take the next frame.

        Parameters
        ----------
        stamp_ns : int
        step : Edge or None
            By vision, from an earlier frame named by its stamp; None where vision is silent.
        """
        if self._alignment is not None:
            self._align(self._alignment, stamp_ns, step)
            return
        step = None if step is None else self._of_imu(step)
        if self._fronts:
            self._go_on(stamp_ns, step)
        else:
            self._wait(stamp_ns, step)
        oldest = [*self._fronts[:1], self._audit.start]
        oldest_ns = [front.stamp_ns for front in oldest if front is not None]
        oldest_ns += [ns for ns, _ in self._waiting[:1]]
        self._buffer.drop(min([stamp_ns, *oldest_ns]))

    def carry(self, reference_ns: int, stamp_ns: int) -> Edge | None:
        """Return the motion of the camera from an earlier frame, with its covariance.

        None where it is unknown: the reference must be the newest measured frame or a later one.
        One after the other, such edges add up to the covariance of the whole way: errors of the IMU
        last.
        """
        known = {front.stamp_ns: front for front in self._fronts}
        start = known.get(reference_ns)
        if start is None or self._is_too_late(stamp_ns):
            return None
        end = known.get(stamp_ns) or self._integrate.advance(self._fronts[-1], stamp_ns)
        if end is None:
            return None
        T, covariance = _carried_along(*self._motion(start, end), self._T_camera_imu)
        return Edge(
            reference_id=start.stamp_ns,
            T_reference_frame=se3.normalize(T),
            covariance=covariance,
            kernel="none",
        )

    def _is_too_late(self, stamp_ns: int) -> bool:
        return stamp_ns - self._fronts[0].stamp_ns > 1e9 * self.max_coast_s

    def _motion(self, start: Front, end: Front) -> tuple[FloatArray, FloatArray]:
        """Return the pose of the IMU at a front in that at another, and its covariance."""
        T = se3.invert(start.T_world_imu) @ end.T_world_imu
        covariance = end.covariance[:6, :6]
        if start is not self._fronts[0]:
            covariance = step_covariance(start.covariance[:6, :6], T, covariance)
        return T, self._audit.factor * covariance

    def _of_imu(self, step: Edge) -> Edge:
        """Return a step of the camera as one of the IMU."""
        T_imu_camera = se3.invert(self._T_camera_imu)
        T, covariance = _carried_along(step.T_reference_frame, step.covariance, T_imu_camera)
        return replace(step, T_reference_frame=T, covariance=covariance)

    def _restart(self, stamp_ns: int, reason: str) -> None:
        _LOGGER.info("the IMU begins anew at %d: %s", stamp_ns, reason)
        self.n_restarts += 1
        self.reason = reason
        self._begin()
        self._wait(stamp_ns, None)

    # Before it has started

    def _align(self, alignment: Alignment, stamp_ns: int, step: Edge | None) -> None:
        """Learn how the IMU sits and how late it is; start with the latest steps."""
        found = alignment.follow(step, stamp_ns, self._buffer)
        if found is None:
            self._buffer.drop(alignment.oldest_ns(stamp_ns))
            return
        _LOGGER.info("the IMU is %s", found)
        self._place(found)
        for ns, each in alignment.steps[-_N_START:]:
            self._wait(ns, self._of_imu(each))

    def _wait(self, stamp_ns: int, step: Edge | None) -> None:
        """Collect frames that are registered one after the other; start when they are enough."""
        is_next = step is not None and self._waiting and self._waiting[-1][0] == step.reference_id
        if not is_next:
            self._waiting = []
        self._waiting.append((stamp_ns, step))
        if len(self._waiting) >= _N_START:
            self._start()

    def _start(self) -> None:
        """Take the frames so far, if they tell gravity."""
        stamps_ns = [ns for ns, _ in self._waiting]
        steps = [step for _, step in self._waiting[1:] if step is not None]
        found = find_start(stamps_ns, steps, self._integrate)
        if isinstance(found, Failure):  # tried again when half of them are new
            self.reason = found.reason
            _LOGGER.info("the IMU is not used yet: %s", found.reason)
            self._waiting = self._waiting[_N_START // 2 :]
            return
        self._waiting = []
        self._fronts = [found]
        for stamp_ns, step in zip(stamps_ns[1:], steps, strict=True):
            if self._fronts:
                self._go_on(stamp_ns, step)

    # Afterwards

    def _go_on(self, stamp_ns: int, step: Edge | None) -> None:
        if stamp_ns - self._fronts[0].stamp_ns > _FORGOTTEN_NS:
            self._restart(stamp_ns, "no frame was registered for a minute")
            return
        end = self._integrate.advance(self._fronts[-1], stamp_ns)
        if end is None:
            self._restart(stamp_ns, "samples were missing")
            return
        known = {front.stamp_ns: front for front in self._fronts}
        self._fronts.append(end)
        if step is None or step.reference_id not in known:
            return
        start = known[step.reference_id]
        if self._is_contradicted(start, end, step):
            self._n_contradictions += 1
            if self._n_contradictions >= _N_CONTRADICTIONS:
                self._n_contradictions = 0
                self._restart(stamp_ns, "it is contradicted by vision")
            return
        self._n_contradictions = 0
        if start is not self._fronts[0]:
            self._fronts = [start.measured(None)]
            end = self._integrate.advance(self._fronts[0], stamp_ns)
        if end is not None:
            front = end.measured(step)
            speed, sigma = front.speed
            is_slow = speed < max(_REST_SPEED, _REST_SIGMAS * sigma)
            self._fronts = [replace(front, is_resting=is_slow and front.is_still)]
            self._audit.follow(self._fronts[0], step, self._integrate)

    def _is_contradicted(self, start: Front, end: Front, step: Edge) -> bool:
        """Tell whether a step of the IMU is another than predicted."""
        T, covariance = self._motion(start, end)
        difference = se3.log(se3.invert(T) @ step.T_reference_frame)
        squares = se3.mahalanobis(difference, covariance + step.covariance)
        return bool(squares > 6.0 * _GATE**2)


def _carried_along(
    T: FloatArray, covariance: FloatArray, T_other_frame: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the motion, and its covariance, of what is fixed to a frame that moves so."""
    covariance = se3.transport_covariance(covariance, T_other_frame)
    T = T_other_frame @ T @ se3.invert(T_other_frame)
    return T, np.asarray(0.5 * (covariance + covariance.T))


# Time over which the IMU is compared with vision, comparisons that the factor rests on, and for how
# many of them one counts that is presumed.
_AUDIT_NS, _N_AUDITS, _PRESUMED = 1_000_000_000, 20.0, 3.0
# Bounds of the factor.
_LEAST_FACTOR, _LARGEST_FACTOR = 0.25, 25.0


class _Audit:
    """Compares what the IMU predicted over a second with what vision saw.

    Attributes
    ----------
    factor : float
        By which predicted covariances are wrong.
    """

    def __init__(self) -> None:
        self.factor = 1.0
        self._sum = self._weight = _PRESUMED
        self.start: Front | None = None
        self._end_ns = 0

    def begin(self, front: Front | None) -> None:
        """Begin to compare from a front on."""
        self.start, self._T_start_end = front, np.eye(4)
        self._end_ns = 0 if front is None else front.stamp_ns

    def follow(self, front: Front, step: Edge, integrate: Preintegrator) -> None:
        """Take the step to the newest state."""
        start = self.start
        if start is None or step.reference_id != self._end_ns:
            self.begin(front)
            return
        self._T_start_end, self._end_ns = self._T_start_end @ step.T_reference_frame, front.stamp_ns
        if front.stamp_ns - start.stamp_ns >= _AUDIT_NS:
            predicted = integrate.advance(start, front.stamp_ns)
            if predicted is not None:
                # Steps lead between poses that do not drift apart: both ends are wrong by one.
                self._judge(predicted, 2.0 * step.covariance)
            self.begin(front)

    def _judge(self, predicted: Front, seen: FloatArray) -> None:
        """Find the factor f of C so that differences have the covariance f C + that of vision.

        Along the axes that both have in common: weighed by how much vision tells there.
        """
        difference = se3.log(se3.invert(predicted.T_world_imu) @ self._T_start_end)
        L_inverse = np.linalg.inv(np.linalg.cholesky(predicted.covariance[:6, :6]))
        ratios, axes = np.linalg.eigh(L_inverse @ seen @ L_inverse.T)
        squares = (axes.T @ L_inverse @ difference) ** 2
        weights = 1.0 / (1.0 + ratios) ** 2
        share = weights.sum() / 6.0
        keep = 1.0 - share / _N_AUDITS
        self._sum = keep * self._sum + float(weights @ (squares - ratios)) / 6.0
        self._weight = keep * self._weight + share
        self.factor = min(max(self._sum / self._weight, _LEAST_FACTOR), _LARGEST_FACTOR)
