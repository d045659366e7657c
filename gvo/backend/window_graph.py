"""The poses of a window in iSAM2, under the caller's names: what goes in, and what comes out."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from gvo.backend.arrival import Arrival
from gvo.backend.checks import place_fault, pose_fault, sane_covariance
from gvo.backend.factors import Factors, Measurement
from gvo.backend.graph import PoseGraph, definite, first_line
from gvo.backend.members import Member, Members, Tie
from gvo.backend.polish import Polish, polish
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, GraphEdge, PosePrior, Prior

_LOGGER = logging.getLogger(__name__)


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
