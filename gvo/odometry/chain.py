"""The raw chains, of registered frames and of given edges: no smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np

from gvo.backend.factors import find_faults
from gvo.backend.motion_model import MAX_EXTRAPOLATION_S, StatusClock, predict_step, velocity_of
from gvo.config import WindowConfig
from gvo.frontend.protocol import Frontend, ObservationsT
from gvo.geometry import se3
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
    Status,
)

# Velocities, and their changes from step to step, of so many seconds are the recent ones.
_RECENT_S = 1.0
# A step is steady where no component changes by more than so many times the median change. Of
# normal errors that is 3.4 sigma; fewer changes than so many do not make a median.
_STEADY = 5.0
_MIN_CHANGES = 3
# Registered steps whose errors add up to that of one that was coasted.
_N_STEPS_COASTED = 1000


class PoseChain:
    """Composes relative poses; where one is missing, continues at constant velocity.

    Parameters
    ----------
    config : WindowConfig
        Sigmas of a coasted step.
    first : Estimate
        Where the chain starts.

    Attributes
    ----------
    newest : Estimate
    velocity : ndarray of float64, shape (6,), or None
        Twist per second (rad/s, m/s) of the last measured step, set by who measures it; None:
        standing still.
    """

    def __init__(self, config: WindowConfig, first: Estimate) -> None:
        self.config = config
        self.start(first)

    def start(self, estimate: Estimate) -> None:
        """Begin anew at a known pose."""
        self.newest = estimate
        self.velocity: FloatArray | None = None
        self._measured_ns = estimate.stamp_ns

    def append(
        self,
        reference: Estimate,
        stamp_ns: int,
        T_reference_frame: FloatArray,
        covariance: FloatArray,
    ) -> Estimate:
        """Add a pose that was measured from an earlier one."""
        self._measured_ns = stamp_ns
        self.newest = _compose(reference, stamp_ns, T_reference_frame, covariance, Status.OK)
        return self.newest

    def predict(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the predicted T_newest_frame and its covariance (6, 6)."""
        elapsed_s = 1e-9 * (stamp_ns - self.newest.stamp_ns)
        coasted_s = 1e-9 * (self.newest.stamp_ns - self._measured_ns)
        return predict_step(self.velocity, elapsed_s, self.config, coasted_s=coasted_s)

    def coast(self, stamp_ns: int) -> Estimate:
        """Add a pose by the prediction alone."""
        step = self.predict(stamp_ns)
        self.newest = _compose(self.newest, stamp_ns, *step, Status.COASTING)
        return self.newest


