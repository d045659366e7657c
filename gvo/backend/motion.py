"""Where the camera would be if it went on as it did."""

from __future__ import annotations

from gvo.coasting import predict_step
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Estimate, FloatArray


class Motion:
    """The last pose, and the velocity between the last two that were measured.

    Parameters
    ----------
    config : WindowConfig
        Sigmas of a second without a measurement.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._measured: tuple[Estimate | None, Estimate | None] = (None, None)
        self.last: Estimate | None = None

    def append(self, estimate: Estimate, *, is_measured: bool) -> None:
        """Take the pose of the next frame."""
        self.last = estimate
        if is_measured:
            self._measured = (self._measured[1], estimate)

    def predict_step(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return T_last_frame, shape (4, 4), of a later frame, and its covariance (6, 6)."""
        elapsed_s = 0.0 if self.last is None else 1e-9 * (stamp_ns - self.last.stamp_ns)
        return predict_step(self._velocity(), elapsed_s, self._config)

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
        before, last = self._measured
        if before is None or last is None:
            return None
        T_before_last = se3.invert(before.T_world_cam) @ last.T_world_cam
        return se3.log(T_before_last) / (1e-9 * (last.stamp_ns - before.stamp_ns))
