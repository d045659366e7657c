"""The graph of a run: its keyframes, the edges between them, and its loops.

It outlives the window. What lies between two keyframes is solved by itself, the earlier one being
the origin: of the poses found there, those of other keyframes become edges, and the frames between
hang on the earlier keyframe. What is needed again at the end only, of all frames and of keyframes
that were merged, is written to temporary files: memory grows with the map, not with the run.

While the run goes, the graph is optimized in a thread whenever loops have come. It is taken over a
fixed number of keyframes later, so that a run can be repeated. Of the keyframes that came back to a
place, only a few stay: the others are merged into the one that they came back to.

References
----------
G. Grisetti, R. Kuemmerle, K. Ni, "Robust optimization of factor graphs by using condensed
measurements", IROS 2012, doi:10.1109/IROS.2012.6385779.
"""

from __future__ import annotations

import copy
import io
import logging
import os
import tempfile
import weakref
from array import array
from bisect import bisect, bisect_left
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, count
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvo.backend.batch import INLIER_CHI2, BatchOptimizer, LocalGraph, WholeGraph
from gvo.backend.factors import ORIGIN, Factors
from gvo.backend.motion_model import MAX_EXTRAPOLATION_S, predict_step
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.geometry.edges import chi2, fuse, inverse, then
from gvo.io.run_folder.line_file import append_whole
from gvo.types import Edge, Estimate, FloatArray, FrameId, Loop, Optimum, PosePrior, Status

# Of keyframes: that of the reference and that of the frame of an edge.
_Pairs: TypeAlias = AbstractSet[tuple[object, int]]

_LOGGER = logging.getLogger(__name__)

# Upper bounds of the sigmas of a guess: rad and m; and the share of a velocity that is one sigma
# of it besides.
_GUESS_SIGMAS = np.array([3.0, 3.0, 3.0, 1000.0, 1000.0, 1000.0])
_HALT = 0.3
# Drift that is allowed for when loops are judged, over the whole path: a share of the way and of
# the turn, and radians per metre.
_DRIFT = 0.01
_TURN_PER_M = 0.0005
# Why loops are refused.
_TOO_FAR = "farther from odometry than that drifts"
_CONTRADICTS = "contradicts odometry or the other loops"
_DOUBTED = "across a loss, where most other loops are refused"
# Of the edges between two parts, so many are compared with each other.
_N_VOTERS = 32
# An optimization begins with a loop when the graph has grown by this share, and by so many
# keyframes, since the last one, and is taken over so many keyframes later: at least so many, and
# this share of the graph's, as a larger one takes longer.
_GROWTH, _N_APART = 0.25, 20
_SHARE_LATER, _N_LATER = 0.025, 5
# Keyframes up to which linked frames are keyframes too: some seconds of work at the end. And
# frames from a keyframe to the next one at most: they are solved at once.
_MAX_LINKED = 2000
_MAX_BETWEEN = 200
# Keyframes that came back to a place and stay; the latest ones stay in any case.
_N_PER_PLACE = 3
_N_LATEST = 50


# Rows of a table that are in memory.
_N_IN_MEMORY = 100
_T, _COVARIANCE = ((4, 4),), ((6, 6),)
_STATUSES: Final = tuple(Status)

_KEYFRAME: Final = np.dtype(
    [
        *(("T_first_keyframe", "f8", *_T), ("covariance", "f8", *_COVARIANCE)),
        *(("drift", "f8", *_COVARIANCE), ("n_steps", "i8")),  # its way
        *(("status", "i8"), ("is_guess", "i8"), ("n_frames", "i8")),
        *(("T_step", "f8", *_T), ("step_covariance", "f8", *_COVARIANCE)),
    ]
)
"""The way to a keyframe, how many frames are before it, and its pose in the keyframe before."""
_FRAME: Final = np.dtype(
    [
        *(("keyframe_ns", "i8"), ("stamp_ns", "i8"), ("status", "i8"), ("T", "f8", *_T)),
        *(("covariance", "f8", *_COVARIANCE), ("with_next", "f8", *_COVARIANCE)),
    ]
)
"""The pose of a frame in its keyframe, its covariance, and that with the next keyframe.

Also of a merged keyframe, in the one that it was merged into.
"""


class Table:
    """Rows by stamps; all but the latest ones are in a temporary file, gone with the object.

    Where that cannot be written they stay in memory.
    """

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self.stamps_ns = array("q")
        self._dtype = dtype
        self._file: io.FileIO | None = None
        # How many rows are in the file, and those after them; replaced at once, for other threads.
        self._rest: tuple[int, list[NDArray[Any]]] = (0, [])

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __contains__(self, stamp_ns: int) -> bool:
        number = self.number(stamp_ns)
        return number < len(self) and self.stamps_ns[number] == stamp_ns

    def number(self, stamp_ns: int) -> int:
        """Return the number of the row of a stamp, where stamps ascend."""
        return bisect_left(self.stamps_ns, stamp_ns)

    def append(self, stamp_ns: int, *values: object) -> None:
        """Add a row by its values."""
        rest = self._rest[1]
        rest.append(np.array(values, dtype=self._dtype))
        self.stamps_ns.append(stamp_ns)
        if len(rest) == _N_IN_MEMORY:  # once, if it cannot be written
            self._write(rest)

    def __getitem__(self, index: int) -> NDArray[Any]:
        n_written, rest = self._rest
        if index >= n_written or self._file is None:
            return rest[index - n_written]
        size = self._dtype.itemsize
        row = os.pread(self._file.fileno(), size, index * size)
        return np.frombuffer(row, dtype=self._dtype).reshape(())

    def append_fields(self, stamp_ns: int, value: object) -> None:
        """Add a row by the fields of an object."""
        self.append(stamp_ns, *(getattr(value, name) for name in self._dtype.names or ()))

    def fields(self, index: int) -> dict[str, Any]:
        """Return a row by the names of its fields."""
        return dict(zip(self._dtype.names or (), self[index].item(), strict=True))

    def _write(self, rest: list[NDArray[Any]]) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - see finalize
                weakref.finalize(self, self._file.close)
            append_whole(self._file, b"".join(row.tobytes() for row in rest))
        except OSError as error:
            _LOGGER.warning("the graph of the run stays in memory: %s", error)
        else:
            self._rest = self._rest[0] + len(rest), []


