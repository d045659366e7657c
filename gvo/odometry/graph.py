"""The graph of a run: its keyframes, the edges between them, and its loops.

It outlives the window. What lies between two keyframes is solved by itself, the earlier one being
the origin: of the poses found there, those of other keyframes become edges, and the frames between
hang on the earlier keyframe. An edge and a frame take a few hundred bytes each.

References
----------
G. Grisetti, R. Kuemmerle, K. Ni, "Robust optimization of factor graphs by using condensed
measurements", IROS 2012, doi:10.1109/IROS.2012.6385779.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gvo.backend.batch import BatchOptimizer, LocalGraph, WholeGraph
from gvo.backend.factors import ORIGIN, Factors
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, Loop, Optimum, PosePrior, Status

# Sigmas of a step of a camera that is lost: rad and m.
_LOST_SIGMA = 100.0
# Drift that is allowed for when loops are judged, over the whole path: a share of it, and radians
# per metre.
_DRIFT = 0.01
_TURN_PER_M = 0.0005


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Frame:
    """A frame that hangs on a keyframe.

    Parameters
    ----------
    stamp_ns : int
    keyframe_ns : int
    T_keyframe_frame : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Of T_keyframe_frame.
    share : float
        Of the way to the next keyframe, 0 to 1.
    status : Status
    """

    stamp_ns: int
    keyframe_ns: int
    T_keyframe_frame: FloatArray
    covariance: FloatArray
    share: float
    status: Status


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
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._factors = Factors(config)
        # As they came: their poses are where an optimization starts.
        self._keyframes: dict[int, Estimate] = {}
        self._edges: list[tuple[int, Edge]] = []
        self._frames: dict[int, _Frame] = {}
        self._arrivals: list[tuple[Estimate, list[Edge]]] = []
        self._last: Estimate | None = None
        self.loops: Sequence[Loop] = ()

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
            self._condense(is_closed=True)

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

    def _condense(self, *, is_closed: bool) -> None:
        """Solve what came since the last keyframe; the newest frame becomes one if it is closed."""
        arrivals, self._arrivals = self._arrivals, []
        origin_ns = next(reversed(self._keyframes))
        local = LocalGraph(origin_ns, self._factors)
        for index, (estimate, edges) in enumerate(arrivals):
            is_closing = is_closed and index == len(arrivals) - 1
            tied = [self._from_keyframe(edge) for edge in edges]
            # those that tie the frame to what is there already come first
            for edge in sorted(tied, key=lambda edge: edge.reference_id not in local):
                if is_closing and edge.reference_id not in local:
                    self._edges.append((estimate.stamp_ns, edge))  # as it is
                else:
                    local.add(estimate.stamp_ns, edge)
        solved = local.solve()
        if is_closed:
            newest = arrivals.pop()[0]
            self._keyframes[newest.stamp_ns] = newest
        for index, (estimate, _) in enumerate(arrivals):
            T, covariance = solved.pop(estimate.stamp_ns)
            self._frames[estimate.stamp_ns] = _Frame(
                stamp_ns=estimate.stamp_ns,
                keyframe_ns=origin_ns,
                T_keyframe_frame=T,
                covariance=covariance,
                share=(index + 1) / (len(arrivals) + 1) if is_closed else 0.0,
                status=estimate.status,
            )
        for stamp_ns, (T, covariance) in solved.items():
            edge = Edge(reference_id=origin_ns, T_reference_frame=T, covariance=covariance)
            self._edges.append((int(stamp_ns), edge))  # type: ignore[call-overload]

    def _from_keyframe(self, edge: Edge) -> Edge:
        """Return an edge from a frame that hangs on a keyframe as one from the keyframe."""
        frame = self._frames.get(edge.reference_id)  # type: ignore[call-overload]
        if frame is None:
            return edge
        T = edge.T_reference_frame
        return replace(
            edge,
            reference_id=frame.keyframe_ns,
            T_reference_frame=frame.T_keyframe_frame @ T,
            covariance=se3.compose_covariance(frame.covariance, T, edge.covariance),
        )

    def optimize(
        self, *, covariances: bool = True, on_step: Callable[[str], None] = lambda _: None
    ) -> Optimum:
        """Return the poses that fit all measurements best, loops that contradict the rest apart.

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
        if self._arrivals:
            self._condense(is_closed=False)
        loops = self._judged(on_step)
        counting = [loop for loop in loops if not loop.reason]
        optimizer = BatchOptimizer(self._whole(counting), on_step=on_step)
        before = optimizer.starts["odometry"]
        optimizer.run()
        poses = dict(zip(self._keyframes, optimizer.poses(), strict=True))
        found = optimizer.covariances() if covariances else [np.eye(6)] * len(poses)
        by_keyframe = dict(zip(self._keyframes, found, strict=True))
        return Optimum(
            estimates=self._place(poses, by_keyframe),
            keyframes_ns=tuple(self._keyframes),
            edges=tuple(self._edges),
            loops=loops,
            residuals=np.array([_residual(loop.edge, loop.stamp_ns, poses) for loop in loops]),
            error_before=before,
            error=optimizer.error,
            n_iterations=optimizer.n_iterations,
        )

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
            graph.add_edges(loop.stamp_ns, [loop.edge])
        return graph

    def _place(
        self, poses: dict[int, FloatArray], covariances: dict[int, FloatArray]
    ) -> tuple[Estimate, ...]:
        """Return all frames; those between two keyframes are bent so that both ends fit."""
        stamps_ns = list(self._keyframes)
        following = dict(pairwise(stamps_ns))
        steps: dict[tuple[object, int | None], FloatArray] = {
            (edge.reference_id, ns): edge.T_reference_frame for ns, edge in self._edges
        }
        estimates = [
            replace(each, T_world_frame=poses[ns], covariance=covariances[ns], rejected=())
            for ns, each in self._keyframes.items()
        ]
        for frame in self._frames.values():
            T_world_keyframe, next_ns = poses[frame.keyframe_ns], following.get(frame.keyframe_ns)
            T_keyframe_frame = frame.T_keyframe_frame
            step = steps.get((frame.keyframe_ns, next_ns))
            if step is not None and next_ns is not None:
                bend = se3.log(se3.invert(T_world_keyframe) @ poses[next_ns] @ se3.invert(step))
                T_keyframe_frame = se3.exp(frame.share * bend) @ T_keyframe_frame
            covariance = se3.compose_covariance(
                covariances[frame.keyframe_ns], T_keyframe_frame, frame.covariance
            )
            estimates.append(
                Estimate(
                    stamp_ns=frame.stamp_ns,
                    T_world_frame=T_world_keyframe @ T_keyframe_frame,
                    covariance=covariance,
                    status=frame.status,
                    frame_id=frame.stamp_ns,
                )
            )
        return tuple(sorted(estimates, key=lambda estimate: estimate.stamp_ns))


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
