"""Which measurements of a new pose go in, where it starts, what is refused.

No robust kernel recovers from a start value at a gross outlier, so a single bad edge must not
determine the start, and is better refused.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import compress
from typing import TypeVar

import gtsam
import numpy as np
from scipy.linalg.lapack import dposv

from gvo.backend.factors import ORIGIN, Measurement, find_faults, prior_fault
from gvo.backend.motion_model import ConstantVelocity
from gvo.backend.window_graph import NewPose, WindowGraph
from gvo.geometry import se3
from gvo.types import Edge, FloatArray, FrameId, IntArray, PosePrior, Prior, Rejected

_Item = TypeVar("_Item")

# Sigmas of the difference of two edges, a 6-vector: 99.9 % of correct ones are below.
_AGREEMENT = 5.0
_TRACE = 1e-9 * np.eye(6)
_ZERO = np.zeros(6)
_NOTHING = np.zeros((6, 6))
# Of a first pose of which only the position is known: radians, and metres beside its prior.
_UNKNOWN_COVARIANCE = np.diag(np.repeat([1.0, 1e4], 3) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GateResult:
    """The start value of a pose, and which of its edges are refused.

    Parameters
    ----------
    T_world_start : gtsam.Pose3
        Weighted mean of the predictions that agree with their medoid.
    reasons : list of str
        For each edge why it is refused; empty if it is not.
    misfit : float
        How far predictions lie from that mean, in squared sigmas per degree of freedom; NaN of a
        single one.
    """

    T_world_start: gtsam.Pose3
    reasons: list[str]
    misfit: float = math.nan


def gate_edges(
    measurements: Sequence[Measurement],
    *,
    pose_of: Callable[[FrameId], gtsam.Pose3],
    relative_covariance: Callable[[FrameId, FrameId], FloatArray],
    motion: Callable[[], Edge | None],
    gate: float | None,
) -> GateResult:
    """Gate the edges of a new pose against each other, and find its start value.

    Each edge predicts the pose. An edge is refused if it disagrees with the medoid of the
    predictions by more than the gate, and if more of the edges (and the predicted motion) agree
    with the medoid than with it. The uncertainty between the references is taken into account: a
    loop that closes after a long drift disagrees with the drift, and is right.

    Parameters
    ----------
    measurements : sequence of Measurement
        At least one, of valid edges.
    pose_of : callable
        Returns the current pose of a reference, T_world_reference.
    relative_covariance : callable
        Returns the covariance (6, 6) of the pose of the second reference in the first. Called
        only when edges disagree.
    motion : callable
        Returns the edge that the last velocity predicts, or None. Called only when edges
        disagree.
    gate : float or None
        In sigmas of the difference of two predictions; None refuses nothing.
    """
    predictions = [_predict(measurement, pose_of) for measurement in measurements]
    if len(measurements) == 1:
        return GateResult(T_world_start=predictions[0], reasons=[""])
    informations = [measurement.gaussian.information() for measurement in measurements]
    twists = _twists(predictions)
    reasons = [""] * len(measurements)
    mean, spread = _mean(twists, informations)
    if spread <= min(_AGREEMENT, gate or _AGREEMENT) ** 2:
        T_world_start = predictions[0].retract(mean)
        return GateResult(
            T_world_start=T_world_start, reasons=reasons, misfit=_misfit(spread, len(twists))
        )
    covariances = [measurement.edge.covariance for measurement in measurements]
    distances = _distances(twists, covariances)
    if gate is not None and distances.max() > gate:
        voters = [*measurements, *map(Measurement.of, filter(None, [motion()]))]
        true_distances = _true_distances(voters, pose_of, relative_covariance)
        reasons = _outvoted(measurements, true_distances, gate=gate)
    if any(reasons):
        is_left = [not reason for reason in reasons]
        predictions = list(compress(predictions, is_left))
        informations = list(compress(informations, is_left))
        covariances = list(compress(covariances, is_left))
        twists = _twists(predictions)
        distances = _distances(twists, covariances)
    medoid = int(np.minimum(distances, _AGREEMENT).sum(axis=1).argmin())
    is_near = (distances[medoid] <= _AGREEMENT).tolist()
    mean, spread = _mean(list(compress(twists, is_near)), list(compress(informations, is_near)))
    return GateResult(
        T_world_start=predictions[0].retract(mean),
        reasons=reasons,
        misfit=_misfit(spread, sum(is_near)),
    )


def disagreement(
    edge: Edge, T_reference_frame: FloatArray, covariance: FloatArray, *, gate: float
) -> str:
    """Say why an edge contradicts the known relative pose; empty if it does not.

    Parameters
    ----------
    edge : Edge
    T_reference_frame : ndarray of float64, shape (4, 4)
        The known one.
    covariance : ndarray of float64, shape (6, 6)
        Of T_reference_frame.
    gate : float
        In sigmas of the difference.
    """
    difference = se3.log(se3.invert(T_reference_frame) @ edge.T_reference_frame)
    sigmas = _mahalanobis(difference, covariance + edge.covariance)
    if sigmas <= gate:
        return ""
    return f"it disagrees by {sigmas:.3g} sigma with the window (window.gate: {gate:g})"


def _predict(measurement: Measurement, pose_of: Callable[[FrameId], gtsam.Pose3]) -> gtsam.Pose3:
    return pose_of(measurement.edge.reference_id).compose(measurement.T_reference_frame)


def _outvoted(
    measurements: Sequence[Measurement], distances: FloatArray, *, gate: float
) -> list[str]:
    """Say for each edge why the others outvote it; empty if they do not.

    The distances may hold a row and a column more than the edges, of the predicted motion: it
    has the casting vote between two edges.
    """
    n = len(measurements)
    # Capped, so that a far outlier weighs no more than a near one.
    medoid = int(np.minimum(distances, gate).sum(axis=1)[:n].argmin())
    n_agreeing = np.count_nonzero(distances <= gate, axis=1)
    is_out = (distances[medoid, :n] > gate) & (n_agreeing[:n] < n_agreeing[medoid])
    return [
        f"it disagrees by {distances[medoid, index]:.3g} sigma with the edge from "
        f"{measurements[medoid].edge.reference_id!r} (window.gate: {gate:g})"
        if is_out[index]
        else ""
        for index in range(n)
    ]


def _true_distances(
    measurements: Sequence[Measurement],
    pose_of: Callable[[FrameId], gtsam.Pose3],
    relative_covariance: Callable[[FrameId, FrameId], FloatArray],
) -> FloatArray:
    """Return Mahalanobis distances, shape (n, n), with the uncertainty of the references."""
    predictions = [_predict(measurement, pose_of) for measurement in measurements]
    edges = [measurement.edge for measurement in measurements]
    distances = np.zeros((len(edges), len(edges)))
    for i, j in zip(*_pairs(len(edges)), strict=True):
        Ad = se3.adjoint(se3.invert(edges[j].T_reference_frame))
        spread = Ad @ relative_covariance(edges[i].reference_id, edges[j].reference_id) @ Ad.T
        difference = predictions[i].localCoordinates(predictions[j])
        total = edges[i].covariance + edges[j].covariance + spread
        distances[i, j] = _mahalanobis(difference, total)
    return distances + distances.T


def _mean(
    twists: Sequence[FloatArray], informations: Sequence[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the weighted mean, shape (6,), of twists (6,), and their spread around it.

    From the mean, a robust kernel weighs each edge close to its final residual. The spread is the
    sum of the squared Mahalanobis lengths of the deviations. It bounds the squared distance of any
    two twists, as (x - y)' (A + B)^-1 (x - y) <= x' A^-1 x + y' B^-1 y.
    """
    # For a few edges a loop takes half the time of stacked arrays.
    weighted = [information @ x for information, x in zip(informations, twists, strict=True)]
    total = sum(weighted, _ZERO)
    mean = dposv(sum(informations, _NOTHING), total)[1]
    squares = sum(float(np.vdot(x, y)) for x, y in zip(twists, weighted, strict=True))
    return mean, squares - float(np.vdot(total, mean))


