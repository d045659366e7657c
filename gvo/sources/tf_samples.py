"""The transforms of one child frame over time, kept in 68 bytes each."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.types import BoolArray, FloatArray, IntArray

_N_NUMBERS = 7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Transforms of one child frame, sorted by stamp.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Strictly increasing, nanoseconds.
    poses : ndarray of float64, shape (n, 7)
        Translation, metres, and quaternion (x, y, z, w) of T_parent_child.
    parents : ndarray of int64, shape (n,)
        Numbers of the parent frames.
    changes_parent : bool
        Whether the child hangs on more than one parent over time.
    """

    stamps_ns: IntArray
    poses: FloatArray
    parents: IntArray
    changes_parent: bool

    def parents_at(self, stamps_ns: IntArray) -> IntArray:
        """Return the parent at stamps (m,); outside of the known range that of its end."""
        return self.parents[np.maximum(self._before(stamps_ns), 0)]

    def at(self, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Interpolate between the neighbours, linearly and along the shortest arc.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (m,)
            In any order, nanoseconds.

        Returns
        -------
        T_parent_child : ndarray of float64, shape (m, 4, 4)
            Outside of the known range, the transform at its end. Between samples of two parents,
            the earlier sample, as tf2 does.
        is_known : ndarray of bool, shape (m,)
            Which stamps lie in the known range.
        """
        before = self._before(stamps_ns)
        is_known = (before >= 0) & (stamps_ns <= self.stamps_ns[-1])
        before = np.maximum(before, 0)
        after = np.minimum(before + 1, len(self.stamps_ns) - 1)
        after = np.where(self.parents[after] == self.parents[before], after, before)
        spans_ns = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        elapsed_ns = np.where(is_known, stamps_ns - self.stamps_ns[before], 0)
        shares = np.where(after > before, elapsed_ns / spans_ns, 0.0)[:, np.newaxis]
        return _between(self.poses[before], self.poses[after], shares), is_known

    def _before(self, stamps_ns: IntArray) -> IntArray:
        """Return the index of the last sample up to each stamp, -1 where there is none."""
        return np.asarray(np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1)


class SampleLog:
    """Takes the transforms of one child frame in any order."""

    def __init__(self) -> None:
        self._sorted = Samples(
            stamps_ns=np.empty(0, dtype=np.int64),
            poses=np.empty((0, _N_NUMBERS)),
            parents=np.empty(0, dtype=np.int32),
            changes_parent=False,
        )
        self._clear_tail()

    def _clear_tail(self) -> None:
        self._stamps_ns, self._poses, self._parents = array("q"), array("d"), array("i")

    def __len__(self) -> int:
        """Return the number of transforms, the repeated ones of the last lookup left out."""
        return len(self._sorted.stamps_ns) + len(self._stamps_ns)

    def append(self, stamp_ns: int, numbers: tuple[float, ...], parent: int) -> None:
        """Add a transform: translation and quaternion (x, y, z, w), seven numbers."""
        self._stamps_ns.append(stamp_ns)
        self._poses.extend(numbers)
        self._parents.append(parent)

    def samples(self) -> Samples:
        """Return all transforms by stamp; of those with one stamp the last that was added."""
        if self._stamps_ns:
            self._sorted = _sorted(
                np.concatenate([self._sorted.stamps_ns, np.frombuffer(self._stamps_ns, np.int64)]),
                np.concatenate(
                    [self._sorted.poses, np.frombuffer(self._poses).reshape(-1, _N_NUMBERS)]
                ),
                np.concatenate([self._sorted.parents, np.frombuffer(self._parents, np.int32)]),
            )
            self._clear_tail()
        return self._sorted


def _sorted(stamps_ns: IntArray, poses: FloatArray, parents: IntArray) -> Samples:
    steps = np.diff(stamps_ns)
    if not np.all(steps > 0):
        order = np.argsort(stamps_ns, kind="stable")
        is_last = np.append(np.diff(stamps_ns[order]) > 0, True)
        kept = order[is_last]
        stamps_ns, poses, parents = stamps_ns[kept], poses[kept], parents[kept]
    return Samples(
        stamps_ns=stamps_ns,
        poses=poses,
        parents=parents,
        # Told here: each lookup asks for it.
        changes_parent=bool(np.any(parents[1:] != parents[:-1])),
    )


def _between(start: FloatArray, end: FloatArray, shares: FloatArray) -> FloatArray:
    """Return transforms (n, 4, 4) at shares (n, 1) of the ways between poses (n, 7)."""
    if len(shares) == 0:
        return np.empty((0, 4, 4))
    rotations = Rotation.from_quat(start[:, 3:])
    arcs = (rotations.inv() * Rotation.from_quat(end[:, 3:])).as_rotvec()
    R = (rotations * Rotation.from_rotvec(shares * arcs)).as_matrix()
    return se3.make_transform(np.asarray(R), start[:, :3] + shares * (end[:, :3] - start[:, :3]))
