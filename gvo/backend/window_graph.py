"""The poses of a window in iSAM2, under the caller's names."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import NamedTuple, TypeVar

import gtsam
import numpy as np

from gvo.backend.batch import BatchResult, optimize_batch
from gvo.backend.factors import (
    ORIGIN,
    Factors,
    Measurement,
    place_fault,
    pose_fault,
    sane_covariance,
)
from gvo.backend.pose_graph import PoseGraph, definite, first_line
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
_Result = TypeVar("_Result")

# Poses that leave at once when the window is made smaller: the cost grows with the cube.
_MAX_LEAVING = 32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPose:
    """A pose to be put into the window, with its admitted measurements.

    Parameters
    ----------
    frame_id : hashable
    stamp_ns : int
        Nanoseconds.
    T_world_start : gtsam.Pose3
        Start of the optimization.
    measurements : sequence of Measurement
        Of the admitted edges.
    T_world_references : mapping of hashable to gtsam.Pose3
        Poses of their references before the update.
    prior : PosePrior or PositionPrior, optional
        If admitted.
    support : Edge or PosePrior, optional
        Constrains a pose that its measurements do not: the origin, or the last velocity.
    rejected : tuple of Rejected
        Refused measurements.
    n_gated : int
        Edges among them that the other edges contradict.
    misfit : float
        Of its measurements, see `GateResult`.
    """

    frame_id: FrameId
    stamp_ns: int
    T_world_start: gtsam.Pose3
    measurements: Sequence[Measurement] = ()
    T_world_references: Mapping[FrameId, gtsam.Pose3] = field(default_factory=dict)
    prior: Prior | None = None
    support: Edge | PosePrior | None = None
    rejected: tuple[Rejected, ...] = ()
    n_gated: int = 0
    misfit: float = math.nan

    @property
    def is_measured(self) -> bool:
        """Tell whether a measurement constrains the pose, or it is the origin."""
        return bool(self.measurements) or self.prior is not None or self.support is ORIGIN


class AcceptedEdge(NamedTuple):
    """An edge in the graph, the key of its reference, and the factory that knows its kernel."""

    edge: Edge
    factors: Factors
    reference_key: int


@dataclass(slots=True, kw_only=True)
class WindowPose:
    """A pose of the window and its measurements.

    Edges stay in the list when their references leave. Each prior comes with the factory that
    made its factor. `causal` is the estimate at the time the pose came in.
    """

    key: int
    stamp_ns: int
    edges: list[AcceptedEdge]
    priors: list[tuple[Prior, Factors]]
    is_kept: bool = False
    causal: Estimate | None = None

    @property
    def status(self) -> Status:
        """The status at the time the pose came in."""
        return Status.OK if self.causal is None else self.causal.status


class WindowPoses(dict[FrameId, WindowPose]):
    """The poses of a window by the caller's names, oldest first."""

    @property
    def newest(self) -> FrameId:
        """The newest frame; None in an empty window."""
        return next(reversed(self), None)

    @property
    def kept(self) -> list[FrameId]:
        """The kept frames, oldest first."""
        return [frame_id for frame_id, pose in self.items() if pose.is_kept]

    def find(self, frame_id: FrameId) -> WindowPose | None:
        """Return a pose, or None if it is not in the window.

        Raises
        ------
        ValueError
            For a name that is not hashable.
        """
        try:
            return self.get(frame_id)
        except TypeError:
            raise ValueError(f"a frame_id must be hashable, got {frame_id!r}") from None

    def require(self, frame_id: FrameId) -> WindowPose:
        """Return a pose of the window.

        Raises
        ------
        ValueError
            If it is not in the window.
        """
        pose = self.find(frame_id)
        if pose is None:
            raise ValueError(absence(frame_id))
        return pose

    def leaving(self, size: int | None) -> list[FrameId]:
        """Return the frames to marginalize with the next pose: neither recent nor kept."""
        if size is None:
            return []
        old = islice(self.items(), max(len(self) + 1 - size, 0))
        return [frame_id for frame_id, pose in old if not pose.is_kept][:_MAX_LEAVING]

    def edge_fault(self, frame_id: FrameId, edge: Edge, *, is_new: bool = False) -> str:
        """Say which end of an edge is missing; empty if none is. A new pose need not be there."""
        if edge.reference_id == frame_id:
            return "an edge of a pose to itself"
        if edge.reference_id not in self:
            return absence(edge.reference_id)
        return absence(frame_id) if frame_id not in self and not is_new else ""

    def current_edges(self, pose: WindowPose) -> Iterator[AcceptedEdge]:
        """Yield the edges of a pose whose references are still in the window."""
        for accepted in pose.edges:
            reference = self.get(accepted.edge.reference_id)
            # Another pose may have the name of one that left, but not its key.
            if reference is not None and reference.key == accepted.reference_key:
                yield accepted