def _misfit(spread: float, n: int) -> float:
    return spread / (6.0 * (n - 1)) if n > 1 else math.nan


@lru_cache(maxsize=32)
def _pairs(n: int) -> tuple[IntArray, IntArray]:
    rows, columns = np.triu_indices(n, k=1)
    return rows, columns


def _twists(predictions: Sequence[gtsam.Pose3]) -> list[FloatArray]:
    """Return the predictions as twists about the first, shape (6,)."""
    first, *others = predictions
    return [_ZERO, *(first.localCoordinates(prediction) for prediction in others)]


def _distances(twists: Sequence[FloatArray], covariances: Sequence[FloatArray]) -> FloatArray:
    """Return Mahalanobis distances, shape (n, n), between predictions of one pose.

    Differences of twists about one of them are exact if they agree, and large if they do not.
    """
    rows, columns = _pairs(len(twists))
    stacked, spreads = np.array(twists), np.array(covariances)
    differences = stacked[rows] - stacked[columns]
    distances = np.zeros((len(twists), len(twists)))
    distances[rows, columns] = _mahalanobis(differences, spreads[rows] + spreads[columns])
    return distances + distances.T


def _mahalanobis(differences: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the lengths, shape (...), of differences (..., 6) in sigmas."""
    # In units of the sigmas, and slightly inflated: never singular.
    sigmas = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    correlations = covariances / (sigmas[..., :, np.newaxis] * sigmas[..., np.newaxis, :])
    squares = se3.mahalanobis(differences / sigmas, correlations + _TRACE)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


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
        Poses without a usable edge, which continue the last velocity.
    n_restored : int
        Updates in which GTSAM failed; the window was restored.
    n_rebuilt : int
        Times that the graph was made anew from its poses and their covariances.
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


class WindowCounter:
    """Counts what a window accepts and refuses."""

    def __init__(self) -> None:
        self._numbers: Counter[str] = Counter()
        self._first_rejected = ""

    @property
    def counts(self) -> WindowCounts:
        """The counts so far."""
        return WindowCounts(**self._numbers, first_rejected=self._first_rejected)

    def add(self, **numbers: int) -> None:
        """Add numbers to counts of the same names."""
        for name, number in numbers.items():
            self._numbers[name] += number

    def add_pose(self, pose: NewPose) -> None:
        """Count a new pose and its measurements."""
        self.add(
            n_poses=1,
            n_edges=len(pose.measurements),
            n_priors=int(pose.prior is not None),
            n_coasting=int(not pose.is_measured),
            n_gated=pose.n_gated,
        )
        for rejected in pose.rejected:
            self.add_rejected(rejected)

    def add_rejected(self, rejected: Rejected, *, is_gated: bool = False) -> None:
        """Count a refusal."""
        self.add(n_rejected=1, n_gated=int(is_gated))
        self._first_rejected = self._first_rejected or str(rejected)


class Admission:
    """Selects the usable measurements of a new pose, and finds its start value.

    Parameters
    ----------
    graph : WindowGraph
        Of the poses that edges refer to.
    motion : ConstantVelocity
        Predicts a pose without usable measurements.
    """

    def __init__(self, graph: WindowGraph, motion: ConstantVelocity) -> None:
        self._graph, self._motion = graph, motion

    def admit(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None,
        *,
        gate: float | None,
    ) -> NewPose:
        """Return the pose with its valid measurements that pass the gate.

        Parameters
        ----------
        frame_id : hashable
        stamp_ns : int
            Nanoseconds.
        edges : sequence of Edge
        prior : PosePrior or PositionPrior or None
        gate : float or None
            In sigmas of the difference of two edges.
        """
        refuse = partial(_refuse, frame_id, stamp_ns)
        rejected = []
        if prior is not None and (fault := prior_fault(prior)):
            rejected.append(refuse(None, fault))
            prior = None
        usable, invalid = _split(edges, self._faults(frame_id, edges))
        rejected += [refuse(edge, reason) for edge, reason in invalid]
        if not usable:
            return self._unmeasured(frame_id, stamp_ns, prior, rejected)
        measurements = list(map(Measurement.of, usable))
        T_world_references = {
            edge.reference_id: self._graph.pose3(edge.reference_id) for edge in usable
        }
        result = self._gate(measurements, T_world_references, stamp_ns, gate)
        accepted, gated = _split(measurements, result.reasons)
        rejected += [refuse(measurement.edge, reason) for measurement, reason in gated]
        return NewPose(
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            T_world_start=result.T_world_start,
            measurements=accepted,
            T_world_references=T_world_references,
            prior=prior,
            rejected=tuple(rejected),
            n_gated=len(gated),
            misfit=result.misfit,
        )

    def _faults(self, frame_id: FrameId, edges: Sequence[Edge]) -> list[str]:
        """Say for each edge of a new pose why it is unusable; empty if it is usable."""
        poses = self._graph.poses
        return [
            poses.edge_fault(frame_id, edge, is_new=True) or fault
            for edge, fault in zip(edges, find_faults(edges), strict=True)
        ]

    def _gate(
        self,
        measurements: Sequence[Measurement],
        T_world_references: Mapping[FrameId, gtsam.Pose3],
        stamp_ns: int,
        gate: float | None,
    ) -> GateResult:
        def pose_of(frame_id: FrameId) -> gtsam.Pose3:
            known = T_world_references.get(frame_id)
            return self._graph.pose3(frame_id) if known is None else known

        return gate_edges(
            measurements,
            pose_of=pose_of,
            relative_covariance=self._graph.relative_covariance,
            motion=lambda: self._coasting_edge(stamp_ns),
            gate=gate,
        )

    def refuse_all(self, pose: NewPose, reason: str) -> NewPose:
        """Return the pose without measurements; it continues the last velocity."""
        edges: list[Edge | None] = [measurement.edge for measurement in pose.measurements]
        edges += [] if pose.prior is None else [None]
        refused = [_refuse(pose.frame_id, pose.stamp_ns, edge, reason) for edge in edges]
        alone = self._unmeasured(pose.frame_id, pose.stamp_ns, None, [*pose.rejected, *refused])
        return replace(alone, n_gated=pose.n_gated)

    def _unmeasured(
        self, frame_id: FrameId, stamp_ns: int, prior: Prior | None, rejected: Sequence[Rejected]
    ) -> NewPose:
        """Return a pose without edges."""
        T_world_start, support = self._start(stamp_ns, prior)
        return NewPose(
            frame_id=frame_id,
            stamp_ns=stamp_ns,
            T_world_start=T_world_start,
            prior=prior,
            support=support,
            rejected=tuple(rejected),
        )

    def _start(
        self, stamp_ns: int, prior: Prior | None
    ) -> tuple[gtsam.Pose3, Edge | PosePrior | None]:
        """Return the start value of a pose without edges, and what constrains it there."""
        if isinstance(prior, PosePrior):
            return gtsam.Pose3(prior.T_world_frame), None
        if (edge := self._coasting_edge(stamp_ns)) is not None:
            T_world_last = self._graph.pose3(edge.reference_id)
            return T_world_last.compose(gtsam.Pose3(edge.T_reference_frame)), edge
        if (prediction := self._motion.predict_pose(stamp_ns)) is not None:
            support = PosePrior(T_world_frame=prediction[0], covariance=prediction[1])
        elif prior is not None:
            T_world_start = se3.make_transform(np.eye(3), prior.position_world)
            support = PosePrior(T_world_frame=T_world_start, covariance=_UNKNOWN_COVARIANCE)
        else:
            support = ORIGIN
        return gtsam.Pose3(support.T_world_frame), support

    def _coasting_edge(self, stamp_ns: int) -> Edge | None:
        """Return the edge that the last velocity predicts; None if the last pose has left."""
        last = self._motion.last
        if last is None or last.frame_id not in self._graph.poses:
            return None
        T_last_frame, covariance = self._motion.predict_step(stamp_ns)
        return Edge(
            reference_id=last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )


def _split(
    items: Sequence[_Item], reasons: Sequence[str]
) -> tuple[list[_Item], list[tuple[_Item, str]]]:
    """Return the items without a reason, and the others with theirs."""
    pairs = list(zip(items, reasons, strict=True))
    accepted = [item for item, reason in pairs if not reason]
    return accepted, [pair for pair in pairs if pair[1]]


def _refuse(frame_id: FrameId, stamp_ns: int, edge: Edge | None, reason: str) -> Rejected:
    """Return the refusal of an edge of a pose, or of its prior."""
    reference_id = None if edge is None else edge.reference_id
    return Rejected(frame_id=frame_id, stamp_ns=stamp_ns, reason=reason, reference_id=reference_id)
