"""Which edges of a new pose are accepted, and where it starts.

No robust kernel recovers from a start value at a gross outlier, so a single bad edge must not
determine the start, and is better refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations, compress
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg.lapack import dposv

from gvo.backend.factors import Measurement
from gvo.geometry import se3
from gvo.geometry.edges import chi2
from gvo.types import BoolArray, Edge, FloatArray, FrameId

# Sigmas of the difference of two edges, a 6-vector: 99.9 % of correct ones are below.
_AGREEMENT = 5.0
_TRACE = 1e-9 * np.eye(6)
_ZERO = np.zeros(6)
_NOTHING = np.zeros((6, 6))


class Prediction(NamedTuple):
    """An edge of a new pose, and where it leads."""

    measurement: Measurement
    T_world_frame: gtsam.Pose3

    @property
    def edge(self) -> Edge:
        """The edge."""
        return self.measurement.edge


class Gated(NamedTuple):
    """The start value of a pose, its accepted edges, and the others with the reasons.

    The start is the weighted mean of the predictions that agree with their medoid.
    """

    T_world_start: gtsam.Pose3
    accepted: list[Measurement]
    refused: list[tuple[Edge, str]]


def gate_edges(
    predictions: Sequence[Prediction],
    *,
    relative_covariance: Callable[[FrameId, FrameId], FloatArray],
    motion: Callable[[], Prediction | None],
    gate: float | None,
) -> Gated:
    """Gate the edges of a new pose against each other, and find its start value.

    An edge is refused if it disagrees with the medoid of the predictions by more than the gate,
    and if more of the edges (and the predicted motion) agree with the medoid than with it. The
    uncertainty between the references is taken into account: a loop that closes after a long
    drift disagrees with the drift, and is right.

    Parameters
    ----------
    predictions : sequence of Prediction
        At least one, of valid edges.
    relative_covariance : callable
        Returns the covariance (6, 6) of the pose of the second reference in the first. Called
        only when edges disagree.
    motion : callable
        Returns the edge that the last velocity predicts, or None. Called only when edges
        disagree.
    gate : float or None
        In sigmas of the difference of two predictions; None refuses nothing.
    """
    near, reasons = list(predictions), [""] * len(predictions)
    T_world_start, spread, twists = _fit(near)
    if spread > min(_AGREEMENT, gate or _AGREEMENT) ** 2:
        distances = _distances(twists, [each.edge.covariance for each in predictions])
        if gate is not None and distances.max() > gate:
            voters = [*predictions, *filter(None, [motion()])]
            reasons = _outvoted(voters, len(predictions), relative_covariance, gate=gate)
        is_accepted = np.array([not reason for reason in reasons])
        near = [*compress(predictions, _near_medoid(distances, is_accepted))]
        T_world_start, _, _ = _fit(near)
    pairs = list(zip(predictions, reasons, strict=True))
    return Gated(
        T_world_start=T_world_start,
        accepted=[each.measurement for each, reason in pairs if not reason],
        refused=[(each.edge, reason) for each, reason in pairs if reason],
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
    sigmas = math.sqrt(max(chi2(edge, T_reference_frame, covariance), 0.0))
    if sigmas <= gate:
        return ""
    return f"it disagrees by {sigmas:.3g} sigma with the window (window.gate: {gate:g})"


def _outvoted(
    voters: Sequence[Prediction],
    n: int,
    relative_covariance: Callable[[FrameId, FrameId], FloatArray],
    *,
    gate: float,
) -> list[str]:
    """Say for each of the first n edges why the others outvote it; empty if they do not.

    The predicted motion may come after them: it has the casting vote between two edges.
    """
    distances = np.zeros((len(voters), len(voters)))
    for (i, one), (j, other) in combinations(enumerate(voters), 2):
        Ad = se3.adjoint(se3.invert(other.edge.T_reference_frame))
        spread = Ad @ relative_covariance(one.edge.reference_id, other.edge.reference_id) @ Ad.T
        difference = one.T_world_frame.localCoordinates(other.T_world_frame)
        total = one.edge.covariance + other.edge.covariance + spread
        distances[i, j] = distances[j, i] = _mahalanobis(difference, total)
    # Capped, so that a far outlier weighs no more than a near one.
    medoid = int(np.minimum(distances, gate).sum(axis=1)[:n].argmin())
    n_agreeing = np.count_nonzero(distances <= gate, axis=1)
    is_out = (distances[medoid] > gate) & (n_agreeing < n_agreeing[medoid])
    return [
        f"it disagrees by {distances[medoid, index]:.3g} sigma with the edge from "
        f"{voters[medoid].edge.reference_id!r} (window.gate: {gate:g})"
        if is_out[index]
        else ""
        for index in range(n)
    ]


def _near_medoid(distances: FloatArray, is_accepted: BoolArray) -> BoolArray:
    """Tell which accepted predictions agree with the medoid of these."""
    capped = np.minimum(distances, _AGREEMENT)[:, is_accepted].sum(axis=1)
    medoid = int(np.where(is_accepted, capped, np.inf).argmin())
    return np.asarray((distances[medoid] <= _AGREEMENT) & is_accepted)


def misfit(predictions: Sequence[Prediction]) -> float:
    """Return how far predictions of a pose lie from their mean, per degree of freedom.

    In squared sigmas; NaN of less than two.
    """
    if len(predictions) < 2:
        return math.nan
    return _fit(predictions)[1] / (6.0 * (len(predictions) - 1))


def _fit(predictions: Sequence[Prediction]) -> tuple[gtsam.Pose3, float, list[FloatArray]]:
    """Return the weighted mean of predictions, their spread, and their twists about the first.

    From the mean, a robust kernel weighs each edge close to its final residual. The spread is the
    sum of the squared Mahalanobis lengths of the deviations. It bounds the squared distance of any
    two twists, as (x - y)' (A + B)^-1 (x - y) <= x' A^-1 x + y' B^-1 y.
    """
    first = predictions[0].T_world_frame
    twists, total, information, squares = [], _ZERO, _NOTHING, 0.0
    # For a few edges a loop takes half the time of stacked arrays.
    for measurement, T_world_frame in predictions:
        x, of_one = first.localCoordinates(T_world_frame), measurement.gaussian.information()
        weighted = of_one @ x
        total, information = total + weighted, information + of_one
        squares += float(x @ weighted)
        twists.append(x)
    mean = dposv(information, total)[1]
    return first.retract(mean), squares - float(total @ mean), twists


def _distances(twists: Sequence[FloatArray], covariances: Sequence[FloatArray]) -> FloatArray:
    """Return Mahalanobis distances, shape (n, n), between predictions of one pose.

    Differences of twists about one of them are exact if they agree, and large if they do not.
    """
    x, C = np.array(twists), np.array(covariances)
    return _mahalanobis(x[:, np.newaxis] - x, C[:, np.newaxis] + C)


def _mahalanobis(differences: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the lengths, shape (...), of differences (..., 6) in sigmas."""
    # In units of the sigmas, and slightly inflated: never singular.
    sigmas = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    correlations = covariances / (sigmas[..., :, np.newaxis] * sigmas[..., np.newaxis, :])
    squares = se3.mahalanobis(differences / sigmas, correlations + _TRACE)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))
