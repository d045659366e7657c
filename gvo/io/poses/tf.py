"""The tree of frames of a recording, whose transforms change over time, as in tf2, without ROS."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.bag.messages import bare, pose_fault, stamp_of
from gvo.io.bag.reader import OLD_TF_TYPE, TF_TYPE, MessageReader
from gvo.io.edges.events import InputFaults
from gvo.trajectory.trajectory import format_stamp
from gvo.types import BoolArray, Failure, FloatArray, IntArray

TF_TYPES = (TF_TYPE, OLD_TF_TYPE)
"""Message types that hold transforms between named frames."""

_N_NUMBERS = 7
N_KEPT_WHOLE = 200_000
"""Up to here all transforms are kept, 14 MB; beyond it what was asked for."""
_N_LISTED = 12


class TfBuffer:
    """Transforms between named frames over time.

    A moving edge is interpolated between its two neighbours and never extrapolated; a static one
    is valid at all stamps. A leading slash of a name does not count. A child may change its
    parent; of two transforms with one stamp the later one counts.

    Attributes
    ----------
    faults : InputFaults
        Invalid transforms, which were left out.
    edges : set of (str, str)
        All pairs (parent, child) that ever were added.
    """

    def __init__(self) -> None:
        self.edges: set[tuple[str, str]] = set()
        self.faults = InputFaults()
        self._numbers: dict[str, int] = {}
        self._names: list[str] = []
        self._moving: dict[str, _Log] = {}
        self._static: dict[str, tuple[str, FloatArray]] = {}
        self._n_moving = 0
        self._kept: Collection[str] | None = None

    def __len__(self) -> int:
        """Return the number of transforms held."""
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
    def notes(self) -> list[str]:
        """Peculiarities of the transforms, a line each."""
        notes = [f"tf: {warning}" for warning in self.faults.warnings()]
        both = sorted(self._moving.keys() & self._static.keys())
        if both:
            notes.append(
                f"tf: {list_names(both)} published as static and as moving; the moving edge is used"
            )
        found = describe_parents(self.edges)
        return [*notes, f"tf: {found}"] if found else notes

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
        self.edges.add((parent, child))
        number, _ = self._number(parent), self._number(child)
        if self._kept is not None and child not in self._kept:
            return
        if is_static:
            R = np.asarray(Rotation.from_quat(pose[3:]).as_matrix())
            self._static[child] = (parent, se3.make_transform(R, np.array(pose[:3])))
        else:
            self._moving.setdefault(child, _Log()).append(stamp_ns, pose, number)
            self._n_moving += 1

    def refuse(self, reason: str) -> None:
        """Count an invalid transform, for a reason of one line."""
        self.faults.add("transforms were refused", reason)

    def keep(self, children: Collection[str]) -> None:
        """Drop the transforms of all other children, also of messages to come.

        `frames` and `edges` still name them.
        """
        self._kept = children
        self._moving = {name: log for name, log in self._moving.items() if name in children}
        self._static = {name: edge for name, edge in self._static.items() if name in children}
        self._n_moving = sum(len(log.stamps_ns) for log in self._moving.values())

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
        if isinstance(path, Failure):
            return path
        return (*path.from_target, path.ancestor, *reversed(path.from_source))

    def edge_stamps_ns(self, target: str, source: str) -> IntArray:
        """Return the stamps of all transforms of the moving edges between two frames.

        Returns
        -------
        ndarray of int64, shape (n,)
            Increasing; empty where no moving edge lies between, or no path at all.
        """
        paths = self._paths_over_time(bare(target), bare(source))
        found = (path for path in paths if isinstance(path, _Path))
        return self._stamps_ns({child for path in found for child in path.children})

    def known(self, target: str, source: str) -> tuple[IntArray, FloatArray]:
        """Return the stamps of `edge_stamps_ns` at which all of the path is known.

        Returns
        -------
        stamps_ns : ndarray of int64, shape (n,)
        T_target_source : ndarray of float64, shape (n, 4, 4)
        """
        stamps_ns = self.edge_stamps_ns(target, source)
        T, is_known = self.lookup_many(target, source, stamps_ns)
        return stamps_ns[is_known], T[is_known]

    def _number(self, name: str) -> int:
        number = self._numbers.setdefault(name, len(self._names))
        if number == len(self._names):
            self._names.append(name)
        return number

    def _stamps_ns(self, children: Collection[str]) -> IntArray:
        moving = self._moving.keys() & children
        stamps = [self._moving[child].samples().stamps_ns for child in sorted(moving)]
        return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *stamps]))

    def _changing(self, children: Collection[str]) -> list[str]:
        """Return those of the children that change their parent."""
        moving = self._moving.keys() & children
        return sorted(child for child in moving if self._moving[child].samples().changes_parent)

    def _paths(
        self, target: str, source: str, stamps_ns: IntArray
    ) -> Iterator[tuple[_Path | Failure, IntArray]]:
        """Yield the paths between two frames, each with the rows of stamps at which it holds."""
        above = _ancestors(self.edges, (target, source))
        parents = {c: parent for c, (parent, _) in self._static.items() if c in above}
        for child in self._moving.keys() & above:
            parents[child] = self._names[self._moving[child].samples().parents[-1]]
        changing = self._changing(above)
        if not changing or len(stamps_ns) == 0:
            yield _find_path(parents, target, source), np.arange(len(stamps_ns))
            return
        numbers = [self._moving[child].samples().parents_at(stamps_ns) for child in changing]
        alternatives, kinds = np.unique(np.stack(numbers), axis=1, return_inverse=True)
        kinds = kinds.reshape(-1)  # some releases of numpy return a row
        for kind, alternative in enumerate(alternatives.T):
            changed = {c: self._names[n] for c, n in zip(changing, alternative, strict=True)}
            yield _find_path(parents | changed, target, source), np.flatnonzero(kinds == kind)

    def _paths_over_time(self, target: str, source: str) -> list[_Path | Failure]:
        """Return all paths between two frames over time, the newest last."""
        changing = self._changing(_ancestors(self.edges, (target, source)))
        paths = list(self._paths(target, source, self._stamps_ns(changing)))
        return [path for path, _ in sorted(paths, key=lambda found: found[1].max(initial=-1))]

    def _climb(self, children: Iterable[str], stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return T_ancestor_frame, shape (n, 4, 4), over edges from the frame upwards."""
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
                return Failure(reason=_describe_unknown(name, self.frames))
        stamps_ns = np.array([stamp_ns], dtype=np.int64)
        ((path, _),) = self._paths(target, source, stamps_ns)
        if isinstance(path, Failure):
            above = _ancestors(self.edges, (target, source))
            found = describe_parents(edge for edge in self.edges if edge[1] in above)
            return Failure(reason=f"{path.reason}; {found}") if found else path
        edge = next(c for c in path.children if not self._climb((c,), stamps_ns)[1][0])
        samples = self._moving[edge].samples()
        first_ns, last_ns = samples.stamps_ns[[0, -1]]
        parent = self._names[samples.parents_at(stamps_ns)[0]]
        return Failure(
            reason=f"tf {target} <- {source}: {parent} <- {edge} is known from "
            f"{format_stamp(first_ns)} to {format_stamp(last_ns)} s, "
            f"not at {format_stamp(stamp_ns)} s"
        )


