"""The frames of a run: which measurements connect, where they are, and the ways between them."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvo.geometry import se3
from gvo.types import BoolArray, Estimate, FloatArray, IntArray, Status

# Odometry may drift by this share of the way, and by so many radians per metre, without its
# covariances saying so: what calibration leaves is wrong alike in each step.
_DRIFT = 0.01
_TURN_PER_M = 0.0005

_STATUSES: Final = tuple(Status)
_ROW: Final = np.dtype(
    [
        ("status", "i1"),
        ("T", "f8", (4, 4)),
        ("covariance", "f8", (6, 6)),
        ("step", "f8", (6, 6)),
    ]
)


class Parts:
    """The frames of a run, named by their stamps, in connected parts: a union-find.

    A part is named by its first frame. What only a guess connects is in different parts: where one
    of them lies in the other is not known.

    References
    ----------
    R. E. Tarjan, "Efficiency of a good but not linear set union algorithm", J. ACM 22(2), 1975,
    doi:10.1145/321879.321884.
    """

    def __init__(self) -> None:
        self._before: dict[int, int] = {}

    def copy(self) -> Parts:
        """Return a copy."""
        parts = Parts()
        parts._before = self._before.copy()
        return parts

    def __contains__(self, stamp_ns: object) -> bool:
        """Tell whether a frame was added."""
        return stamp_ns in self._before

    def add(self, stamp_ns: int, references_ns: Iterable[int] = ()) -> None:
        """Add a frame with those that it was measured from; without any it is a part by itself."""
        self._before.setdefault(stamp_ns, stamp_ns)
        for reference_ns in references_ns:
            self.join(stamp_ns, reference_ns)

    def join(self, first_ns: int, second_ns: int) -> None:
        """Connect the parts of two frames."""
        first, second = sorted((self.of(first_ns), self.of(second_ns)))
        self._before[second] = first

    def of(self, stamp_ns: int) -> int:
        """Return the part of a frame; one that was not added is a part by itself."""
        before, found = self._before, stamp_ns
        while before.get(found, found) != found:
            found = before[found]
        while before.get(stamp_ns, stamp_ns) != found:  # a shorter way for the next question
            before[stamp_ns], stamp_ns = found, before[stamp_ns]
        return found


class Way(NamedTuple):
    """The motion from one frame to a later one by odometry.

    Parameters
    ----------
    T : ndarray of float64, shape (..., 4, 4)
        Pose of the later frame in the earlier one.
    covariance, drift : ndarray of float64, shape (..., 6, 6)
        Of T, in the later frame: by the covariances of the steps, and by what they may drift.
    """

    T: FloatArray
    covariance: FloatArray
    drift: FloatArray


class Path:
    """Poses of all frames, oldest first, and the covariance of each step from the frame before."""

    def __init__(self) -> None:
        self.stamps_ns = array("q")
        self._rows = np.zeros(64, dtype=_ROW)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.stamps_ns)

    def copy(self) -> Path:
        """Return a copy."""
        path = Path()
        path.stamps_ns, path._rows = self.stamps_ns[:], self._rows.copy()
        return path

    def index(self, stamp_ns: int) -> int:
        """Return the number of a frame."""
        return bisect_left(self.stamps_ns, stamp_ns)

    def __contains__(self, stamp_ns: object) -> bool:
        """Tell whether a frame is there."""
        if not isinstance(stamp_ns, int):
            return False
        index = self.index(stamp_ns)
        return index < len(self.stamps_ns) and self.stamps_ns[index] == stamp_ns

    def append(self, estimate: Estimate, step_covariance: FloatArray) -> None:
        """Add a frame."""
        n = len(self)
        if n == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self.stamps_ns.append(estimate.stamp_ns)
        self._rows["step"][n] = step_covariance
        self.update([estimate])

    def update(self, estimates: Iterable[Estimate]) -> None:
        """Take over better estimates of frames; those of others are passed over."""
        for estimate in estimates:
            if estimate.stamp_ns in self:
                row = self._rows[self.index(estimate.stamp_ns)]
                row["T"], row["covariance"] = estimate.T_world_frame, estimate.covariance
                row["status"] = _STATUSES.index(estimate.status)

    def move(self, is_moved: BoolArray, T_world_world: FloatArray, *, start: int) -> None:
        """Move some frames; those between `start` and the first of them are bent to fit."""
        T, end = self.poses, int(np.argmax(is_moved))
        T[start + 1 : end] = bent(
            T[start + 1 : end],
            T[end],
            T_world_world @ T[end],
            self.shares(np.arange(start + 1, end), np.array(start), np.array(end)),
        )
        T[is_moved] = T_world_world @ T[is_moved]

    def shares(self, frames: IntArray, starts: IntArray, ends: IntArray) -> FloatArray:
        """Return which share of a move of the end frames takes, that lie between start and end.

        A velocity is wrong in proportion to the time since it was measured, a way to its square.
        """
        stamps_ns = np.array(self.stamps_ns)
        whole_ns = np.maximum(stamps_ns[ends] - stamps_ns[starts], 1)
        return np.asarray(np.clip((stamps_ns[frames] - stamps_ns[starts]) / whole_ns, 0, 1) ** 2)

    def connect(self, first_ns: int, last_ns: int, covariance: FloatArray) -> None:
        """State how certain the way between two frames is, since something measured it."""
        steps, last = self._rows["step"], self.index(last_ns)
        steps[self.index(first_ns) + 1 : last] = 0.0
        steps[last] = covariance

    @property
    def poses(self) -> NDArray[Any]:
        """T_world_frame of all frames, shape (n, 4, 4)."""
        return self._rows["T"][: len(self)]

    def pose(self, stamp_ns: int) -> FloatArray:
        """Return T_world_frame of a frame."""
        return np.array(self._rows["T"][self.index(stamp_ns)])

    def estimates(
        self, poses: FloatArray | None = None, covariances: FloatArray | None = None
    ) -> tuple[Estimate, ...]:
        """Return all frames; with other poses and covariances, if given."""
        rows = self._rows[: len(self)]
        poses = rows["T"] if poses is None else poses
        covariances = rows["covariance"] if covariances is None else covariances
        statuses = rows["status"].tolist()
        columns = zip(self.stamps_ns, statuses, poses, covariances, strict=True)
        return tuple(
            Estimate(
                stamp_ns=stamp_ns,
                T_world_frame=T,
                covariance=covariance,
                status=_STATUSES[status],
                frame_id=stamp_ns,
            )
            for stamp_ns, status, T, covariance in columns
        )

    def ways(self, first: int = 0, last: int | None = None) -> Ways:
        """Return the ways between all frames, or those from a first to a last one, as they are."""
        rows = self._rows[first : len(self) if last is None else last + 1]
        return Ways(se3.invert(rows["T"][0]) @ rows["T"], rows["step"])

    def way(self, first_ns: int, last_ns: int) -> Way:
        """Return the way between two frames, the first of which is the earlier one."""
        first, last = self.index(first_ns), self.index(last_ns)
        return self.ways(first, last).between(np.array(0), np.array(last - first))


class Ways:
    """The ways between frames, which are numbered from 0.

    Parameters
    ----------
    T : ndarray of float64, shape (n, 4, 4)
        Poses of the frames in the first one.
    steps : ndarray of float64, shape (n, 6, 6)
        Covariances of the steps that lead to them.
    """

    def __init__(self, T: FloatArray, steps: FloatArray) -> None:
        self._T = T
        # Summed up in the axes of the first frame.
        Ad = se3.adjoint(T)
        lengths = np.linalg.norm(np.diff(T[:, :3, 3], axis=0, prepend=T[:1, :3, 3]), axis=1)
        sigmas = lengths[:, np.newaxis] * np.repeat([_TURN_PER_M, _DRIFT], 3)
        drifts = (Ad * sigmas[:, np.newaxis] ** 2) @ np.swapaxes(Ad, 1, 2)
        self._covariances = np.cumsum(Ad @ steps @ np.swapaxes(Ad, 1, 2), axis=0)
        self._drifts = np.cumsum(drifts, axis=0)

    def between(self, first: IntArray, last: IntArray) -> Way:
        """Return the ways (...) from frames to later ones, given by their numbers (...)."""
        T = se3.invert(self._T[first]) @ self._T[last]
        T_last = se3.invert(self._T[last])
        covariance, drift = (
            se3.transport_covariance(total[last] - total[first], T_last)
            for total in (self._covariances, self._drifts)
        )
        # each step drifts alike: the sigmas add up
        return Way(T, covariance, (last - first)[..., np.newaxis, np.newaxis] * drift)


def bent(
    T_world_frames: FloatArray,
    T_world_end: FloatArray,
    T_world_moved: FloatArray,
    shares: FloatArray,
) -> FloatArray:
    """Return frames (n, 4, 4) that take so large a share (n,) of a move of what they lead to."""
    T_frames_end = se3.invert(T_world_frames) @ T_world_end
    move = se3.log(se3.invert(T_world_end) @ T_world_moved)
    moves = (se3.adjoint(T_frames_end) @ move[..., np.newaxis])[..., 0]
    return np.asarray(T_world_frames @ se3.exp(shares[:, np.newaxis] * moves))
