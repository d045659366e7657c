"""The raw chains, of registered frames and of given edges: no smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Generic

import numpy as np

from gvo.backend.factors import find_faults
from gvo.backend.inertial import InertialEstimator
from gvo.backend.motion_model import (
    LOST_AFTER_S,
    MAX_EXTRAPOLATION_S,
    ConstantVelocity,
    StatusClock,
    go_on,
    predict_step,
    velocity_of,
)
from gvo.frontend.protocol import Frontend, ObservationsT
from gvo.geometry import se3
from gvo.geometry.edges import gone_on
from gvo.types import (
    Contradiction,
    Edge,
    Estimate,
    Failure,
    FloatArray,
    FrameId,
    MotionPrior,
    PosePrior,
    Prior,
    RelativePose,
    Stamped,
    Status,
)

# Velocities, and their changes from step to step, of so many seconds are the recent ones.
_RECENT_S = 1.0
# A step is steady where no component changes by more than so many times the median change. Of
# normal errors that is 3.4 sigma; fewer changes than so many do not make a median.
_STEADY = 5.0
_MIN_CHANGES = 3
# After so many seconds without a registered frame an IMU knows more than the last velocity.
_GAP_S = 0.25
# Registered steps whose errors add up to that of one that was coasted.
_N_STEPS_COASTED = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawStep:
    """One step of the chain of frames.

    Parameters
    ----------
    estimate : Estimate
        Pose of the frame by the chain, with the covariance that registrations state.
    covariance : ndarray of float64, shape (6, 6)
        Of it, by what those turned out to be wrong by.
    effects : ndarray of float64, shape (6, k), optional
        By how much each error that all registrations share moves the pose, right perturbation, by
        one sigma of each as known at the time; not in the covariances.
    edge : Edge or None
        From the frame that the step starts from, named by its stamp; None for the first frame.
    registration : RelativePose or None
        None where the step continues the last velocity, and for the first frame.
    failure : Failure or None
        Why a step was not registered.
    is_steady : bool
        The velocity changed no more than it did from step to step in the last second.
    n_steps : int
        Registered steps since the first frame; a coasted one counts as many.
    """

    estimate: Estimate
    covariance: FloatArray
    effects: FloatArray | None = None
    edge: Edge | None = None
    registration: RelativePose | None = None
    failure: Failure | None = None
    is_steady: bool = False
    n_steps: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Node(Generic[ObservationsT]):
    """A frame that the next one may be registered against."""

    frame: Stamped
    observations: ObservationsT
    step: RawStep


class RawChain(Generic[ObservationsT]):
    """Chains relative poses of consecutive frames; the smoother never touches it.

    A frame that cannot be registered against its predecessor is tried against the last
    registered frame, so that one bad image in between costs nothing. Failing that, the pose
    goes on with constant velocity.

    Parameters
    ----------
    frontend : Frontend
        Its results are not checked here, see `CheckedFrontend`.
    """

    def __init__(self, frontend: Frontend[ObservationsT]) -> None:
        self._frontend = frontend
        # The predecessor, and the last registered frame where that is another.
        self._nodes: list[_Node[ObservationsT]] = []
        self._velocity: FloatArray | None = None
        self._inertial: InertialEstimator | None = None
        # Stamps of the last second, the velocities there, and how they changed from the one before.
        self._recent: list[tuple[int, FloatArray, FloatArray | None]] = []

    @property
    def anchor(self) -> ObservationsT | None:
        """The last registered frame, which the next one may be tied to."""
        return self._nodes[-1].observations if self._nodes else None

    def reconfigure(self, frontend: Frontend[ObservationsT], *, is_renewed: bool = False) -> None:
        """Change the front-end; the last frames are extracted again if they are to be renewed."""
        self._frontend = frontend
        if is_renewed:
            self._nodes = [
                replace(node, observations=frontend.extract(node.frame)) for node in self._nodes
            ]

    def advance(
        self,
        frame: Stamped,
        current: ObservationsT,
        *,
        variance_factor: float = 1.0,
        effects_factor: float = 1.0,
        seeks_places: bool = False,
        inertial: InertialEstimator | None = None,
    ) -> RawStep:
        """Register the next frame and return its step.

        Parameters
        ----------
        frame
            Kept until the next one is registered, to be extracted again after a change.
        current : observations
            Of the frame.
        variance_factor : float
            By which the covariance that the registration states is wrong.
        effects_factor : float
            Size of the errors that all registrations share, in units of their `shared`.
        seeks_places : bool
            A camera that was lost looks for places itself: nothing predicts how far it is from the
            last registered frame, and one registration alone may be of a view that looks alike.
        inertial : InertialEstimator, optional
            Predicts frames after a gap.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        anchors: list[_Node[ObservationsT]] = []
        if not self._nodes:
            T, covariance = np.eye(4), np.zeros((6, 6))
            first = Estimate(stamp_ns=current.stamp_ns, T_world_frame=T, covariance=covariance)
            step = RawStep(estimate=first, covariance=covariance)
        else:
            self._check_stamp(current.stamp_ns)
            factors = variance_factor, effects_factor
            self._inertial = inertial
            step, anchors = self._follow(current, factors, seeks_places=seeks_places)
        self._nodes = [_Node(frame=frame, observations=current, step=step), *anchors]
        return step

    def _check_stamp(self, stamp_ns: int) -> None:
        before_ns = self._nodes[0].step.estimate.stamp_ns
        if stamp_ns <= before_ns:
            raise ValueError(f"stamp {stamp_ns} is not after {before_ns}, that of the frame before")

    def _follow(
        self, current: ObservationsT, factors: tuple[float, float], *, seeks_places: bool
    ) -> tuple[RawStep, list[_Node[ObservationsT]]]:
        """Return the step of a frame, and the last registered frame if it is not this one."""
        unmeasured_s = self._unregistered_s(current.stamp_ns)
        if self._inertial is not None:  # which may have led here since
            carried_s = 1e-9 * (current.stamp_ns - self._inertial.carried_ns)
            unmeasured_s = min(unmeasured_s, carried_s)
        is_lost = seeks_places and unmeasured_s > LOST_AFTER_S
        failures: list[Failure] = []
        for node in self._nodes[: 1 if is_lost else None]:
            result = self._register(node, current)
            if isinstance(result, RelativePose):
                return self._append(node, current.stamp_ns, result, *factors), []
            failures.append(result)
        failure = next((each for each in failures if each.reason), failures[-1])
        return self._coast(current.stamp_ns, failure), self._nodes[-1:]

    def _unregistered_s(self, stamp_ns: int) -> float:
        """Return the time since the last registered frame."""
        return 1e-9 * (stamp_ns - self._nodes[-1].step.estimate.stamp_ns)

    def _register(
        self, node: _Node[ObservationsT], current: ObservationsT
    ) -> RelativePose | Failure:
        """Search around the predicted pixels, then around the previous ones."""
        stamp_ns, gap_s = current.stamp_ns, self._unregistered_s(current.stamp_ns)
        prior = None if self._inertial is None else self._carried(self._inertial, node, stamp_ns)
        if prior is None and self._velocity is not None and gap_s <= MAX_EXTRAPOLATION_S:
            newest = self._nodes[0].step.estimate
            T_node_newest = se3.invert(node.step.estimate.T_world_frame) @ newest.T_world_frame
            # Outliers do not move the median.
            axes = zip(*(velocity.tolist() for _, velocity, _ in self._recent), strict=True)
            recent = np.array([*map(median, axes)])
            T_recent = se3.exp(recent * 1e-9 * (stamp_ns - newest.stamp_ns))
            prior = MotionPrior(
                T_predicted=T_node_newest @ self._predict(stamp_ns)[0],
                T_recent=T_node_newest @ T_recent,
                is_confirmed=len(self._nodes) == 1,
            )
        if prior is not None:
            result = self._frontend.register(node.observations, current, prior)
            # What contradicts the prediction would be believed without it.
            if isinstance(result, RelativePose | Contradiction):
                return result
        return self._frontend.register(node.observations, current, None)

    def _carried(
        self, inertial: InertialEstimator, node: _Node[ObservationsT], stamp_ns: int
    ) -> MotionPrior | None:
        """Return what the IMU expects of a frame after a gap; None without one."""
        is_confirmed = len(self._nodes) == 1
        if is_confirmed and self._unregistered_s(stamp_ns) <= _GAP_S:
            return None
        edge = inertial.carry(node.step.estimate.stamp_ns, stamp_ns)
        if edge is None:
            return None
        T = edge.T_reference_frame
        return MotionPrior(T_predicted=T, T_recent=T, is_confirmed=is_confirmed)

    def _predict(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the predicted pose of a frame in its predecessor, and its covariance."""
        newest_ns = self._nodes[0].step.estimate.stamp_ns
        elapsed_s = 1e-9 * (stamp_ns - newest_ns)
        return predict_step(self._velocity, elapsed_s, coasted_s=self._unregistered_s(newest_ns))

    def _append(
        self,
        node: _Node[ObservationsT],
        stamp_ns: int,
        result: RelativePose,
        variance_factor: float,
        effects_factor: float,
    ) -> RawStep:
        T, covariance, reference = result.T_reference_current, result.covariance, node.step.estimate
        # What the next step takes back is not chained: with it the raw NEES over 1 s of rendered
        # hands with a rolling shutter falls from 0.6 to 0.4, and covariances are too large.
        lasting = covariance - result.passing_covariance
        elapsed_s, before = 1e-9 * (stamp_ns - reference.stamp_ns), node.step
        shared = None if result.shared is None else effects_factor * result.shared
        edge = Edge(
            reference_id=reference.stamp_ns,
            T_reference_frame=T,
            covariance=covariance,
            effects=result.shared,
        )
        return RawStep(
            estimate=go_on(reference, stamp_ns, T, lasting),
            covariance=se3.compose_covariance(before.covariance, T, variance_factor * lasting),
            effects=gone_on(before.effects, replace(edge, effects=shared)),
            edge=edge,
            registration=result,
            is_steady=self._note_velocity(stamp_ns, result, elapsed_s),
            n_steps=before.n_steps + 1,
        )

    def _note_velocity(self, stamp_ns: int, result: RelativePose, elapsed_s: float) -> bool:
        """Take over the velocity of a registration; tell whether it is steady."""
        self._velocity = velocity_of(result.T_reference_current, elapsed_s)
        sigmas = np.sqrt(np.diagonal(result.covariance)) / elapsed_s
        known = [change for _, _, change in self._recent if change is not None]
        change = np.abs(self._velocity - self._recent[-1][1]) if self._recent else None
        recent = [*self._recent, (stamp_ns, self._velocity, change)]
        self._recent = [each for each in recent if 1e-9 * (stamp_ns - each[0]) <= _RECENT_S]
        if change is None or len(known) < _MIN_CHANGES:
            return False
        limits = _STEADY * np.maximum(np.sort(known, axis=0)[len(known) // 2], sigmas)
        return bool((change <= limits).all())

    def _coast(self, stamp_ns: int, failure: Failure) -> RawStep:
        before, (T, covariance) = self._nodes[0].step, self._predict(stamp_ns)
        before_ns = before.estimate.stamp_ns
        edge = Edge(reference_id=before_ns, T_reference_frame=T, covariance=covariance)
        return RawStep(
            estimate=go_on(before.estimate, stamp_ns, T, covariance, Status.COASTING),
            covariance=se3.compose_covariance(before.covariance, T, covariance),
            effects=gone_on(before.effects, edge),
            edge=edge,
            failure=failure,
            n_steps=before.n_steps + _N_STEPS_COASTED,
        )


class EdgeChain:
    """Chains the first usable edge of each pose.

    A pose without one continues the last velocity, or begins the chain anew where its pose in
    the world is given.
    """

    def __init__(self) -> None:
        self._motion, self._status = ConstantVelocity(), StatusClock()
        self._poses: dict[FrameId, Estimate] = {}

    def __len__(self) -> int:
        """Return the number of poses that edges may refer to."""
        return len(self._poses)

    def advance(self, first: Estimate, edges: Sequence[Edge], prior: Prior | None) -> Estimate:
        """Add a pose.

        Parameters
        ----------
        first : Estimate
            Its causal estimate: gives name and stamp, and the pose where it is the very first.
        edges : sequence of Edge
            The first that is usable, to a pose that was not forgotten, is taken.
        prior : PosePrior or PositionPrior, optional
            Taken where no edge is usable.

        Returns
        -------
        Estimate
            T_world_frame of the chain and its covariance.
        """
        stamp_ns, T_world_before = first.stamp_ns, None
        predicted, edge = self._motion.predict_pose(stamp_ns), self._usable(edges)
        estimate, is_tied = predicted or first, predicted is None
        if predicted is not None and edge is not None:
            reference, is_tied = self._poses[edge.reference_id], True
            estimate = go_on(reference, stamp_ns, edge.T_reference_frame, edge.covariance)
            before = self._motion.measured
            T_world_before = None if before is None else before.T_world_frame
        elif predicted is not None and isinstance(prior, PosePrior):
            T, covariance, is_tied = prior.T_world_frame, prior.covariance, True
            estimate = Estimate(stamp_ns=stamp_ns, T_world_frame=T, covariance=covariance)
        status = self._status.next(stamp_ns, is_measured=is_tied)
        estimate = replace(estimate, status=status, frame_id=first.frame_id, rejected=())
        self._motion.append(estimate, is_measured=is_tied, T_world_measured=T_world_before)
        self._poses[first.frame_id] = estimate
        return estimate

    def forget(self, frame_ids: Iterable[FrameId]) -> None:
        """Forget poses that no edge will refer to any more."""
        for frame_id in frame_ids:
            self._poses.pop(frame_id, None)

    def _usable(self, edges: Sequence[Edge]) -> Edge | None:
        known = [edge for edge in edges if edge.reference_id in self._poses]
        sound = (edge for edge, fault in zip(known, find_faults(known), strict=True) if not fault)
        return next(sound, None)
