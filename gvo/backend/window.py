"""A sliding window of poses, smoothed by iSAM2 with marginalization."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import gtsam
import numpy as np

from gvo.backend.checks import (
    find_faults,
    place_fault,
    pose_fault,
    prior_fault,
    sane_covariance,
)
from gvo.backend.comparison import MeasurementLog
from gvo.backend.export import g2o_lines
from gvo.backend.factors import Factors, Measurement
from gvo.backend.gating import Verdict, disagreement, judge
from gvo.backend.graph import PoseGraph, definite, first_line
from gvo.backend.ledger import Ledger, WindowCounts
from gvo.backend.motion import Motion
from gvo.backend.polish import Polish, polish
from gvo.coasting import StatusClock
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.keyframe_policy import choose_released, is_needed, proximity
from gvo.types import (
    Edge,
    Estimate,
    FloatArray,
    FrameId,
    GraphEdge,
    PosePrior,
    PositionPrior,
    Prior,
    Rejected,
    Status,
)

Keeping = Literal["manual", "distance"]

_LOGGER = logging.getLogger(__name__)

# Of poses that a smaller window lets go: what they cost together grows with the cube.
_MAX_LEAVING = 32
# Of a first pose without a prior, which defines the world: radians and metres.
_ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))
# Of a first pose of which the position alone is known: radians, and metres beside its prior.
_UNKNOWN_SIGMAS = np.repeat([1.0, 1e4], 3)


class _Tie(NamedTuple):
    """An accepted edge, with the key of its reference and what made its factor: its kernel."""

    edge: Edge
    factors: Factors
    reference_key: int


@dataclass(slots=True, kw_only=True)
class _Member:
    """A pose of the window, with what was measured of it.

    Ties to poses that have left since stay among the edges.
    """

    key: int
    stamp_ns: int
    edges: list[_Tie]
    priors: list[tuple[Prior, Factors]]
    is_kept: bool = False
    status: Status = Status.OK
    causal: Estimate | None = None


@dataclass(slots=True, kw_only=True)
class _Arrival:
    """A pose on its way into the window, with what is usable of its measurements.

    `T_world_references` are the poses of the references at that moment, by their names;
    `T_world_after` those of the pose and of them once it is in the graph, by their keys. `anchor`
    and `coasting` hold the pose where the measurements do not; they are none themselves.
    """

    frame_id: FrameId
    key: int
    stamp_ns: int
    T_world_start: gtsam.Pose3
    T_world_references: dict[FrameId, gtsam.Pose3] = field(default_factory=dict)
    T_world_after: dict[int, gtsam.Pose3] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    anchor: PosePrior | None = None
    coasting: Edge | None = None
    is_origin: bool = False

    @property
    def is_measured(self) -> bool:
        """Tell whether a measurement ties the pose, or it is the origin."""
        return bool(self.measurements or self.priors or self.is_origin)


class SlidingWindow:
    """Recent poses and kept keyframes, tied by relative poses of any origin.

    A pose leaves when it is neither recent nor kept; what was known of it stays as a marginal on
    the poses it was tied to. It is then handed over by `pop_finished`. With `window.size: null`
    nothing leaves, and `finish` polishes the result by Levenberg-Marquardt.

    Whatever the measurements hold, the window goes on: an edge or a prior that GTSAM could not
    live with, or that the others contradict, is refused with a reason (`Rejected`), and a pose
    without a usable edge continues the last velocity.

    Parameters
    ----------
    config : WindowConfig, optional
        Number of recent poses, robust kernel, gate.
    keyframes : {"manual", "distance"}
        Who keeps poses: the caller by `keep` and `release`, or the window, by distance and angle
        (`window.keyframe_distance_m`, `window.keyframe_angle_deg`, `window.n_keyframes`).
    log : MeasurementLog, optional
        Is given all that goes in, to compare ways of smoothing it; grows with every pose.

    Examples
    --------
    >>> window = SlidingWindow()
    >>> _ = window.add_pose("a", 0, [])
    >>> step = np.eye(4)
    >>> step[2, 3] = 1.0
    >>> edge = Edge(reference_id="a", T_reference_frame=step, covariance=1e-4 * np.eye(6))
    >>> estimate = window.add_pose("b", 100_000_000, [edge])
    >>> estimate.T_world_cam[:3, 3].round(6).tolist()
    [0.0, 0.0, 1.0]
    """

    def __init__(
        self,
        config: WindowConfig | None = None,
        *,
        keyframes: Keeping = "manual",
        log: MeasurementLog | None = None,
    ) -> None:
        if keyframes not in get_args(Keeping):
            raise ValueError(f"keyframes must be one of {get_args(Keeping)}, got {keyframes!r}")
        if config is not None:
            _check_config(config)
        self._config = config or WindowConfig()
        self._keeps_by_distance = keyframes == "distance"
        self._factors = Factors(self._config)
        self._is_whole = self._config.size is None
        self._graph = self._new_graph()
        self._members: dict[FrameId, _Member] = {}
        self._finished: list[Estimate] = []
        self._n_keys = 0
        self._ledger = Ledger()
        self._clock = StatusClock(self._config.lost_after_s)
        self._motion = Motion(self._config)
        self._polish: Polish | None = None
        self._log = log

    def __contains__(self, frame_id: object) -> bool:
        """Tell whether a frame is in the window."""
        return frame_id in self._members

    def __len__(self) -> int:
        """Return the number of poses in the window."""
        return len(self._members)

    @property
    def newest(self) -> FrameId:
        """The newest frame of the window; None while it is empty."""
        return next(reversed(self._members), None)

    @property
    def counts(self) -> WindowCounts:
        """What was taken and refused so far."""
        return self._ledger.counts

    @property
    def polish(self) -> Polish | None:
        """What `finish` gained by Levenberg-Marquardt, where the window kept everything."""
        return self._polish

    def reconfigure(self, config: WindowConfig) -> None:
        """Go on with another configuration; what is in the window stays as it went in.

        Parameters
        ----------
        config : WindowConfig
            Kernel and gate are those of what comes from now on. With a smaller size poses leave
            with the next updates, up to 32 at a time. With `size: null` nothing leaves from now
            on; what left before stays where it is, so that `finish` has nothing to polish.

        Raises
        ------
        ValueError
            When it is no WindowConfig.
        """
        _check_config(config)
        if config == self._config:
            return
        former, self._config = self._config, config
        if (config.kernel, config.kernel_threshold) != (former.kernel, former.kernel_threshold):
            self._factors = Factors(config)
        self._clock.reconfigure(config.lost_after_s)
        self._motion.reconfigure(config)
        if not self._members:
            self._is_whole = config.size is None
            self._graph = self._new_graph()
        elif self._is_whole and config.size is not None:
            self._prepare_to_leave()

    def _prepare_to_leave(self) -> None:
        """Go on with a graph that poses can leave."""
        self._is_whole = False
        graph = self._new_graph()
        try:
            with graph.restored_on_error():
                graph.update(self._graph.factors(), self._graph.values())
        except SmoothingError as error:
            # It can still be made anew from the poses, where the next update fails.
            _LOGGER.warning("the graph stays as it is: %s", first_line(error))
        else:
            self._graph = graph

    def add_pose(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None = None,
        *,
        status: Status | None = None,
    ) -> Estimate:
        """Add a pose, smooth the window, and let poses leave that are neither recent nor kept.

        Parameters
        ----------
        frame_id : hashable
            The caller's name for the pose.
        stamp_ns : int
            Nanoseconds, later than that of the pose before.
        edges : sequence of Edge
            Relative poses to poses in the window; none for the very first one. They are gated
            against each other. Where none is usable the pose continues the last velocity.
        prior : PosePrior or PositionPrior, optional
            What is known of the pose in the world. The very first pose is the identity where it
            has none; of a position alone its rotation starts there, free to turn.
        status : Status, optional
            Handed through to the estimates; found by the window where omitted.

        Returns
        -------
        Estimate
            The causal pose: the best at this moment, with its marginal covariance, and what was
            refused.

        Raises
        ------
        ValueError
            A name that is in the window already, a stamp that does not advance, edges of the
            very first pose. The window stands as before.
        """
        edges = _as_edges(frame_id, edges)
        self._check_arrival(frame_id, stamp_ns, edges, prior)
        arrival = self._receive(frame_id, int(stamp_ns), edges, prior)
        estimate = self._enter(arrival, status)
        self._note_motion(arrival, estimate)
        if self._keeps_by_distance and frame_id in self._members:
            self._keep_by_distance(frame_id)
        return estimate

    def add_edge(self, frame_id: FrameId, edge: Edge) -> Estimate | Rejected:
        """Tie two poses that are both in the window, as a loop does.

        Parameters
        ----------
        frame_id : hashable
            The frame that the edge measures in its `reference_id`.
        edge : Edge

        Returns
        -------
        Estimate or Rejected
            The frame's pose with the edge; falsy where the edge was refused.
        """
        self._find(frame_id)
        _as_edges(frame_id, [edge])
        fault = self._membership_fault(frame_id, edge) or find_faults([edge])[0]
        gated = "" if fault else self._gate_loop(frame_id, edge)
        if fault or gated:
            return self._reject(frame_id, fault or gated, edge=edge, is_gated=bool(gated))
        member = self._members[frame_id]
        reference_key = self._members[edge.reference_id].key
        answer = self._extend(
            frame_id,
            self._factors.between(reference_key, member.key, Measurement.of(edge)),
            edge=edge,
        )
        if isinstance(answer, Estimate):
            member.edges.append(_Tie(edge, self._factors, reference_key))
            self._ledger.add(n_edges=1)
        return answer

    def add_prior(self, frame_id: FrameId, prior: Prior) -> Estimate | Rejected:
        """Tie a pose of the window to the world.

        Parameters
        ----------
        frame_id : hashable
        prior : PosePrior or PositionPrior

        Returns
        -------
        Estimate or Rejected
            The frame's pose with the prior; falsy where the prior was refused.
        """
        _check_prior(frame_id, prior)
        is_there = self._find(frame_id) is not None
        fault = prior_fault(prior) if is_there else _absence(frame_id)
        if fault:
            return self._reject(frame_id, fault)
        member = self._members[frame_id]
        answer = self._extend(frame_id, self._factors.prior(member.key, prior))
        if isinstance(answer, Estimate):
            member.priors.append((prior, self._factors))
            self._ledger.add(n_priors=1)
        return answer

    def keep(self, frame_id: FrameId) -> None:
        """Keep a pose of the window as a keyframe until it is released."""
        self._member(frame_id).is_kept = True

    def release(self, frame_id: FrameId) -> None:
        """Let a kept pose leave, with the next update after it is no longer recent."""
        self._member(frame_id).is_kept = False

    def kept(self) -> list[FrameId]:
        """Return the kept frames, oldest first."""
        return [frame_id for frame_id, member in self._members.items() if member.is_kept]

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose of the window."""
        member = self._member(frame_id)
        T_world_frame = self._graph.pose(member.key)
        if member.causal is not None and pose_fault(T_world_frame):
            return member.causal.T_world_cam
        return T_world_frame

    def poses(self) -> dict[FrameId, FloatArray]:
        """Return T_world_frame of all poses of the window, oldest first."""
        return {frame_id: self.pose(frame_id) for frame_id in self._members}

    def edges(self, frame_id: FrameId) -> tuple[Edge, ...]:
        """Return the edges from earlier frames that were accepted for a frame.

        Empty where it is not in the window.
        """
        member = self._members.get(frame_id)
        return () if member is None else tuple(tie.edge for tie in self._standing(member))

    def stamp_ns(self, frame_id: FrameId) -> int:
        """Return the stamp of a pose of the window, nanoseconds."""
        return self._member(frame_id).stamp_ns

    def estimate(self, frame_id: FrameId) -> Estimate:
        """Return what is known now of a pose of the window."""
        self._member(frame_id)
        return self._final_estimate(frame_id)

    def covariance(self, frame_id: FrameId) -> FloatArray:
        """Return the marginal covariance, shape (6, 6), of a pose of the window."""
        return self.estimate(frame_id).covariance

    def relative_pose(self, reference_id: FrameId, frame_id: FrameId) -> Edge:
        """Return the pose of one frame of the window in another, with its covariance.

        Parameters
        ----------
        reference_id, frame_id : hashable
            Two poses of the window.

        Returns
        -------
        Edge
            T_reference_frame; its covariance comes of the joint one of both poses, so that what
            they do not know together does not count.
        """
        return Edge(
            reference_id=reference_id,
            T_reference_frame=se3.invert(self.pose(reference_id)) @ self.pose(frame_id),
            covariance=self._relative_covariance(reference_id, frame_id),
        )

    def graph(self) -> list[GraphEdge]:
        """Return the measurements between poses of the window, and how the poses fit them.

        What poses that left knew is in the marginals and not listed.
        """
        poses = self.poses()
        found = []
        for frame_id, member in self._members.items():
            found += [
                tie.factors.residual_of_edge(
                    tie.edge, frame_id, poses[tie.edge.reference_id], poses[frame_id]
                )
                for tie in self._standing(member)
            ]
            found += [
                factors.residual_of_prior(prior, frame_id, poses[frame_id])
                for prior, factors in member.priors
            ]
        return found

    def write_g2o(self, path: str | Path) -> None:
        """Write poses and edges of the window as a g2o file.

        Parameters
        ----------
        path : str or Path
            Whole-number ids are kept, others numbered with their names as comments; priors are
            left out. Rotations of the information matrix are in radians, as GTSAM reads them.

        Raises
        ------
        SmoothingError
            When the file cannot be written.
        """
        text = "".join(f"{line}\n" for line in g2o_lines(self.poses(), self.graph()))
        try:
            Path(path).write_text(text, encoding="utf-8", newline="\n")
        except OSError as error:
            raise SmoothingError(f"{path}: cannot be written: {error.strerror}") from error

    def pop_finished(self) -> list[Estimate]:
        """Hand over the smoothed estimates of the poses that left since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def finish(self) -> list[Estimate]:
        """Hand over all estimates that were not popped yet, in the order of their stamps.

        Where the window kept everything they are polished first. It is empty afterwards, ready
        for another first pose.
        """
        self._polish = None
        if self._is_whole and self._members:
            self._finished += self._polished()
        else:
            self._finished += [self._final_estimate(frame_id) for frame_id in self._members]
        self._members = {}
        self._is_whole = self._config.size is None
        self._graph = self._new_graph()
        self._motion = Motion(self._config)
        self._clock = StatusClock(self._config.lost_after_s)
        return sorted(self.pop_finished(), key=lambda estimate: estimate.stamp_ns)

    # What comes in

    def _check_arrival(
        self, frame_id: FrameId, stamp_ns: int, edges: Sequence[Edge], prior: Prior | None
    ) -> None:
        is_known = self._find(frame_id) is not None
        if frame_id is None or is_known:
            raise ValueError(
                f"{frame_id!r} is in the window already" if is_known else "no frame_id"
            )
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
            raise ValueError(f"stamp_ns of {frame_id!r} must be an int, got {stamp_ns!r}")
        last = self._motion.last
        if last is not None and stamp_ns <= last.stamp_ns:
            raise ValueError(
                f"stamp {stamp_ns} of {frame_id!r} is not after {last.stamp_ns} of the pose before"
            )
        if prior is not None:
            _check_prior(frame_id, prior)
        if len(edges) > 0 and last is None:
            raise ValueError(f"{frame_id!r} is the first pose and can have no edges, only a prior")

    def _membership_fault(self, frame_id: FrameId, edge: Edge, *, is_new: bool = False) -> str:
        if edge.reference_id == frame_id:
            return "an edge of a pose to itself"
        for end in [edge.reference_id] if is_new else [edge.reference_id, frame_id]:
            if end not in self._members:
                return _absence(end)
        return ""

    def _receive(
        self, frame_id: FrameId, stamp_ns: int, edges: Sequence[Edge], prior: Prior | None
    ) -> _Arrival:
        """Sort out what is usable, and find where to start."""
        arrival = _Arrival(
            frame_id=frame_id, key=self._n_keys, stamp_ns=stamp_ns, T_world_start=gtsam.Pose3()
        )
        self._n_keys += 1
        if prior is not None:
            self._receive_prior(arrival, prior)
        valid = []
        for edge, fault in zip(edges, find_faults(edges), strict=True):
            reason = self._membership_fault(frame_id, edge, is_new=True) or fault
            if reason:
                self._refuse(arrival, edge, reason)
            else:
                valid.append(edge)
        if valid:
            self._receive_edges(arrival, valid)
        else:
            self._receive_without_edges(arrival)
        return arrival

    def _receive_prior(self, arrival: _Arrival, prior: Prior) -> None:
        if fault := prior_fault(prior):
            self._refuse(arrival, None, fault)
        else:
            arrival.priors.append(prior)

    def _receive_edges(self, arrival: _Arrival, edges: list[Edge]) -> None:
        measurements = [Measurement.of(edge) for edge in edges]
        verdict = self._judge(arrival, measurements)
        arrival.T_world_start = verdict.T_world_start
        for measurement, reason in zip(measurements, verdict.reasons, strict=True):
            if reason:
                self._refuse(arrival, measurement.edge, reason, is_gated=True)
            else:
                arrival.measurements.append(measurement)

    def _receive_without_edges(self, arrival: _Arrival) -> None:
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
            arrival.anchor, arrival.is_origin = _ORIGIN, True

    def _coast(self, arrival: _Arrival) -> None:
        """Tie the pose to the last one by the velocity so far."""
        arrival.coasting = self._coasting_edge(arrival.stamp_ns)
        if arrival.coasting is not None:
            T_last_frame = gtsam.Pose3(arrival.coasting.T_reference_frame)
            last_key = self._members[arrival.coasting.reference_id].key
            arrival.T_world_start = self._graph.pose3(last_key).compose(T_last_frame)
        elif (prediction := self._motion.predict_pose(arrival.stamp_ns)) is not None:
            arrival.T_world_start = gtsam.Pose3(prediction[0])
            arrival.anchor = PosePrior(T_world_frame=prediction[0], covariance=prediction[1])

    def _refuse(
        self, arrival: _Arrival, edge: Edge | None, reason: str, *, is_gated: bool = False
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

    def _reject(
        self, frame_id: FrameId, reason: str, *, edge: Edge | None = None, is_gated: bool = False
    ) -> Rejected:
        member = self._members.get(frame_id)
        return self._ledger.reject(
            frame_id,
            None if member is None else member.stamp_ns,
            reason,
            reference_id=None if edge is None else edge.reference_id,
            is_gated=is_gated,
        )

    def _judge(self, arrival: _Arrival, measurements: list[Measurement]) -> Verdict:
        known = arrival.T_world_references

        def pose_of(frame_id: FrameId) -> gtsam.Pose3:
            if frame_id not in known:
                known[frame_id] = self._graph.pose3(self._members[frame_id].key)
            return known[frame_id]

        return judge(
            measurements,
            pose_of=pose_of,
            relative_covariance=self._relative_covariance,
            motion=lambda: self._coasting_edge(arrival.stamp_ns),
            gate=self._config.gate,
        )

    def _coasting_edge(self, stamp_ns: int) -> Edge | None:
        """Return the edge from the last pose, where it is in the window, by the velocity so far."""
        last = self._motion.last
        if last is None or last.frame_id not in self._members:
            return None
        T_last_frame, covariance = self._motion.predict_step(stamp_ns)
        return Edge(
            reference_id=last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )

    def _gate_loop(self, frame_id: FrameId, edge: Edge) -> str:
        """Return why an edge between known poses is refused; empty where it fits them."""
        if self._config.gate is None:
            return ""
        known = self.relative_pose(edge.reference_id, frame_id)
        return disagreement(edge, known.T_reference_frame, known.covariance, gate=self._config.gate)

    def _relative_covariance(self, reference_id: FrameId, frame_id: FrameId) -> FloatArray:
        """Return the covariance (6, 6) of T_reference_frame, zero of a pose to itself."""
        if reference_id == frame_id:
            return np.zeros((6, 6))
        T = se3.invert(self.pose(reference_id)) @ self.pose(frame_id)
        # T exp(d) = (T_r exp(d_r))^-1 T_f exp(d_f)  =>  d = d_f - Ad(T^-1) d_r
        J = np.hstack([-se3.adjoint(se3.invert(T)), np.eye(6)])
        try:
            keys = self._members[reference_id].key, self._members[frame_id].key
            joint = self._graph.joint_covariance(*keys)
            return definite(J @ joint @ J.T)
        except (RuntimeError, SmoothingError):
            # What they share is lost in rounding: as if they shared nothing, which is no less.
            apart = np.zeros((12, 12))
            apart[:6, :6] = self._final_estimate(reference_id).covariance
            apart[6:, 6:] = self._final_estimate(frame_id).covariance
            return sane_covariance(J @ apart @ J.T)

    # What goes into the graph

    def _note_motion(self, arrival: _Arrival, estimate: Estimate) -> None:
        """Remember how the camera moved, if the graph says so and not a prior alone."""
        measured = self._members.get(self._motion.measured_id) if arrival.measurements else None
        T_world_measured = None
        if measured is not None:
            T = arrival.T_world_after.get(measured.key)
            T_world_measured = self._graph.pose(measured.key) if T is None else T.matrix()
        self._motion.append(
            estimate, is_measured=arrival.is_measured, T_world_measured=T_world_measured
        )

    def _enter(self, arrival: _Arrival, status: Status | None) -> Estimate:
        """Put the pose into the graph; where GTSAM gives up, with ever less beside it."""
        pose = self._insert_safely(arrival)
        found = self._clock.next(arrival.stamp_ns, is_tied=arrival.is_measured)
        estimate = Estimate(
            frame_id=arrival.frame_id,
            stamp_ns=arrival.stamp_ns,
            T_world_cam=pose[0],
            covariance=pose[1],
            status=status if status and arrival.is_measured else found,
            rejected=tuple(arrival.rejected),
        )
        if arrival.frame_id in self._members:
            member = self._members[arrival.frame_id]
            member.status, member.causal = estimate.status, estimate
        else:
            self._finished.append(estimate)
        self._ledger.add(
            n_poses=1,
            n_edges=len(arrival.measurements),
            n_priors=len(arrival.priors),
            n_coasting=int(not arrival.is_measured),
        )
        return estimate

    def _insert_safely(self, arrival: _Arrival) -> tuple[FloatArray, FloatArray]:
        """Return the pose of the new frame and its covariance, whatever GTSAM does."""
        harden = [self._harden] if self._graph.can_be_hardened else []
        for simplify in (None, *harden, self._drop_measurements, self._rebuild_for):
            try:
                if simplify is not None:
                    simplify(arrival)
                return self._insert(arrival)
            except SmoothingError as error:
                self._ledger.add(n_restored=1)
                place = f"{arrival.frame_id!r} at {arrival.stamp_ns} ns"
                _LOGGER.warning("%s: %s; the window stands as before", place, error)
        # Not even alone: the pose is handed over as it is reckoned, and never in the window.
        prediction = self._motion.predict_pose(arrival.stamp_ns)
        return prediction or (_ORIGIN.T_world_frame, _ORIGIN.covariance)

    def _new_graph(self) -> PoseGraph:
        return PoseGraph(is_whole=self._is_whole)

    def _harden(self, _: _Arrival) -> None:
        """Go on with a graph that takes worse conditioned measurements."""
        self._graph = self._graph.hardened()

    def _drop_measurements(self, arrival: _Arrival) -> None:
        edges = [measurement.edge for measurement in arrival.measurements]
        for edge in [*edges, *(None for _ in arrival.priors)]:
            self._refuse(arrival, edge, "GTSAM gave up on the update")
        arrival.measurements, arrival.priors = [], []
        arrival.anchor, arrival.is_origin = None, False
        self._receive_without_edges(arrival)

    def _rebuild_for(self, arrival: _Arrival) -> None:
        """Make the graph anew from its poses and what is known of each; nobody leaves."""
        graph = PoseGraph(is_whole=self._is_whole, is_hardened=True)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for frame_id, member in self._members.items():
            estimate = self._final_estimate(frame_id)
            prior = PosePrior(
                T_world_frame=se3.normalize(estimate.T_world_cam),
                covariance=sane_covariance(estimate.covariance),
            )
            factors.add(self._factors.prior(member.key, prior))
            values.insert(member.key, gtsam.Pose3(estimate.T_world_cam))
        with graph.restored_on_error():
            graph.update(factors, values)
        self._graph = graph
        self._ledger.add(n_rebuilt=1)
        for member in self._members.values():
            member.edges, member.priors = [], []

    def _insert(self, arrival: _Arrival) -> tuple[FloatArray, FloatArray]:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        ties, before = [], {arrival.key: arrival.T_world_start}
        for measurement in arrival.measurements:
            reference_id = measurement.edge.reference_id
            key = self._members[reference_id].key
            factors.add(self._factors.between(key, arrival.key, measurement))
            ties.append(_Tie(measurement.edge, self._factors, key))
            before[key] = arrival.T_world_references[reference_id]
        if arrival.coasting is not None:
            last_key = self._members[arrival.coasting.reference_id].key
            coasting = Measurement.of(arrival.coasting)
            factors.add(self._factors.between(last_key, arrival.key, coasting))
        anchors = [] if arrival.anchor is None else [arrival.anchor]
        for prior in [*arrival.priors, *anchors]:
            factors.add(self._factors.prior(arrival.key, prior))
        values.insert(arrival.key, arrival.T_world_start)
        leaving = self._leaving()
        keys = [self._members[frame_id].key for frame_id in leaving]
        alive = [member.key for member in self._members.values()]
        with self._graph.restored_on_error():
            self._graph.update(factors, values, alive=alive, leaving=keys)
            after, is_moved = self._graph.settle(before, alive=[*alive, arrival.key], leaving=keys)
            arrival.T_world_after = after
            # The new pose first: GTSAM is faster so than the other way round.
            covariance, *others = self._graph.covariances([arrival.key, *keys])
            pose = np.asarray(after[arrival.key].matrix()), covariance
            _check_result(pose[0])
            finished = list(map(self._estimate, leaving, others))
            if is_moved:
                self._check_others()
            self._graph.marginalize(keys)
        if self._log is not None:
            self._log.add(factors, values, keys={arrival.frame_id: arrival.key}, leaving=keys)
        self._finished += finished
        for frame_id in leaving:
            del self._members[frame_id]
        self._members[arrival.frame_id] = _Member(
            key=arrival.key,
            stamp_ns=arrival.stamp_ns,
            edges=ties,
            priors=[(prior, self._factors) for prior in arrival.priors],
        )
        return pose

    def _extend(
        self, frame_id: FrameId, factor: gtsam.NonlinearFactor, *, edge: Edge | None = None
    ) -> Estimate | Rejected:
        """Add a factor between poses that are there."""
        factors = gtsam.NonlinearFactorGraph()
        factors.add(factor)
        while True:
            try:
                estimate = self._updated(frame_id, factors)
            except SmoothingError as error:
                self._ledger.add(n_restored=1)
                _LOGGER.warning("%r: %s; the window stands as before", frame_id, error)
                if not self._hardened():
                    reason = f"GTSAM gave up on the update: {error}"
                    return self._reject(frame_id, reason, edge=edge)
            else:
                if self._log is not None:
                    self._log.add(factors, gtsam.Values(), keys={})
                return estimate

    def _hardened(self) -> bool:
        """Go on with a graph that takes worse conditioned factors; False where there is none."""
        if not self._graph.can_be_hardened:
            return False
        try:
            self._graph = self._graph.hardened()
        except SmoothingError as error:
            _LOGGER.warning("the graph stays as it is: %s", first_line(error))
            return False
        return True

    def _updated(self, frame_id: FrameId, factors: gtsam.NonlinearFactorGraph) -> Estimate:
        """Return a pose after factors between known poses were added."""
        key = self._members[frame_id].key
        with self._graph.restored_on_error():
            before = {key: self._graph.pose3(key)}
            self._graph.update(factors, gtsam.Values())
            self._graph.settle(before)
            estimate = self._estimate(frame_id)
            _check_result(estimate.T_world_cam)
            self._check_others()
        return estimate

    def _check_others(self) -> None:
        """Raise where an update sent a pose to infinity; a whole graph is too large to look at."""
        if not self._is_whole and (fault := place_fault(self._graph.positions())):
            raise SmoothingError(f"GTSAM: {fault}")

    def _leaving(self) -> list[FrameId]:
        """Return who leaves with the next pose: neither recent then, nor kept."""
        if self._config.size is None:
            return []
        n_old = max(len(self._members) + 1 - self._config.size, 0)
        old = islice(self._members.items(), n_old)
        return [frame_id for frame_id, member in old if not member.is_kept][:_MAX_LEAVING]

    def _standing(self, member: _Member) -> Iterator[_Tie]:
        """Yield the edges of a pose whose references are still in the window.

        A name may have been given again to another pose: the key tells.
        """
        for tie in member.edges:
            reference = self._members.get(tie.edge.reference_id)
            if reference is not None and reference.key == tie.reference_key:
                yield tie

    def _keep_by_distance(self, frame_id: FrameId) -> None:
        T_frame_world = se3.invert(self.pose(frame_id))
        scores = {
            kept_id: proximity(T_frame_world @ self.pose(kept_id), self._config)
            for kept_id in self.kept()
        }
        if self._config.n_keyframes > 0 and is_needed(scores, self._config):
            self.keep(frame_id)
        n_kept = len(scores) + int(self._members[frame_id].is_kept)
        for kept_id in choose_released(scores, self._config, n_kept=n_kept):
            self.release(kept_id)

    # What comes out

    def _member(self, frame_id: FrameId) -> _Member:
        member = self._find(frame_id)
        if member is None:
            raise ValueError(_absence(frame_id))
        return member

    def _find(self, frame_id: FrameId) -> _Member | None:
        """Return a pose of the window, if it is there; misuse is told."""
        try:
            return self._members.get(frame_id)
        except TypeError:
            raise ValueError(f"a frame_id must be hashable, got {frame_id!r}") from None

    def _estimate(self, frame_id: FrameId, covariance: FloatArray | None = None) -> Estimate:
        member = self._members[frame_id]
        return Estimate(
            stamp_ns=member.stamp_ns,
            T_world_cam=self._graph.pose(member.key),
            covariance=self._graph.covariance(member.key) if covariance is None else covariance,
            status=member.status,
            frame_id=frame_id,
        )

    def _final_estimate(self, frame_id: FrameId) -> Estimate:
        """Return a pose also where GTSAM cannot give it, or its covariance, any more."""
        try:
            estimate = self._estimate(frame_id)
            _check_result(estimate.T_world_cam)
        except (RuntimeError, SmoothingError) as error:
            member = self._members[frame_id]
            place = f"{frame_id!r} at {member.stamp_ns} ns"
            _LOGGER.warning("%s: %s; its causal pose stands", place, first_line(error))
            if member.causal is None:
                raise
            return replace(member.causal, status=member.status, rejected=())
        return estimate

    def _polished(self) -> list[Estimate]:
        """Return all poses at the least error of the whole graph."""
        try:
            optimized, self._polish = polish(self._graph.factors(), self._graph.values())
            self._graph = self._graph.moved(optimized)
        except (RuntimeError, SmoothingError) as error:
            _LOGGER.warning("the poses stand as iSAM2 left them: %s", first_line(error))
        return [self._final_estimate(frame_id) for frame_id in self._members]


def _as_edges(frame_id: FrameId, edges: Sequence[Edge]) -> tuple[Edge, ...]:
    if isinstance(edges, Sequence) and all(isinstance(edge, Edge) for edge in edges):
        return tuple(edges)
    raise ValueError(f"edges of {frame_id!r} must be a sequence of Edge values")


def _check_config(config: WindowConfig) -> None:
    if not isinstance(config, WindowConfig):
        raise ValueError(f"config must be a gvo.WindowConfig, got {type(config).__name__}")


def _check_prior(frame_id: FrameId, prior: Prior) -> None:
    if not isinstance(prior, PosePrior | PositionPrior):
        raise ValueError(f"the prior of {frame_id!r} must be a PosePrior or a PositionPrior")


def _absence(frame_id: FrameId) -> str:
    return f"{frame_id!r} is not in the window: it has left, or never was"


def _check_result(T_world_frame: FloatArray) -> None:
    if fault := pose_fault(T_world_frame):
        raise SmoothingError(f"GTSAM: {fault}")