@dataclass(slots=True)
class _Log:
    """The transforms of one child frame, in the order in which they were added."""

    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))
    parents: array[int] = field(default_factory=lambda: array("q"))
    _sorted: _Samples | None = None

    def append(self, stamp_ns: int, pose: tuple[float, ...], parent: int) -> None:
        self.stamps_ns.append(stamp_ns)
        self.poses.extend(pose)
        self.parents.append(parent)
        self._sorted = None

    def samples(self) -> _Samples:
        """Return all transforms by stamp; of those with one stamp the last that was added."""
        if self._sorted is None:
            stamps_ns = np.array(self.stamps_ns)
            order = np.argsort(stamps_ns, kind="stable")
            kept = order[np.append(np.diff(stamps_ns[order]) > 0, True)]
            poses = np.array(self.poses).reshape(-1, _N_NUMBERS)
            parents = np.array(self.parents)[kept]
            changes_parent = bool(np.any(parents[1:] != parents[:-1]))
            self._sorted = _Samples(stamps_ns[kept], poses[kept], parents, changes_parent)
        return self._sorted


class _Samples(NamedTuple):
    """Transforms T_parent_child of one child frame, strictly increasing by stamp."""

    stamps_ns: IntArray
    poses: FloatArray  # (n, 7): translation, metres, and quaternion (x, y, z, w)
    parents: IntArray  # numbers of the frames
    changes_parent: bool

    def parents_at(self, stamps_ns: IntArray) -> IntArray:
        """Return the parents at stamps (m,); outside of the known range the nearest known."""
        return self.parents[np.maximum(self._before(stamps_ns), 0)]

    def at(self, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Interpolate linearly and along the shortest arc: transforms (m, 4, 4), and where known.

        Between samples of two parents it is the earlier sample, as in tf2.
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


def _between(start: FloatArray, end: FloatArray, shares: FloatArray) -> FloatArray:
    """Interpolate between poses (n, 7) at shares (n, 1); return transforms (n, 4, 4)."""
    if len(shares) == 0:
        return np.empty((0, 4, 4))
    rotations = Rotation.from_quat(start[:, 3:])
    arcs = (rotations.inv() * Rotation.from_quat(end[:, 3:])).as_rotvec()
    R = (rotations * Rotation.from_rotvec(shares * arcs)).as_matrix()
    return se3.make_transform(np.asarray(R), start[:, :3] + shares * (end[:, :3] - start[:, :3]))


def _fault(parent: str, child: str, pose: tuple[float, ...]) -> str:
    """Say why seven numbers are no valid transform; empty if valid."""
    if not parent or not child:
        return "a name is empty"
    if parent == child:
        return "a frame cannot be its own parent"
    return pose_fault(pose)


class _Path(NamedTuple):
    """The edges between two frames, each named by its child, up to where both ways meet."""

    from_target: tuple[str, ...]
    from_source: tuple[str, ...]
    ancestor: str

    @property
    def children(self) -> tuple[str, ...]:
        return self.from_target + self.from_source


def _find_path(parents: Mapping[str, str], target: str, source: str) -> _Path | Failure:
    """Find the path by the lowest common ancestor, or name the roots of both trees, or a loop."""
    above_target, above_source = _upwards(parents, target), _upwards(parents, source)
    for way in (above_target, above_source):
        if way[-1] in parents:
            loop = [*way[way.index(parents[way[-1]]) :], parents[way[-1]]]
            return Failure(reason=f"tf holds a loop: {' <- '.join(loop)}")
    ranks = {name: rank for rank, name in enumerate(above_source)}
    for rank, name in enumerate(above_target):
        if name in ranks:
            return _Path(tuple(above_target[:rank]), tuple(above_source[: ranks[name]]), name)
    return Failure(
        reason=f"tf does not connect {target} and {source}: the tree of {target} ends at "
        f"{above_target[-1]}, that of {source} at {above_source[-1]}"
    )


def _upwards(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return a frame and its ancestors, up to the root or to where a loop closes."""
    way = {frame: None}  # keeps the order, and tells quickly what it holds
    while (parent := parents.get(frame)) is not None and parent not in way:
        way[parent] = None
        frame = parent
    return list(way)


def _ancestors(edges: Iterable[tuple[str, str]], frames: Iterable[str]) -> set[str]:
    """Return frames and all their ancestors by any of the edges (parent, child)."""
    parents: dict[str, set[str]] = {}
    for parent, child in edges:
        parents.setdefault(child, set()).add(parent)
    found: set[str] = set()
    ahead = set(frames)
    while ahead:
        found |= ahead
        ahead = {parent for child in ahead for parent in parents.get(child, ())} - found
    return found


def describe_parents(edges: Iterable[tuple[str, str]]) -> str:
    """Name the frames with more than one parent by edges (parent, child)."""
    parents: dict[str, list[str]] = {}
    for parent, child in sorted(edges):
        parents.setdefault(child, []).append(parent)
    said = [
        f"{child} has the parents {' and '.join(names)}"
        for child, names in parents.items()
        if len(names) > 1
    ]
    return f"{list_names(said)}: publish one of them, a frame has one parent" if said else ""


def _describe_unknown(name: str, frames: tuple[str, ...]) -> str:
    if not frames:
        return f"tf holds no frame {name}: it is empty"
    close = get_close_matches(name, frames, n=3, cutoff=0.5)
    nearest = f" (the nearest: {', '.join(close)})" if close else ""
    return f"tf holds no frame {name}{nearest}; it holds {list_names(frames)}"


def list_names(names: Collection[str]) -> str:
    """Return the first names in one line, and how many more there are."""
    n_more = len(names) - _N_LISTED
    return ", ".join(list(names)[:_N_LISTED]) + (f" and {n_more} more" if n_more > 0 else "")


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
            if frames is not None and kept is None and len(buffer) > N_KEPT_WHOLE:
                kept = _above(buffer, frames)
                buffer.keep(kept)
        if kept is None or frames is None or _above(buffer, frames) <= kept:
            return buffer
        # The tree grew upwards after transforms were left out: once more, with all it needs.
        kept = _above(buffer, frames)


def _above(buffer: TfBuffer, frames: Collection[str]) -> set[str]:
    return _ancestors(buffer.edges, map(bare, frames))


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