def absence(frame_id: FrameId) -> str:
    """Return the message for a frame that is not in the window."""
    return f"{frame_id!r} is not in the window: it has left, or never was"


class WindowGraph:
    """Poses and their measurements in iSAM2; those neither recent nor kept are marginalized.

    If GTSAM fails in an update, everything is as before, and a `SmoothingError` says why.

    Parameters
    ----------
    config : WindowConfig
        Number of recent poses, robust kernel.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._factors = Factors(config)
        self._finished: list[Estimate] = []
        self._n_keys = 0
        self.poses = WindowPoses()
        self._begin()

    def reconfigure(self, config: WindowConfig) -> None:
        """Set another size, and another kernel for later measurements."""
        former, self._config = self._config, config
        if config.kernel != former.kernel:
            self._factors = Factors(config)
        if not self.poses:
            self._begin()
        elif self._is_whole and config.size is not None:
            self._make_sliding()

    def _begin(self) -> None:
        self.poses.clear()
        self._is_whole = self._config.size is None
        self._isam = PoseGraph(is_whole=self._is_whole)

    def _make_sliding(self) -> None:
        """Move the factors to a graph that poses can be marginalized in."""
        self._is_whole = False
        graph = PoseGraph(is_hardened=self._isam.is_hardened)
        try:
            with graph.restored_on_error():
                graph.update(self._isam.factors(), self._isam.values())
        except SmoothingError as error:
            # It can still be rebuilt from the poses if the next update fails.
            _LOGGER.warning("the graph stays as it is: %s", first_line(error))
        else:
            self._isam = graph

    # What goes in

    def insert(self, pose: NewPose) -> tuple[FloatArray, FloatArray]:
        """Add a pose to the graph and marginalize those that leave.

        Returns
        -------
        T_world_frame : ndarray of float64, shape (4, 4)
        covariance : ndarray of float64, shape (6, 6)
        """
        return self._hardened_on_error(partial(self._insert, pose))

    def _insert(self, pose: NewPose) -> tuple[FloatArray, FloatArray]:
        key = self._n_keys
        edges = [
            AcceptedEdge(m.edge, self._factors, self.poses[m.edge.reference_id].key)
            for m in pose.measurements
        ]
        leaving = self.poses.leaving(self._config.size)
        leaving_keys = [self.poses[frame_id].key for frame_id in leaving]
        with self._isam.restored_on_error():
            self._update(pose, key, edges, leaving_keys)
            covariance, *others = map(self._isam.covariance, [key, *leaving_keys])
            T_world_frame = self._isam.pose(key)
            _check_result(T_world_frame)
            finished = list(map(self._estimate, leaving, others))
            self._isam.marginalize(leaving_keys)
        self._n_keys += 1
        self._finished += finished
        for frame_id in leaving:
            del self.poses[frame_id]
        priors = [] if pose.prior is None else [(pose.prior, self._factors)]
        self.poses[pose.frame_id] = WindowPose(
            key=key, stamp_ns=pose.stamp_ns, edges=edges, priors=priors
        )
        return T_world_frame, covariance

    def _update(
        self, pose: NewPose, key: int, edges: Sequence[AcceptedEdge], leaving: Sequence[int]
    ) -> None:
        """Add the factors of a pose, and iterate until it and its references converge."""
        alive = [other.key for other in self.poses.values()]
        values = gtsam.Values()
        values.insert(key, pose.T_world_start)
        before = {e.reference_key: pose.T_world_references[e.edge.reference_id] for e in edges}
        factors = self._factors_of(pose, key, edges)
        self._isam.update(factors, values, alive=alive, leaving=leaving)
        start = {key: pose.T_world_start}
        if self._isam.iterate(before, start, alive=[*alive, key], leaving=leaving):
            self._check_others()

    def _factors_of(
        self, pose: NewPose, key: int, edges: Sequence[AcceptedEdge]
    ) -> gtsam.NonlinearFactorGraph:
        factors, support = gtsam.NonlinearFactorGraph(), pose.support
        for accepted, measurement in zip(edges, pose.measurements, strict=True):
            factors.add(self._factors.between(accepted.reference_key, key, measurement))
        if isinstance(support, Edge):
            reference_key = self.poses[support.reference_id].key
            factors.add(self._factors.between(reference_key, key, Measurement.of(support)))
        if pose.prior is not None:
            factors.add(self._factors.prior(key, pose.prior))
        if isinstance(support, PosePrior):
            factors.add(self._factors.prior(key, support))
        return factors

    def add_edge(self, frame_id: FrameId, edge: Edge) -> Estimate:
        """Add an edge between two poses of the window; return the new estimate of the frame."""
        pose, reference = self.poses[frame_id], self.poses[edge.reference_id]
        factor = self._factors.between(reference.key, pose.key, Measurement.of(edge))
        estimate = self._extend(frame_id, factor)
        pose.edges.append(AcceptedEdge(edge, self._factors, reference.key))
        return estimate

    def add_prior(self, frame_id: FrameId, prior: Prior) -> Estimate:
        """Add a prior to a pose of the window; return its new estimate."""
        pose = self.poses[frame_id]
        estimate = self._extend(frame_id, self._factors.prior(pose.key, prior))
        pose.priors.append((prior, self._factors))
        return estimate

    def _extend(self, frame_id: FrameId, factor: gtsam.NonlinearFactor) -> Estimate:
        """Add a factor on poses of the window."""
        return self._hardened_on_error(partial(self._add_factor, frame_id, factor))

    def _add_factor(self, frame_id: FrameId, factor: gtsam.NonlinearFactor) -> Estimate:
        factors = gtsam.NonlinearFactorGraph()
        factors.add(factor)
        with self._isam.restored_on_error():
            before = self._isam.poses3(factor.keys())
            self._isam.update(factors, gtsam.Values())
            self._isam.iterate(before, {})
            estimate = self._estimate(frame_id)
            _check_result(estimate.T_world_frame)
            self._check_others()
        return estimate

    def _check_others(self) -> None:
        """Raise if an update made a pose diverge; a whole graph is too large to look at."""
        if not self._is_whole and (fault := place_fault(self._isam.positions())):
            raise SmoothingError(f"GTSAM: {fault}")

    # When GTSAM failed

    def _read(self, read: Callable[[PoseGraph], _Result]) -> _Result:
        """Read from the graph; if GTSAM fails, from one that takes worse conditioned factors."""
        try:
            return read(self._isam)
        except (RuntimeError, SmoothingError):
            if self._isam.is_hardened:
                raise
            return read(self._isam.hardened())

    def _hardened_on_error(self, change: Callable[[], _Result]) -> _Result:
        """Change the graph; if GTSAM fails, move to one that takes worse conditioned factors.

        If it fails there as well, the graph stays what it was.
        """
        former = self._isam
        try:
            return change()
        except SmoothingError as error:
            if former.is_hardened:
                raise
            try:
                self._isam = former.hardened()
                result = change()
            except BaseException:
                self._isam = former
                raise
            _LOGGER.info("%s; from here on the graph is solved by QR", first_line(error))
            return result

    def rebuild(self) -> None:
        """Make the graph anew from the poses and their covariances."""
        graph = PoseGraph(is_whole=self._is_whole, is_hardened=True)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for frame_id, pose in self.poses.items():
            estimate = self.estimate(frame_id)
            prior = PosePrior(
                T_world_frame=se3.normalize(estimate.T_world_frame),
                covariance=sane_covariance(estimate.covariance),
            )
            factors.add(self._factors.prior(pose.key, prior))
            values.insert(pose.key, gtsam.Pose3(estimate.T_world_frame))
        with graph.restored_on_error():
            graph.update(factors, values)
        self._isam = graph
        for pose in self.poses.values():
            pose.edges, pose.priors = [], []

    # What comes out

    def pose3(self, frame_id: FrameId) -> gtsam.Pose3:
        """Return T_world_frame of a pose of the window as GTSAM holds it."""
        return self._isam.pose3(self.poses[frame_id].key)

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose; the causal one if it diverged."""
        pose = self.poses[frame_id]
        T_world_frame = self._isam.pose(pose.key)
        if pose.causal is not None and pose_fault(T_world_frame):
            return pose.causal.T_world_frame
        return T_world_frame

    def estimate(self, frame_id: FrameId) -> Estimate:
        """Return the estimate of a pose; the causal one if GTSAM has none any more."""
        key = self.poses[frame_id].key
        try:
            covariance = self._read(lambda graph: graph.covariance(key))
            estimate = self._estimate(frame_id, covariance)
            _check_result(estimate.T_world_frame)
        except (RuntimeError, SmoothingError) as error:
            pose = self.poses[frame_id]
            place = f"{frame_id!r} at {pose.stamp_ns} ns"
            _LOGGER.warning("%s: %s; its causal pose is returned", place, first_line(error))
            if pose.causal is None:
                raise
            return replace(pose.causal, rejected=())
        return estimate

    def _estimate(self, frame_id: FrameId, covariance: FloatArray | None = None) -> Estimate:
        pose = self.poses[frame_id]
        return Estimate(
            stamp_ns=pose.stamp_ns,
            T_world_frame=self._isam.pose(pose.key),
            covariance=self._isam.covariance(pose.key) if covariance is None else covariance,
            status=pose.status,
            frame_id=frame_id,
        )

    def relative_covariance(self, reference_id: FrameId, frame_id: FrameId) -> FloatArray:
        """Return the covariance (6, 6) of T_reference_frame; zero of a pose to itself."""
        if reference_id == frame_id:
            return np.zeros((6, 6))
        T = se3.invert(self.pose(reference_id)) @ self.pose(frame_id)
        # T exp(d) = (T_r exp(d_r))^-1 T_f exp(d_f)  =>  d = d_f - Ad(T^-1) d_r
        J = np.hstack([-se3.adjoint(se3.invert(T)), np.eye(6)])
        keys = self.poses[reference_id].key, self.poses[frame_id].key
        try:
            return self._read(lambda graph: definite(J @ graph.joint_covariance(*keys) @ J.T))
        except (RuntimeError, SmoothingError):
            # Their correlation is lost in rounding: without it the covariance is no smaller.
            independent = np.zeros((12, 12))
            independent[:6, :6] = self.estimate(reference_id).covariance
            independent[6:, 6:] = self.estimate(frame_id).covariance
            return sane_covariance(J @ independent @ J.T)

    def measurements(self) -> list[GraphEdge]:
        """Return the measurements between poses of the window, with their residuals."""
        poses = {frame_id: self.pose(frame_id) for frame_id in self.poses}
        found = []
        for frame_id, pose in self.poses.items():
            found += [
                accepted.factors.residual_of_edge(
                    accepted.edge, frame_id, poses[accepted.edge.reference_id], poses[frame_id]
                )
                for accepted in self.poses.current_edges(pose)
            ]
            found += [
                factors.residual_of_prior(prior, frame_id, poses[frame_id])
                for prior, factors in pose.priors
            ]
        return found

    def keep_causal(self, estimate: Estimate) -> None:
        """Keep the causal estimate of a pose; it is final if the pose is not in the graph."""
        pose = self.poses.get(estimate.frame_id)
        if pose is None:
            self._finished.append(estimate)
        else:
            pose.causal = estimate

    def pop_finished(self) -> list[Estimate]:
        """Return the smoothed estimates of the poses that left since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def finish(self) -> BatchResult | None:
        """Let all poses leave and begin anew; a whole graph is optimized in a batch first."""
        result = None
        if self._is_whole and self.poses:
            try:
                optimized, result = optimize_batch(self._isam.factors(), self._isam.values())
                self._isam = self._isam.moved(optimized)
            except (RuntimeError, SmoothingError) as error:
                _LOGGER.warning(
                    "no batch optimization, the poses are those of iSAM2: %s", first_line(error)
                )
        self._finished += [self.estimate(frame_id) for frame_id in self.poses]
        self._begin()
        return result


def _check_result(T_world_frame: FloatArray) -> None:
    if fault := pose_fault(T_world_frame):
        raise SmoothingError(f"GTSAM: {fault}")
