"""The raw chains, of registered frames and of given edges: no smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np

from gvo.backend.motion_model import MAX_EXTRAPOLATION_S, StatusClock, predict_step
from gvo.backend.validation import find_faults
from gvo.config import WindowConfig
from gvo.frontend.protocol import Frontend, ObservationsT, register_checked
from gvo.geometry import se3
from gvo.types import (
    Contradiction,
    Edge,
    Estimate,
    Failure,
    FloatArray,
    FrameId,
    PosePrior,
    Prior,
    RelativePose,
    Status,
)

# The usual velocity, and its usual change from step to step, are the medians of so many seconds.
_USUAL_S = 1.0
# A step is steady where no component changes by more than so many times what is usual. Of normal
# errors that is 3.4 sigma; fewer changes than so many tell nothing of what is usual.
_STEADY = 5.0
_MIN_CHANGES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawStep:
    """One step of the chain.

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
    reason : str
        Why there is no registration; empty where there is one.
    n_matches, n_inliers : int
    is_steady : bool
        The velocity changed no more than it did from step to step in the last second.
    """

    estimate: Estimate
    reference_ns: int | None
    T_reference_frame: FloatArray
    covariance: FloatArray
    registration: RelativePose | None = None
    reason: str = ""
    n_matches: int = 0
    n_inliers: int = 0
    is_steady: bool = False

    @property
    def is_registered(self) -> bool:
        """False where the step continues the last velocity."""
        return self.reference_ns is None or self.registration is not None

    @property
    def flow_px(self) -> float | None:
        """Median displacement of the inliers in the image, where it is known."""
        return None if self.registration is None else self.registration.flow_px


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Link(Generic[ObservationsT]):
    """A frame that the next one may be registered against."""

    observations: ObservationsT
    T_world_frame: FloatArray
    covariance: FloatArray


class RawChain(Generic[ObservationsT]):
    """Chains relative poses of consecutive frames; the smoother never touches it.

    A frame that cannot be registered against its predecessor is tried against the last
    registered frame, so that one bad image in between costs nothing. Failing that, the pose
    goes on with constant velocity.

    Parameters
    ----------
    frontend : Frontend
    config : WindowConfig
        Sigmas of a step without registration.
    """

    def __init__(self, frontend: Frontend[ObservationsT], config: WindowConfig) -> None:
        self._frontend = frontend
        self._config = config
        self._predecessor: _Link[ObservationsT] | None = None
        self._anchor: _Link[ObservationsT] | None = None
        self._velocity: FloatArray | None = None
        self._velocities: list[tuple[int, FloatArray]] = []
        self._changes: list[tuple[int, FloatArray]] = []

    @property
    def anchor_ns(self) -> int | None:
        """Stamp of the last registered frame, which the next one may be tied to."""
        return None if self._anchor is None else self._anchor.observations.stamp_ns

    def reconfigure(
        self,
        frontend: Frontend[ObservationsT],
        config: WindowConfig,
        observations: Mapping[int, ObservationsT],
    ) -> None:
        """Go on with another front-end or configuration; poses and velocity stay.

        Parameters
        ----------
        frontend : Frontend
        config : WindowConfig
        observations : mapping of int to observations
            What the front-end keeps of the last frame and of the last registered one, by their
            stamps; where one is missing, what was kept before is registered.
        """
        self._frontend, self._config = frontend, config
        is_same = self._anchor is self._predecessor
        self._predecessor = _with_observations(self._predecessor, observations)
        self._anchor = (
            self._predecessor if is_same else _with_observations(self._anchor, observations)
        )

    def advance(self, current: ObservationsT) -> RawStep:
        """Register the next frame and return its step.

        Raises
        ------
        ValueError
            For a stamp that does not advance.
        """
        predecessor, anchor = self._predecessor, self._anchor
        if predecessor is None or anchor is None:
            return self._begin(current)
        elapsed_s = 1e-9 * (current.stamp_ns - predecessor.observations.stamp_ns)
        if elapsed_s <= 0:
            raise ValueError(
                f"stamp {current.stamp_ns} is not after {predecessor.observations.stamp_ns}, "
                "that of the frame before"
            )
        coasted_ns = predecessor.observations.stamp_ns - anchor.observations.stamp_ns
        predicted = predict_step(
            self._velocity, elapsed_s, self._config, coasted_s=1e-9 * coasted_ns
        )
        T_world_predicted = predecessor.T_world_frame @ predicted[0]
        failure = Failure(reason="")
        for link in [predecessor] if anchor is predecessor else [predecessor, anchor]:
            result = self._register(link, current, T_world_predicted)
            if isinstance(result, RelativePose):
                return self._append(link, current, result)
            failure = failure if failure.reason else result
        return self._coast(predecessor, current, predicted, failure)

    def _register(
        self, link: _Link[ObservationsT], current: ObservationsT, T_world_predicted: FloatArray
    ) -> RelativePose | Failure:
        """Search around the predicted pixels, then around the previous ones."""
        if self._velocity is not None and self._is_foretold(current.stamp_ns):
            T_frame_world = se3.invert(link.T_world_frame)
            result = register_checked(
                *(self._frontend, link.observations, current, T_frame_world @ T_world_predicted),
                T_usual=self._usual_motion(T_frame_world, current.stamp_ns),
            )
            # What speaks against the prediction would be taken for true without it.
            if isinstance(result, RelativePose | Contradiction):
                return result
        return register_checked(self._frontend, link.observations, current, None)

    def _usual_motion(self, T_frame_world: FloatArray, stamp_ns: int) -> FloatArray | None:
        """Return the motion from a frame at the usual velocity; None before there is one."""
        predecessor = self._predecessor
        if predecessor is None or not self._velocities:
            return None
        usual = np.median([velocity for _, velocity in self._velocities], axis=0)
        elapsed_s = 1e-9 * (stamp_ns - predecessor.observations.stamp_ns)
        T_frame_predecessor = T_frame_world @ predecessor.T_world_frame
        return np.asarray(T_frame_predecessor @ se3.exp(usual * elapsed_s))

    def _is_foretold(self, stamp_ns: int) -> bool:
        """Tell whether the last velocity still says where a frame should be."""
        anchor_ns = self.anchor_ns
        return anchor_ns is None or 1e-9 * (stamp_ns - anchor_ns) <= MAX_EXTRAPOLATION_S

    def _begin(self, current: ObservationsT) -> RawStep:
        step = RawStep(
            estimate=Estimate(
                stamp_ns=current.stamp_ns, T_world_cam=np.eye(4), covariance=np.zeros((6, 6))
            ),
            reference_ns=None,
            T_reference_frame=np.eye(4),
            covariance=np.zeros((6, 6)),
        )
        self._predecessor = self._anchor = _link_of(current, step.estimate)
        return step

    def _append(
        self, link: _Link[ObservationsT], current: ObservationsT, result: RelativePose
    ) -> RawStep:
        T_world_current = se3.normalize(link.T_world_frame @ result.T_reference_current)
        estimate = Estimate(
            stamp_ns=current.stamp_ns,
            T_world_cam=T_world_current,
            covariance=se3.compose_covariance(
                link.covariance, result.T_reference_current, result.covariance
            ),
        )
        span_s = 1e-9 * (current.stamp_ns - link.observations.stamp_ns)
        velocity = se3.log(result.T_reference_current) / span_s
        sigmas = np.sqrt(np.diagonal(result.covariance)) / span_s
        is_steady = self._note_change(current.stamp_ns, velocity, sigmas)
        self._velocity = velocity
        self._velocities = _of_last_second(self._velocities, (current.stamp_ns, velocity))
        self._predecessor = self._anchor = _link_of(current, estimate)
        return RawStep(
            estimate=estimate,
            reference_ns=link.observations.stamp_ns,
            T_reference_frame=result.T_reference_current,
            covariance=result.covariance,
            registration=result,
            n_matches=result.n_matches,
            n_inliers=result.n_inliers,
            is_steady=is_steady,
        )

    def _note_change(self, stamp_ns: int, velocity: FloatArray, sigmas: FloatArray) -> bool:
        """Note the change of the velocity, and tell whether changes like that are usual."""
        if self._velocity is None:
            return False
        change = np.abs(velocity - self._velocity)
        known = np.sort([each for _, each in self._changes], axis=0)
        self._changes = _of_last_second(self._changes, (stamp_ns, change))
        if len(known) < _MIN_CHANGES:
            return False
        usual = np.maximum(known[len(known) // 2], sigmas)
        return bool((change <= _STEADY * usual).all())

    def _coast(
        self,
        predecessor: _Link[ObservationsT],
        current: ObservationsT,
        predicted: tuple[FloatArray, FloatArray],
        failure: Failure,
    ) -> RawStep:
        T_predecessor_current, covariance = predicted
        estimate = Estimate(
            stamp_ns=current.stamp_ns,
            T_world_cam=se3.normalize(predecessor.T_world_frame @ T_predecessor_current),
            covariance=se3.compose_covariance(
                predecessor.covariance, T_predecessor_current, covariance
            ),
            status=Status.COASTING,
        )
        self._predecessor = _link_of(current, estimate)
        return RawStep(
            estimate=estimate,
            reference_ns=predecessor.observations.stamp_ns,
            T_reference_frame=T_predecessor_current,
            covariance=covariance,
            reason=failure.reason,
            n_matches=failure.n_matches,
            n_inliers=failure.n_inliers,
        )


def _of_last_second(
    noted: list[tuple[int, FloatArray]], newest: tuple[int, FloatArray]
) -> list[tuple[int, FloatArray]]:
    kept = [*noted, newest]
    return [(ns, each) for ns, each in kept if 1e-9 * (newest[0] - ns) <= _USUAL_S]


def _with_observations(
    link: _Link[ObservationsT] | None, observations: Mapping[int, ObservationsT]
) -> _Link[ObservationsT] | None:
    if link is None:
        return None
    stamp_ns = link.observations.stamp_ns
    return replace(link, observations=observations.get(stamp_ns, link.observations))


def _link_of(observations: ObservationsT, estimate: Estimate) -> _Link[ObservationsT]:
    return _Link(
        observations=observations,
        T_world_frame=estimate.T_world_cam,
        covariance=estimate.covariance,
    )


class EdgeChain:
    """Composes the first edge of each pose.

    A pose without a usable edge continues the last velocity, or begins the chain anew where its
    pose in the world is given.

    Parameters
    ----------
    config : WindowConfig
        Sigmas of a pose without an edge.
    """

    def __init__(self, config: WindowConfig) -> None:
        self._config = config
        self._poses: dict[FrameId, Estimate] = {}
        self._newest: Estimate | None = None
        self._velocity: FloatArray | None = None
        self._coasted_s = 0.0
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
        if self._newest is None:
            T, covariance, is_tied = first.T_world_cam, first.covariance, True
        else:
            T, covariance, is_tied = self._next(self._newest, first.stamp_ns, edges, prior)
        estimate = Estimate(
            stamp_ns=first.stamp_ns,
            T_world_cam=T,
            covariance=covariance,
            status=self._status.next(first.stamp_ns, is_tied=is_tied),
            frame_id=first.frame_id,
        )
        self._poses[first.frame_id] = self._newest = estimate
        return estimate

    def forget(self, frame_ids: Iterable[FrameId]) -> None:
        """Let go of poses that no edge will refer to any more."""
        for frame_id in frame_ids:
            self._poses.pop(frame_id, None)

    def _next(
        self, newest: Estimate, stamp_ns: int, edges: Sequence[Edge], prior: Prior | None
    ) -> tuple[FloatArray, FloatArray, bool]:
        elapsed_s = 1e-9 * (stamp_ns - newest.stamp_ns)
        edge = self._usable(edges)
        if edge is not None:
            T, covariance = _compose(
                self._poses[edge.reference_id], edge.T_reference_frame, edge.covariance
            )
            T_newest_frame = se3.invert(newest.T_world_cam) @ T
            self._velocity = se3.log(T_newest_frame) / elapsed_s if elapsed_s > 0 else None
            self._coasted_s = 0.0
            return T, covariance, True
        if isinstance(prior, PosePrior):
            self._velocity, self._coasted_s = None, 0.0
            return prior.T_world_frame, prior.covariance, True
        step = predict_step(self._velocity, elapsed_s, self._config, coasted_s=self._coasted_s)
        self._coasted_s += elapsed_s
        return *_compose(newest, *step), False

    def _usable(self, edges: Sequence[Edge]) -> Edge | None:
        known = [edge for edge in edges if edge.reference_id in self._poses]
        return next(
            (edge for edge, fault in zip(known, find_faults(known), strict=True) if not fault),
            None,
        )


def _compose(
    reference: Estimate, T_reference_frame: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    # Of a million products the rotation would cease to be one.
    T = se3.normalize(reference.T_world_cam @ T_reference_frame)
    return T, se3.compose_covariance(reference.covariance, T_reference_frame, covariance)
