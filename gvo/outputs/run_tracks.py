"""The poses of a run so far, and the velocities between them."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.io.convert.bag_messages import pose_numbers
from gvo.types import Estimate, FloatArray, IntArray

_N_NUMBERS = 7


class StampedPose(NamedTuple):
    """Stamp in nanoseconds and pose (4, 4) of a frame."""

    stamp_ns: int
    T_world_frame: FloatArray


class Twist(NamedTuple):
    """A velocity of a moving frame, in its own axes.

    (rx, ry, rz, tx, ty, tz) per second, shape (6,), radians and metres; its covariance (6, 6) in
    the same order, None where it is not known.
    """

    velocity: FloatArray
    covariance: FloatArray | None


class Track:
    """The poses of one estimate so far, 64 bytes each, in the order of their stamps."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._poses = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, estimate: Estimate) -> None:
        """Take the next pose, in any order of stamps."""
        index = bisect_right(self._stamps_ns, estimate.stamp_ns)
        self._stamps_ns.insert(index, estimate.stamp_ns)
        numbers = pose_numbers(estimate.T_world_cam).tolist()
        self._poses[_N_NUMBERS * index : _N_NUMBERS * index] = array("d", numbers)

    def before(self, stamp_ns: int) -> StampedPose | None:
        """Return stamp and pose (4, 4) of the latest pose before a stamp."""
        index = bisect_left(self._stamps_ns, stamp_ns) - 1
        if index < 0:
            return None
        numbers = np.array(self._poses[_N_NUMBERS * index : _N_NUMBERS * (index + 1)])
        R = np.asarray(Rotation.from_quat(numbers[3:]).as_matrix())
        return StampedPose(self._stamps_ns[index], se3.make_transform(R, numbers[:3]))

    def poses(self, n_most: int | None = None) -> tuple[IntArray, FloatArray]:
        """Return stamps (n,) and positions with quaternions (n, 7).

        Of more than `n_most`, every second, fourth, ... and the last are taken: those shown stay
        the same while the track grows.
        """
        stride = 1
        while n_most is not None and stride * (n_most - 1) < len(self) > n_most:
            stride *= 2
        is_shown = np.arange(len(self)) % stride == 0
        is_shown[-1:] = True
        stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
        return stamps_ns[is_shown], np.array(self._poses).reshape(-1, _N_NUMBERS)[is_shown]


def twist_between(
    estimate: Estimate,
    previous: StampedPose | None,
    step_covariance: FloatArray | None,
) -> Twist:
    """Return the velocity that leads from the pose before to this one.

    Parameters
    ----------
    estimate : Estimate
        The later pose.
    previous : StampedPose or None
        The earlier one; without it the velocity is 0, of unknown covariance.
    step_covariance : ndarray of float64, shape (6, 6), or None
        Of the step between the two, (rx, ry, rz, tx, ty, tz), in the later frame.
    """
    if previous is None:
        return Twist(velocity=np.zeros(6), covariance=None)
    elapsed_s = 1e-9 * (estimate.stamp_ns - previous.stamp_ns)
    step = se3.log(se3.invert(previous.T_world_frame) @ estimate.T_world_cam)
    covariance = None if step_covariance is None else step_covariance / elapsed_s**2
    return Twist(velocity=step / elapsed_s, covariance=covariance)
