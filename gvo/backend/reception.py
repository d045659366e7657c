"""What of the measurements of a new pose is usable, and where it starts."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from gvo.backend.arrival import ORIGIN, Arrival
from gvo.backend.checks import find_faults, prior_fault
from gvo.backend.factors import Measurement
from gvo.backend.gating import Verdict, judge
from gvo.backend.ledger import Ledger
from gvo.backend.motion import Motion
from gvo.backend.window_graph import WindowGraph
from gvo.types import Edge, FrameId, PosePrior, PositionPrior, Prior

# Of a first pose of which the position alone is known: radians, and metres beside its prior.
_UNKNOWN_SIGMAS = np.repeat([1.0, 1e4], 3)


class Reception:
    """Sorts the measurements of new poses out; what it refuses is counted.

    Parameters
    ----------
    graph : WindowGraph
        The poses that edges refer to.
    motion : Motion
        Of the poses so far; leads where measurements do not.
    ledger : Ledger
    """

    def __init__(self, graph: WindowGraph, motion: Motion, ledger: Ledger) -> None:
        self._graph = graph
        self._motion = motion
        self._ledger = ledger
        self._n_keys = 0

    def receive(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None,
        *,
        gate: float | None,
    ) -> Arrival:
        """Sort out what is usable, and find where to start.

        Parameters
        ----------
        frame_id : hashable
        stamp_ns : int
            Nanoseconds.
        edges : sequence of Edge
        prior : PosePrior or PositionPrior or None
        gate : float or None
            In sigmas of the difference of two edges.
        """
        arrival = Arrival(frame_id=frame_id, key=self._n_keys, stamp_ns=stamp_ns)
        self._n_keys += 1
        if prior is not None:
            self._receive_prior(arrival, prior)
        valid, members = [], self._graph.members
        for edge, fault in zip(edges, find_faults(edges), strict=True):
            reason = members.tie_fault(frame_id, edge, is_new=True) or fault
            if reason:
                self.refuse(arrival, edge, reason)
            else:
                valid.append(edge)
        if valid:
            self._receive_edges(arrival, valid, gate)
        else:
            self._start_without_edges(arrival)
        return arrival

    def drop_measurements(self, arrival: Arrival, reason: str) -> None:
        """Refuse all measurements of a pose; it continues the last velocity."""
        edges = [measurement.edge for measurement in arrival.measurements]
        for edge in [*edges, *(None for _ in arrival.priors)]:
            self.refuse(arrival, edge, reason)
        arrival.measurements, arrival.priors = [], []
        arrival.anchor, arrival.is_origin = None, False
        self._start_without_edges(arrival)

    def refuse(
        self, arrival: Arrival, edge: Edge | None, reason: str, *, is_gated: bool = False
    ) -> None:
        """Refuse an edge of a new pose, or its prior."""
        arrival.rejected.append(
            self._ledger.reject(
                arrival.frame_id,
                arrival.stamp_ns,
                reason,
                reference_id=None if edge is None else edge.reference_id,
                is_gated=is_gated,
            )
        )

    def _receive_prior(self, arrival: Arrival, prior: Prior) -> None:
        if fault := prior_fault(prior):
            self.refuse(arrival, None, fault)
        else:
            arrival.priors.append(prior)

    def _receive_edges(self, arrival: Arrival, edges: list[Edge], gate: float | None) -> None:
        measurements = [Measurement.of(edge) for edge in edges]
        verdict = self._judge(arrival, measurements, gate)
        arrival.T_world_start = verdict.T_world_start
        for measurement, reason in zip(measurements, verdict.reasons, strict=True):
            if reason:
                self.refuse(arrival, measurement.edge, reason, is_gated=True)
            else:
                arrival.measurements.append(measurement)

    def _judge(
        self, arrival: Arrival, measurements: list[Measurement], gate: float | None
    ) -> Verdict:
        known = arrival.T_world_references

        def pose_of(frame_id: FrameId) -> gtsam.Pose3:
            if frame_id not in known:
                known[frame_id] = self._graph.pose3(frame_id)
            return known[frame_id]

        return judge(
            measurements,
            pose_of=pose_of,
            relative_covariance=self._graph.relative_covariance,
            motion=lambda: self._coasting_edge(arrival.stamp_ns),
            gate=gate,
        )

    def _coasting_edge(self, stamp_ns: int) -> Edge | None:
        """Return the edge from the last pose, where it is in the window, by the velocity so far."""
        last = self._motion.last
        if last is None or last.frame_id not in self._graph.members:
            return None
        T_last_frame, covariance = self._motion.predict_step(stamp_ns)
        return Edge(
            reference_id=last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )

    def _start_without_edges(self, arrival: Arrival) -> None:
        """Start at the prior, else at the origin, else where the last velocity leads."""
        prior = arrival.priors[0] if arrival.priors else None
        if isinstance(prior, PosePrior):
            arrival.T_world_start = gtsam.Pose3(prior.T_world_frame)
        elif self._motion.last is not None:
            self._coast(arrival)
        elif isinstance(prior, PositionPrior):
            arrival.T_world_start = gtsam.Pose3(gtsam.Rot3(), prior.position_world)
            arrival.anchor = PosePrior(
                T_world_frame=arrival.T_world_start.matrix(), covariance=np.diag(_UNKNOWN_SIGMAS**2)
            )
        else:
            arrival.anchor, arrival.is_origin = ORIGIN, True

    def _coast(self, arrival: Arrival) -> None:
        """Tie the pose to the last one by the velocity so far."""
        arrival.coasting = self._coasting_edge(arrival.stamp_ns)
        if arrival.coasting is not None:
            T_last_frame = gtsam.Pose3(arrival.coasting.T_reference_frame)
            T_world_last = self._graph.pose3(arrival.coasting.reference_id)
            arrival.T_world_start = T_world_last.compose(T_last_frame)
        elif (prediction := self._motion.predict_pose(arrival.stamp_ns)) is not None:
            arrival.T_world_start = gtsam.Pose3(prediction[0])
            arrival.anchor = PosePrior(T_world_frame=prediction[0], covariance=prediction[1])
