"""Constant velocity with a covariance that grows with the time without a measurement."""

from __future__ import annotations

import numpy as np

from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, Status

# A camera that nothing measures for longer is lost: by then nobody knows where it has gone.
LOST_AFTER_S = 2.0
# What may change in a second that nothing measures, rad/s and m/s: a hand turns and a car brakes by
# as much. With smaller ones, loops to where it went would be refused.
TURN_SIGMA, SHIFT_SIGMA = np.radians(30.0), 3.0
# After a longer gap the last velocity is no longer extrapolated.
MAX_EXTRAPOLATION_S = 1.0
_MIN_ELAPSED_S = 1e-3
# Upper bounds of the sigmas: a uniformly distributed angle, and an unknown position.
_ANY_TURN = np.pi / np.sqrt(3.0)
_ANYWHERE_M = 1e5


def velocity_of(T_last_frame: FloatArray, elapsed_s: float) -> FloatArray:
    """Return the twist per second of a step.

    One of less than a millisecond, as between stamps of arrival, counts as one of a millisecond:
    its noise over its time would be a velocity of kilometres per second.
    """
    return se3.log(T_last_frame) / max(elapsed_s, _MIN_ELAPSED_S)


def predict_step(
    velocity: FloatArray | None, elapsed_s: float, *, coasted_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Predict the next relative pose at the last velocity.

    Parameters
    ----------
    velocity : ndarray of float64, shape (6,), or None
        Twist per second (rad/s, m/s); None for zero.
    elapsed_s : float
        Seconds since the last pose.
    coasted_s : float
        Seconds without a measurement before the last pose.

    Returns
    -------
    T_last_frame : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Over several steps the sigmas grow in proportion to the whole time without a
        measurement, however short the steps are: the error of a velocity is systematic.
    """
    T = np.eye(4) if velocity is None else se3.exp(velocity * min(elapsed_s, MAX_EXTRAPOLATION_S))
    elapsed_s = max(elapsed_s, _MIN_ELAPSED_S)
    grown_s = np.sqrt(elapsed_s * (elapsed_s + 2.0 * coasted_s))  # (t + dt)^2 - t^2
    turn = min(TURN_SIGMA * grown_s, _ANY_TURN)
    shift = min(SHIFT_SIGMA * grown_s, _ANYWHERE_M)
    return T, np.diag(np.repeat([turn, shift], 3)) ** 2


def go_on(
    reference: Estimate,
    stamp_ns: int,
    T_reference_frame: FloatArray,
    covariance: FloatArray,
    status: Status = Status.OK,
) -> Estimate:
    """Return the estimate of a frame whose pose in an earlier one is known."""
    return Estimate(
        stamp_ns=stamp_ns,
        # Over a million products the rotation would lose its orthogonality.
        T_world_frame=se3.normalize(reference.T_world_frame @ T_reference_frame),
        covariance=se3.compose_covariance(reference.covariance, T_reference_frame, covariance),
        status=status,
    )


class StatusClock:
    """Derives the status of a frame from the time without a measurement.

    The camera is lost after more than `LOST_AFTER_S`, whether frames cannot be registered or are
    missing.
    """

    def __init__(self) -> None:
        self._measured_ns: int | None = None
        self._has_none = False

    def next(self, stamp_ns: int, *, is_measured: bool, is_carried: bool = False) -> Status:
        """Return the status of the next frame, which a measurement constrains or not.

        What carries it, such as an IMU, is none, but keeps it from being lost.
        """
        had_none, self._has_none = self._has_none, not is_measured
        if is_measured:
            self._measured_ns = stamp_ns
            return Status.RESUMED if had_none else Status.OK
        if is_carried or self._measured_ns is None:
            self._measured_ns = stamp_ns
        coasting_s = 1e-9 * (stamp_ns - self._measured_ns)
        return Status.LOST if coasting_s > LOST_AFTER_S else Status.COASTING


class ConstantVelocity:
    """The last pose, and the velocity between the last two that were measured.

    Attributes
    ----------
    last, measured : Estimate or None
        The last pose, and the last one with a measurement.
    """

    def __init__(self) -> None:
        self.last: Estimate | None = None
        self.measured: Estimate | None = None
        self._velocity: FloatArray | None = None

    def append(
        self, estimate: Estimate, *, is_measured: bool, T_world_measured: FloatArray | None = None
    ) -> None:
        """Add the pose of the next frame.

        Parameters
        ----------
        estimate : Estimate
        is_measured : bool
            Whether a measurement constrains it.
        T_world_measured : ndarray of float64, shape (4, 4), optional
            Current pose of `measured` in the same graph: its causal estimate would make a
            correction look like a motion. The velocity is unknown without it.
        """
        self.last = estimate
        if not is_measured:
            return
        former, self.measured, self._velocity = self.measured, estimate, None
        if former is not None and T_world_measured is not None:
            T_measured_frame = se3.invert(T_world_measured) @ estimate.T_world_frame
            elapsed_s = 1e-9 * (estimate.stamp_ns - former.stamp_ns)
            self._velocity = velocity_of(T_measured_frame, elapsed_s)

    def predict(self, stamp_ns: int) -> Edge | None:
        """Return the edge from the last frame to a later one; None without a last one."""
        if self.last is None:
            return None
        measured_ns = (self.measured or self.last).stamp_ns
        T_last_frame, covariance = predict_step(
            self._velocity,
            1e-9 * (stamp_ns - self.last.stamp_ns),
            coasted_s=1e-9 * (self.last.stamp_ns - measured_ns),
        )
        return Edge(
            reference_id=self.last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )

    def predict_pose(self, stamp_ns: int) -> Estimate | None:
        """Return where a later frame is in the world; None without a last one."""
        if self.last is None or (edge := self.predict(stamp_ns)) is None:
            return None
        step = edge.T_reference_frame, edge.covariance
        return go_on(self.last, stamp_ns, *step, status=Status.COASTING)
