"""The graph of a run: all its frames, the edges between them, and its loops.

It outlives the window. Loops are judged on the chain of their ends, which odometry joins; those
that count go with all edges into one optimization at the end. While the run goes, the same chain
tells how the loops correct the newest pose: it is optimized in a thread and taken over a fixed
number of keyframes later, so that a run can be repeated.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from gvo.backend.batch import INLIER_CHI2, BatchOptimizer, WholeGraph
from gvo.backend.factors import ORIGIN
from gvo.backend.motion_model import SHIFT_SIGMA, TURN_SIGMA
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.geometry.edges import NO_EFFECTS, between, chi2, fuse, inverse, source_ns, then
from gvo.odometry.path import Parts, Path, Way, Ways, bent
from gvo.types import Edge, Estimate, FloatArray, Loop, Optimum, PosePrior, Status

_LOGGER = logging.getLogger(__name__)

# Between which frames loops contradict the rest, and the correction of the newest pose.
_Verdict: TypeAlias = tuple[set[tuple[int, int]], FloatArray]

# The latest frames are not merged: edges to come may start from them.
_N_RECENT = 100
# Why loops are refused.
_TOO_FAR = "farther from odometry than that drifts"
_CONTRADICTS = "contradicts odometry or the other loops"
_DOUBTED = "across a gap, where most other loops are refused"
# 95 % quantile of chi-square with six degrees of freedom: how far a loop may be from odometry.
_FAR_CHI2 = 12.592
# Without a measurement, what moves may halt: a share of the velocity is one sigma of it. For a
# second, a velocity changes in proportion to the time, so that a way does with its square.
_HALT = 0.3
_STEADY_S = 1.0
# Upper bounds of the sigmas of a guess: rad and m.
_GUESS_SIGMAS = np.array([3.0, 3.0, 3.0, 1000.0, 1000.0, 1000.0])
# The chain is optimized again when so many keyframes have come, and this share of its length, and
# taken over so many keyframes later.
_N_APART, _SHARE_APART, _N_LATER = 20, 0.25, 5


class RunGraph:
    """The frames of a run with the edges between them, named by their stamps.

    Parameters
    ----------
    max_frames : int
        Of the graph: beyond so many, those that are no places are merged, oldest first.

    Attributes
    ----------
    path : Path
        All frames, as the window has them.
    parts : Parts
        Which of them the edges connect, those of the newest one being added.
    loops : sequence of Loop
        Those with a reason against them do not count.
    T_map_world : ndarray of float64, shape (4, 4)
        The correction of the newest poses by loops, as last optimized while the run goes.
    """

    def __init__(self, *, max_frames: int = 3000) -> None:
        self._max_frames = max_frames
        self.path, self.parts = Path(), Parts()
        # By the stamps of both ends, the earlier one first; and which frames are tied to which.
        self._edges: dict[tuple[int, int], list[Edge]] = {}
        self._neighbours: dict[int, set[int]] = {}
        # Frames of the graph that are no places, oldest first.
        self._passing: deque[int] = deque()
        self._measured_ns = 0
        # An edge led to a frame that nothing measured: what came after it tells where that was.
        self._is_bridged = False
        self.loops: Sequence[Loop] = ()
        self.T_map_world: FloatArray = np.eye(4)
        self._running: Future[_Verdict] | None = None
        self._n_keyframes = self._next = self._due = 0
        self._is_due = False
        # Size of the errors that the edges share, in units of their effects.
        self.effects_factor = 1.0

    def __len__(self) -> int:
        """Return the number of frames that were not merged."""
        return len(self._neighbours)

    def add_frame(self, estimate: Estimate, edges: Sequence[Edge], *, is_place: bool) -> None:
        """Add a frame with the edges that measure it from earlier ones.

        Parameters
        ----------
        estimate : Estimate
            Its pose as it came, by the window.
        edges : sequence of Edge
            Without one its place is a guess: it may have moved on or halted.
        is_place : bool
            Loops may lead to it: it stays in the graph however many others follow.
        """
        stamp_ns = estimate.stamp_ns
        edges = [edge for edge in edges if edge.reference_id in self.path]
        if len(self.path) == 0:
            self._neighbours[stamp_ns] = set()
        self.path.append(estimate, self._guessed(estimate))
        if edges or len(self.path) == 1:
            self._measured_ns = stamp_ns
        self._connect(estimate, edges)
        self._is_bridged |= bool(edges) and estimate.status is Status.COASTING
        for edge in edges:
            self._put(stamp_ns, edge)
        if edges and not is_place:
            self._passing.append(stamp_ns)
        while len(self) > self._max_frames and len(self._passing) > _N_RECENT:
            self._merge(self._passing.popleft())

    def snapshot(self) -> RunGraph:
        """Return a copy to optimize in another thread, which stays as it is while this grows."""
        graph = copy(self)
        graph.path, graph.parts = self.path.copy(), self.parts.copy()
        graph._edges = {ends: [*edges] for ends, edges in self._edges.items()}
        graph._neighbours = {ns: {*others} for ns, others in self._neighbours.items()}
        graph._passing, graph.loops, graph._running = self._passing.copy(), (*self.loops,), None
        return graph

    def settle(self, estimates: Iterable[Estimate]) -> None:
        """Take over better poses of frames, such as those that the window has smoothed."""
        self.path.update(estimates)

    def allows(self, loop: Loop) -> bool:
        """Tell whether a loop leads where odometry, and what was guessed in the dark, allow it."""
        way = self.path.way(loop.reference_ns, loop.stamp_ns) if self._is_known(loop) else None
        return way is None or _is_allowed(loop, way)

    def _is_known(self, loop: Loop) -> bool:
        return loop.stamp_ns in self.path and loop.reference_ns in self.path

    def _guessed(self, estimate: Estimate) -> FloatArray:
        """Return the covariance of the step to a frame that nothing measures."""
        if len(self.path) == 0:
            return np.zeros((6, 6))
        last_ns = self.path.stamps_ns[-1]
        elapsed_s = 1e-9 * (estimate.stamp_ns - last_ns)
        T_last_frame = se3.invert(self.path.pose(last_ns)) @ estimate.T_world_frame
        velocity = se3.log(T_last_frame).reshape(2, 3) / elapsed_s
        turn, speed = _HALT * np.linalg.norm(velocity, axis=1)
        variances = []
        for stamp_ns in (last_ns, estimate.stamp_ns):
            t = 1e-9 * (stamp_ns - self._measured_ns)
            turns = TURN_SIGMA * t, turn * t
            shifts = SHIFT_SIGMA * t * min(t / _STEADY_S, 1.0), speed * t
            sigmas = np.repeat([np.hypot(*turns), np.hypot(*shifts)], 3)
            variances.append(np.minimum(sigmas, _GUESS_SIGMAS) ** 2)
        return np.diag(variances[1] - variances[0])

    def _connect(self, estimate: Estimate, edges: Sequence[Edge]) -> None:
        """Note which parts the edges of the newest frame connect, and move those that come to it.

        All frames of a part move along with the one that found its place.
        """
        stamp_ns, path, parts = estimate.stamp_ns, self.path, self.parts
        by_part = {parts.of(source_ns(edge)): edge for edge in edges}
        parts.add(stamp_ns)
        if not by_part:
            return
        newest = max(edges, key=source_ns)
        path.connect(source_ns(newest), stamp_ns, newest.covariance)
        first = min(by_part)
        home = by_part.pop(first)
        for part, edge in by_part.items():
            reference_ns = source_ns(edge)
            T_world_reference = estimate.T_world_frame @ se3.invert(edge.T_reference_frame)
            T_moved = T_world_reference @ se3.invert(path.pose(reference_ns))
            before_ns = max(ns for ns in path.stamps_ns if ns < part and parts.of(ns) == first)
            is_moved = np.array([parts.of(ns) == part for ns in path.stamps_ns])
            path.move(is_moved, T_moved, start=path.index(before_ns))
            T_part_frame = se3.invert(path.pose(part)) @ estimate.T_world_frame
            path.connect(before_ns, part, se3.transport_covariance(home.covariance, T_part_frame))
        parts.add(stamp_ns, [first, *by_part])

    def _put(self, frame_ns: int, edge: Edge) -> None:
        reference_ns = source_ns(edge)
        if reference_ns > frame_ns:
            frame_ns, edge, reference_ns = reference_ns, inverse(edge, frame_ns), frame_ns
        self._edges.setdefault((reference_ns, frame_ns), []).append(edge)
        self._neighbours.setdefault(frame_ns, set()).add(reference_ns)
        self._neighbours.setdefault(reference_ns, set()).add(frame_ns)

    def _merge(self, stamp_ns: int) -> None:
        """Merge a frame into the neighbour that it is tied to most closely.

        Its other ties go on from there. The closest one counts once, so they share it.
        """
        ties = {}
        for other_ns in self._neighbours.pop(stamp_ns):
            self._neighbours[other_ns].discard(stamp_ns)
            ends = min(other_ns, stamp_ns), max(other_ns, stamp_ns)
            tie = fuse(self._edges.pop(ends))
            ties[other_ns] = inverse(tie, other_ns) if other_ns > stamp_ns else tie
        if not ties:  # all that it was tied to was merged into it
            return
        hub_ns = min(ties, key=lambda ns: float(np.trace(ties[ns].covariance[3:, 3:])))
        hub = ties.pop(hub_ns)
        hub = replace(hub, covariance=max(len(ties), 1) * hub.covariance)
        for other_ns, tie in ties.items():
            self._put(other_ns, then(hub, inverse(tie, stamp_ns)))
            ends = min(other_ns, hub_ns), max(other_ns, hub_ns)
            self._edges[ends] = [fuse(self._edges[ends])]

    def advance(self, *, is_looped: bool) -> None:
        """Begin to correct the newest poses in a thread, or take it over, where it is time.

        Call it after each keyframe.

        Parameters
        ----------
        is_looped : bool
            A loop was confirmed since the last call.
        """
        self._n_keyframes += 1
        self._is_due = self._is_due or is_looped
        if self._running is not None and self._n_keyframes >= self._due:
            running, self._running = self._running, None
            error = running.exception()  # waits
            if error is None:
                _, self.T_map_world = running.result()
            else:
                _LOGGER.warning("the map is not corrected while the run goes: %s", error)
        if self._running is None and self._is_due and self._n_keyframes >= self._next:
            self._is_due = False
            chain = self._chain(self.loops, self.path.ways())
            self._due = self._n_keyframes + _N_LATER
            self._next = self._n_keyframes + max(_N_APART, int(_SHARE_APART * len(chain.ends_ns)))
            pool = ThreadPoolExecutor(1)
            self._running = pool.submit(chain.judge)
            pool.shutdown(wait=False)

    def _chain(self, loops: Iterable[Loop], ways: Ways) -> _Chain:
        """Return the ends of the confirmed loops that odometry alone allows, as it joins them."""
        allowed, too_far = list[Loop](), list[Loop]()
        for loop in loops:
            if not loop.reason and self._is_known(loop):
                is_allowed = _is_allowed(loop, self._way_of(loop, ways))
                (allowed if is_allowed else too_far).append(loop)
        ends_ns = {self.path.stamps_ns[0], self.path.stamps_ns[-1]}
        ends_ns.update(*((loop.reference_ns, loop.stamp_ns) for loop in allowed))
        ends = np.array([self.path.index(ns) for ns in sorted(ends_ns)])
        return _Chain(
            ends_ns=sorted(ends_ns),
            T_world_ends=np.array(self.path.poses[ends]),
            ways=ways.between(ends[:-1], ends[1:]),
            loops=allowed,
            too_far=too_far,
        )

    def _way_of(self, loop: Loop, ways: Ways) -> Way:
        first, last = (self.path.index(ns) for ns in (loop.reference_ns, loop.stamp_ns))
        return ways.between(np.array(first), np.array(last))

    def optimize(self) -> Optimum:
        """Return the poses that fit all measurements best, loops that contradict the rest apart.

        Without a loop that counts, or a gap that an IMU led over, the poses are those of the path.
        Nothing is changed by it.
        Where loops contradict the covariances of odometry, those of the poses are as much larger.

        Raises
        ------
        SmoothingError
            If GTSAM fails, the graph is empty, or no valid edge leads to a frame.
        """
        if len(self.path) == 0:
            raise SmoothingError("the graph of the run is empty: no frame has come")
        ways = self.path.ways()
        reasons = self._reasons(self.loops, ways)
        loops = tuple(
            replace(each, reason=each.reason or reasons.get(_ends(each), "")) for each in self.loops
        )
        counted = [loop for loop in loops if not loop.reason]
        estimates, progress = self.path.estimates(), dict[str, Any]()
        if counted or self._is_bridged:
            estimates, progress = self._fit(counted, ways)
        poses = {each.stamp_ns: each.T_world_frame for each in estimates}
        edges = ((frame_ns, edge) for (_, frame_ns), ties in self._edges.items() for edge in ties)
        misfits = [
            chi2(each.edge, se3.invert(poses[each.reference_ns]) @ poses[each.stamp_ns])
            for each in loops
        ]
        return Optimum(
            estimates=estimates,
            frames_ns=tuple(sorted(self._neighbours)),
            edges=tuple(edges),
            loops=loops,
            residuals=np.sqrt(misfits),
            **progress,
        )

    def _fit(
        self, loops: Sequence[Loop], ways: Ways
    ) -> tuple[tuple[Estimate, ...], dict[str, Any]]:
        """Optimize all edges and these loops; return all frames, and how it went."""
        frames_ns = sorted(self._neighbours)
        graph = self._whole(frames_ns, loops)
        optimizer = BatchOptimizer(graph, start="given")
        if len(optimizer.numbers) < len(frames_ns):
            raise SmoothingError(f"a frame has no valid edge: {graph.rejected[0]}")
        progress = {"error_before": optimizer.error}
        optimizer.run()
        progress |= {"error": optimizer.error, "n_iterations": optimizer.n_iterations}
        odometry = BatchOptimizer(self._whole(frames_ns, ()), start="given")
        drawn = dict(zip(frames_ns, odometry.effects(), strict=True))
        factor = self._variance_factor(loops, ways, drawn)
        covariances = factor * optimizer.covariances()
        effects = self.effects_factor * optimizer.effects()
        return self._place(frames_ns, optimizer.poses(), covariances, effects, ways), progress

    def _reasons(self, loops: Sequence[Loop], ways: Ways) -> dict[tuple[int, int], str]:
        """Return why confirmed loops between two frames do not count."""
        chain = self._chain(loops, ways)
        refused = {_ends(loop) for loop in chain.too_far}
        reasons = dict.fromkeys(refused, _TOO_FAR)
        reasons |= dict.fromkeys(chain.judge()[0], _CONTRADICTS)
        # Such a world repeats itself, and across a gap odometry cannot tell which are false.
        n_confirmed = len(chain.loops) + len(chain.too_far)
        if 2 * len(reasons) > n_confirmed:
            across = map(_ends, filter(self._is_across, chain.loops))
            reasons = dict.fromkeys(across, _DOUBTED) | reasons
        return reasons

    def _is_across(self, loop: Loop) -> bool:
        """Tell whether a loop leads from one part to another."""
        return self.parts.of(loop.stamp_ns) != self.parts.of(loop.reference_ns)

    def _whole(self, frames_ns: Sequence[int], loops: Sequence[Loop]) -> WholeGraph:
        """Return the graph of some frames; a guess is an edge only where nothing else connects."""
        graph, parts = _graph_of(frames_ns, map(self.path.pose, frames_ns)), Parts()
        for (reference_ns, frame_ns), edges in self._edges.items():
            graph.add_edges(frame_ns, edges)
            parts.join(reference_ns, frame_ns)
        for loop in loops:
            graph.add_edges(loop.stamp_ns, [loop.edge])
            parts.join(loop.reference_ns, loop.stamp_ns)
        for before_ns, frame_ns in pairwise(frames_ns):
            if parts.of(before_ns) != parts.of(frame_ns):
                way = self.path.way(before_ns, frame_ns)
                # What led past a part that nothing connects left no guess of where that lies.
                sigmas = np.repeat([TURN_SIGMA, SHIFT_SIGMA], 3) * 1e-9 * (frame_ns - before_ns)
                known = way.covariance if way.covariance.any() else np.diag(sigmas**2)
                graph.add_edges(frame_ns, [_edge(before_ns, way.T, known)])
                parts.join(before_ns, frame_ns)
        return graph

    def _variance_factor(
        self, loops: Sequence[Loop], ways: Ways, effects: Mapping[int, FloatArray]
    ) -> float:
        """Return how much more odometry drifts than its covariances say, 1 at least.

        The median over the loops of what each contradicts it by, unless that may be chance. What
        shared errors do to a loop and to the way between its ends, by those on frames, is no drift.
        """
        ratios = []
        for loop in loops:
            if not self._is_across(loop):
                way = self._way_of(loop, ways)
                moved = between(effects[loop.reference_ns], effects[loop.stamp_ns], way.T)
                moved -= NO_EFFECTS if loop.effects is None else loop.effects
                moved *= self.effects_factor
                ratios.append(chi2(loop.edge, way.T, way.covariance + moved @ moved.T) / 6.0)
        factor = float(np.median(ratios)) if ratios else 1.0
        return factor if factor > INLIER_CHI2 / 6.0 else 1.0

    def _place(
        self,
        frames_ns: Sequence[int],
        poses: FloatArray,
        covariances: FloatArray,
        effects: FloatArray,
        ways: Ways,
    ) -> tuple[Estimate, ...]:
        """Return all frames; those that are not in the graph hang on those that are.

        Each goes with the one before it, and is bent so that the one after it fits, too.
        """
        path, n = self.path, len(self.path)
        known = np.array([path.index(ns) for ns in frames_ns])
        others = np.setdiff1d(np.arange(n), known)
        T, C = np.empty((n, 4, 4)), np.empty((n, 6, 6))
        T[known], C[known] = poses, covariances
        before = np.searchsorted(known, others) - 1
        after = np.minimum(before + 1, len(known) - 1)
        way = ways.between(known[before], others)
        placed = poses[before] @ way.T
        ends = placed @ se3.invert(path.poses[others]) @ path.poses[known[after]]
        shares = path.shares(others, known[before], known[after])
        T[others] = bent(placed, ends, poses[after], shares)
        rest = (1.0 - shares)[:, np.newaxis, np.newaxis] * way.covariance
        C[others] = se3.compose_covariance(covariances[before], way.T, rest)
        S = np.empty((n, *effects.shape[1:]))
        S[known] = effects
        starts = se3.adjoint(se3.invert(way.T)) @ effects[before]
        moves = se3.adjoint(se3.invert(T[others]) @ poses[after]) @ effects[after] - starts
        S[others] = starts + shares[:, np.newaxis, np.newaxis] * moves
        return path.estimates(T, C + S @ np.swapaxes(S, 1, 2))


class _Chain(NamedTuple):
    """The ends of loops, oldest first, the first and the latest frame, and the ways between."""

    ends_ns: list[int]
    T_world_ends: FloatArray
    ways: Way
    loops: list[Loop]
    too_far: list[Loop]

    def judge(self) -> _Verdict:
        """Find out which loops fit together with odometry, which may drift, and with each other."""
        graph, n = _graph_of(self.ends_ns, self.T_world_ends), len(self.ends_ns)
        # of all ways alike: the sigmas of their drifts add up
        covariances = self.ways.covariance + (n - 1) * self.ways.drift
        for (before_ns, end_ns), T, covariance in zip(
            pairwise(self.ends_ns), self.ways.T, covariances, strict=True
        ):
            graph.add_edges(end_ns, [_edge(before_ns, T, covariance)], is_trusted=True)
        for loop in self.loops:
            graph.add_edges(loop.stamp_ns, [loop.edge])
        optimizer = BatchOptimizer(graph, "gnc", start="given")
        optimizer.run()
        refused = {(self.ends_ns[a], self.ends_ns[b]) for a, b, _ in optimizer.refused}
        return refused, optimizer.poses()[-1] @ se3.invert(self.T_world_ends[-1])


def _graph_of(stamps_ns: Iterable[int], poses: Iterable[FloatArray]) -> WholeGraph:
    """Return a graph of frames where they are, without edges; the first one is held there."""
    graph = WholeGraph()
    for stamp_ns, T_world_frame in zip(stamps_ns, poses, strict=True):
        is_first = not graph.frame_ids
        origin = PosePrior(T_world_frame=T_world_frame, covariance=ORIGIN.covariance)
        graph.add_pose(stamp_ns, stamp_ns, origin if is_first else None)
        graph.given[stamp_ns] = T_world_frame
    return graph


def _is_allowed(loop: Loop, way: Way) -> bool:
    return chi2(loop.edge, way.T, way.covariance + way.drift) <= _FAR_CHI2


def _edge(reference_ns: int, T: FloatArray, covariance: FloatArray) -> Edge:
    return Edge(reference_id=reference_ns, T_reference_frame=T, covariance=covariance)


def _ends(loop: Loop) -> tuple[int, int]:
    return loop.reference_ns, loop.stamp_ns
