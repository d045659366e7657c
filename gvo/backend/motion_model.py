"""Going on without a measurement: at the last velocity, less sure with every second."""

from __future__ import annotations

import numpy as np

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Estimate, FloatArray, FrameId, Status

# After a longer gap the last velocity says nothing about where the camera is.
MAX_EXTRAPOLATION_S = 1.0
_MIN_ELAPSED_S = 1e-3
# Sigma of an angle that is not known at all, and of a place.
_ANY_TURN = np.pi / np.sqrt(3.0)
_ANYWHERE_M = 1e5


def predict_step(
    velocity: FloatArray | None, elapsed_s: float, config: WindowConfig, *, coasted_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Continue the last velocity.

    Parameters
    ----------
    velocity : ndarray of float64, shape (6,), or None
        Twist per second (rad/s, m/s); None: standing still.
    elapsed_s : float
        Seconds since the last pose.
    config : WindowConfig
        Sigmas of a second without a measurement.
    coasted_s : float
        Seconds that went by without a measurement before.

    Returns
    -------
    T_last_frame : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Steps of it add up to sigmas in proportion to the whole time without a measurement,
        however short they are: a velocity that is wrong stays wrong.
    """
    T = np.eye(4) if velocity is None else se3.exp(velocity * min(elapsed_s, MAX_EXTRAPOLATION_S))
    elapsed_s = max(elapsed_s, _MIN_ELAPSED_S)
    grown_s = np.sqrt(elapsed_s * (elapsed_s + 2.0 * coasted_s))  # (t + dt)^2 - t^2
    turn = min(np.radians(config.coasting_sigma_deg_per_s) * grown_s, _ANY_TURN)
    shift = min(config.coasting_sigma_m_per_s * grown_s, _ANYWHERE_M)
    return T, np.diag(np.repeat([turn, shift], 3)) ** 2


class StatusClock:
    """Tells a frame's status from how long there was no measurement.

    Parameters
    ----------
    lost_after_s : float
        Without a measurement for longer the camera is lost, be it that frames cannot be
        registered or that there are none.
    """

    def __init__(self, lost_after_s: float) -> None:
        self._lost_after_s = lost_after_s
        self._tied_ns: int | None = None
        self._is_loose = False

    def reconfigure(self, lost_after_s: float) -> None:
        """Take another limit from the next frame on."""
        self._lost_after_s = lost_after_s

    def next(self, stamp_ns: int, *, is_tied: bool) -> Status:
        """Return the status of the next frame.

        Parameters
        ----------
        stamp_ns : int
            Its stamp, nanoseconds.
        is_tied : bool
            Whether a measurement ties it to earlier frames or to the world.
        """
        was_loose, self._is_loose = self._is_loose, not is_tied
        if is_tied:
            self._tied_ns = stamp_ns
            return Status.RESUMED if was_loose else Status.OK
        self._tied_ns = stamp_ns if self._tied_ns is None else self._tied_ns
        coasting_s = 1e-9 * (stamp_ns - self._tied_ns)
        return Status.LOST if coasting_s > self._lost_after_s else Status.COASTING


class ConstantVelocity:
    """The last pose, and the velocity between the last two that were measured.

    Parameters
    ----------
    config : WindowConfig
        Sigmas of a second without a measurement.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self.restart()

    def restart(self) -> None:
        """Forget the poses so far."""
        self._measured: Estimate | None = None
        self._step: tuple[FloatArray, FloatArray, float] | None = None
        self.last: Estimate | None = None

    def reconfigure(self, config: WindowConfig) -> None:
        """Take other sigmas; the motion goes on."""
        self._config = config

    @property
    def measured_id(self) -> FrameId:
        """The last frame that a measurement tied; None before the first."""
        return None if self._measured is None else self._measured.frame_id

    def append(
        self, estimate: Estimate, *, is_measured: bool, T_world_measured: FloatArray | None = None
    ) -> None:
        """Take the pose of the next frame.

        Parameters
        ----------
        estimate : Estimate
        is_measured : bool
            Whether a measurement ties it.
        T_world_measured : ndarray of float64, shape (4, 4), optional
            Present pose of `measured_id`, where the new one is tied to the same graph: between
            estimates of different moments a correction would look like a motion.
        """
        self.last = estimate
        if not is_measured:
            return
        self._step = None
        if self._measured is not None and T_world_measured is not None:
            elapsed_s = 1e-9 * (estimate.stamp_ns - self._measured.stamp_ns)
            self._step = T_world_measured, estimate.T_world_cam, elapsed_s
        self._measured = estimate

    def predict_step(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return T_last_frame, shape (4, 4), of a later frame, and its covariance (6, 6)."""
        if self.last is None:
            return predict_step(None, 0.0, self._config)
        measured_ns = (self._measured or self.last).stamp_ns
        return predict_step(
            self._velocity(),
            1e-9 * (stamp_ns - self.last.stamp_ns),
            self._config,
            coasted_s=1e-9 * (self.last.stamp_ns - measured_ns),
        )

    def predict_pose(self, stamp_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Return T_world_frame of a later frame, and its covariance; None without a last pose."""
        if self.last is None:
            return None
        T_last_frame, covariance = self.predict_step(stamp_ns)
        return (
            se3.normalize(self.last.T_world_cam @ T_last_frame),
            se3.compose_covariance(self.last.covariance, T_last_frame, covariance),
        )

    def _velocity(self) -> FloatArray | None:
        """Return the twist per second, computed only where it is asked for, which is rare."""
        if self._step is None:
            return None
        T_world_before, T_world_last, elapsed_s = self._step
        return se3.log(se3.invert(T_world_before) @ T_world_last) / elapsed_s
