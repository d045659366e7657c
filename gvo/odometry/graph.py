"""The graph of a run: its keyframes, the edges between them, and its loops.

It outlives the window. What lies between two keyframes is solved by itself, the earlier one being
the origin: of the poses found there, those of other keyframes become edges, and the frames between
hang on the earlier keyframe. An edge and a frame take a few hundred bytes each.

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
import logging
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gvo.backend.batch import BatchOptimizer, LocalGraph, WholeGraph
from gvo.backend.factors import ORIGIN, Factors
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, Loop, Optimum, PosePrior, Status

_LOGGER = logging.getLogger(__name__)

# Sigmas of a step of a camera that is lost: rad and m.
_LOST_SIGMA = 100.0
# 99 % quantile of chi-square with six degrees of freedom, of each.
_MAX_CHANCE = 16.812 / 6.0
# Beyond this sigma in metres a step tells nothing.
_LOOSE_SIGMA_M = 10.0
# Drift that is allowed for when loops are judged, over the whole path: a share of it, and radians
# per metre.
_DRIFT = 0.01
_TURN_PER_M = 0.0005
# An optimization begins with a loop when the graph has grown by this share, and by so many
# keyframes, since the last one, and is taken over so many keyframes later.
_GROWTH = 0.25
_N_APART = 20
_N_LATER = 5
# Keyframes that came back to a place and stay; the latest ones stay in any case.
_N_PER_PLACE = 3
_N_LATEST = 50


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stretch:
    """The frames from a keyframe to the next one; they hang on the earlier one.

    Parameters
    ----------
    keyframe_ns : int
    stamps_ns : tuple of int
    T_keyframe_frame : ndarray of float64, shape (n, 4, 4)
    covariances : ndarray of float64, shape (n, 6, 6)
        Of T_keyframe_frame.
    statuses : tuple of Status
    next_ns : int or None
        The next keyframe; None while there is none.
    step : Edge or None
        Its pose in the keyframe.
    """

    keyframe_ns: int
    stamps_ns: tuple[int, ...]
    T_keyframe_frame: FloatArray
    covariances: FloatArray
    statuses: tuple[Status, ...]
    next_ns: int | None
    step: Edge | None

    def edge_to(self, stamp_ns: int) -> Edge:
        """Return the pose of a frame in the keyframe."""
        index = self.stamps_ns.index(stamp_ns)
        return Edge(
            reference_id=self.keyframe_ns,
            T_reference_frame=self.T_keyframe_frame[index],
            covariance=self.covariances[index],
        )

    def _shares(self, step: Edge) -> FloatArray:
        """Return how much of the way to the next keyframe lies before the frames, shape (n,)."""
        n = len(self.stamps_ns)
        if not _is_loose(step):
            return np.arange(1, n + 1) / (n + 1)
        # Of its uncertainty, as the mean over its directions.
        solved = np.linalg.solve(step.covariance, self.covariances)
        return np.asarray(np.clip(np.trace(solved, axis1=1, axis2=2) / 6.0, 0.0, 1.0))

    def place(
        self, poses: dict[int, FloatArray], covariances: dict[int, FloatArray]
    ) -> Iterator[Estimate]:
        """Yield the frames, bent so that both ends fit: where they are least certain, most."""
        T_keyframe_frame, found = self.T_keyframe_frame, self.covariances
        placed = se3.compose_covariance(covariances[self.keyframe_ns], T_keyframe_frame, found)
        if self.step is not None and self.next_ns is not None:
            T_next_keyframe = se3.invert(self.step.T_reference_frame)
            T_next_frame = T_next_keyframe @ T_keyframe_frame
            shares = self._shares(self.step)
            bend = poses[self.keyframe_ns], poses[self.next_ns] @ T_next_keyframe
            bend_twist = se3.log(se3.invert(bend[0]) @ bend[1])
            T_keyframe_frame = se3.exp(shares[:, np.newaxis] * bend_twist) @ T_keyframe_frame
            if _is_loose(self.step):
                rests = (1.0 - shares)[:, np.newaxis, np.newaxis] * self.step.covariance
                zero = np.zeros((6, 6))
                back = covariances[self.next_ns] + rests
                back = se3.compose_covariance(back, T_next_frame, zero)
                is_nearer = np.linalg.det(back) < np.linalg.det(placed)
                placed = np.where(is_nearer[:, np.newaxis, np.newaxis], back, placed)
        T_world_frame = poses[self.keyframe_ns] @ T_keyframe_frame
        for stamp_ns, status, T, covariance in zip(
            self.stamps_ns, self.statuses, T_world_frame, placed, strict=True
        ):
            yield Estimate(
                stamp_ns=stamp_ns,
                T_world_frame=T,
                covariance=covariance,
                status=status,
                frame_id=stamp_ns,
            )


class _Merged(NamedTuple):
    """A keyframe that was merged into another one, and its pose there."""

    estimate: Estimate
    edge: Edge


class _Solution(NamedTuple):
    """The poses of keyframes, merged ones among them, and the loops as judged with them."""

    poses: dict[int, FloatArray]
    loops: tuple[Loop, ...]
    error_before: float
    optimizer: BatchOptimizer


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
        Those with a reason against them do not count.
    T_map_world : ndarray of float64, shape (4, 4)
        The correction of the newest poses by loops, as last optimized while the run goes.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._factors = Factors(config)
        # As they came: their poses are where an optimization starts.
        self._keyframes: dict[int, Estimate] = {}
        self._merged: dict[int, _Merged] = {}
        self._edges: list[tuple[int, Edge]] = []
        # By their keyframe; that of the latest one has not ended.
        self._stretches: dict[int, _Stretch] = {}
        self._arrivals: list[tuple[Estimate, list[Edge]]] = []
        self._last: Estimate | None = None
        self._running: Future[_Solution] | None = None
        self._began_with: Estimate | None = None
        # Numbers of keyframes, merged ones too, at which the next one begins and is taken over.
        self._next = self._due = 0
        self._is_due = False
        self.loops: Sequence[Loop] = ()
        self.T_map_world: FloatArray = np.eye(4)

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
            The very first frame is one in any case.
        """
        last, self._last = self._last, estimate
        if last is None:
            self._keyframes[estimate.stamp_ns] = estimate
            return
        edges = list(edges)
        near = {next(reversed(self._keyframes)), *(each.stamp_ns for each, _ in self._arrivals)}
        if not any(edge.reference_id in near for edge in edges):
            edges.append(self._unmeasured(last, estimate))
        self._arrivals.append((estimate, edges))
        if is_keyframe:
            self._condense()
            self._arrivals = []

    def _unmeasured(self, last: Estimate, estimate: Estimate) -> Edge:
        config, elapsed_s = self._config, 1e-9 * (estimate.stamp_ns - last.stamp_ns)
        turn = np.radians(config.coasting_sigma_deg_per_s)
        sigmas = elapsed_s * np.repeat([turn, config.coasting_sigma_m_per_s], 3)
        if estimate.status is Status.LOST:
            sigmas = np.full(6, _LOST_SIGMA)
        return Edge(
            reference_id=last.stamp_ns,
            T_reference_frame=se3.invert(last.T_world_frame) @ estimate.T_world_frame,
            covariance=np.diag(sigmas**2),
        )

    def _condense(self, *, is_closed: bool = True) -> None:
        """Solve what came since the last keyframe; the newest frame becomes one if it is closed."""
        frames = [estimate for estimate, _ in self._arrivals]
        newest = frames.pop() if is_closed else None
        origin_ns = next(reversed(self._keyframes))
        local = LocalGraph(origin_ns, self._factors)
        for estimate, edges in self._arrivals:
            found = map(self._from_keyframe, edges)
            # those that tie the frame to what is there already come first
            for edge in sorted(found, key=lambda each: each.reference_id not in local):
                if estimate is newest and edge.reference_id not in local:
                    self._edges.append((estimate.stamp_ns, edge))  # as it is
                else:
                    local.add(estimate.stamp_ns, edge)
        solved = local.solve()
        hanging = [solved.pop(frame.stamp_ns) for frame in frames]
        others = {
            int(stamp_ns): Edge(reference_id=origin_ns, T_reference_frame=T, covariance=covariance)  # type: ignore[call-overload]
            for stamp_ns, (T, covariance) in solved.items()
        }
        self._edges += others.items()
        self._stretches[origin_ns] = _Stretch(
            keyframe_ns=origin_ns,
            stamps_ns=tuple(frame.stamp_ns for frame in frames),
            T_keyframe_frame=np.array([T for T, _ in hanging]).reshape(-1, 4, 4),
            covariances=np.array([each for _, each in hanging]).reshape(-1, 6, 6),
            statuses=tuple(frame.status for frame in frames),
            next_ns=None if newest is None else newest.stamp_ns,
            step=None if newest is None else others[newest.stamp_ns],
        )
        if newest is not None:
            self._keyframes[newest.stamp_ns] = newest

    def _from_keyframe(self, edge: Edge) -> Edge:
        """Return an edge from a frame that hangs on a keyframe as one from the keyframe."""
        reference_ns = int(edge.reference_id)  # type: ignore[call-overload]
        if reference_ns in self._keyframes or reference_ns > next(reversed(self._keyframes)):
            return edge
        if reference_ns in self._merged:
            return self._from_keyframe(_join(self._merged[reference_ns].edge, edge))
        stretches = reversed(self._stretches.values())
        home = next(each for each in stretches if each.keyframe_ns < reference_ns)
        return self._from_keyframe(_join(home.edge_to(reference_ns), edge))

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
        n_keyframes = len(self._stretches) + 1
        self._is_due = self._is_due or bool(loops)
        if self._running is not None and n_keyframes >= self._due:
            self._take_over(self._running, places)
            self._running = None
        if self._running is None and self._is_due and n_keyframes >= self._next:
            self._is_due = False
            self._due = n_keyframes + _N_LATER
            self._next = n_keyframes + max(_N_APART, int(_GROWTH * len(self)))
            self._began_with = self._last
            pool = ThreadPoolExecutor(1)
            self._running = pool.submit(self._copied()._solve)
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
        """Merge keyframes that came back to a place, and those after them without a place."""
        counting = {loop.stamp_ns: loop for loop in loops if not loop.reason}
        references = {loop.reference_ns for loop in counting.values()}
        n_at = Counter(counting[ns].reference_ns for ns in self._keyframes if ns in counting)
        before = {each.next_ns: each.keyframe_ns for each in self._stretches.values()}
        for ns in list(self._keyframes)[1:-_N_LATEST]:
            loop = counting.get(ns)
            if ns in places or ns in references:
                continue
            if loop is not None and n_at[loop.reference_ns] > _N_PER_PLACE:
                n_at[loop.reference_ns] -= 1
                self._merge(ns, loop.edge)
            elif loop is None and before[ns] in self._merged:
                self._merge(ns)

    def _merge(self, stamp_ns: int, loop: Edge | None = None) -> None:
        """Merge a keyframe into the one that it came back to, or else into the nearest."""
        edges: dict[int, Edge] = {}  # its pose in each neighbour
        others = []
        for frame_ns, edge in self._edges:
            if stamp_ns == frame_ns:
                _fuse(edges, int(edge.reference_id), edge)  # type: ignore[call-overload]
            elif stamp_ns == edge.reference_id:
                _fuse(edges, frame_ns, _inverse(frame_ns, edge))
            else:
                others.append((frame_ns, edge))
        if loop is not None:
            _fuse(edges, int(loop.reference_id), loop)  # type: ignore[call-overload]
        hub_ns = min(edges, key=lambda ns: float(np.trace(edges[ns].covariance[3:, 3:])))
        hub_ns = hub_ns if loop is None else int(loop.reference_id)  # type: ignore[call-overload]
        self._merged[stamp_ns] = _Merged(self._keyframes.pop(stamp_ns), edges.pop(hub_ns))
        # What ties it to the other one counts once, shared out among the edges that go on there.
        hub = self._merged[stamp_ns].edge
        hub = replace(hub, covariance=max(len(edges), 1) * hub.covariance)
        moved = {ns: _join(hub, _inverse(stamp_ns, edge)) for ns, edge in edges.items()}
        self._edges = []
        for frame_ns, edge in others:
            if edge.reference_id == hub_ns and frame_ns in moved:
                _fuse(moved, frame_ns, edge)
            elif frame_ns == hub_ns and edge.reference_id in moved:
                _fuse(moved, int(edge.reference_id), _inverse(frame_ns, edge))
            else:
                self._edges.append((frame_ns, edge))
        self._edges += moved.items()

    def _copied(self) -> RunGraph:
        """Return the graph as it is, the frames since the latest keyframe among it."""
        graph = copy.copy(self)
        graph._keyframes, graph._merged = dict(self._keyframes), dict(self._merged)
        graph._stretches, graph._edges = dict(self._stretches), list(self._edges)
        graph.loops = tuple(self.loops)
        if graph._arrivals:
            graph._condense(is_closed=False)
        return graph

    def optimize(
        self, *, covariances: bool = True, on_step: Callable[[str], None] = lambda _: None
    ) -> Optimum:
        """Return the poses that fit all measurements best, loops that contradict the rest apart.

        Nothing is changed by it. Where loops contradict the covariances of odometry, those of the
        poses are as much larger.

        Parameters
        ----------
        covariances : bool
            Else they are the identity.
        on_step : callable
            Called with the state in words.

        Raises
        ------
        SmoothingError
            If GTSAM fails.
        ValueError
            If the graph is empty.
        """
        if not self._keyframes:
            raise ValueError("the graph of the run is empty: no frame has come")
        graph = self._copied()
        poses, loops, error_before, optimizer = graph._solve(on_step)
        found = np.broadcast_to(np.eye(6), (len(graph), 6, 6))
        if covariances:
            found = graph._variance_factor(loops) * optimizer.covariances()
        by_keyframe = dict(zip(graph._keyframes, found, strict=True))
        return Optimum(
            estimates=graph._place(poses, by_keyframe),
            keyframes_ns=tuple(graph._keyframes),
            edges=tuple(graph._edges),
            loops=loops,
            residuals=np.array([_residual(loop.edge, loop.stamp_ns, poses) for loop in loops]),
            error_before=error_before,
            error=optimizer.error,
            n_iterations=optimizer.n_iterations,
        )

    def _solve(self, on_step: Callable[[str], None] = lambda _: None) -> _Solution:
        loops = self._judged(on_step)
        graph = self._whole([loop for loop in loops if not loop.reason])
        optimizer = BatchOptimizer(graph, on_step=on_step)
        error_before = optimizer.starts["odometry"]
        optimizer.run()
        poses = dict(zip(self._keyframes, optimizer.poses(), strict=True))
        for stamp_ns, (_, edge) in reversed(self._merged.items()):
            poses[stamp_ns] = poses[int(edge.reference_id)] @ edge.T_reference_frame  # type: ignore[call-overload]
        return _Solution(poses, loops, error_before, optimizer)

    def _judged(self, on_step: Callable[[str], None]) -> tuple[Loop, ...]:
        """Return the loops, those with a reason that contradict odometry and the other ones."""
        confirmed = [loop for loop in self.loops if not loop.reason]
        if not confirmed:
            return tuple(self.loops)
        graph = self._whole(confirmed, drift=_DRIFT * np.sqrt(len(self._edges)))
        optimizer = BatchOptimizer(graph, "gnc", on_step=on_step)
        optimizer.run()
        keyframes = list(self._keyframes)
        refused = {(keyframes[a], keyframes[b]) for a, b, _ in optimizer.refused}
        # A keyframe that was merged elsewhere had its loop refused.
        refused |= {
            (loop.reference_ns, loop.stamp_ns)
            for loop in confirmed
            if loop.stamp_ns in self._merged
            and self._merged[loop.stamp_ns].edge.reference_id != loop.reference_ns
        }
        reason = "contradicts odometry or the other loops"
        return tuple(
            replace(loop, reason=loop.reason or reason)
            if (loop.reference_ns, loop.stamp_ns) in refused
            else loop
            for loop in self.loops
        )

    def _whole(self, loops: Sequence[Loop], *, drift: float = 0.0) -> WholeGraph:
        """Return the graph; with a share of each way by which odometry may be wrong besides."""
        graph, first = WholeGraph(), next(iter(self._keyframes.values()))
        origin = PosePrior(T_world_frame=first.T_world_frame, covariance=ORIGIN.covariance)
        for stamp_ns, estimate in self._keyframes.items():
            graph.add_pose(stamp_ns, stamp_ns, origin if estimate is first else None)
            graph.given[stamp_ns] = estimate.T_world_frame
        for stamp_ns, edge in self._edges:
            graph.add_edges(stamp_ns, [_drifting(edge, drift)], is_trusted=True)
        for loop in loops:
            if loop.stamp_ns in self._keyframes and loop.reference_ns in self._keyframes:
                graph.add_edges(loop.stamp_ns, [loop.edge])
        return graph

    def _variance_factor(self, loops: Sequence[Loop]) -> float:
        """Return how much more odometry drifts than its covariances say, 1 at least.

        The median over the loops of what each contradicts it by, unless that may be chance.
        """
        T_first_frame, covariance, part = np.eye(4), np.zeros((6, 6)), 0
        ways = {next(iter(self._stretches), None): (T_first_frame, covariance, part)}
        for stretch in self._stretches.values():
            if (step := stretch.step) is not None:
                T_first_frame = T_first_frame @ step.T_reference_frame
                Ad = se3.adjoint(T_first_frame)
                covariance = covariance + Ad @ step.covariance @ Ad.T
                if _is_loose(step):
                    covariance, part = np.zeros((6, 6)), part + 1
                ways[stretch.next_ns] = T_first_frame, covariance, part
        ratios = []
        for loop in loops:
            T, covariance, part = ways[loop.stamp_ns]
            T_reference, before, part_before = ways[loop.reference_ns]
            if not loop.reason and part == part_before:
                T_frame_first = se3.invert(T)
                Ad = se3.adjoint(T_frame_first)
                total = Ad @ (covariance - before) @ Ad.T + loop.covariance
                error = se3.log(T_frame_first @ T_reference @ loop.T_reference_frame)
                ratios.append(float(se3.mahalanobis(error, total)) / 6.0)
        factor = float(np.median(ratios)) if ratios else 1.0
        return factor if factor > _MAX_CHANCE else 1.0

    def _place(
        self, poses: dict[int, FloatArray], covariances: dict[int, FloatArray]
    ) -> tuple[Estimate, ...]:
        """Return all frames."""
        known = dict(self._keyframes)
        for stamp_ns, (estimate, edge) in reversed(self._merged.items()):
            before = covariances[int(edge.reference_id)]  # type: ignore[call-overload]
            T, known[stamp_ns] = edge.T_reference_frame, estimate
            covariances[stamp_ns] = se3.compose_covariance(before, T, edge.covariance)
        estimates = [
            replace(each, T_world_frame=poses[ns], covariance=covariances[ns], rejected=())
            for ns, each in known.items()
        ]
        for stretch in self._stretches.values():
            estimates += stretch.place(poses, covariances)
        return tuple(sorted(estimates, key=lambda estimate: estimate.stamp_ns))


