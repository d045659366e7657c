"""A sliding window of poses, smoothed by iSAM2 with marginalization."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import gtsam
import numpy as np

from gvo.backend.batch import BatchResult
from gvo.backend.factors import ORIGIN, Measurement, find_faults, prior_fault
from gvo.backend.gating import Gated, Prediction, disagreement, gate_edges, misfit
from gvo.backend.keyframe_policy import choose_released, is_needed, proximity
from gvo.backend.motion_model import ConstantVelocity, StatusClock
from gvo.backend.pose_graph import NewPose, PoseGraph, absence
from gvo.config import WindowConfig
from gvo.errors import SmoothingError, write_faults
from gvo.geometry import se3
from gvo.geometry.edges import NO_EFFECTS, between, gone_on
from gvo.trajectory.g2o import g2o_lines
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

# Of a first pose of which only the position is known: radians, and metres beside its prior.
_UNKNOWN_COVARIANCE = np.diag(np.repeat([1.0, 1e4], 3) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowCounts:
    """Counts of what a window accepted and refused so far.

    Parameters
    ----------
    n_poses, n_edges, n_priors : int
        Accepted.
    n_rejected : int
        Refused edges and priors, the gated ones among them.
    n_gated : int
        Edges refused because others contradict them.
    n_coasting : int
        Poses without a usable edge, which continue the last velocity, or go on by `coasting`.
    n_restored : int
        Updates in which GTSAM failed; the window was restored.
    n_rebuilt : int
        Times that GTSAM failed with a pose alone; all poses left, and the window began anew.
    first_rejected : str
        The first refusal; empty before it.
    """

    n_poses: int = 0
    n_edges: int = 0
    n_priors: int = 0
    n_rejected: int = 0
    n_gated: int = 0
    n_coasting: int = 0
    n_restored: int = 0
    n_rebuilt: int = 0
    first_rejected: str = ""


class SlidingWindow:
    """Recent poses and keyframes, smoothed over relative poses of any origin.

    A pose that is neither recent nor kept is marginalized, and `pop_finished` returns its smoothed
    estimate. With `window.size: null` none is marginalized, and `finish` ends with a batch
    optimization by Levenberg-Marquardt.

    No measurement stops the window: an edge or a prior that is invalid, or that others
    contradict, is refused with a reason (`Rejected`), and a pose without a usable edge continues
    the last velocity.

    Parameters
    ----------
    config : WindowConfig, optional
        Number of recent poses, robust kernel, gate.
    keyframes : {"manual", "distance"}
        Who chooses keyframes: the caller by `keep` and `release`, or the window by distance and
        angle (`window.keyframe_distance_m`, `window.keyframe_angle_deg`, `window.n_keyframes`).

    Attributes
    ----------
    variance_factor : float
        By which covariances are multiplied that are given out: what those of all edges turned out
        to be wrong by. Poses and gates do not depend on it.
    effects_factor : float
        By which the effects of edges are multiplied, in covariances that are given out: the size of
        the errors that all edges share.
    misfit : float
        How far the places that the edges of the last pose lead to, from their references as they
        were given out, lie from their mean, in squared sigmas per degree of freedom: about one if
        covariances are true. NaN with less than two edges.

    Examples
    --------
    >>> window = SlidingWindow()
    >>> _ = window.add_pose("a", 0, [])
    >>> step = np.eye(4)
    >>> step[2, 3] = 1.0
    >>> edge = Edge(reference_id="a", T_reference_frame=step, covariance=1e-4 * np.eye(6))
    >>> estimate = window.add_pose("b", 100_000_000, [edge])
    >>> estimate.T_world_frame[:3, 3].round(6).tolist()
    [0.0, 0.0, 1.0]
    """

    def __init__(
        self, config: WindowConfig | None = None, *, keyframes: Keeping = "manual"
    ) -> None:
        if keyframes not in get_args(Keeping):
            raise ValueError(f"keyframes must be one of {get_args(Keeping)}, got {keyframes!r}")
        if config is not None:
            _check_config(config)
        self._config = config or WindowConfig()
        self._keeps_by_distance = keyframes == "distance"
        self._graph = PoseGraph(self._config)
        self._poses = self._graph.poses
        self._counted: Counter[str] = Counter()
        self._first_rejected = ""
        self._clock = StatusClock()
        self._motion = ConstantVelocity()
        self._batch_result: BatchResult | None = None
        self.variance_factor = self.effects_factor = 1.0
        self.misfit = math.nan
        # By how much errors that edges share move poses, in their frames, until they are popped.
        self._effects: dict[FrameId, FloatArray] = {}

    def __repr__(self) -> str:
        """Return the number of poses, the newest, and the counts in one line."""
        counts = self.counts
        newest = f", newest {self.newest!r}, {len(self.kept())} kept" if self else ""
        return (
            f"SlidingWindow({len(self)} poses{newest}; so far {counts.n_poses} poses, "
            f"{counts.n_edges} edges accepted, {counts.n_rejected} rejected)"
        )

    def __contains__(self, frame_id: object) -> bool:
        """Tell whether a frame is in the window."""
        return frame_id in self._poses

    def __len__(self) -> int:
        """Return the number of poses in the window."""
        return len(self._poses)

    @property
    def newest(self) -> FrameId:
        """The newest frame of the window; None while it is empty."""
        return next(reversed(self._poses), None)

    @property
    def counts(self) -> WindowCounts:
        """What was accepted and refused so far."""
        return WindowCounts(**self._counted, first_rejected=self._first_rejected)

    @property
    def batch_result(self) -> BatchResult | None:
        """The batch optimization in `finish`; None if `size` was not null from the start."""
        return self._batch_result

    def reconfigure(self, config: WindowConfig) -> None:
        """Use another configuration from now on; measurements keep their kernels.

        Parameters
        ----------
        config : WindowConfig
            With a smaller size poses leave with the next updates, up to 32 at a time. With
            `size: null` no more poses leave; `finish` does a batch optimization only if it was
            null from the first pose on.

        Raises
        ------
        ValueError
            If it is no WindowConfig.
        """
        _check_config(config)
        if config == self._config:
            return
        self._config = config
        self._graph.reconfigure(config)

    def add_pose(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None = None,
        *,
        status: Status | None = None,
        coasting: Edge | None = None,
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
            against each other. If none is usable, the pose continues the last velocity.
        prior : PosePrior or PositionPrior, optional
            A measurement of the pose in the world. Without one the very first pose is the
            identity; with a position alone its rotation starts at the identity, nearly free.
        status : Status, optional
            Of the estimates, if the pose is measured; found by the window if omitted.
        coasting : Edge, optional
            How the pose goes on from one in the window if no edge is usable: by an IMU or wheels,
            say, in place of the last velocity. The pose is coasting then, and never lost. Where two
            edges contradict each other, it has the casting vote. If it is invalid, it counts for
            nothing.

        Returns
        -------
        Estimate
            The causal pose with its marginal covariance, and what was refused.

        Raises
        ------
        ValueError
            For a name that is in the window already, a stamp that does not advance, or edges of
            the very first pose. The window is unchanged.
        """
        edges = _as_edges(frame_id, edges)
        self._check_new(frame_id, stamp_ns, edges, prior)
        carried = None if coasting is None else self._usable(frame_id, coasting)
        new = self._gated(frame_id, int(stamp_ns), edges, prior, carried)
        new, T_world_frame, covariance = self._insert(new)
        is_measured, is_carried = new.is_measured, new.is_carried
        found = self._clock.next(new.stamp_ns, is_measured=is_measured, is_carried=is_carried)
        estimate = Estimate(
            frame_id=frame_id,
            stamp_ns=new.stamp_ns,
            T_world_frame=T_world_frame,
            covariance=covariance,
            status=status if status and new.is_measured else found,
            rejected=new.rejected,
        )
        self._graph.keep_causal(estimate)
        self._count(new)
        self.misfit = self._misfit(new)
        self._consider(frame_id)
        self._update_motion(new, estimate)
        if self._keeps_by_distance and frame_id in self:
            self._keep_by_distance(frame_id)
        return self._scaled(estimate)

    def add_edge(self, frame_id: FrameId, edge: Edge) -> Estimate | Rejected:
        """Add an edge between two poses of the window, such as a loop.

        Parameters
        ----------
        frame_id : hashable
            The frame that the edge measures in its `reference_id`.
        edge : Edge

        Returns
        -------
        Estimate or Rejected
            The new estimate of the frame; falsy if the edge was refused.
        """
        pose = self._graph.find(frame_id)
        _as_edges(frame_id, [edge])
        fault = "" if pose else absence(frame_id)
        fault = self._absence(frame_id, edge) or fault or find_faults([edge])[0]
        gated = "" if fault else self._gate_loop(frame_id, edge)
        return self._extend(frame_id, edge, fault or gated, is_gated=bool(gated))

    def add_prior(self, frame_id: FrameId, prior: Prior) -> Estimate | Rejected:
        """Add a measurement of a pose of the window in the world.

        Parameters
        ----------
        frame_id : hashable
        prior : PosePrior or PositionPrior

        Returns
        -------
        Estimate or Rejected
            The new estimate of the frame; falsy if the prior was refused.
        """
        _check_prior(frame_id, prior)
        is_there = self._graph.find(frame_id) is not None
        return self._extend(frame_id, prior, prior_fault(prior) if is_there else absence(frame_id))

    def keep(self, frame_id: FrameId) -> None:
        """Keep a pose in the window until it is released."""
        self._graph.require(frame_id).is_kept = True

    def release(self, frame_id: FrameId) -> None:
        """Let a kept pose leave with the next update, unless it is recent."""
        self._graph.require(frame_id).is_kept = False

    def kept(self) -> list[FrameId]:
        """Return the kept frames, oldest first."""
        return [frame_id for frame_id, pose in self._poses.items() if pose.is_kept]

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose of the window."""
        return self._graph.pose(frame_id)

    def poses(self, frame_ids: Iterable[FrameId] | None = None) -> dict[FrameId, FloatArray]:
        """Return T_world_frame of all poses of the window, oldest first, or of some frames."""
        asked = self._poses if frame_ids is None else frame_ids
        return {each: self._graph.pose(each) for each in asked if each in self._poses}

    def edges(self, frame_id: FrameId) -> tuple[Edge, ...]:
        """Return the accepted edges of a frame to poses of the window; empty if it has left."""
        if frame_id not in self._poses:
            return ()
        found = (measured for measured, _ in self._graph.measurements_of(frame_id))
        return tuple(measured for measured in found if isinstance(measured, Edge))

    def stamp_ns(self, frame_id: FrameId) -> int:
        """Return the stamp of a pose of the window, nanoseconds."""
        return self._graph.require(frame_id).stamp_ns

    def estimate(self, frame_id: FrameId) -> Estimate:
        """Return the current estimate of a pose of the window."""
        self._graph.require(frame_id)
        return self._scaled(self._graph.estimate(frame_id))

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
            T_reference_frame, with a covariance from the joint one of both poses: their common
            uncertainty cancels. What shared errors of the edges make of it is contained.
        """
        T = se3.invert(self.pose(reference_id)) @ self.pose(frame_id)
        covariance = self.variance_factor * self._graph.relative_covariance(reference_id, frame_id)
        start, end = (self._effects.get(each, NO_EFFECTS) for each in (reference_id, frame_id))
        effects = self.effects_factor * between(start, end, T)
        covariance = covariance + effects @ effects.T
        return Edge(reference_id=reference_id, T_reference_frame=T, covariance=covariance)

    def graph(self) -> list[GraphEdge]:
        """Return the measurements of the poses of the window, with residuals and weights.

        Marginals of poses that left are not listed.
        """
        return self._graph.measurements()

    def write_g2o(self, path: str | Path) -> None:
        """Write poses and edges of the window as a g2o file.

        Parameters
        ----------
        path : str or Path
            Whole-number ids are kept, others are numbered, with their names as comments; priors
            are left out. Rotations of the information matrix are in radians, as GTSAM reads them.

        Raises
        ------
        SmoothingError
            If the file cannot be written.
        """
        text = "".join(f"{line}\n" for line in g2o_lines(self.poses(), self.graph()))
        with write_faults(SmoothingError, path):
            Path(path).write_text(text, encoding="utf-8", newline="\n")

    def pop_finished(self) -> list[Estimate]:
        """Return the smoothed estimates of the poses that left since the last call."""
        finished = [self._scaled(estimate) for estimate in self._graph.pop_finished()]
        for estimate in finished:
            self._effects.pop(estimate.frame_id, None)
        return finished

    def finish(self) -> list[Estimate]:
        """Return all estimates that were not popped yet, by stamp, and empty the window.

        A window that kept all poses from the start (`size: null`) is optimized in a batch first.
        """
        self._batch_result = self._graph.finish()
        self._motion = ConstantVelocity()
        self._clock = StatusClock()
        return sorted(self.pop_finished(), key=lambda estimate: estimate.stamp_ns)

    # What comes in

    def _check_new(
        self, frame_id: FrameId, stamp_ns: int, edges: Sequence[Edge], prior: Prior | None
    ) -> None:
        if frame_id is None:
            raise ValueError("a frame_id must not be None")
        if self._graph.find(frame_id) is not None:
            raise ValueError(f"{frame_id!r} is in the window already")
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

    def _gate_loop(self, frame_id: FrameId, edge: Edge) -> str:
        """Say why an edge between known poses is refused; empty if it is not."""
        if self._config.gate is None:
            return ""
        T = se3.invert(self.pose(edge.reference_id)) @ self.pose(frame_id)
        covariance = self._graph.relative_covariance(edge.reference_id, frame_id)
        return disagreement(edge, T, covariance, gate=self._config.gate)

    def _scaled(self, estimate: Estimate) -> Estimate:
        covariance = self.variance_factor * estimate.covariance
        effects = self.effects_factor * self._effects.get(estimate.frame_id, NO_EFFECTS)
        return replace(estimate, covariance=covariance + effects @ effects.T)

    def _consider(self, frame_id: FrameId) -> None:
        """Find how errors that edges share move a pose: by the mean of where these lead.

        Older poses stay as they are. A prior pins a pose; without measurements it moves as the one
        before.
        """
        if frame_id not in self._poses:
            return
        weights, before = np.zeros((6, 6)), self._motion.last
        total: FloatArray | None = None
        for measured, _ in self._graph.measurements_of(frame_id):
            if isinstance(measured, Edge):
                information = np.linalg.inv(measured.covariance)
                moved = gone_on(self._effects.get(measured.reference_id), measured)
                if moved is not None:
                    pull = np.asarray(information @ moved)
                    total = pull if total is None else total + pull
            else:
                information = _pinning(measured, self.pose(frame_id))
            weights += information
        if total is not None:
            self._effects[frame_id] = np.asarray(np.linalg.solve(weights, total))
        elif not weights.any() and before is not None and before.frame_id in self._effects:
            T_frame_before = se3.invert(self.pose(frame_id)) @ before.T_world_frame
            self._effects[frame_id] = se3.adjoint(T_frame_before) @ self._effects[before.frame_id]

    def _misfit(self, new: NewPose) -> float:
        """Return how far the edges of a pose disagree, from references as they were given out.

        Smoothed since, these have been drawn to where the edges to come lead.
        """
        predictions = []
        for measurement in new.measurements:
            reference = self._poses.get(measurement.edge.reference_id)
            if reference is not None and reference.causal is not None:
                T_world_reference = gtsam.Pose3(reference.causal.T_world_frame)
                T_world_frame = T_world_reference.compose(measurement.T_reference_frame)
                predictions.append(Prediction(measurement, T_world_frame))
        return misfit(predictions)

    def _count(self, new: NewPose) -> None:
        self._counted["n_poses"] += 1
        self._counted["n_edges"] += len(new.measurements)
        self._counted["n_priors"] += int(new.prior is not None)
        self._counted["n_coasting"] += int(not new.is_measured)
        self._counted["n_gated"] += new.n_gated
        self._count_rejected(new.rejected)

    def _count_rejected(self, rejected: Sequence[Rejected]) -> None:
        self._counted["n_rejected"] += len(rejected)
        if rejected and not self._first_rejected:
            self._first_rejected = str(rejected[0])

    # What passes the gate

    def _usable(self, frame_id: FrameId, coasting: Edge) -> Prediction | None:
        """Return the edge that a pose may go on by, if it is valid."""
        _as_edges(frame_id, [coasting])
        fault = self._absence(frame_id, coasting) or find_faults([coasting])[0]
        return None if fault else self._predict(coasting)

    def _gated(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None,
        coasting: Prediction | None,
    ) -> NewPose:
        """Return a pose with its valid measurements that pass the gate."""
        refused: list[tuple[Edge | None, str]] = []
        if prior is not None and (fault := prior_fault(prior)):
            refused, prior = [(None, fault)], None
        predictions = []
        for edge, fault in zip(edges, find_faults(edges), strict=True):
            if fault := self._absence(frame_id, edge) or fault:
                refused.append((edge, fault))
            else:
                predictions.append(self._predict(edge))
        if coasting is not None and not predictions:
            T_world_start, support = coasting.T_world_frame, None
            if isinstance(prior, PosePrior):
                T_world_start = gtsam.Pose3(prior.T_world_frame)
            gated = Gated(T_world_start, [coasting.measurement], [])
        else:
            gated, support = self._gate(predictions, stamp_ns, prior, coasting)
        refused += gated.refused
        return NewPose(
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            T_world_start=gated.T_world_start,
            measurements=gated.accepted,
            prior=prior,
            support=support,
            is_carried=coasting is not None
            and [each.edge for each in gated.accepted] == [coasting.edge],
            rejected=tuple(_refusal(frame_id, stamp_ns, *each) for each in refused),
            n_gated=len(gated.refused),
        )

    def _gate(
        self,
        predictions: Sequence[Prediction],
        stamp_ns: int,
        prior: Prior | None,
        coasting: Prediction | None,
    ) -> tuple[Gated, Edge | PosePrior | None]:
        """Gate edges against each other; without any, return what constrains the pose instead."""
        if not predictions:
            T_world_start, support = self._start(stamp_ns, prior)
            return Gated(T_world_start, [], []), support
        gated = gate_edges(
            predictions,
            relative_covariance=self._graph.relative_covariance,
            motion=lambda: coasting or self._coast(stamp_ns),
            gate=self._config.gate,
        )
        return gated, None

    def _absence(self, frame_id: FrameId, edge: Edge) -> str:
        """Say why the reference of an edge cannot be one; empty if it can."""
        if edge.reference_id == frame_id:
            return "an edge of a pose to itself"
        return "" if edge.reference_id in self._poses else absence(edge.reference_id)

    def _predict(self, edge: Edge) -> Prediction:
        measurement = Measurement.of(edge)
        T_world_reference = self._graph.pose3(edge.reference_id)
        return Prediction(measurement, T_world_reference.compose(measurement.T_reference_frame))

    def _coast(self, stamp_ns: int) -> Prediction | None:
        """Return the edge that the last velocity predicts; None if the last pose has left."""
        edge = self._motion.predict(stamp_ns)
        if edge is None or edge.reference_id not in self._poses:
            return None
        return self._predict(edge)

    def _start(
        self, stamp_ns: int, prior: Prior | None
    ) -> tuple[gtsam.Pose3, Edge | PosePrior | None]:
        """Return where a pose without edges begins, and what constrains it there."""
        if isinstance(prior, PosePrior):
            return gtsam.Pose3(prior.T_world_frame), None
        if (coasted := self._coast(stamp_ns)) is not None:
            return coasted.T_world_frame, coasted.edge
        support = self._support(stamp_ns, prior)
        return gtsam.Pose3(support.T_world_frame), support

    def _support(self, stamp_ns: int, prior: PositionPrior | None) -> PosePrior:
        """Return where a pose begins that no pose of the window leads to."""
        if (predicted := self._motion.predict_pose(stamp_ns)) is not None:
            T, covariance = predicted.T_world_frame, predicted.covariance
            return PosePrior(T_world_frame=T, covariance=covariance)
        if prior is None:
            return ORIGIN
        T_world_start = se3.make_transform(np.eye(3), prior.position_world)
        return PosePrior(T_world_frame=T_world_start, covariance=_UNKNOWN_COVARIANCE)

    # What goes into the graph

    def _insert(self, new: NewPose) -> tuple[NewPose, FloatArray, FloatArray]:
        """Put a pose into the graph, without measurements where GTSAM fails.

        Returns
        -------
        new : NewPose
            As it went in.
        T_world_frame : ndarray of float64, shape (4, 4)
        covariance : ndarray of float64, shape (6, 6)
        """
        for is_alone in (False, True):
            new = self._refuse_all(new) if is_alone else new
            try:
                return new, *self._graph.insert(new)
            except SmoothingError as error:
                self._note_failure(f"{new.frame_id!r} at {new.stamp_ns} ns", error)
        # Not even alone: it is handed over as predicted, and the next pose begins a window.
        self._graph.begin_anew()
        self._counted["n_rebuilt"] += 1
        start = self._support(new.stamp_ns, None)
        return new, start.T_world_frame, start.covariance

    def _refuse_all(self, new: NewPose) -> NewPose:
        """Return the pose without measurements."""
        edges: list[Edge | None] = [measurement.edge for measurement in new.measurements]
        edges += [] if new.prior is None else [None]
        ends, reason = (new.frame_id, new.stamp_ns), "GTSAM gave up on the update"
        T_world_start, support = self._start(new.stamp_ns, None)
        return replace(
            new,
            T_world_start=T_world_start,
            measurements=(),
            prior=None,
            support=support,
            is_carried=False,
            rejected=(*new.rejected, *(_refusal(*ends, edge, reason) for edge in edges)),
        )

    def _extend(
        self, frame_id: FrameId, measured: Edge | Prior, fault: str, *, is_gated: bool = False
    ) -> Estimate | Rejected:
        """Add a measurement of a pose of the window that has no fault."""
        edge = measured if isinstance(measured, Edge) else None
        if not fault:
            try:
                estimate = self._graph.extend(frame_id, measured)
            except SmoothingError as error:
                self._note_failure(repr(frame_id), error)
                fault = f"GTSAM gave up on the update: {error}"
            else:
                self._counted["n_priors" if edge is None else "n_edges"] += 1
                self._consider(frame_id)
                return self._scaled(estimate)
        pose = self._poses.get(frame_id)
        rejected = _refusal(frame_id, None if pose is None else pose.stamp_ns, edge, fault)
        self._counted["n_gated"] += int(is_gated)
        self._count_rejected([rejected])
        return rejected

    def _note_failure(self, place: str, error: SmoothingError) -> None:
        self._counted["n_restored"] += 1
        _LOGGER.warning("%s: %s; the window is restored", place, error)

    def _update_motion(self, new: NewPose, estimate: Estimate) -> None:
        """Update the velocity if edges, and not a prior alone, say how the camera moved."""
        before, T_world_before = self._motion.measured, None
        if new.measurements and before is not None and before.frame_id in self._poses:
            T_world_before = self._graph.pose(before.frame_id)
        is_known = new.is_measured or new.is_carried
        self._motion.append(estimate, is_measured=is_known, T_world_measured=T_world_before)

    def _keep_by_distance(self, frame_id: FrameId) -> None:
        T_frame_world = se3.invert(self.pose(frame_id))
        scores = {
            kept_id: proximity(T_frame_world @ self.pose(kept_id), self._config)
            for kept_id in self.kept()
        }
        if self._config.n_keyframes > 0 and is_needed(scores):
            self.keep(frame_id)
        n_kept = len(scores) + int(self._poses[frame_id].is_kept)
        for kept_id in choose_released(scores, self._config, n_kept=n_kept):
            self.release(kept_id)


def _pinning(prior: Prior, T_world_frame: FloatArray) -> FloatArray:
    """Return the information of a prior, (6, 6), in the frame."""
    if isinstance(prior, PosePrior):
        return np.asarray(np.linalg.inv(prior.covariance))
    information, R = np.zeros((6, 6)), T_world_frame[:3, :3]
    information[3:, 3:] = R.T @ np.linalg.inv(prior.covariance) @ R
    return information


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


def _refusal(frame_id: FrameId, stamp_ns: int | None, edge: Edge | None, reason: str) -> Rejected:
    """Return the refusal of an edge of a pose, or of its prior."""
    reference_id = None if edge is None else edge.reference_id
    return Rejected(frame_id=frame_id, stamp_ns=stamp_ns, reason=reason, reference_id=reference_id)
