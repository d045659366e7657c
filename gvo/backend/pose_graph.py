"""The poses of a window in iSAM2: add, smooth, marginalize, and go back where GTSAM fails.

References
----------
M. Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31(2),
2012, doi:10.1177/0278364911430419.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, TypeVar

import gtsam
import numpy as np

from gvo.backend.batch import BatchResult, optimize_batch
from gvo.backend.factors import (
    ORIGIN,
    Factors,
    Measurement,
    check_places,
    definite,
    first_line,
    residual_of,
)
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

# Radians and metres: poses that an update moves farther than this are linearized again. A step of
# Gauss-Newton leaves about the square of it, and kernels their weights from before it.
_FAR = 0.01
_MAX_STEPS = 10
# Poses that leave at once when the window is made smaller: the cost grows with the cube.
_MAX_LEAVING = 32
# Poses between two fixes for which the window grows: an update takes about 20 ms then.
_MAX_FIX_INTERVAL = 300
_FAILURES = RuntimeError, IndexError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPose:
    """A pose to be put into the window, with the measurements that passed the gate.

    `support` constrains a pose that its measurements do not: the origin, or the last velocity. With
    `is_carried` they are one edge, by which the pose goes on unseen.
    """

    frame_id: FrameId
    stamp_ns: int
    T_world_start: gtsam.Pose3
    measurements: Sequence[Measurement] = ()
    prior: Prior | None = None
    support: Edge | PosePrior | None = None
    is_carried: bool = False
    rejected: tuple[Rejected, ...] = ()
    n_gated: int = 0

    @property
    def is_measured(self) -> bool:
        """Tell whether a measurement constrains the pose, or it is the origin."""
        is_seen = bool(self.measurements) and not self.is_carried
        return is_seen or self.prior is not None or self.support is ORIGIN


@dataclass(slots=True, kw_only=True)
class WindowPose:
    """A pose of the window, its measurements with their factors, and its estimate as it came in.

    Edges stay in the list when their references leave.
    """

    key: int
    stamp_ns: int
    measured: list[tuple[Edge | Prior, gtsam.NoiseModelFactor]] = field(default_factory=list)
    is_kept: bool = False
    causal: Estimate | None = None


class PoseGraph:
    """Poses and their measurements in iSAM2; those neither recent nor kept are marginalized.

    If GTSAM fails in a change, everything is as before, and a `SmoothingError` says why.
    """

    def __init__(self, config: WindowConfig) -> None:
        self.poses: dict[FrameId, WindowPose] = {}
        """By the caller's names, oldest first."""
        self._config, self._factors = config, Factors(config)
        self._finished: list[Estimate] = []
        self._n_keys = 0
        self._is_warned = False
        self._begin()

    def reconfigure(self, config: WindowConfig) -> None:
        """Set another size, and another kernel for later measurements."""
        self._config, self._factors = config, Factors(config)
        if not self.poses:
            self._begin()

    def _begin(self) -> None:
        self.poses.clear()
        self._is_whole, self._is_hardened = self._config.size is None, False
        self._last_fix_key: int | None = None
        self._fix_interval = 0
        self._isam = gtsam.ISAM2(self._parameters())

    def _parameters(self) -> gtsam.ISAM2Params:
        parameters = gtsam.ISAM2Params()
        # QR takes three times as long. Cholesky calls the system indeterminate once the drift's
        # variance is 4096^2 times that of an edge.
        parameters.setFactorization("QR" if self._is_hardened else "CHOLESKY")
        if self._is_whole:
            # GTSAM's defaults, which trade accuracy for time: the batch optimization at the end
            # makes up for it.
            parameters.setRelinearizeThreshold(0.1)
            parameters.relinearizeSkip = 10
        else:
            parameters.setRelinearizeThreshold(0.001)
            parameters.relinearizeSkip = 1
            parameters.findUnusedFactorSlots = True
            # Propagate every change to the oldest pose: by default small ones are ignored, which
            # loses what smoothing gains with edges accurate to a tenth of a millimetre.
            parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        return parameters

    def _make(self, factors: gtsam.NonlinearFactorGraph, points: gtsam.Values) -> None:
        """Make the graph anew of these factors, linearized at these poses."""
        isam = gtsam.ISAM2(self._parameters())
        isam.update(factors, points)
        self._isam = isam

    # Who is there

    def find(self, frame_id: FrameId) -> WindowPose | None:
        """Return a pose, or None if it is not in the window; a `ValueError` if it cannot be."""
        try:
            return self.poses.get(frame_id)
        except TypeError:
            raise ValueError(f"a frame_id must be hashable, got {frame_id!r}") from None

    def require(self, frame_id: FrameId) -> WindowPose:
        """Return a pose of the window; a `ValueError` if it is not there."""
        pose = self.find(frame_id)
        if pose is None:
            raise ValueError(absence(frame_id))
        return pose

    def measurements_of(
        self, frame_id: FrameId
    ) -> Iterator[tuple[Edge | Prior, gtsam.NoiseModelFactor]]:
        """Yield the priors of a pose, and its edges whose references are still in the window."""
        for measured, factor in self.poses[frame_id].measured:
            if isinstance(measured, Edge):
                reference = self.poses.get(measured.reference_id)
                # Another pose may have the name of one that left, but not its key.
                if reference is None or reference.key not in factor.keys():  # noqa: SIM118
                    continue
            yield measured, factor

    def _leaving(self) -> list[FrameId]:
        """Return the frames to marginalize with the next pose: neither recent nor kept."""
        if self._config.size is None:
            return []
        # A pose stays until a fix comes after it: else each fix would move the newest poses alone.
        size = max(self._config.size, self._fix_interval + 1)
        old = islice(self.poses.items(), max(len(self.poses) + 1 - size, 0))
        return [frame_id for frame_id, pose in old if not pose.is_kept][:_MAX_LEAVING]

    # What goes in

    def insert(self, new: NewPose) -> tuple[FloatArray, FloatArray]:
        """Add a pose, let old ones leave; return T_world_frame (4, 4) and its covariance (6, 6)."""
        answer = self._attempt(lambda: self._insert(new))
        if new.prior is not None:
            self._note_fix(self._n_keys - 1)
        return answer

    def _note_fix(self, key: int) -> None:
        """Learn how many poses lie between the measurements of poses in the world."""
        last = self._last_fix_key
        if last is not None and key <= last:
            return
        self._last_fix_key = key
        if last is None:
            return
        if (interval := key - last) > _MAX_FIX_INTERVAL:
            if not self._is_warned and self._config.size is not None:
                _LOGGER.warning(
                    "priors are %d poses apart, and the window holds at most %d for them: "
                    "set window.size to null to smooth over all poses",
                    interval,
                    _MAX_FIX_INTERVAL,
                )
            self._is_warned, interval = True, 0
        self._fix_interval = interval

    def _insert(self, new: NewPose) -> tuple[FloatArray, FloatArray]:
        if self._is_whole and self._config.size is not None:  # from now on poses leave
            self._is_whole = False
            self._make(self._isam.getFactorsUnsafe(), self._isam.getLinearizationPoint())
        pose, factors = self._with_factors(new)
        values = gtsam.Values()
        values.insert(pose.key, new.T_world_start)
        leaving = self._leaving()
        keys = [self.poses[frame_id].key for frame_id in leaving]
        self._update(factors, values, keys)
        T_world_frame, covariance = self._pose(pose.key), self._covariance(pose.key)
        check_places(T_world_frame)
        finished = list(map(self._estimate, leaving))
        for key in keys:
            leaf = gtsam.KeyList()
            leaf.push_back(key)
            self._isam.marginalizeLeaves(leaf)
        for frame_id in leaving:
            del self.poses[frame_id]
        self._finished += finished
        self._n_keys += 1
        self.poses[new.frame_id] = pose
        return T_world_frame, covariance

    def _with_factors(self, new: NewPose) -> tuple[WindowPose, gtsam.NonlinearFactorGraph]:
        pose, graph = WindowPose(key=self._n_keys, stamp_ns=new.stamp_ns), _graph_of()
        for each in new.measurements:
            pose.measured.append((each.edge, self._between(pose.key, each)))
        if new.prior is not None:
            pose.measured.append((new.prior, self._factor(pose.key, new.prior)))
        for _, factor in pose.measured:
            graph.add(factor)
        if new.support is not None:
            graph.add(self._factor(pose.key, new.support))
        return pose, graph

    def _factor(self, key: int, measured: Edge | Prior) -> gtsam.NoiseModelFactor:
        if isinstance(measured, Edge):
            return self._between(key, Measurement.of(measured))
        return self._factors.prior(key, measured)

    def _between(self, key: int, measurement: Measurement) -> gtsam.NoiseModelFactor:
        reference_key = self.poses[measurement.edge.reference_id].key
        return self._factors.between(reference_key, key, measurement)

    def extend(self, frame_id: FrameId, measured: Edge | Prior) -> Estimate:
        """Add an edge to, or a prior of, a pose of the window; return its new estimate."""
        pose = self.poses[frame_id]
        factor = self._factor(pose.key, measured)
        estimate = self._attempt(lambda: self._add_factor(frame_id, factor))
        pose.measured.append((measured, factor))
        if not isinstance(measured, Edge):
            self._note_fix(pose.key)
        return estimate

    def _add_factor(self, frame_id: FrameId, factor: gtsam.NoiseModelFactor) -> Estimate:
        self._update(_graph_of(factor), gtsam.Values())
        return self._estimate(frame_id)

    def _update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        leaving: Sequence[int] = (),
    ) -> None:
        """Add factors and poses; repeat until no pose is far from where it was linearized.

        One step of Gauss-Newton is exact only for motions by a fraction of a radian; closing a
        loop takes a few. A whole graph is left to the batch optimization at its end.
        """
        constraints = self._constraints(factors.keyVector(), leaving)
        self._isam.update(factors, values, *constraints)
        if self._is_whole:
            return
        n_steps = 0
        while n_steps < _MAX_STEPS and not np.abs(self._isam.getDelta().vector()).max() < _FAR:
            self._isam.update(_graph_of(), gtsam.Values(), *constraints)
            n_steps += 1
        if n_steps > 0:
            check_places(gtsam.utilities.extractPose3(self._isam.calculateEstimate()))

    def _constraints(self, last: Sequence[int], leaving: Sequence[int]) -> tuple[Any, ...]:
        """Return the arguments of an update that make leaving poses leaves of the Bayes tree.

        Only these can be marginalized; each is in a group of its own, which is eliminated first.
        """
        if not leaving:
            return ()
        n_leaving = len(leaving)
        groups = {}
        for pose in self.poses.values():
            groups[pose.key] = n_leaving
        # The poses that the factors constrain come last: their covariances are cheap then, and
        # the next pose usually has edges to the same ones.
        groups.update(dict.fromkeys(last, n_leaving + 1))
        groups.update(zip(leaving, range(n_leaving), strict=True))
        constrained, reeliminate = gtsam.KeyGroupMap(), gtsam.KeyList()
        for key, group in groups.items():
            constrained.insert2(key, group)
            reeliminate.push_back(key)
        return [], constrained, None, reeliminate, False

    # When GTSAM fails

    def _attempt(self, act: Callable[[], _Result]) -> _Result:
        """Return what `act` answers; if GTSAM fails, once more with the graph solved by QR."""
        while True:
            was_hardened, saved = self._is_hardened, self._snapshot()
            try:
                return act()
            except BaseException as error:
                self._restore(*saved)
                if not isinstance(error, _FAILURES):
                    raise
                message = first_line(error)
                if was_hardened:
                    raise SmoothingError(f"GTSAM: {message}") from error
                _LOGGER.info("GTSAM: %s; from here on the graph is solved by QR", message)

    def _snapshot(self) -> tuple[int, tuple[gtsam.NonlinearFactorGraph, gtsam.Values] | None]:
        """Return the number of factors, and copies of them and of what they are linearized at.

        A whole graph only grows, and is not copied for each pose: what is left of one that failed
        tells what was before.
        """
        factors = self._isam.getFactorsUnsafe()
        if self._is_whole:
            return factors.size(), None
        points = gtsam.Values(self._isam.getLinearizationPoint())
        return factors.size(), (gtsam.NonlinearFactorGraph(factors), points)

    def _restore(
        self, n_factors: int, saved: tuple[gtsam.NonlinearFactorGraph, gtsam.Values] | None
    ) -> None:
        """Make the graph anew as it was: linearized at the same poses, it has the same optimum."""
        if saved is None:
            factors = gtsam.NonlinearFactorGraph(self._isam.getFactorsUnsafe())
            points = gtsam.Values(self._isam.getLinearizationPoint())
            factors.resize(n_factors)
            if points.exists(self._n_keys):
                points.erase(self._n_keys)
            saved = factors, points
        self._is_hardened = True
        with suppress(*_FAILURES):  # then the next change fails, and the window begins anew
            self._make(*saved)

    # What comes out

    def pose3(self, frame_id: FrameId) -> gtsam.Pose3:
        """Return T_world_frame of a pose of the window as GTSAM holds it."""
        return self._isam.calculateEstimatePose3(self.poses[frame_id].key)

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose; a `ValueError` if it is not there."""
        return self._pose(self.require(frame_id).key)

    def _pose(self, key: int) -> FloatArray:
        return np.asarray(self._isam.calculateEstimatePose3(key).matrix())

    def _covariance(self, key: int) -> FloatArray:
        return definite(self._isam.marginalCovariance(key))

    def estimate(self, frame_id: FrameId) -> Estimate:
        """Return the estimate of a pose; the causal one if GTSAM has none any more."""
        try:
            return self._attempt(lambda: self._estimate(frame_id))
        except SmoothingError as error:
            pose = self.poses[frame_id]
            place = f"{frame_id!r} at {pose.stamp_ns} ns"
            _LOGGER.warning("%s: %s; its causal pose is returned", place, first_line(error))
            if pose.causal is None:
                raise
            return replace(pose.causal, rejected=())

    def _estimate(self, frame_id: FrameId) -> Estimate:
        pose = self.poses[frame_id]
        T_world_frame = self._pose(pose.key)
        check_places(T_world_frame)
        return Estimate(
            stamp_ns=pose.stamp_ns,
            T_world_frame=T_world_frame,
            covariance=self._covariance(pose.key),
            status=Status.OK if pose.causal is None else pose.causal.status,
            frame_id=frame_id,
        )

    def relative_covariance(self, reference_id: FrameId, frame_id: FrameId) -> FloatArray:
        """Return the covariance (6, 6) of T_reference_frame; zero of a pose to itself."""
        if reference_id == frame_id:
            return np.zeros((6, 6))
        T = se3.invert(self.pose(reference_id)) @ self.pose(frame_id)
        # T exp(d) = (T_r exp(d_r))^-1 T_f exp(d_f)  =>  d = d_f - Ad(T^-1) d_r
        J = np.hstack([-se3.adjoint(se3.invert(T)), np.eye(6)])
        keys = [self.poses[reference_id].key, self.poses[frame_id].key]

        def read() -> FloatArray:
            return definite(J @ self._isam.jointMarginalCovariance(keys).fullMatrix() @ J.T)

        try:
            return self._attempt(read)
        except SmoothingError:
            # Their correlation is lost in rounding: without it the covariance is no smaller.
            independent = np.zeros((12, 12))
            independent[:6, :6] = self.estimate(reference_id).covariance
            independent[6:, 6:] = self.estimate(frame_id).covariance
            return definite(J @ independent @ J.T)

    def measurements(self) -> list[GraphEdge]:
        """Return the measurements between poses of the window, with their residuals."""
        values, found = self._isam.calculateEstimate(), []
        for frame_id in self.poses:
            for measured, factor in self.measurements_of(frame_id):
                residual, weight = residual_of(factor, values)
                found.append(
                    GraphEdge(
                        reference_id=measured.reference_id if isinstance(measured, Edge) else None,
                        frame_id=frame_id,
                        T_reference_frame=self._measured_pose(frame_id, measured),
                        covariance=measured.covariance,
                        residual=residual,
                        weight=weight,
                    )
                )
        return found

    def _measured_pose(self, frame_id: FrameId, measured: Edge | Prior) -> FloatArray:
        if isinstance(measured, Edge):
            return measured.T_reference_frame
        if isinstance(measured, PosePrior):
            return measured.T_world_frame
        return se3.make_transform(self.pose(frame_id)[:3, :3], measured.position_world)

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
        """Optimize a whole graph in a batch, then begin anew."""
        result = None
        if self._is_whole and self.poses:
            factors = self._isam.getFactorsUnsafe()
            try:
                optimized, result = optimize_batch(factors, self._isam.calculateEstimate())
                self._make(factors, optimized)
            except RuntimeError as error:
                _LOGGER.warning(
                    "no batch optimization, the poses are those of iSAM2: %s", first_line(error)
                )
        self.begin_anew()
        return result

    def begin_anew(self) -> None:
        """Let all poses leave, and begin with an empty graph."""
        self._finished += [self.estimate(frame_id) for frame_id in self.poses]
        self._begin()


def absence(frame_id: FrameId) -> str:
    """Return the message for a frame that is not in the window."""
    return f"{frame_id!r} is not in the window: it has left, or never was"


def _graph_of(*factors: gtsam.NonlinearFactor) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph
