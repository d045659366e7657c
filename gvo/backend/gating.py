"""Which edges of a new pose agree: where to start, and which one to refuse.

No robust kernel leaves the wrong side of a gross outlier, so a single bad edge must not decide
where the optimization starts, and is better not let in at all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress

import gtsam
import numpy as np
from scipy.linalg.lapack import dposv

from gvo.backend.factors import Measurement
from gvo.backend.motion_model import Motion
from gvo.backend.validation import find_faults, prior_fault
from gvo.backend.window_graph import ORIGIN, Arrival, WindowGraph
from gvo.geometry import se3
from gvo.types import (
    BoolArray,
    Edge,
    FloatArray,
    FrameId,
    IntArray,
    PosePrior,
    PositionPrior,
    Prior,
    Rejected,
)

# Sigmas of the difference of two edges, a 6-vector: all but a thousandth of good ones.
_AGREEMENT = 5.0
_TRACE = 1e-9 * np.eye(6)
_ZERO = np.zeros(6)
_NOTHING = np.zeros((6, 6))
# Of a first pose of which the position alone is known: radians, and metres beside its prior.
_UNKNOWN_SIGMAS = np.repeat([1.0, 1e4], 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """What the edges of one pose say together.

    Parameters
    ----------
    T_world_start : gtsam.Pose3
        Mean of the predictions that agree with the one most agree with, their medoid.
    reasons : list of str
        For each edge why it is refused; empty where it is not.
    """

    T_world_start: gtsam.Pose3
    reasons: list[str]


def judge(
    measurements: Sequence[Measurement],
    *,
    pose_of: Callable[[FrameId], gtsam.Pose3],
    relative_covariance: Callable[[FrameId, FrameId], FloatArray],
    motion: Callable[[], Edge | None],
    gate: float | None,
) -> Verdict:
    """Find where the edges of a new pose agree, and which of them do not.

    An edge is refused when it disagrees with the medoid by more than the gate, and more of the
    edges (and of the motion so far) agree with the medoid than with it. What the references
    themselves are uncertain of counts as agreement: a loop that closes after a long drift
    disagrees with the drift, and is right.

    Parameters
    ----------
    measurements : sequence of Measurement
        At least one, of valid edges.
    pose_of : callable
        Returns the present pose of a reference, T_world_reference.
    relative_covariance : callable
        Returns the covariance (6, 6) of the pose of the second reference in the first. Called
        only when edges disagree.
    motion : callable
        Returns the edge that the motion so far predicts, or None. Called only when edges
        disagree.
    gate : float or None
        In sigmas of the difference of two predictions; None refuses nothing.
    """
    predictions = [_predict(measurement, pose_of) for measurement in measurements]
    if len(measurements) == 1:
        return Verdict(T_world_start=predictions[0], reasons=[""])
    informations = [measurement.gaussian.information() for measurement in measurements]
    twists = _twists(predictions)
    reasons = [""] * len(measurements)
    mean, spread = _mean(twists, informations)
    if spread <= min(_AGREEMENT, gate or _AGREEMENT) ** 2:
        return Verdict(T_world_start=predictions[0].retract(mean), reasons=reasons)
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
    is_near = _are_near_medoid(distances).tolist()
    mean, _ = _mean(list(compress(twists, is_near)), list(compress(informations, is_near)))
    return Verdict(T_world_start=predictions[0].retract(mean), reasons=reasons)


def disagreement(
    edge: Edge, T_reference_frame: FloatArray, covariance: FloatArray, *, gate: float
) -> str:
    """Return why an edge contradicts what is known of its two poses; empty where it does not.

    Parameters
    ----------
    edge : Edge
    T_reference_frame : ndarray of float64, shape (4, 4)
        As known.
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
    """Return for each edge why the others outvote it; empty where they do not.

    Where two edges disagree, the motion so far, behind them, has the casting vote.
    """
    n = len(measurements)
    # Capped: how far off an outlier is must not weigh more than that it is one.
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
    """Return Mahalanobis distances, shape (n, n), that know how sure the references are."""
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


def _are_near_medoid(distances: FloatArray) -> BoolArray:
    """Tell which predictions, shape (n,), agree with the one that most agree with."""
    medoid = int(np.minimum(distances, _AGREEMENT).sum(axis=1).argmin())
    return np.asarray(distances[medoid] <= _AGREEMENT)