def _compose(
    reference: Estimate,
    stamp_ns: int,
    T_reference_frame: FloatArray,
    covariance: FloatArray,
    status: Status,
) -> Estimate:
    return Estimate(
        stamp_ns=stamp_ns,
        # Over a million products the rotation would lose its orthogonality.
        T_world_frame=se3.normalize(reference.T_world_frame @ T_reference_frame),
        covariance=se3.compose_covariance(reference.covariance, T_reference_frame, covariance),
        status=status,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawStep:
    """One step of the chain of frames.

    Parameters
    ----------
    estimate : Estimate
        Pose of the frame by the chain.
    reference_ns : int or None
        Stamp of the frame that the step starts from; None for the first frame.
    T_reference_frame : ndarray of float64, shape (4, 4)
    covariance : ndarray of float64, shape (6, 6)
        Of T_reference_frame.
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
    reference_ns: int | None
    T_reference_frame: FloatArray
    covariance: FloatArray
    registration: RelativePose | None = None
    failure: Failure | None = None
    is_steady: bool = False
    n_steps: int = 0

    @property
    def is_registered(self) -> bool:
        """False where the step continues the last velocity."""
        return self.reference_ns is None or self.registration is not None

    @property
    def edge(self) -> Edge:
        """The step as a measurement."""
        return Edge(
            reference_id=self.reference_ns,
            T_reference_frame=self.T_reference_frame,
            covariance=self.covariance,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Node(Generic[ObservationsT]):
    """A frame that the next one may be registered against."""

    observations: ObservationsT
    estimate: Estimate
    n_steps: int


class RawChain(Generic[ObservationsT]):
    """Chains relative poses of consecutive frames; the smoother never touches it.

    A frame that cannot be registered against its predecessor is tried against the last
    registered frame, so that one bad image in between costs nothing. Failing that, the pose
    goes on with constant velocity.

    Parameters
    ----------
    frontend : Frontend
        Its results are not checked here, see `CheckedFrontend`.
    config : WindowConfig
        Sigmas of a coasted step.
    """

    def __init__(self, frontend: Frontend[ObservationsT], config: WindowConfig) -> None:
        self._frontend, self._config = frontend, config
        self._poses: PoseChain | None = None
        # The predecessor, and the last registered frame where that is another.
        self._nodes: list[_Node[ObservationsT]] = []
        self._recent = _RecentVelocities()

    @property
    def anchor(self) -> ObservationsT | None:
        """The last registered frame, which the next one may be tied to."""
        return self._nodes[-1].observations if self._nodes else None

    def reconfigure(
        self,
        frontend: Frontend[ObservationsT],
        config: WindowConfig,
        observations: Mapping[int, ObservationsT],
    ) -> None:
        """Change front-end or configuration; poses and velocity are kept.

        Parameters
        ----------
        frontend : Frontend
        config : WindowConfig
        observations : mapping of int to observations
            New ones of the last frame and of the last registered one, by stamp; where one is
            missing, the former are kept.
        """
        self._frontend, self._config = frontend, config
        if self._poses is not None:
            self._poses.config = config
        self._nodes = [
            replace(node, observations=observations.get(node.estimate.stamp_ns, node.observations))
            for node in self._nodes
        ]

    def advance(
        self, current: ObservationsT, *, variance_factor: float = 1.0, seeks_places: bool = False
    ) -> RawStep:
        """Register the next frame and return its step.

        Parameters
        ----------
        current : observations
        variance_factor : float
            Of the step's covariance in that of the chain.
        seeks_places : bool
            A camera that was lost looks for places itself: nothing predicts how far it is from the
            last registered frame, and one registration alone may be of a view that looks alike.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        if self._poses is None:
            return self._begin(current)
        predecessor_ns = self._poses.newest.stamp_ns
        if current.stamp_ns <= predecessor_ns:
            raise ValueError(
                f"stamp {current.stamp_ns} is not after {predecessor_ns}, that of the frame before"
            )
        failures: list[Failure] = []
        elapsed_s = 1e-9 * (current.stamp_ns - self._nodes[-1].estimate.stamp_ns)
        is_lost = seeks_places and elapsed_s > self._config.lost_after_s
        for node in self._nodes[: 1 if is_lost else None]:
            result = self._register(self._poses, node, current)
            if isinstance(result, RelativePose):
                return self._append(self._poses, node, current, result, variance_factor)
            failures.append(result)
        failure = next((each for each in failures if each.reason), failures[-1])
        return self._coast(self._poses, current, failure)

    def _register(
        self, poses: PoseChain, node: _Node[ObservationsT], current: ObservationsT
    ) -> RelativePose | Failure:
        """Search around the predicted pixels, then around the previous ones."""
        if self._is_prediction_valid(poses, current.stamp_ns):
            prior = self._predict(poses, node, current.stamp_ns)
            result = self._frontend.register(node.observations, current, prior)
            # What contradicts the prediction would be believed without it.
            if isinstance(result, RelativePose | Contradiction):
                return result
        return self._frontend.register(node.observations, current, None)

    def _is_prediction_valid(self, poses: PoseChain, stamp_ns: int) -> bool:
        anchor_ns = self._nodes[-1].estimate.stamp_ns
        return poses.velocity is not None and 1e-9 * (stamp_ns - anchor_ns) <= MAX_EXTRAPOLATION_S

    def _predict(self, poses: PoseChain, node: _Node[ObservationsT], stamp_ns: int) -> MotionPrior:
        T_world_newest = poses.newest.T_world_frame
        T_world_predicted = T_world_newest @ poses.predict(stamp_ns)[0]
        T_node_world = se3.invert(node.estimate.T_world_frame)
        elapsed_s = 1e-9 * (stamp_ns - poses.newest.stamp_ns)
        T_newest_recent = se3.exp(self._recent.median() * elapsed_s)
        return MotionPrior(
            T_predicted=T_node_world @ T_world_predicted,
            T_recent=T_node_world @ T_world_newest @ T_newest_recent,
            is_confirmed=len(self._nodes) == 1,
        )

    def _begin(self, current: ObservationsT) -> RawStep:
        estimate = Estimate(
            stamp_ns=current.stamp_ns, T_world_frame=np.eye(4), covariance=np.zeros((6, 6))
        )
        self._poses = PoseChain(self._config, estimate)
        self._nodes = [_Node(observations=current, estimate=estimate, n_steps=0)]
        return RawStep(
            estimate=estimate,
            reference_ns=None,
            T_reference_frame=np.eye(4),
            covariance=np.zeros((6, 6)),
        )

    def _append(
        self,
        poses: PoseChain,
        node: _Node[ObservationsT],
        current: ObservationsT,
        result: RelativePose,
        variance_factor: float,
    ) -> RawStep:
        reference, stamp_ns = node.estimate, current.stamp_ns
        T, covariance = result.T_reference_current, result.covariance
        # What the next step takes back is not chained: with it the raw NEES over 1 s of rendered
        # hands with a rolling shutter falls from 0.6 to 0.4, and covariances are too large.
        lasting = variance_factor * (covariance - result.passing_covariance)
        estimate = poses.append(reference, stamp_ns, T, lasting)
        is_steady = self._note_velocity(poses, result, 1e-9 * (stamp_ns - reference.stamp_ns))
        n_steps = node.n_steps + 1
        self._nodes = [_Node(observations=current, estimate=estimate, n_steps=n_steps)]
        return RawStep(
            estimate=estimate,
            reference_ns=reference.stamp_ns,
            T_reference_frame=T,
            covariance=covariance,
            registration=result,
            is_steady=is_steady,
            n_steps=n_steps,
        )

    def _note_velocity(self, poses: PoseChain, result: RelativePose, elapsed_s: float) -> bool:
        """Take over the velocity of a registration; tell whether it is steady."""
        poses.velocity = velocity_of(result.T_reference_current, elapsed_s)
        sigmas = np.sqrt(np.diagonal(result.covariance)) / elapsed_s
        return self._recent.add(poses.newest.stamp_ns, poses.velocity, sigmas)

    def _coast(self, poses: PoseChain, current: ObservationsT, failure: Failure) -> RawStep:
        predecessor, anchor = self._nodes[0], self._nodes[-1]
        T_predecessor_current, covariance = poses.predict(current.stamp_ns)
        estimate = poses.coast(current.stamp_ns)
        n_steps = predecessor.n_steps + _N_STEPS_COASTED
        self._nodes = [_Node(observations=current, estimate=estimate, n_steps=n_steps), anchor]
        return RawStep(
            estimate=estimate,
            reference_ns=predecessor.estimate.stamp_ns,
            T_reference_frame=T_predecessor_current,
            covariance=covariance,
            failure=failure,
            n_steps=n_steps,
        )


class _RecentVelocities:
    """Velocities of the last second, and their changes from step to step."""

    def __init__(self) -> None:
        self._velocities: list[tuple[int, FloatArray]] = []
        self._changes: list[tuple[int, FloatArray]] = []

    def median(self) -> FloatArray:
        """Return the median velocity, which outliers do not move."""
        return np.asarray(np.median([velocity for _, velocity in self._velocities], axis=0))

    def add(self, stamp_ns: int, velocity: FloatArray, sigmas: FloatArray) -> bool:
        """Add a velocity; tell whether it is steady: its change no larger than usual."""
        is_steady = False
        if self._velocities:
            change = np.abs(velocity - self._velocities[-1][1])
            is_steady = self._is_small(change, sigmas)
            self._changes = _of_last_second([*self._changes, (stamp_ns, change)])
        self._velocities = _of_last_second([*self._velocities, (stamp_ns, velocity)])
        return is_steady

    def _is_small(self, change: FloatArray, sigmas: FloatArray) -> bool:
        known = np.sort([each for _, each in self._changes], axis=0)
        if len(known) < _MIN_CHANGES:
            return False
        limits = _STEADY * np.maximum(known[len(known) // 2], sigmas)
        return bool((change <= limits).all())


def _of_last_second(values: list[tuple[int, FloatArray]]) -> list[tuple[int, FloatArray]]:
    newest_ns = values[-1][0]
    return [(ns, value) for ns, value in values if 1e-9 * (newest_ns - ns) <= _RECENT_S]


class EdgeChain:
    """Chains the first usable edge of each pose.

    A pose without one continues the last velocity, or begins the chain anew where its pose in
    the world is given.

    Parameters
    ----------
    config : WindowConfig
        Sigmas of a pose without an edge.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._chain: PoseChain | None = None
        self._poses: dict[FrameId, Estimate] = {}
        self._status = StatusClock(config.lost_after_s)

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
        if self._chain is None:
            self._chain, is_tied = PoseChain(self._config, first), True
        else:
            is_tied = self._advance(self._chain, first.stamp_ns, edges, prior)
        status = self._status.next(first.stamp_ns, is_measured=is_tied)
        newest = self._chain.newest
        estimate = replace(newest, status=status, frame_id=first.frame_id, rejected=())
        self._poses[first.frame_id] = estimate
        return estimate

    def forget(self, frame_ids: Iterable[FrameId]) -> None:
        """Forget poses that no edge will refer to any more."""
        for frame_id in frame_ids:
            self._poses.pop(frame_id, None)

    def _advance(
        self, chain: PoseChain, stamp_ns: int, edges: Sequence[Edge], prior: Prior | None
    ) -> bool:
        """Add a pose; tell whether an edge or a prior ties it."""
        newest, edge = chain.newest, self._usable(edges)
        if edge is not None:
            reference = self._poses[edge.reference_id]
            estimate = chain.append(reference, stamp_ns, edge.T_reference_frame, edge.covariance)
            elapsed_s = 1e-9 * (stamp_ns - newest.stamp_ns)
            T_newest_frame = se3.invert(newest.T_world_frame) @ estimate.T_world_frame
            chain.velocity = velocity_of(T_newest_frame, elapsed_s) if elapsed_s > 0 else None
        elif isinstance(prior, PosePrior):
            T, covariance = prior.T_world_frame, prior.covariance
            chain.start(Estimate(stamp_ns=stamp_ns, T_world_frame=T, covariance=covariance))
        else:
            chain.coast(stamp_ns)
            return False
        return True

    def _usable(self, edges: Sequence[Edge]) -> Edge | None:
        known = [edge for edge in edges if edge.reference_id in self._poses]
        sound = (edge for edge, fault in zip(known, find_faults(known), strict=True) if not fault)
        return next(sound, None)
