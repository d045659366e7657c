"""Constant velocity with a covariance that grows with the time without a measurement."""

from __future__ import annotations

import numpy as np

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, Status

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
    velocity: FloatArray | None, elapsed_s: float, config: WindowConfig, *, coasted_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Predict the next relative pose at the last velocity.

    Parameters
    ----------
    velocity : ndarray of float64, shape (6,), or None
        Twist per second (rad/s, m/s); None for zero.
    elapsed_s : float
        Seconds since the last pose.
    config : WindowConfig
        Sigmas per second without a measurement.
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
    turn = min(np.radians(config.coasting_sigma_deg_per_s) * grown_s, _ANY_TURN)
    shift = min(config.coasting_sigma_m_per_s * grown_s, _ANYWHERE_M)
    return T, np.diag(np.repeat([turn, shift], 3)) ** 2


class StatusClock:
    """Derives the status of a frame from the time without a measurement.

    Parameters
    ----------
    lost_after_s : float
        The camera is lost after a longer time, whether frames cannot be registered or are
        missing.
    """

    def __init__(self, lost_after_s: float) -> None:
        self.lost_after_s = lost_after_s
        self._measured_ns: int | None = None
        self._has_none = False

    def next(self, stamp_ns: int, *, is_measured: bool) -> Status:
        """Return the status of the next frame.

        Parameters
        ----------
        stamp_ns : int
            Its stamp, nanoseconds.
        is_measured : bool
            Whether a measurement constrains it.
        """
        had_none, self._has_none = self._has_none, not is_measured
        if is_measured:
            self._measured_ns = stamp_ns
            return Status.RESUMED if had_none else Status.OK
        self._measured_ns = stamp_ns if self._measured_ns is None else self._measured_ns
        coasting_s = 1e-9 * (stamp_ns - self._measured_ns)
        return Status.LOST if coasting_s > self.lost_after_s else Status.COASTING


class ConstantVelocity:
    """The last pose, and the velocity between the last two that were measured.

    Parameters
    ----------
    config : WindowConfig
        Sigmas per second without a measurement.
    """

    def __init__(self, config: WindowConfig) -> None:
        self.config = config
        self.restart()

    def restart(self) -> None:
        """Forget the poses so far."""
        self._measured: Estimate | None = None
        self._step: tuple[FloatArray, FloatArray, float] | None = None
        self.last: Estimate | None = None

    @property
    def measured_id(self) -> FrameId:
        """The last frame with a measurement; None before the first."""
        return None if self._measured is None else self._measured.frame_id

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
            Current pose of `measured_id` in the same graph: its causal estimate would make a
            correction look like a motion. The velocity is unknown without it.
        """
        self.last = estimate
        if not is_measured:
            return
        self._step = None
        if self._measured is not None and T_world_measured is not None:
            elapsed_s = 1e-9 * (estimate.stamp_ns - self._measured.stamp_ns)
            self._step = T_world_measured, estimate.T_world_frame, elapsed_s
        self._measured = estimate

    def predict(self, stamp_ns: int) -> Edge | None:
        """Return the edge from the last frame to a later one; None without a last one."""
        if self.last is None:
            return None
        measured_ns = (self._measured or self.last).stamp_ns
        T_last_frame, covariance = predict_step(
            self._velocity(),
            1e-9 * (stamp_ns - self.last.stamp_ns),
            self.config,
            coasted_s=1e-9 * (self.last.stamp_ns - measured_ns),
        )
        return Edge(
            reference_id=self.last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )

    def predict_pose(self, stamp_ns: int) -> PosePrior | None:
        """Return where a later frame is in the world; None without a last one."""
        if self.last is None or (edge := self.predict(stamp_ns)) is None:
            return None
        T = edge.T_reference_frame
        return PosePrior(
            T_world_frame=se3.normalize(self.last.T_world_frame @ T),
            covariance=se3.compose_covariance(self.last.covariance, T, edge.covariance),
        )

    def _velocity(self) -> FloatArray | None:
        """Return the twist per second; None if unknown."""
        if self._step is None:
            return None
        T_world_before, T_world_last, elapsed_s = self._step
        return velocity_of(se3.invert(T_world_before) @ T_world_last, elapsed_s)