_NO_STEP: Final = Edge(reference_id=0, T_reference_frame=np.eye(4), covariance=np.eye(6))


class _Way(NamedTuple):
    """The way along all keyframes to one of them, as measured.

    Parameters
    ----------
    T_first_keyframe : ndarray of float64, shape (4, 4)
    covariance, drift : ndarray of float64, shape (6, 6)
        In the axes of the first one, where they add up. The drift is that of the steps as if they
        drifted each on its own: they do so all alike, and their sigmas add up.
    n_steps : int
    """

    T_first_keyframe: FloatArray
    covariance: FloatArray
    drift: FloatArray
    n_steps: int

    def then(self, step: Edge) -> _Way:
        """Return the way to the next keyframe."""
        T_first_keyframe = self.T_first_keyframe @ step.T_reference_frame
        return _Way(
            T_first_keyframe,
            self.covariance + se3.transport_covariance(step.covariance, T_first_keyframe),
            self.drift + se3.transport_covariance(_drift(step, _DRIFT), T_first_keyframe),
            self.n_steps + 1,
        )

    def covariance_since(self, other: _Way, *, drifts: bool) -> FloatArray:
        """Return the covariance of what lies between another keyframe and this one, in its axes."""
        n_steps = self.n_steps - other.n_steps
        covariance = np.sign(n_steps) * (self.covariance - other.covariance)
        if drifts:
            covariance = covariance + n_steps * (self.drift - other.drift)
        return se3.transport_covariance(covariance, se3.invert(self.T_first_keyframe))

    def chi2(self, loop: Loop, before: _Way, *, drifts: bool) -> float:
        """Return by how much a loop to a keyframe before contradicts the way from there."""
        T_frame_before = se3.invert(self.T_first_keyframe) @ before.T_first_keyframe
        error = se3.log(T_frame_before @ loop.T_reference_frame)
        covariance = self.covariance_since(before, drifts=drifts) + loop.covariance
        return float(se3.mahalanobis(error, covariance))


class _Solution(NamedTuple):
    """The poses of keyframes, their loops that count, and why others between two frames do not."""

    poses: dict[int, FloatArray]
    loops: list[Loop]
    reasons: dict[tuple[object, int], str]
    error_before: float
    optimizer: BatchOptimizer
    firsts: dict[int, int]


