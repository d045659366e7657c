"""Where the camera would be if it went on as it did."""

from __future__ import annotations

from gvo.coasting import predict_step
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Estimate, FloatArray, FrameId


class Motion:
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
