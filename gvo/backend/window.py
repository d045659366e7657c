"""A sliding window of poses, smoothed by iSAM2 with marginalization.

References
----------
M. Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31(2),
2012, doi:10.1177/0278364911430419.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import gtsam
import numpy as np

from gvo.backend.noise import check_covariance, check_transform, edge_noise
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId, Status

# Of the first pose, which defines the world: radians and metres.
_ORIGIN_SIGMA = 1e-5


@dataclass(slots=True, kw_only=True)
class _Member:
    """A pose of the window."""

    key: int
    stamp_ns: int
    status: Status
    is_kept: bool = False


class SlidingWindow:
    """Recent poses and kept keyframes, tied by relative poses of any origin.

    A pose leaves when it is neither recent nor kept; what was known of it stays as a
    marginal on the poses it was tied to. It is then handed over by `pop_finished`.

    Parameters
    ----------
    config : WindowConfig, optional
        Number of recent poses, robust kernel.

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

    def __init__(self, config: WindowConfig | None = None) -> None:
        self._config = config or WindowConfig()
        self._members: OrderedDict[FrameId, _Member] = OrderedDict()
        self._finished: list[Estimate] = []
        self._n_keys = 0
        parameters = gtsam.ISAM2Params()
        # Cholesky calls the system indeterminate once the drift's variance is 4096^2 times
        # that of an edge; QR does not.
        parameters.setFactorization("QR")
        parameters.setRelinearizeThreshold(0.01)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        # Carry every change through to the oldest pose: by default small ones are left out, which
        # costs what smoothing gains where edges are good to a tenth of a millimetre.
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._isam = gtsam.ISAM2(parameters)

    def __contains__(self, frame_id: object) -> bool:
        """Tell whether a frame is in the window."""
        return frame_id in self._members

    def __len__(self) -> int:
        """Return the number of poses in the window."""
        return len(self._members)

    def add_pose(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        *,
        T_world_frame: FloatArray | None = None,
        status: Status = Status.OK,
    ) -> Estimate:
        """Add a pose, smooth the window, and let poses leave that are neither recent nor kept.

        Parameters
        ----------
        frame_id : hashable
            The caller's name for the pose.
        stamp_ns : int
            Nanoseconds, later than that of the pose before.
        edges : sequence of Edge
            Relative poses to poses in the window; none for the very first one only.
        T_world_frame : ndarray of float64, shape (4, 4), optional
            The very first pose; the identity where omitted.
        status : Status
            Handed through to the estimates.

        Returns
        -------
        Estimate
            The causal pose: the best at this moment, with its marginal covariance.

        Raises
        ------
        ValueError
            A known name, a stamp that does not advance, an edge to a pose that is not in the
            window, a matrix that is no rotation or no covariance.
        SmoothingError
            When GTSAM fails all the same; the window stands as it was before.
        """
        self._check(frame_id, stamp_ns, edges, T_world_frame)
        key = self._n_keys
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if edges:
            self._add_edges(graph, key, edges)
            start = self._start_value(edges)
        else:
            start = np.eye(4) if T_world_frame is None else T_world_frame
            origin = gtsam.noiseModel.Isotropic.Sigma(6, _ORIGIN_SIGMA)
            graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(start), origin))
        values.insert(key, gtsam.Pose3(start))
        with self._restored_on_error(frame_id):
            self._n_keys += 1
            self._members[frame_id] = _Member(key=key, stamp_ns=stamp_ns, status=status)
            self._update(graph, values, new_key=key)
            return self._estimate(frame_id)

    def keep(self, frame_id: FrameId) -> None:
        """Keep a pose of the window as a keyframe until it is released."""
        self._member(frame_id).is_kept = True

    def release(self, frame_id: FrameId) -> None:
        """Let a kept pose leave, with the next update after it is no longer recent."""
        self._member(frame_id).is_kept = False

    def pose(self, frame_id: FrameId) -> FloatArray:
        """Return T_world_frame, shape (4, 4), of a pose of the window."""
        key = self._member(frame_id).key
        return np.asarray(self._isam.calculateEstimatePose3(key).matrix())

    def poses(self) -> dict[FrameId, FloatArray]:
        """Return T_world_frame of all poses of the window, oldest first."""
        return {frame_id: self.pose(frame_id) for frame_id in self._members}

    def covariance(self, frame_id: FrameId) -> FloatArray:
        """Return the marginal covariance, shape (6, 6), of a pose of the window."""
        return np.asarray(self._isam.marginalCovariance(self._member(frame_id).key))

    def pop_finished(self) -> list[Estimate]:
        """Hand over the smoothed estimates of the poses that left since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def finish(self) -> list[Estimate]:
        """Hand over all estimates that were not popped yet, in the order of their stamps."""
        self._finished += [self._estimate(frame_id) for frame_id in self._members]
        self._members.clear()
        return sorted(self.pop_finished(), key=lambda estimate: estimate.stamp_ns)

    def _member(self, frame_id: FrameId) -> _Member:
        if frame_id not in self._members:
            raise ValueError(f"{frame_id!r} is not in the window")
        return self._members[frame_id]

    def _estimate(self, frame_id: FrameId) -> Estimate:
        member = self._members[frame_id]
        return Estimate(
            stamp_ns=member.stamp_ns,
            T_world_cam=self.pose(frame_id),
            covariance=self.covariance(frame_id),
            status=member.status,
            frame_id=frame_id,
        )

    def _check(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        T_world_frame: FloatArray | None,
    ) -> None:
        if frame_id in self._members:
            raise ValueError(f"{frame_id!r} is in the window already")
        if self._members:
            last = next(reversed(self._members.values()))
            if stamp_ns <= last.stamp_ns:
                raise ValueError(f"stamp {stamp_ns} of {frame_id!r} is not after {last.stamp_ns}")
        if bool(edges) != bool(self._members):
            raise ValueError(
                f"{frame_id!r} needs an edge to a pose in the window; only the first has none"
            )
        for edge in edges:
            self._member(edge.reference_id)
            name = f"edge {edge.reference_id!r} -> {frame_id!r}"
            check_transform(edge.T_reference_frame, f"T_reference_frame of {name}")
            check_covariance(edge.covariance, f"covariance of {name}")
        if T_world_frame is not None:
            check_transform(T_world_frame, f"T_world_frame of {frame_id!r}")

    def _start_value(self, edges: Sequence[Edge]) -> FloatArray:
        """Return the prediction that the other edges agree with best, their medoid.

        A robust kernel cannot leave the wrong side of an outlier, so a single bad edge must
        not decide where the optimization starts.
        """
        predictions = np.stack(
            [self.pose(edge.reference_id) @ edge.T_reference_frame for edge in edges]
        )
        if len(edges) == 1:
            return np.asarray(predictions[0])
        information = np.linalg.inv(np.stack([edge.covariance for edge in edges]))
        residuals = se3.log(se3.invert(predictions) @ predictions[:, np.newaxis])
        squares = np.einsum("mni,nij,mnj->mn", residuals, information, residuals)
        disagreements = np.sum(np.sqrt(np.maximum(squares, 0.0)), axis=1)
        return np.asarray(predictions[int(np.argmin(disagreements))])

    @contextmanager
    def _restored_on_error(self, frame_id: FrameId) -> Iterator[None]:
        """Put the window back as it was when an update fails or is interrupted."""
        before = gtsam.ISAM2(self._isam), self._members.copy(), list(self._finished)
        try:
            yield
        except BaseException as error:
            self._isam, self._members, self._finished = before
            if isinstance(error, RuntimeError | IndexError):
                reason = str(error).strip().splitlines()[0]
                raise SmoothingError(f"the window refused {frame_id!r}: {reason}") from error
            raise

    def _add_edges(
        self, graph: gtsam.NonlinearFactorGraph, key: int, edges: Sequence[Edge]
    ) -> None:
        for edge in edges:
            graph.add(
                gtsam.BetweenFactorPose3(
                    self._members[edge.reference_id].key,
                    key,
                    gtsam.Pose3(edge.T_reference_frame),
                    edge_noise(edge.covariance, self._config),
                )
            )

    def _leaving(self) -> list[FrameId]:
        n_old = max(len(self._members) - self._config.n_recent, 0)
        old = list(self._members.items())[:n_old]
        return [frame_id for frame_id, member in old if not member.is_kept]

    def _update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *, new_key: int
    ) -> None:
        leaving = self._leaving()
        if leaving:
            self._update_with_order(graph, values, leaving, new_key=new_key)
        else:
            self._isam.update(graph, values)
        self._finished += [self._estimate(frame_id) for frame_id in leaving]
        for frame_id in leaving:
            leaf = gtsam.KeyList()
            leaf.push_back(self._members.pop(frame_id).key)
            self._isam.marginalizeLeaves(leaf)

    def _update_with_order(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        leaving: Sequence[FrameId],
        *,
        new_key: int,
    ) -> None:
        """Update with the leaving poses eliminated first, each in a group of its own.

        Only so do they become leaves of the Bayes tree, which can be marginalized.
        """
        groups = {frame_id: group for group, frame_id in enumerate(leaving)}
        constrained, reeliminate = gtsam.KeyGroupMap(), gtsam.KeyList()
        for frame_id, member in self._members.items():
            constrained.insert2(member.key, groups.get(frame_id, len(leaving)))
            if member.key != new_key:
                reeliminate.push_back(member.key)
        self._isam.update(graph, values, [], constrained, None, reeliminate, False)