class RunGraph:
    """The keyframes of a run with the edges between them; the frames between hang on them.

    Frames are named by their stamps.

    Parameters
    ----------
    config : WindowConfig
        Kernel, sigmas of steps that were not measured.

    Attributes
    ----------
    loops : sequence of Loop
        Those with a reason against them do not count. A shallow copy must stay as it is.
    T_map_world : ndarray of float64, shape (4, 4)
        The correction of the newest poses by loops, as last optimized while the run goes.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._factors = Factors(config)
        # As they came: their poses are where an optimization starts.
        self._keyframes: dict[int, Estimate] = {}
        # By numbers that ascend; and the numbers of those at a keyframe.
        self._edges: dict[int, tuple[int, Edge]] = {}
        self._touching: dict[int, dict[int, None]] = {}
        self._numbers = count()
        # All keyframes, merged ones too; where these are, and their rows there; the frames before
        # each keyframe, and in a copy those after the last one.
        self._known, self._merged, self._frames = map(Table, (_KEYFRAME, _FRAME, _FRAME))
        self._merged_at = array("q")
        self._open: list[tuple[Any, ...]] = []
        self._way = _Way(np.eye(4), np.zeros((6, 6)), np.zeros((6, 6)), 0)
        self._arrivals: list[tuple[Estimate, list[Edge]]] = []
        self._last: Estimate | None = None
        # Where nothing measured connects a keyframe with those before: the one before it.
        self._guesses: dict[int, int] = {}
        # The frames since the latest keyframe that follow a guess; from which stamps on frames are
        # of which world.
        self._adrift: set[object] = set()
        self._worlds = [(0, 0)]
        self._n_worlds = self._measured_ns = 0
        self._running: Future[_Solution] | None = None
        self._began_with: Estimate | None = None
        # Numbers of keyframes, merged ones too, at which the next one begins and is taken over.
        self._next = self._due = 0
        self._is_due = False
        # The confirmed loops of keyframes that are not merged.
        self._standing: dict[int, Loop] = {}
        self.loops: Sequence[Loop] = ()
        self.T_map_world: FloatArray = np.eye(4)

    def reconfigure(self, config: WindowConfig) -> None:
        """Use another configuration from now on."""
        self._config, self._factors = config, Factors(config)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._keyframes)

    def __contains__(self, stamp_ns: int) -> bool:
        """Tell whether a frame is a keyframe."""
        return stamp_ns in self._keyframes

    def add_frame(self, estimate: Estimate, edges: Sequence[Edge], *, is_keyframe: bool) -> None:
        """Add a frame with the edges that measure it from earlier ones.

        Parameters
        ----------
        estimate : Estimate
            Its pose as it came, by the window.
        edges : sequence of Edge
            Without one from a recent frame, it continues the motion before it, with the sigmas of
            a step that was not measured.
        is_keyframe : bool
            The very first frame is one in any case; so is one that is linked to more than those
            just before it, as long as the graph is small: what is condensed loses a little.
        """
        last, self._last = self._last, estimate
        if last is None:
            self._know(estimate)
            self._n_worlds, self._measured_ns = 1, estimate.stamp_ns
            return
        stamp_ns, latest_ns = estimate.stamp_ns, next(reversed(self._keyframes))
        first_ns = self._known.stamps_ns[0]  # references before it are not in the graph
        edges = [edge for edge in edges if int(edge.reference_id) >= first_ns]  # type: ignore[call-overload]
        if (world := self.world_of(edges)) != self._worlds[-1][1]:
            self._worlds.append((stamp_ns, world))
            self._n_worlds = max(self._n_worlds, world + 1)
        near = {latest_ns, *(each.stamp_ns for each, _ in self._arrivals)}
        ties = [edge for edge in edges if edge.reference_id in near]
        is_back = bool(ties) and ties[0].reference_id in self._adrift
        if self._arrivals and (is_back or not (ties or self._adrift)):
            self._close(last.stamp_ns)  # so that the guess is an edge of its own
        is_linked = len(ties) < len(edges)
        guess = [] if ties else [self._unmeasured(last, estimate)]
        self._adrift |= {stamp_ns} if guess else set()
        self._measured_ns = stamp_ns if edges else self._measured_ns
        self._arrivals.append((estimate, [*edges, *guess]))
        is_keyframe |= is_linked and len(self._known) < _MAX_LINKED
        if is_keyframe or len(self._arrivals) >= _MAX_BETWEEN:
            self._close(stamp_ns)

    def _close(self, stamp_ns: int) -> None:
        """Make the newest frame a keyframe."""
        is_guess, newest = stamp_ns in self._adrift, self._arrivals[-1][0]
        if is_guess:
            self._guesses[stamp_ns] = next(reversed(self._keyframes))
        frames, step = self._condense(newest)
        for row in frames:
            self._frames.append(row[1], *row)
        self._way = self._way.then(self._bounded(stamp_ns, step))
        self._know(newest, step, n_frames=len(frames))
        self._arrivals, self._adrift = [], set()

    def _know(self, estimate: Estimate, step: Edge = _NO_STEP, *, n_frames: int = 0) -> None:
        """Add a keyframe, where it is in the one before, and how many frames are between."""
        stamp_ns = estimate.stamp_ns
        what = _STATUSES.index(estimate.status), stamp_ns in self._guesses, n_frames
        edge = step.T_reference_frame, step.covariance
        self._known.append(stamp_ns, *self._way, *what, *edge)
        self._merged_at.append(-1)
        self._keyframes[stamp_ns] = estimate

    def world_of(self, edges: Sequence[Edge]) -> int:
        """Return the number of the world that the edges of the next frame connect it with.

        Where nothing connects a frame with earlier ones, another world begins: its place among
        the others is only guessed.
        """
        starts = [bisect(self._worlds, (e.reference_id, self._n_worlds)) for e in edges]
        return min((self._worlds[start - 1][1] for start in starts), default=self._n_worlds)

    def from_keyframe(self, stamp_ns: int, loop: Loop) -> Edge | None:
        """Return a loop as an edge from another keyframe, by the way between; None if guessed."""
        if stamp_ns == loop.reference_ns:
            return loop.edge
        is_known = stamp_ns in self._known and loop.reference_ns in self._known
        if not is_known or self._part(stamp_ns) != self._part(loop.reference_ns):
            return None
        first, second = self._way_to(stamp_ns), self._way_to(loop.reference_ns)
        T = se3.invert(first.T_first_keyframe) @ second.T_first_keyframe
        return then(_edge(stamp_ns, T, second.covariance_since(first, drifts=True)), loop.edge)

    def allows(self, loop: Loop) -> bool:
        """Tell whether a loop leads where odometry, and what was guessed in the dark, allow it."""
        is_known = loop.stamp_ns in self._known and loop.reference_ns in self._known
        return not is_known or self._chi2(loop, drifts=True) <= INLIER_CHI2

    def _unmeasured(self, last: Estimate, estimate: Estimate) -> Edge:
        config, stamps_ns = self._config, [self._measured_ns, last.stamp_ns, estimate.stamp_ns]
        coasted_s, elapsed_s = 1e-9 * np.diff(stamps_ns)
        _, covariance = predict_step(None, elapsed_s, config, coasted_s=coasted_s)
        T_last_frame = se3.invert(last.T_world_frame) @ estimate.T_world_frame
        # Whatever moves may halt: the faster, the less certain is the velocity.
        velocity = se3.log(T_last_frame) / min(elapsed_s, MAX_EXTRAPOLATION_S)
        sigmas = np.radians(config.coasting_sigma_deg_per_s), config.coasting_sigma_m_per_s
        shares = _HALT * np.linalg.norm(velocity.reshape(2, 3), axis=1) / sigmas
        covariance = covariance * np.repeat(1.0 + shares**2, 3)
        return _edge(last.stamp_ns, T_last_frame, covariance)

    def _condense(self, newest: Estimate | None = None) -> tuple[list[tuple[Any, ...]], Edge]:
        """Solve what came since the last keyframe; the newest frame becomes one if it is given.

        Returns
        -------
        list of tuple
            Rows of the frames that hang on the last keyframe.
        Edge
            The pose of the newest one there.
        """
        frames = [estimate for estimate, _ in self._arrivals if estimate is not newest]
        origin_ns = next(reversed(self._keyframes))
        local = LocalGraph(origin_ns, self._factors)
        for estimate, edges in self._arrivals:
            found = map(self._from_keyframe, edges)
            # those that tie the frame to what is there already come first
            for edge in sorted(found, key=lambda each: each.reference_id not in local):
                if estimate is newest and edge.reference_id not in local:
                    self._add_edge(estimate.stamp_ns, edge)  # as it is
                else:
                    local.add(estimate.stamp_ns, edge)
        solved = local.solve(None if newest is None else newest.stamp_ns)
        rows = [
            (origin_ns, frame.stamp_ns, _STATUSES.index(frame.status), *solved.pop(frame.stamp_ns))
            for frame in frames
        ]
        step = _NO_STEP
        for frame_id, (T, covariance, _) in solved.items():
            stamp_ns = int(frame_id)  # type: ignore[call-overload]
            edge = _edge(origin_ns, T, covariance)
            if newest is not None and stamp_ns == newest.stamp_ns:
                step, edge = edge, self._bounded(stamp_ns, edge)
            self._add_edge(stamp_ns, edge)
        return rows, step

    def _bounded(self, stamp_ns: int, edge: Edge) -> Edge:
        """Return the edge to a new keyframe as graph and way have it: a guess is bounded."""
        if stamp_ns not in self._guesses:
            return edge
        variances = np.minimum(np.diagonal(edge.covariance), _GUESS_SIGMAS**2)
        return replace(edge, covariance=np.diag(variances))

    def _add_edge(self, frame_ns: int, edge: Edge) -> None:
        number = next(self._numbers)
        T = se3.normalize(edge.T_reference_frame)  # of a whole way between keyframes
        self._edges[number] = frame_ns, replace(edge, T_reference_frame=T)
        for stamp_ns in (frame_ns, int(edge.reference_id)):  # type: ignore[call-overload]
            self._touching.setdefault(stamp_ns, {})[number] = None

    def _pop_edges(self, numbers: Iterable[int]) -> Iterator[tuple[int, Edge]]:
        for number in [*numbers]:
            frame_ns, edge = self._edges.pop(number)
            for stamp_ns in (frame_ns, int(edge.reference_id)):  # type: ignore[call-overload]
                del self._touching[stamp_ns][number]
            yield frame_ns, edge

    def _part(self, stamp_ns: int) -> int:
        """Return the number of guesses on the way to a keyframe."""
        return bisect(list(self._guesses), stamp_ns)

    def _way_to(self, stamp_ns: int) -> _Way:
        """Return the way to a keyframe."""
        row = self._known[self._known.number(stamp_ns)]
        T, covariance, drift = (row[key] for key in ("T_first_keyframe", "covariance", "drift"))
        return _Way(T, covariance, drift, int(row["n_steps"]))

    def _from_keyframe(self, edge: Edge) -> Edge:
        """Return an edge from a frame that hangs on a keyframe as one from the keyframe."""
        reference_ns = int(edge.reference_id)  # type: ignore[call-overload]
        if reference_ns in self._keyframes or reference_ns > self._known.stamps_ns[-1]:
            return edge
        return self._from_keyframe(then(self._home(reference_ns), edge))

    def _home(self, stamp_ns: int) -> Edge:
        """Return the pose of a frame, or of a merged keyframe, in its keyframe."""
        if stamp_ns in self._known:
            row = self._merged[self._merged_at[self._known.number(stamp_ns)]]
        else:
            row = self._frames[self._frames.number(stamp_ns)]
        return _edge(int(row["keyframe_ns"]), row["T"], row["covariance"])

    def advance(self, loops: Sequence[Loop], places: Container[int]) -> None:
        """Begin an optimization in a thread, or take one over, where it is time.

        Call it after each keyframe.

        Parameters
        ----------
        loops : sequence of Loop
            Those confirmed with it.
        places : container of int
            Stamps of keyframes that loops may lead to.
        """
        n_keyframes = len(self._known)
        self._is_due = self._is_due or bool(loops)
        self._standing |= {loop.stamp_ns: loop for loop in loops if loop.stamp_ns in self}
        if self._running is not None and n_keyframes >= self._due:
            self._take_over(self._running, places)
            self._running = None
        if self._running is None and self._is_due and n_keyframes >= self._next:
            self._is_due = False
            self._due = n_keyframes + max(_N_LATER, int(_SHARE_LATER * len(self)))
            self._next = n_keyframes + max(_N_APART, int(_GROWTH * len(self)))
            self._began_with = self._last
            graph = self._copied()
            if not graph._guesses:  # else those of merged keyframes tell which part is where
                graph.loops = [self._standing[ns] for ns in self._keyframes if ns in self._standing]
            pool = ThreadPoolExecutor(1)
            self._running = pool.submit(graph._solve)
            pool.shutdown(wait=False)

    def _take_over(self, running: Future[_Solution], places: Container[int]) -> None:
        error = running.exception()  # waits
        if error is not None or self._began_with is None:
            _LOGGER.warning("the map is not corrected while the run goes: %s", error)
            return
        solution, last = running.result(), self._began_with
        self.T_map_world = solution.poses[last.stamp_ns] @ se3.invert(last.T_world_frame)
        self._thin(solution.loops, places)

    def _thin(self, loops: Sequence[Loop], places: Container[int]) -> None:
        """Merge keyframes that came back to a place, and those after them without a place.

        Not across a loss: what is merged stays so, though its loop may be doubted later.
        """
        counting, lost = {loop.stamp_ns: loop for loop in loops}, self._losses()
        references = {*self._guesses.values(), *(loop.reference_ns for loop in loops)}
        n_at = Counter(counting[ns].reference_ns for ns in self._keyframes if ns in counting)
        for ns in list(self._keyframes)[1:-_N_LATEST]:
            loop = counting.get(ns)
            if ns in places or ns in references or ns in self._guesses:
                continue
            if loop is not None and bisect(lost, ns) > bisect(lost, loop.reference_ns):
                continue
            if loop is not None and n_at[loop.reference_ns] > _N_PER_PLACE:
                n_at[loop.reference_ns] -= 1
                self._merge(ns, loop.edge)
            elif loop is None and self._merged_at[self._known.number(ns) - 1] >= 0:
                self._merge(ns)

    def _merge(self, stamp_ns: int, loop: Edge | None = None) -> None:
        """Merge a keyframe into the one that it came back to, or else into the nearest."""
        edges: dict[int, Edge] = {}  # its pose in each neighbour
        for frame_ns, edge in self._pop_edges(self._touching[stamp_ns]):
            if stamp_ns == frame_ns:
                _fuse(edges, int(edge.reference_id), edge)  # type: ignore[call-overload]
            else:
                _fuse(edges, frame_ns, inverse(edge, frame_ns))
        del self._touching[stamp_ns]
        if loop is not None:
            _fuse(edges, int(loop.reference_id), loop)  # type: ignore[call-overload]
        hub_ns = min(edges, key=lambda ns: float(np.trace(edges[ns].covariance[3:, 3:])))
        hub_ns = hub_ns if loop is None else int(loop.reference_id)  # type: ignore[call-overload]
        del self._keyframes[stamp_ns]
        self._standing.pop(stamp_ns, None)
        hub = edges.pop(hub_ns)
        self._merged_at[self._known.number(stamp_ns)] = len(self._merged)
        place = hub.T_reference_frame, hub.covariance, np.zeros((6, 6))
        self._merged.append(stamp_ns, hub_ns, stamp_ns, 0, *place)
        # What ties it to the other one counts once, shared out among the edges that go on there.
        hub = replace(hub, covariance=max(len(edges), 1) * hub.covariance)
        moved = {ns: then(hub, inverse(edge, stamp_ns)) for ns, edge in edges.items()}
        neighbours = set().union(*(self._touching[ns] for ns in moved))
        between = [number for number in self._touching[hub_ns] if number in neighbours]
        for frame_ns, edge in self._pop_edges(between):
            if frame_ns == hub_ns:
                _fuse(moved, int(edge.reference_id), inverse(edge, frame_ns))  # type: ignore[call-overload]
            else:
                _fuse(moved, frame_ns, edge)
        for each in moved.items():
            self._add_edge(*each)

    def _copied(self) -> RunGraph:
        """Return the graph as it is, the frames since the latest keyframe among it."""
        graph = copy.copy(self)
        graph._keyframes, graph._guesses = dict(self._keyframes), dict(self._guesses)
        graph._edges, graph._touching = dict(self._edges), {}
        graph.loops = copy.copy(self.loops)
        if graph._arrivals:
            graph._open, _ = graph._condense()
        return graph

    def optimize(self) -> Optimum:
        """Return the poses that fit all measurements best, loops that contradict the rest apart.

        Nothing is changed by it. Where loops contradict the covariances of odometry, those of the
        poses are as much larger.

        Raises
        ------
        SmoothingError
            If GTSAM fails, the graph is empty, or no valid edge leads to a keyframe.
        """
        if not self._keyframes:
            raise SmoothingError("the graph of the run is empty: no frame has come (loops.enabled)")
        graph = self._copied()
        poses, _, reasons, error_before, optimizer, firsts = graph._solve()
        loops = tuple(
            replace(each, reason=each.reason or reasons.get(_ends(each), ""))
            for each in graph.loops
        )
        found = graph._variance_factor(loops) * optimizer.covariances()
        by_keyframe = dict(zip(graph._keyframes, found, strict=True))
        for stamp_ns, first_ns in firsts.items():
            T = se3.invert(poses[stamp_ns]) @ poses[first_ns]
            guessed = se3.transport_covariance(graph._keyframes[first_ns].covariance, T)
            by_keyframe[stamp_ns] = by_keyframe[stamp_ns] + guessed
        return Optimum(
            estimates=graph._place(poses, by_keyframe),
            keyframes_ns=tuple(graph._keyframes),
            edges=tuple(graph._edges.values()),
            loops=loops,
            residuals=np.sqrt(
                [
                    chi2(each.edge, se3.invert(poses[each.reference_ns]) @ poses[each.stamp_ns])
                    for each in loops
                ]
            ),
            error_before=error_before,
            error=optimizer.error,
            n_iterations=optimizer.n_iterations,
        )

    def _solve(self) -> _Solution:
        loops, reasons, refused = self._judged()
        graph = self._whole(loops, refused=refused)
        firsts = self._bridge(graph)
        optimizer = BatchOptimizer(graph)
        if len(optimizer.numbers) < len(self._keyframes):
            raise SmoothingError(f"a keyframe has no valid edge: {graph.rejected[0]}")
        error_before = optimizer.starts["odometry"]
        optimizer.run()
        poses = dict(zip(self._keyframes, optimizer.poses(), strict=True))
        return _Solution(poses, loops, reasons, error_before, optimizer, firsts)

    def _judged(self) -> tuple[list[Loop], dict[tuple[object, int], str], _Pairs]:
        """Return the loops of keyframes that count, and why those between others do not.

        And the pairs of keyframes whose loops, or edges between parts, are refused.
        """
        loops, far, refused = self._possible()
        if loops or self._guesses:
            if self._guesses:  # else all is one part
                confirmed = (loop for loop in self.loops if not loop.reason)
                refused |= self._outvoted(loop for loop in confirmed if _ends(loop) not in far)
            possible = [loop for loop in loops if _ends(loop) not in refused]
            drift = _DRIFT * np.sqrt(len(self._edges))
            graph = self._whole(possible, drift=drift, refused=refused)
            optimizer = BatchOptimizer(graph, "gnc")
            optimizer.run(only_refuse=True)
            keyframes = list(self._keyframes)
            refused |= {(keyframes[a], keyframes[b]) for a, b, _ in optimizer.refused}
        reasons = dict.fromkeys(refused, _CONTRADICTS) | dict.fromkeys(far, _TOO_FAR)
        if doubted := self._doubted(loops, reasons.keys()):
            refused |= doubted
            reasons = dict.fromkeys(doubted, _DOUBTED) | reasons
        return [loop for loop in loops if _ends(loop) not in refused], reasons, refused

    def _doubted(
        self, loops: Sequence[Loop], reasons: AbstractSet[tuple[object, int]]
    ) -> set[tuple[object, int]]:
        """Return what leads across a loss, where most loops are refused.

        Such a world repeats itself, and across a loss odometry cannot tell which are false.
        """
        lost = self._losses()
        edges = {(edge.reference_id, frame_ns) for frame_ns, edge in self._edges.values()}
        n_confirmed = sum(not loop.reason for loop in self.loops) if lost else 0
        if 2 * len(reasons - edges) <= n_confirmed:
            return set()
        return {
            (reference, frame_ns)
            for reference, frame_ns in edges.union(map(_ends, loops))
            if bisect(lost, reference) != bisect(lost, frame_ns)  # type: ignore[call-overload]
            and self._guesses.get(frame_ns) != reference
        }

    def _losses(self) -> list[int]:
        """Return the keyframes that a loss is before."""
        return [ns for ns in self._guesses if self._keyframes[ns].status is Status.LOST]

    def _bridge(self, graph: WholeGraph) -> dict[int, int]:
        """Add the guesses that alone connect keyframes: elsewhere they tell nothing.

        They are added as if they were known: the rest of a graph does not depend on that, and
        sigmas so far apart would be too much for a solver.

        Returns
        -------
        dict of int to int
            By keyframes that only guesses connect with the first one: the first of those that
            are connected with them.
        """
        stamps_ns = list(self._keyframes)
        roots = {ns: ns for ns in stamps_ns}

        def root(stamp_ns: int) -> int:
            while roots[stamp_ns] != stamp_ns:
                stamp_ns = roots[stamp_ns]
            return stamp_ns

        for reference, frame, _ in graph.links:
            first, second = sorted((root(stamps_ns[reference]), root(stamps_ns[frame])))
            roots[second] = first
        firsts = {ns: root(ns) for ns in stamps_ns if root(ns) != stamps_ns[0]}
        for stamp_ns, edge in self._edges.values():
            before_ns = self._guesses.get(stamp_ns, stamp_ns)
            if edge.reference_id == before_ns and root(before_ns) != root(stamp_ns):
                roots[root(stamp_ns)] = root(before_ns)
                graph.add_edges(stamp_ns, [replace(edge, covariance=ORIGIN.covariance)])
        return firsts

    def _whole(
        self, loops: Sequence[Loop], *, drift: float = 0.0, refused: _Pairs = frozenset()
    ) -> WholeGraph:
        """Return the graph without guesses; or with a share of each way that odometry may drift.

        Edges between two parts, which only guesses connect besides, may be refused as loops are.
        """
        graph, first = WholeGraph(), next(iter(self._keyframes.values()))
        origin = PosePrior(T_world_frame=first.T_world_frame, covariance=ORIGIN.covariance)
        for stamp_ns, estimate in self._keyframes.items():
            graph.add_pose(stamp_ns, stamp_ns, origin if estimate is first else None)
            graph.given[stamp_ns] = estimate.T_world_frame
        for stamp_ns, edge in self._edges.values():
            reference_ns = int(edge.reference_id)  # type: ignore[call-overload]
            is_guess = self._guesses.get(stamp_ns) == reference_ns
            is_inside = self._part(stamp_ns) == self._part(reference_ns)
            if drift if is_guess else (reference_ns, stamp_ns) not in refused or is_inside:
                is_trusted = is_inside or is_guess
                graph.add_edges(
                    stamp_ns,
                    [replace(edge, covariance=edge.covariance + _drift(edge, drift))],
                    is_trusted=is_trusted,
                )
        for loop in loops:
            if loop.stamp_ns in self._keyframes and loop.reference_ns in self._keyframes:
                graph.add_edges(loop.stamp_ns, [loop.edge])
        return graph

    def _possible(self) -> tuple[list[Loop], set[tuple[object, int]], set[tuple[object, int]]]:
        """Return the loops of keyframes that odometry alone allows.

        And the ends of those that it does not, however many agree with each other, as those between
        equal rooms do; and of those whose keyframe was merged elsewhere, which were refused.
        """
        loops, far, elsewhere = [], set(), set()
        for loop in self.loops:
            if loop.reason:
                continue
            if loop.stamp_ns not in self._keyframes:
                if self._home(loop.stamp_ns).reference_id != loop.reference_ns:
                    elsewhere.add(_ends(loop))
            elif not self.allows(loop):
                far.add(_ends(loop))
            else:
                loops.append(loop)
        return loops, far, elsewhere

    def _chi2(self, loop: Loop, *, drifts: bool) -> float:
        """Return by how much a loop contradicts the way between its ends."""
        way, before = self._way_to(loop.stamp_ns), self._way_to(loop.reference_ns)
        return way.chi2(loop, before, drifts=drifts)

    def _outvoted(self, loops: Iterable[Loop]) -> set[tuple[object, int]]:
        """Return which loops and edges between two parts contradict the one with most agreement.

        Odometry is trusted but for its drift over the whole way, however many of them agree.
        """
        across: dict[tuple[int, int], list[tuple[int, Edge]]] = {}
        looped = ((loop.stamp_ns, loop.edge) for loop in loops)
        for frame_ns, edge in chain(looped, self._edges.values()):
            reference_ns = int(edge.reference_id)  # type: ignore[call-overload]
            parts = self._part(reference_ns), self._part(frame_ns)
            if parts[0] != parts[1] and self._guesses.get(frame_ns) != reference_ns:
                across.setdefault(parts, []).append((frame_ns, edge))
        refused: set[tuple[object, int]] = set()
        for group in across.values():
            voters = group[:: len(group) // _N_VOTERS + 1]
            n_agreeing = [sum(self._agree(*one, *each) for each in voters) for one in voters]
            best = voters[int(np.argmax(n_agreeing))]
            against = [each for each in group if not self._agree(*best, *each)]
            refused |= {(edge.reference_id, frame_ns) for frame_ns, edge in against}
        return refused

    def _agree(self, first_ns: int, first: Edge, second_ns: int, second: Edge) -> bool:
        """Tell whether two edges agree, as far as odometry between their ends drifts."""
        start, end, other_start, other_end = (
            self._way_to(ns)  # type: ignore[arg-type]
            for ns in (first.reference_id, first_ns, second.reference_id, second_ns)
        )
        T_starts = se3.invert(other_start.T_first_keyframe) @ start.T_first_keyframe
        T_ends = se3.invert(end.T_first_keyframe) @ other_end.T_first_keyframe
        T_expected = T_starts @ first.T_reference_frame @ T_ends
        drift = other_end.covariance_since(end, drifts=True)
        covariance = se3.compose_covariance(first.covariance, T_ends, drift) + second.covariance
        drift = other_start.covariance_since(start, drifts=True)
        covariance += se3.transport_covariance(drift, se3.invert(second.T_reference_frame))
        difference = se3.log(se3.invert(T_expected) @ second.T_reference_frame)
        return bool(se3.mahalanobis(difference, covariance) <= INLIER_CHI2)

    def _variance_factor(self, loops: Sequence[Loop]) -> float:
        """Return how much more odometry drifts than its covariances say, 1 at least.

        The median over the loops of what each contradicts it by, unless that may be chance.
        """
        ratios = [
            self._chi2(loop, drifts=False) / 6.0
            for loop in loops
            if not loop.reason and self._part(loop.stamp_ns) == self._part(loop.reference_ns)
        ]
        factor = float(np.median(ratios)) if ratios else 1.0
        return factor if factor > INLIER_CHI2 / 6.0 else 1.0

    def _place(
        self, poses: dict[int, FloatArray], covariances: dict[int, FloatArray]
    ) -> tuple[Estimate, ...]:
        """Return all frames; those of merged keyframes are added to the poses."""
        estimates: list[Estimate] = []
        first, before_ns = 0, self._known.stamps_ns[0]
        places = poses, covariances
        for number, stamp_ns in enumerate(self._known.stamps_ns):
            row = self._known[number]
            self._place_merged(stamp_ns, *places)
            rows = [self._frames[k] for k in range(first, first + int(row["n_frames"]))]
            if rows:
                estimates += _place_frames(rows, before_ns, *places, next_ns=stamp_ns, step=row)
            T, covariance = poses[stamp_ns], covariances[stamp_ns]
            estimates.append(_estimate(stamp_ns, int(row["status"]), T, covariance))
            first, before_ns = first + len(rows), stamp_ns
        estimates += _place_frames(self._open, before_ns, *places)
        return tuple(estimates)

    def _place_merged(
        self, stamp_ns: int, poses: dict[int, FloatArray], covariances: dict[int, FloatArray]
    ) -> None:
        """Add the pose of a keyframe that was merged, and of those on the way to where it is."""
        pending = []
        while stamp_ns not in poses:
            pending.append((stamp_ns, self._home(stamp_ns)))
            stamp_ns = int(pending[-1][1].reference_id)  # type: ignore[call-overload]
        for merged_ns, edge in reversed(pending):
            T, before = edge.T_reference_frame, covariances[stamp_ns]
            poses[merged_ns] = poses[stamp_ns] @ T
            covariances[merged_ns] = se3.compose_covariance(before, T, edge.covariance)
            stamp_ns = merged_ns


def _place_frames(
    rows: Sequence[NDArray[Any] | tuple[Any, ...]],
    keyframe_ns: int,
    poses: dict[int, FloatArray],
    covariances: dict[int, FloatArray],
    *,
    next_ns: int | None = None,
    step: NDArray[Any] | None = None,
) -> Iterator[Estimate]:
    """Yield the frames that hang on a keyframe, in the world.

    They are bent so that they fit the next keyframe, too: where they are least certain, most.

    Parameters
    ----------
    rows : sequence of _FRAME
    keyframe_ns : int
    poses, covariances : dict of int to ndarray
        Of keyframes.
    next_ns : int, optional
        The next keyframe, where there is one.
    step : _KEYFRAME, optional
        Its row.
    """
    frames = np.array(rows, dtype=_FRAME)
    T_keyframe_frame, found, with_next = (
        np.ascontiguousarray(frames[name]) for name in ("T", "covariance", "with_next")
    )
    placed = se3.compose_covariance(covariances[keyframe_ns], T_keyframe_frame, found)
    if step is not None and next_ns is not None:
        T_next_keyframe = se3.invert(step["T_step"])
        T_next_frame = T_next_keyframe @ T_keyframe_frame
        T_keyframe_next = se3.invert(poses[keyframe_ns]) @ poses[next_ns]
        # what the next keyframe tells of a frame when it turns out to be elsewhere
        gains = with_next @ np.linalg.inv(step["step_covariance"])
        is_guess = bool(step["is_guess"])
        if is_guess:
            # too far for that: as much of the way as of the uncertainty
            shares = np.clip(np.trace(gains, axis1=1, axis2=2) / 6.0, 0.0, 1.0)
            bend = se3.log(T_keyframe_next @ T_next_keyframe)
            T_keyframe_frame = se3.exp(shares[:, np.newaxis] * bend) @ T_keyframe_frame
        else:
            miss = se3.log(T_next_keyframe @ T_keyframe_next)
            T_keyframe_frame = T_keyframe_frame @ se3.exp(gains @ miss)
        rest = found - gains @ np.swapaxes(with_next, 1, 2)
        rest = 0.5 * (rest + np.swapaxes(rest, 1, 2))
        forth, back = (
            se3.compose_covariance(covariances[ns], T, rest)
            for ns, T in ((keyframe_ns, T_keyframe_frame), (next_ns, T_next_frame))
        )
        is_larger = np.linalg.det(back) > np.linalg.det(forth)
        placed = np.where((is_larger ^ is_guess)[:, np.newaxis, np.newaxis], back, forth)
    stamps_ns, statuses = (frames[name].tolist() for name in ("stamp_ns", "status"))
    yield from map(_estimate, stamps_ns, statuses, poses[keyframe_ns] @ T_keyframe_frame, placed)


def _estimate(stamp_ns: int, status: int, T: FloatArray, covariance: FloatArray) -> Estimate:
    return Estimate(
        stamp_ns=stamp_ns,
        T_world_frame=T,
        covariance=covariance,
        status=_STATUSES[status],
        frame_id=stamp_ns,
    )


def _edge(reference_id: FrameId, T: FloatArray, covariance: FloatArray) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=covariance)


def _ends(loop: Loop) -> tuple[object, int]:
    return loop.reference_ns, loop.stamp_ns


def _fuse(edges: dict[int, Edge], key: int, edge: Edge) -> None:
    """Add an edge, made one with what is there already, from the same frame to the same."""
    edges[key] = fuse([edges[key], edge]) if key in edges else edge


def _drift(edge: Edge, share: float) -> FloatArray:
    """Return the covariance of a drift that is a share of a way and of its turn."""
    T = edge.T_reference_frame
    sigma_m = share * float(np.linalg.norm(T[:3, 3]))
    turn = share * float(se3.rotation_angle(T)) + _TURN_PER_M / _DRIFT * sigma_m
    return np.diag(np.repeat([turn, sigma_m], 3) ** 2)
