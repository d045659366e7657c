"""The poses of a window in iSAM2, under the caller's names: what goes in, and what comes out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

import gtsam
import numpy as np

from gvo.backend.batch import Polish, polish
from gvo.backend.factors import Factors, Measurement
from gvo.backend.isam2 import PoseGraph, definite, first_line
from gvo.backend.validation import place_fault, pose_fault, sane_covariance
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.types import (
    Edge,
    Estimate,
    FloatArray,
    FrameId,
    GraphEdge,
    PosePrior,
    Prior,
    Rejected,
    Status,
)

_LOGGER = logging.getLogger(__name__)

# Of a first pose without a prior, which defines the world: radians and metres.
ORIGIN = PosePrior(T_world_frame=np.eye(4), covariance=1e-10 * np.eye(6))
# Of poses that a smaller window lets go: what they cost together grows with the cube.
_MAX_LEAVING = 32


@dataclass(slots=True, kw_only=True)
class Arrival:
    """A pose on its way into the window, with what is usable of its measurements.

    `T_world_references` are the poses of the references at that moment, by their names;
    `T_world_after` those of the pose and of them once it is in the graph, by their keys. `anchor`
    and `coasting` hold the pose where the measurements do not; they are none themselves.
    """

    frame_id: FrameId
    key: int
    stamp_ns: int
    T_world_start: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
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


class Tie(NamedTuple):
    """An accepted edge, with the key of its reference and what made its factor: its kernel."""

    edge: Edge
    factors: Factors
    reference_key: int


@dataclass(slots=True, kw_only=True)
class Member:
    """A pose of the window, with what was measured of it.

    Ties to poses that have left since stay among the edges. Each prior comes with what made its
    factor.
    """

    key: int
    stamp_ns: int
    edges: list[Tie]
    priors: list[tuple[Prior, Factors]]
    is_kept: bool = False
    status: Status = Status.OK
    causal: Estimate | None = None


class Members(dict[FrameId, Member]):
    """The poses of a window by the caller's names, oldest first."""

    @property
    def newest(self) -> FrameId:
        """The newest frame; None where there is none."""
        return next(reversed(self), None)

    @property
    def kept(self) -> list[FrameId]:
        """The kept frames, oldest first."""
        return [frame_id for frame_id, member in self.items() if member.is_kept]

    def find(self, frame_id: FrameId) -> Member | None:
        """Return a pose of the window, if it is there.

        Raises
        ------
        ValueError
            Where it can be no name.
        """
        try:
            return self.get(frame_id)
        except TypeError:
            raise ValueError(f"a frame_id must be hashable, got {frame_id!r}") from None

    def member(self, frame_id: FrameId) -> Member:
        """Return a pose of the window.

        Raises
        ------
        ValueError
            Where it is not there.
        """
        member = self.find(frame_id)
        if member is None:
            raise ValueError(absence(frame_id))
        return member

    def leaving(self, size: int | None) -> list[FrameId]:
        """Return who leaves with the next pose: neither recent then, nor kept."""
        if size is None:
            return []
        old = islice(self.items(), max(len(self) + 1 - size, 0))
        return [frame_id for frame_id, member in old if not member.is_kept][:_MAX_LEAVING]

    def tie_fault(self, frame_id: FrameId, edge: Edge, *, is_new: bool = False) -> str:
        """Return which end of an edge is not there; empty where both are, or a new pose is one."""
        if edge.reference_id == frame_id:
            return "an edge of a pose to itself"
        ends = [edge.reference_id] if is_new else [edge.reference_id, frame_id]
        return next((absence(end) for end in ends if end not in self), "")

    def standing_ties(self, member: Member) -> Iterator[Tie]:
        """Yield the edges of a pose whose references are still in the window.

        A name may have been given again to another pose: the key tells.
        """
        for tie in member.edges:
            reference = self.get(tie.edge.reference_id)
            if reference is not None and reference.key == tie.reference_key:
                yield tie


def absence(frame_id: FrameId) -> str:
    """Return what to say of a frame that is not there."""
    return f"{frame_id!r} is not in the window: it has left, or never was"


