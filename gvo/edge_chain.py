"""The raw chain of edges: what a front-end gave, without any smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gvo.backend.checks import find_faults
from gvo.coasting import StatusClock, predict_step
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, PosePrior, Prior


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
