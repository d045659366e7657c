"""Trajectories: stamps, poses, optional covariances."""

from __future__ import annotations

from dataclasses import dataclass

from gvo.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses over time, sorted by stamp.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Strictly increasing, nanoseconds.
    T_world_cam : ndarray of float64, shape (n, 4, 4)
        Map camera coordinates to the world, metres.
    covariances : ndarray of float64, shape (n, 6, 6), optional
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the camera frame.
    """

    stamps_ns: IntArray
    T_world_cam: FloatArray
    covariances: FloatArray | None = None

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)