class WindowGraph:
    """Poses with their measurements, of which those leave that are neither recent nor kept.

    Where GTSAM gives an update up, all stands as before, and a `SmoothingError` says so.

    Parameters
    ----------
    config : WindowConfig
        Number of recent poses, robust kernel.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._factors = Factors(config)
        self._finished: list[Estimate] = []
        self.members = Members()
        self._begin()

    def reconfigure(self, config: WindowConfig) -> None:
        """Take another size, and another kernel for what comes from now on."""
        former, self._config = self._config, config
        if (config.kernel, config.kernel_threshold) != (former.kernel, former.kernel_threshold):
            self._factors = Factors(config)
        if not self.members:
            self._begin()
        elif self._is_whole and config.size is not None:
            self._prepare_to_leave()

    def _begin(self) -> None:
        self.members.clear()
        self._is_whole = self._config.size is None
        self._isam = PoseGraph(is_whole=self._is_whole)

    def _prepare_to_leave(self) -> None:
        """Go on with a graph that poses can leave."""
        self._is_whole = False
        graph = PoseGraph()
        try:
            with graph.restored_on_error():
                graph.update(self._isam.factors(), self._isam.values())
        except SmoothingError as error:
            # It can still be made anew from the poses, where the next update fails.
            _LOGGER.warning("the graph stays as it is: %s", first_line(error))
        else:
            self._isam = graph

    # What goes in

    def insert(self, arrival: Arrival) -> tuple[FloatArray, FloatArray]:
        """Put a pose into the graph, and let others leave.

        Parameters
        ----------
        arrival : Arrival
            Is told where the update moved it and its references.

        Returns
        -------
        T_world_frame : ndarray of float64, shape (4, 4)
        covariance : ndarray of float64, shape (6, 6)
        """
        factors, ties = self._factors_of(arrival)
        values = gtsam.Values()
        values.insert(arrival.key, arrival.T_world_start)
        before = {
            tie.reference_key: arrival.T_world_references[tie.edge.reference_id] for tie in ties
        }
        before[arrival.key] = arrival.T_world_start
        leaving = self.members.leaving(self._config.size)
        keys = [self.members[frame_id].key for frame_id in leaving]
        with self._isam.restored_on_error():
            covariance, *others = self._update(arrival, factors, values, before, keys)
            T_world_frame = np.asarray(arrival.T_world_after[arrival.key].matrix())
            _check_result(T_world_frame)
            finished = list(map(self._estimate, leaving, others))
            self._isam.marginalize(keys)
        self._finished += finished
        for frame_id in leaving:
            del self.members[frame_id]
        self.members[arrival.frame_id] = Member(
            key=arrival.key,
            stamp_ns=arrival.stamp_ns,
            edges=ties,
            priors=[(prior, self._factors) for prior in arrival.priors],
        )
        return T_world_frame, covariance

    def _factors_of(self, arrival: Arrival) -> tuple[gtsam.NonlinearFactorGraph, list[Tie]]:
        factors, ties = gtsam.NonlinearFactorGraph(), []
        for measurement in arrival.measurements:
            key = self.members[measurement.edge.reference_id].key
            factors.add(self._factors.between(key, arrival.key, measurement))
            ties.append(Tie(measurement.edge, self._factors, key))
        if arrival.coasting is not None:
            key = self.members[arrival.coasting.reference_id].key
            coasting = Measurement.of(arrival.coasting)
            factors.add(self._factors.between(key, arrival.key, coasting))
        anchors = [] if arrival.anchor is None else [arrival.anchor]
        for prior in [*arrival.priors, *anchors]:
            factors.add(self._factors.prior(arrival.key, prior))
        return factors, ties

    def _update(
        self,
        arrival: Arrival,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        before: Mapping[int, gtsam.Pose3],
        leaving: Sequence[int],
    ) -> list[FloatArray]:
        """Return the covariances of the new pose and of those that leave, by their keys."""
        alive = [member.key for member in self.members.values()]
        self._isam.update(factors, values, alive=alive, leaving=leaving)
        arrival.T_world_after, is_moved = self._isam.settle(
            before, alive=[*alive, arrival.key], leaving=leaving
        )
        if is_moved:
            self._check_others()
        # The new pose first: GTSAM is faster so than the other way round.
        return self._isam.covariances([arrival.key, *leaving])

    def add_edge(self, frame_id: FrameId, edge: Edge) -> Estimate:
        """Tie two poses of the window; return the first with the edge."""
        member, reference = self.members[frame_id], self.members[edge.reference_id]
        measurement = Measurement.of(edge)
        factor = self._factors.between(reference.key, member.key, measurement)
        estimate = self._extend(frame_id, factor)
        member.edges.append(Tie(edge, self._factors, reference.key))
        return estimate

    def add_prior(self, frame_id: FrameId, prior: Prior) -> Estimate:
        """Tie a pose of the window to the world; return it with the prior."""
        member = self.members[frame_id]
        estimate = self._extend(frame_id, self._factors.prior(member.key, prior))
        member.priors.append((prior, self._factors))
        return estimate

    def _extend(self, frame_id: FrameId, factor: gtsam.NonlinearFactor) -> Estimate:
        """Add a factor between poses that are there."""
        factors = gtsam.NonlinearFactorGraph()
        factors.add(factor)
        key = self.members[frame_id].key
        with self._isam.restored_on_error():
            before = {key: self._isam.pose3(key)}
            self._isam.update(factors, gtsam.Values())
            self._isam.settle(before)
            estimate = self._estimate(frame_id)
            _check_result(estimate.T_world_cam)
            self._check_others()
        return estimate

    def _check_others(self) -> None:
        """Raise where an update sent a pose to infinity; a whole graph is too large to look at."""
        if not self._is_whole and (fault := place_fault(self._isam.positions())):
            raise SmoothingError(f"GTSAM: {fault}")

    # Where GTSAM gave up

    @property
    def can_be_hardened(self) -> bool:
        """Tell whether there is a graph that takes worse conditioned measurements."""
        return self._isam.can_be_hardened

    def harden(self) -> None:
        """Go on with a graph that takes worse conditioned measurements."""
        self._isam = self._isam.hardened()

    def rebuild(self) -> None:
        """Make the graph anew from its poses and what is known of each; nobody leaves."""
        graph = PoseGraph(is_whole=self._is_whole, is_hardened=True)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for frame_id, member in self.members.items():
            estimate = self.estimate(frame_id)
            prior = PosePrior(
                T_world_frame=se3.normalize(estimate.T_world_cam),
                covariance=sane_covariance(estimate.covariance),
            )
            factors.add(self._factors.prior(member.key, prior))
            values.insert(member.key, gtsam.Pose3(estimate.T_world_cam))
        with graph.restored_on_error():
            graph.update(factors, values)
        self._isam = graph
        for member in self.members.values():
            member.edges, member.priors = [], []

    # What comes out

    def pose3(self, frame_id: FrameId) -> gtsam.Pose3:
        """Return T_world_frame of a pose of the window as GTSAM holds it."""
        return self._isam.pose3(self.members[frame_id].key)

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose; the causal one where it diverged."""
        member = self.members[frame_id]
        T_world_frame = self._isam.pose(member.key)
        if member.causal is not None and pose_fault(T_world_frame):
            return member.causal.T_world_cam
        return T_world_frame

    def estimate(self, frame_id: FrameId) -> Estimate:
        """Return a pose also where GTSAM cannot give it, or its covariance, any more."""
        try:
            estimate = self._estimate(frame_id)
            _check_result(estimate.T_world_cam)
        except (RuntimeError, SmoothingError) as error:
            member = self.members[frame_id]
            place = f"{frame_id!r} at {member.stamp_ns} ns"
            _LOGGER.warning("%s: %s; its causal pose stands", place, first_line(error))
            if member.causal is None:
                raise
            return replace(member.causal, status=member.status, rejected=())
        return estimate

    def _estimate(self, frame_id: FrameId, covariance: FloatArray | None = None) -> Estimate:
        member = self.members[frame_id]
        return Estimate(
            stamp_ns=member.stamp_ns,
            T_world_cam=self._isam.pose(member.key),
            covariance=self._isam.covariance(member.key) if covariance is None else covariance,
            status=member.status,
            frame_id=frame_id,
        )

    def relative_covariance(self, reference_id: FrameId, frame_id: FrameId) -> FloatArray:
        """Return the covariance (6, 6) of T_reference_frame, zero of a pose to itself."""
        if reference_id == frame_id:
            return np.zeros((6, 6))
        T = se3.invert(self.pose(reference_id)) @ self.pose(frame_id)
        # T exp(d) = (T_r exp(d_r))^-1 T_f exp(d_f)  =>  d = d_f - Ad(T^-1) d_r
        J = np.hstack([-se3.adjoint(se3.invert(T)), np.eye(6)])
        try:
            keys = self.members[reference_id].key, self.members[frame_id].key
            return definite(J @ self._isam.joint_covariance(*keys) @ J.T)
        except (RuntimeError, SmoothingError):
            # What they share is lost in rounding: as if they shared nothing, which is no less.
            apart = np.zeros((12, 12))
            apart[:6, :6] = self.estimate(reference_id).covariance
            apart[6:, 6:] = self.estimate(frame_id).covariance
            return sane_covariance(J @ apart @ J.T)

    def measurements(self) -> list[GraphEdge]:
        """Return the measurements between poses of the window, and how the poses fit them."""
        poses = {frame_id: self.pose(frame_id) for frame_id in self.members}
        found = []
        for frame_id, member in self.members.items():
            found += [
                tie.factors.residual_of_edge(
                    tie.edge, frame_id, poses[tie.edge.reference_id], poses[frame_id]
                )
                for tie in self.members.standing_ties(member)
            ]
            found += [
                factors.residual_of_prior(prior, frame_id, poses[frame_id])
                for prior, factors in member.priors
            ]
        return found

    def finish_one(self, estimate: Estimate) -> None:
        """Hand over a pose that never came into the graph."""
        self._finished.append(estimate)

    def pop_finished(self) -> list[Estimate]:
        """Hand over the smoothed estimates of the poses that left since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def finish(self) -> Polish | None:
        """Let all poses leave, polished where nothing ever left, and begin anew."""
        polished = None
        if self._is_whole and self.members:
            try:
                optimized, polished = polish(self._isam.factors(), self._isam.values())
                self._isam = self._isam.moved(optimized)
            except (RuntimeError, SmoothingError) as error:
                _LOGGER.warning("the poses stand as iSAM2 left them: %s", first_line(error))
        self._finished += [self.estimate(frame_id) for frame_id in self.members]
        self._begin()
        return polished


def _check_result(T_world_frame: FloatArray) -> None:
    if fault := pose_fault(T_world_frame):
        raise SmoothingError(f"GTSAM: {fault}")