def _mean(
    twists: Sequence[FloatArray], informations: Sequence[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the weighted mean, shape (6,), of twists (6,), and how far they lie around it.

    By such a start a robust kernel weighs each edge near where it will be, not from where one of
    them was. The spread is the sum of the squared lengths of the deviations, in sigmas. No two of
    the twists are farther apart, as (x - y)' (A + B)^-1 (x - y) <= x' A^-1 x + y' B^-1 y.
    """
    # One by one: for a few edges that takes half the time of stacking them.
    weighted = [information @ x for information, x in zip(informations, twists, strict=True)]
    total = sum(weighted, _ZERO)
    mean = dposv(sum(informations, _NOTHING), total)[1]
    squares = sum(float(np.vdot(x, y)) for x, y in zip(twists, weighted, strict=True))
    return mean, squares - float(np.vdot(total, mean))


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

    Differences of twists about one of them are exact where they agree, large where they do not.
    """
    rows, columns = _pairs(len(twists))
    stacked, spreads = np.array(twists), np.array(covariances)
    differences = stacked[rows] - stacked[columns]
    distances = np.zeros((len(twists), len(twists)))
    distances[rows, columns] = _mahalanobis(differences, spreads[rows] + spreads[columns])
    return distances + distances.T


def _mahalanobis(differences: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the lengths, shape (...), of differences (..., 6) in sigmas."""
    # In units of the sigmas, and a trace wider than they: never singular.
    sigmas = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    correlations = covariances / (sigmas[..., :, np.newaxis] * sigmas[..., np.newaxis, :])
    squares = se3.mahalanobis(differences / sigmas, correlations + _TRACE)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowCounts:
    """What a window has taken and refused so far.

    Parameters
    ----------
    n_poses, n_edges, n_priors : int
        Taken in.
    n_rejected : int
        Edges and priors refused, those below among them.
    n_gated : int
        Edges refused because the others disagree with them.
    n_coasting : int
        Poses without a usable edge, which continue the last velocity.
    n_restored : int
        Updates that GTSAM gave up; the window went back to where it was before.
    n_rebuilt : int
        Times that the graph was made anew from its poses and their covariances.
    first_rejected : str
        The first refusal; empty where there was none.
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


class Ledger:
    """Counts what happens in a window."""

    def __init__(self) -> None:
        self._numbers: Counter[str] = Counter()
        self._first_rejected = ""

    @property
    def counts(self) -> WindowCounts:
        """What happened so far."""
        return WindowCounts(**self._numbers, first_rejected=self._first_rejected)

    def add(self, **numbers: int) -> None:
        """Add to counts by their names."""
        for name, number in numbers.items():
            self._numbers[name] += number

    def reject(
        self,
        frame_id: FrameId,
        stamp_ns: int | None,
        reason: str,
        *,
        reference_id: FrameId = None,
        is_gated: bool = False,
    ) -> Rejected:
        """Count a refusal and return it."""
        rejected = Rejected(
            frame_id=frame_id, stamp_ns=stamp_ns, reason=reason, reference_id=reference_id
        )
        self.add(n_rejected=1, n_gated=int(is_gated))
        self._first_rejected = self._first_rejected or str(rejected)
        return rejected


class Reception:
    """Sorts the measurements of new poses out; what it refuses is counted.

    Parameters
    ----------
    graph : WindowGraph
        The poses that edges refer to.
    motion : Motion
        Of the poses so far; leads where measurements do not.
    ledger : Ledger
    """

    def __init__(self, graph: WindowGraph, motion: Motion, ledger: Ledger) -> None:
        self._graph = graph
        self._motion = motion
        self._ledger = ledger
        self._n_keys = 0

    def receive(
        self,
        frame_id: FrameId,
        stamp_ns: int,
        edges: Sequence[Edge],
        prior: Prior | None,
        *,
        gate: float | None,
    ) -> Arrival:
        """Sort out what is usable, and find where to start.

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
        arrival = Arrival(frame_id=frame_id, key=self._n_keys, stamp_ns=stamp_ns)
        self._n_keys += 1
        if prior is not None:
            self._receive_prior(arrival, prior)
        valid, members = [], self._graph.members
        for edge, fault in zip(edges, find_faults(edges), strict=True):
            reason = members.tie_fault(frame_id, edge, is_new=True) or fault
            if reason:
                self.refuse(arrival, edge, reason)
            else:
                valid.append(edge)
        if valid:
            self._receive_edges(arrival, valid, gate)
        else:
            self._start_without_edges(arrival)
        return arrival

    def drop_measurements(self, arrival: Arrival, reason: str) -> None:
        """Refuse all measurements of a pose; it continues the last velocity."""
        edges = [measurement.edge for measurement in arrival.measurements]
        for edge in [*edges, *(None for _ in arrival.priors)]:
            self.refuse(arrival, edge, reason)
        arrival.measurements, arrival.priors = [], []
        arrival.anchor, arrival.is_origin = None, False
        self._start_without_edges(arrival)

    def refuse(
        self, arrival: Arrival, edge: Edge | None, reason: str, *, is_gated: bool = False
    ) -> None:
        """Refuse an edge of a new pose, or its prior."""
        arrival.rejected.append(
            self._ledger.reject(
                arrival.frame_id,
                arrival.stamp_ns,
                reason,
                reference_id=None if edge is None else edge.reference_id,
                is_gated=is_gated,
            )
        )

    def _receive_prior(self, arrival: Arrival, prior: Prior) -> None:
        if fault := prior_fault(prior):
            self.refuse(arrival, None, fault)
        else:
            arrival.priors.append(prior)

    def _receive_edges(self, arrival: Arrival, edges: list[Edge], gate: float | None) -> None:
        measurements = [Measurement.of(edge) for edge in edges]
        verdict = self._judge(arrival, measurements, gate)
        arrival.T_world_start = verdict.T_world_start
        for measurement, reason in zip(measurements, verdict.reasons, strict=True):
            if reason:
                self.refuse(arrival, measurement.edge, reason, is_gated=True)
            else:
                arrival.measurements.append(measurement)

    def _judge(
        self, arrival: Arrival, measurements: list[Measurement], gate: float | None
    ) -> Verdict:
        known = arrival.T_world_references

        def pose_of(frame_id: FrameId) -> gtsam.Pose3:
            if frame_id not in known:
                known[frame_id] = self._graph.pose3(frame_id)
            return known[frame_id]

        return judge(
            measurements,
            pose_of=pose_of,
            relative_covariance=self._graph.relative_covariance,
            motion=lambda: self._coasting_edge(arrival.stamp_ns),
            gate=gate,
        )

    def _coasting_edge(self, stamp_ns: int) -> Edge | None:
        """Return the edge from the last pose, where it is in the window, by the velocity so far."""
        last = self._motion.last
        if last is None or last.frame_id not in self._graph.members:
            return None
        T_last_frame, covariance = self._motion.predict_step(stamp_ns)
        return Edge(
            reference_id=last.frame_id,
            T_reference_frame=T_last_frame,
            covariance=covariance,
            kernel="none",
        )

    def _start_without_edges(self, arrival: Arrival) -> None:
        """Start at the prior, else at the origin, else where the last velocity leads."""
        prior = arrival.priors[0] if arrival.priors else None
        if isinstance(prior, PosePrior):
            arrival.T_world_start = gtsam.Pose3(prior.T_world_frame)
        elif self._motion.last is not None:
            self._coast(arrival)
        elif isinstance(prior, PositionPrior):
            arrival.T_world_start = gtsam.Pose3(gtsam.Rot3(), prior.position_world)
            arrival.anchor = PosePrior(
                T_world_frame=arrival.T_world_start.matrix(), covariance=np.diag(_UNKNOWN_SIGMAS**2)
            )
        else:
            arrival.anchor, arrival.is_origin = ORIGIN, True

    def _coast(self, arrival: Arrival) -> None:
        """Tie the pose to the last one by the velocity so far."""
        arrival.coasting = self._coasting_edge(arrival.stamp_ns)
        if arrival.coasting is not None:
            T_last_frame = gtsam.Pose3(arrival.coasting.T_reference_frame)
            T_world_last = self._graph.pose3(arrival.coasting.reference_id)
            arrival.T_world_start = T_world_last.compose(T_last_frame)
        elif (prediction := self._motion.predict_pose(arrival.stamp_ns)) is not None:
            arrival.T_world_start = gtsam.Pose3(prediction[0])
            arrival.anchor = PosePrior(T_world_frame=prediction[0], covariance=prediction[1])