def _is_loose(step: Edge) -> bool:
    """Tell whether a step says nothing of where the camera went."""
    return bool(step.covariance[3, 3] > _LOOSE_SIGMA_M**2)


def _join(first: Edge, second: Edge) -> Edge:
    """Return an edge and the one that goes on from its end as one."""
    T = second.T_reference_frame
    return replace(
        second,
        reference_id=first.reference_id,
        T_reference_frame=first.T_reference_frame @ T,
        covariance=se3.compose_covariance(first.covariance, T, second.covariance),
    )


def _inverse(frame_id: FrameId, edge: Edge) -> Edge:
    """Return the pose of the reference in the frame."""
    Ad = se3.adjoint(edge.T_reference_frame)
    covariance = Ad @ edge.covariance @ Ad.T
    return Edge(
        reference_id=frame_id,
        T_reference_frame=se3.invert(edge.T_reference_frame),
        covariance=0.5 * (covariance + covariance.T),
    )


def _fuse(edges: dict[int, Edge], key: int, edge: Edge) -> None:
    """Add an edge, made one with what is there already, from the same frame to the same."""
    if key not in edges:
        edges[key] = edge
        return
    T, covariance = edges[key].T_reference_frame, edges[key].covariance
    gain = covariance @ np.linalg.inv(covariance + edge.covariance)
    T = T @ se3.exp(gain @ se3.log(se3.invert(T) @ edge.T_reference_frame))
    covariance = gain @ edge.covariance
    covariance = 0.5 * (covariance + covariance.T)
    edges[key] = replace(edge, T_reference_frame=se3.normalize(T), covariance=covariance)


def _drifting(edge: Edge, drift: float) -> Edge:
    """Widen an edge by a share of its way."""
    if drift == 0.0:
        return edge
    sigma_m = drift * float(np.linalg.norm(edge.T_reference_frame[:3, 3]))
    variances = np.repeat([(_TURN_PER_M / _DRIFT * sigma_m) ** 2, sigma_m**2], 3)
    return replace(edge, covariance=edge.covariance + np.diag(variances))


def _residual(edge: Edge, stamp_ns: int, poses: dict[int, FloatArray]) -> float:
    T = se3.invert(poses[int(edge.reference_id)]) @ poses[stamp_ns]  # type: ignore[call-overload]
    error = se3.log(se3.invert(edge.T_reference_frame) @ T)
    return float(np.sqrt(se3.mahalanobis(error, edge.covariance)))
