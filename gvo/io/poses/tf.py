"""The tree of frames of a recording, whose transforms change over time, as in tf2, without ROS."""

from __future__ import annotations

import math
from array import array
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.bag.messages import stamp_of
from gvo.io.bag.reader import OLD_TF_TYPE, TF_TYPE, MessageReader
from gvo.io.poses.tf_paths import (
    FramePath,
    ancestors,
    bare,
    describe_unknown,
    find_path,
    list_names,
)
from gvo.trajectory.formats import MAX_POSITION_M
from gvo.trajectory.trajectory import format_stamp
from gvo.types import BoolArray, Failure, FloatArray, IntArray

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
        """Return the parents at stamps (m,); outside of the known range the nearest known."""
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
    """Collects the transforms of one child frame in any order."""

    def __init__(self) -> None:
        self._sorted = _sorted(
            np.empty(0, dtype=np.int64), np.empty((0, _N_NUMBERS)), np.empty(0, dtype=np.int32)
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
    """Interpolate between poses (n, 7) at shares (n, 1); return transforms (n, 4, 4)."""
    if len(shares) == 0:
        return np.empty((0, 4, 4))
    rotations = Rotation.from_quat(start[:, 3:])
    arcs = (rotations.inv() * Rotation.from_quat(end[:, 3:])).as_rotvec()
    R = (rotations * Rotation.from_rotvec(shares * arcs)).as_matrix()
    return se3.make_transform(np.asarray(R), start[:, :3] + shares * (end[:, :3] - start[:, :3]))


_SQUARED_NORM_TOLERANCE = 1e-2  # of quaternions, as in tf2


class TfBuffer:
    """Transforms between named frames over time.

    A moving edge is interpolated between its two neighbours and never extrapolated; a static one
    is valid at all stamps. A leading slash of a name does not count. A child may change its
    parent; of two transforms with one stamp the later one counts.

    Attributes
    ----------
    n_refused : int
        Invalid transforms, which were left out.
    first_refused : str
        The first of them in one line; empty if none.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._names: list[str] = []
        self._edges: set[tuple[str, str]] = set()
        self._moving: dict[str, SampleLog] = {}
        self._static: dict[str, tuple[str, FloatArray]] = {}
        self._n_moving = 0
        self._kept: Collection[str] | None = None
        self.n_refused = 0
        self.first_refused = ""

    def __len__(self) -> int:
        """Return the number of transforms held, repeated ones included."""
        return self._n_moving + len(self._static)

    @property
    def is_whole(self) -> bool:
        """Tell whether no transform was left out by `keep`."""
        return self._kept is None

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted, without leading slashes."""
        return tuple(sorted(self._names))

    @property
    def edges(self) -> frozenset[tuple[str, str]]:
        """All pairs (parent, child) that ever were added."""
        return frozenset(self._edges)

    @property
    def notes(self) -> list[str]:
        """Peculiarities of the transforms, a line each."""
        notes = []
        if self.n_refused:
            notes.append(
                f"tf: {self.n_refused} transforms were refused; the first: {self.first_refused}"
            )
        both = sorted(self._moving.keys() & self._static.keys())
        if both:
            notes.append(
                f"tf: {list_names(both)} published as static and as moving; the moving edge is used"
            )
        changing = sorted(self._changing(self._moving))
        if changing:
            notes.append(f"tf: the parent of {list_names(changing)} changes over time")
        return notes

    def add_message(self, message: Any, *, is_static: bool = False) -> None:  # noqa: ANN401
        """Add a `geometry_msgs/TransformStamped`, in any order of stamps; count an invalid one.

        Parameters
        ----------
        message : geometry_msgs/TransformStamped
            Of ROS 1 or ROS 2.
        is_static : bool
            Whether it is valid at all stamps; of several of one child the last one counts.
        """
        t, q = message.transform.translation, message.transform.rotation
        pose = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
        parent, child = bare(message.header.frame_id), bare(message.child_frame_id)
        stamp_ns = stamp_of(message.header)
        reason = _fault(parent, child, pose)
        if reason:
            self.refuse(f"{parent} -> {child} at {format_stamp(stamp_ns)} s: {reason}")
            return
        self._edges.add((parent, child))
        number, _ = self._number(parent), self._number(child)
        if self._kept is not None and child not in self._kept:
            return
        if is_static:
            R = np.asarray(Rotation.from_quat(pose[3:]).as_matrix())
            self._static[child] = (parent, se3.make_transform(R, np.array(pose[:3])))
        else:
            self._moving.setdefault(child, SampleLog()).append(stamp_ns, pose, number)
            self._n_moving += 1

    def refuse(self, reason: str) -> None:
        """Count an invalid transform, for a reason of one line."""
        self.n_refused += 1
        self.first_refused = self.first_refused or reason

    def keep(self, children: Collection[str]) -> None:
        """Drop the transforms of all other children, also of messages to come.

        `frames` and `edges` still name them.
        """
        self._kept = children
        self._moving = {name: log for name, log in self._moving.items() if name in children}
        self._static = {name: edge for name, edge in self._static.items() if name in children}
        self._n_moving = sum(map(len, self._moving.values()))

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray | Failure:
        """Return T_target_source at a stamp: p_target = T_target_source @ p_source.

        Parameters
        ----------
        target, source : str
            Names of the frames.
        stamp_ns : int
            Nanoseconds.

        Returns
        -------
        ndarray of float64, shape (4, 4), or Failure
            The failure says which frame is unknown, which edge is not known at the stamp, or
            why the frames are not connected.
        """
        T, is_known = self.lookup_many(target, source, np.array([stamp_ns], dtype=np.int64))
        if is_known[0]:
            return np.asarray(T[0])
        return self._why_unknown(bare(target), bare(source), stamp_ns)

    def lookup_many(
        self, target: str, source: str, stamps_ns: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return T_target_source at many stamps.

        Parameters
        ----------
        target, source : str
            Names of the frames.
        stamps_ns : ndarray of int64, shape (n,)
            In any order, nanoseconds.

        Returns
        -------
        T_target_source : ndarray of float64, shape (n, 4, 4)
            NaN where it is not known.
        is_known : ndarray of bool, shape (n,)
            `lookup` gives the reason where it is not.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        T = np.full((len(stamps), 4, 4), np.nan)
        is_known = np.zeros(len(stamps), dtype=np.bool_)
        for path, rows in self._paths(bare(target), bare(source), stamps):
            if isinstance(path, Failure):
                continue
            T_ancestor_target, knows_target = self._climb(path.from_target, stamps[rows])
            T_ancestor_source, knows_source = self._climb(path.from_source, stamps[rows])
            is_known[rows] = knows_target & knows_source
            T[rows] = se3.invert(T_ancestor_target) @ T_ancestor_source
        T[~is_known] = np.nan
        return T, is_known

    def chain(self, target: str, source: str) -> tuple[str, ...] | Failure:
        """Return the names from target to source by way of their common ancestor.

        Where a parent changes over time, this is the chain at the end.
        """
        path = self._paths_over_time(bare(target), bare(source))[-1]
        return path if isinstance(path, Failure) else path.names

    def is_static(self, target: str, source: str) -> bool:
        """Tell whether two frames are connected by static edges alone."""
        return all(
            isinstance(path, FramePath) and self._moving.keys().isdisjoint(path.children)
            for path in self._paths_over_time(bare(target), bare(source))
        )

    def edge_stamps_ns(self, target: str, source: str) -> IntArray:
        """Return the stamps of all transforms of the moving edges between two frames.

        Returns
        -------
        ndarray of int64, shape (n,)
            Increasing; empty where no moving edge lies between, or no path at all.
        """
        paths = self._paths_over_time(bare(target), bare(source))
        children = {c for path in paths if isinstance(path, FramePath) for c in path.children}
        return self._stamps_ns(children)

    def _number(self, name: str) -> int:
        number = self._numbers.setdefault(name, len(self._names))
        if number == len(self._names):
            self._names.append(name)
        return number

    def _stamps_ns(self, children: Collection[str]) -> IntArray:
        """Return the stamps of all transforms of those children that move."""
        moving = self._moving.keys() & children
        stamps = [self._moving[child].samples().stamps_ns for child in sorted(moving)]
        return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *stamps]))

    def _changing(self, children: Collection[str]) -> list[str]:
        """Return those of the children that change their parent."""
        moving = self._moving.keys() & children
        return sorted(child for child in moving if self._moving[child].samples().changes_parent)

    def _trees(
        self, frames: tuple[str, ...], stamps_ns: IntArray
    ) -> Iterator[tuple[dict[str, str], IntArray]]:
        """Yield the parent of each child above some frames, and at which of the stamps."""
        above = ancestors(self._edges, frames)
        parents = {c: parent for c, (parent, _) in self._static.items() if c in above}
        for child in self._moving.keys() & above:
            parents[child] = self._names[self._moving[child].samples().parents[-1]]
        changing = self._changing(above)
        if not changing or len(stamps_ns) == 0:
            yield parents, np.arange(len(stamps_ns))
            return
        numbers = [self._moving[child].samples().parents_at(stamps_ns) for child in changing]
        alternatives, kinds = np.unique(np.stack(numbers), axis=1, return_inverse=True)
        kinds = kinds.reshape(-1)  # some releases of numpy return a row
        for kind, alternative in enumerate(alternatives.T):
            changed = {c: self._names[n] for c, n in zip(changing, alternative, strict=True)}
            yield parents | changed, np.flatnonzero(kinds == kind)

    def _paths(
        self, target: str, source: str, stamps_ns: IntArray
    ) -> Iterator[tuple[FramePath | Failure, IntArray]]:
        """Yield the paths between two frames, each with the stamps at which it exists."""
        for parents, rows in self._trees((target, source), stamps_ns):
            yield find_path(parents, target, source), rows

    def _paths_over_time(self, target: str, source: str) -> list[FramePath | Failure]:
        """Return all paths between two frames over time, the newest last."""
        changing = self._changing(ancestors(self._edges, (target, source)))
        stamps_ns = self._stamps_ns(changing)
        paths = list(self._paths(target, source, stamps_ns))
        return [path for path, _ in sorted(paths, key=lambda found: found[1].max(initial=-1))]

    def _climb(self, children: Sequence[str], stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return T_ancestor_frame, shape (n, 4, 4), and where it is known.

        The children are those of the edges from the frame upwards.
        """
        T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        is_known = np.ones(len(stamps_ns), dtype=np.bool_)
        for child in children:
            if child in self._moving:
                T_parent_child, knows_edge = self._moving[child].samples().at(stamps_ns)
                T, is_known = T_parent_child @ T, is_known & knows_edge
            else:
                T = self._static[child][1] @ T
        return T, is_known

    def _why_unknown(self, target: str, source: str, stamp_ns: int) -> Failure:
        for name in (target, source):
            if name not in self._numbers:
                return Failure(reason=describe_unknown(name, self.frames))
        stamps_ns = np.array([stamp_ns], dtype=np.int64)
        ((path, _),) = self._paths(target, source, stamps_ns)
        if isinstance(path, Failure):
            return path
        edge = next(c for c in path.children if not self._climb((c,), stamps_ns)[1][0])
        samples = self._moving[edge].samples()
        first_ns, last_ns = samples.stamps_ns[[0, -1]]
        parent = self._names[samples.parents_at(stamps_ns)[0]]
        return Failure(
            reason=f"tf {target} <- {source}: {parent} <- {edge} is known from "
            f"{format_stamp(first_ns)} to {format_stamp(last_ns)} s, "
            f"not at {format_stamp(stamp_ns)} s"
        )


def _fault(parent: str, child: str, pose: tuple[float, ...]) -> str:
    """Say why seven numbers are no valid transform; empty if valid."""
    if not parent or not child:
        return "a name is empty"
    if parent == child:
        return "a frame cannot be its own parent"
    if not all(map(math.isfinite, pose)):
        return "the numbers are not finite"
    if any(abs(number) > MAX_POSITION_M for number in pose):
        return f"a number is beyond {MAX_POSITION_M:g}"
    squared_norm = sum(number * number for number in pose[3:])
    if abs(squared_norm - 1.0) >= _SQUARED_NORM_TOLERANCE:
        return f"the quaternion has the norm {math.sqrt(squared_norm):.3g}, expected 1"
    return ""


TF_TYPES = (TF_TYPE, OLD_TF_TYPE)
"""Message types that hold transforms between named frames."""

# About 14 MB: up to here all transforms are kept, beyond it what was asked for.
_N_KEPT_WHOLE = 200_000


def read_tf(reader: MessageReader, *, frames: Collection[str] | None = None) -> TfBuffer:
    """Read the transforms of a recording.

    All topics of type `tf2_msgs/TFMessage` or `tf/tfMessage` are read. Those of topics whose name
    ends in `tf_static` are static.

    Parameters
    ----------
    reader : MessageReader
    frames : collection of str, optional
        The frames that will be looked up. Of a long recording only what lies above them in the
        tree is kept, so that the memory stays small.

    Returns
    -------
    TfBuffer
        Messages that hold no transforms are counted there as refused.

    Raises
    ------
    RecordingError
        When the bag cannot be read on.
    """
    kept: set[str] | None = None
    while True:
        buffer = TfBuffer()
        if kept is not None:
            buffer.keep(kept)
        for message, is_static in _transforms(reader, buffer):
            buffer.add_message(message, is_static=is_static)
            if frames is not None and kept is None and len(buffer) > _N_KEPT_WHOLE:
                kept = _above(buffer, frames)
                buffer.keep(kept)
        if kept is None or frames is None or _above(buffer, frames) <= kept:
            return buffer
        # The tree grew upwards after transforms were left out: once more, with all it needs.
        kept = _above(buffer, frames)


def _above(buffer: TfBuffer, frames: Collection[str]) -> set[str]:
    return ancestors(buffer.edges, map(bare, frames))


def _transforms(reader: MessageReader, buffer: TfBuffer) -> Iterator[tuple[Any, bool]]:
    """Yield the transforms of all topics, and whether they are static."""
    names = [topic.name for topic in reader.topics if topic.type in TF_TYPES]
    for message in reader.messages(names) if names else ():
        if message.topic.type not in TF_TYPES:
            continue
        is_static = message.topic.name.rstrip("/").endswith("tf_static")
        try:
            transforms = message.decode().transforms
        except RecordingError as error:
            buffer.refuse(str(error))
            continue
        for transform in transforms:
            yield transform, is_static
