"""The truth in the world of an estimate, as far as the estimate has come."""

from __future__ import annotations

import numpy as np

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import alignment, associate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray

_NOTHING = np.zeros((0, 3))


class TruthPath:
    """Lays the truth onto a growing estimate.

    Where the truth has a rotation for the first frame, its pose there is laid onto the estimate's,
    so that drift shows; else the positions are fitted by a rigid motion.

    Parameters
    ----------
    truth : Trajectory
        In any world, stamped by the estimate's clock.
    """

    def __init__(self, truth: Trajectory) -> None:
        self._truth = truth
        self._first_ns: int | None = None
        self._moved: Trajectory | None = None

    def until(self, stamps_ns: IntArray, positions_world: FloatArray) -> FloatArray:
        """Return the truth's positions (m, 3) between the first and last stamp, metres.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (n,)
            Of the estimate; its first frame is the world.
        positions_world : ndarray of float64, shape (n, 3)
            Metres.
        """
        if len(stamps_ns) == 0:
            return _NOTHING
        if self._first_ns != int(stamps_ns[0]):
            self._first_ns = int(stamps_ns[0])
            self._moved = self._laid_by_first(stamps_ns[:1])
        moved = self._moved or self._fitted(stamps_ns, positions_world)
        if moved is None:
            return _NOTHING
        is_in = (moved.stamps_ns >= stamps_ns[0]) & (moved.stamps_ns <= stamps_ns[-1])
        return np.asarray(moved.positions[is_in])

    def _laid_by_first(self, first_ns: IntArray) -> Trajectory | None:
        stamps_ns = self._truth.stamps_ns
        if not self._truth.has_rotations or len(stamps_ns) == 0:
            return None
        if not stamps_ns[0] <= first_ns[0] <= stamps_ns[-1]:
            return None
        T_truth_first = self._truth.interpolate(first_ns).T_world_cam[0]
        return self._truth.moved(se3.invert(T_truth_first))

    def _fitted(self, stamps_ns: IntArray, positions_world: FloatArray) -> Trajectory | None:
        estimate = Trajectory.of_positions(stamps_ns, positions_world)
        try:
            rows_truth, rows = associate(self._truth, estimate)
        except TrajectoryError:
            return None
        fit = alignment(estimate.select(rows), self._truth.select(rows_truth), "se3")
        return fit.apply(self._truth)
