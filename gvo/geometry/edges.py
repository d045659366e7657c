"""The algebra of uncertain relative poses: an `Edge` after another, turned round, fused, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from gvo.geometry import se3
from gvo.types import Edge, FloatArray, FrameId

NO_EFFECTS: Final = np.zeros((6, 1))
"""Of a pose or an edge that shared errors do not move."""


def source_ns(edge: Edge) -> int:
    """Return the stamp that names the reference of an edge."""
    return int(edge.reference_id)  # type: ignore[call-overload, no-any-return]


def then(first: Edge, second: Edge) -> Edge:
    """Return an edge and the independent one that goes on from its end, as one edge.

    Parameters
    ----------
    first : Edge
        Measures the reference of `second`.
    second : Edge

    Returns
    -------
    Edge
        From the reference of `first` to the frame of `second`, with the kernel of `second`.
    """
    T = second.T_reference_frame
    return replace(
        second,
        reference_id=first.reference_id,
        T_reference_frame=first.T_reference_frame @ T,
        covariance=se3.compose_covariance(first.covariance, T, second.covariance),
        effects=gone_on(first.effects, second),
    )


def gone_on(effects: FloatArray | None, edge: Edge) -> FloatArray | None:
    """Return the effects of shared errors at the end of an edge, by those at its reference.

    None: there are none, as at the first pose of all, or along an edge that does not say.
    """
    if effects is None:
        return edge.effects
    moved = np.asarray(se3.adjoint(se3.invert(edge.T_reference_frame)) @ effects)
    return moved if edge.effects is None else moved + edge.effects


def between(start: FloatArray, end: FloatArray, T_start_end: FloatArray) -> FloatArray:
    """Return the effects of shared errors on relative poses (..., 6, k), by those on both ends."""
    return np.asarray(end - se3.adjoint(se3.invert(T_start_end)) @ start)


def inverse(edge: Edge, frame_id: FrameId) -> Edge:
    """Return an edge seen from its other end.

    Parameters
    ----------
    edge : Edge
        Measures `frame_id` in its reference.
    frame_id : hashable
        The reference of the result.

    Returns
    -------
    Edge
        The same measurement of the former reference; its residuals have the same chi-square.
    """
    T = edge.T_reference_frame
    # (T exp(d))^-1 = T^-1 exp(-Ad_T d)
    covariance = se3.transport_covariance(edge.covariance, T)
    return replace(
        edge,
        reference_id=frame_id,
        T_reference_frame=se3.invert(T),
        covariance=0.5 * (covariance + covariance.T),
        effects=None if edge.effects is None else -se3.adjoint(T) @ edge.effects,
    )


def fuse(edges: Sequence[Edge]) -> Edge:
    """Return independent edges from one reference to one frame as one edge.

    Parameters
    ----------
    edges : sequence of Edge
        At least one. They should agree: the means are taken in the tangent space of the first
        ones.

    Returns
    -------
    Edge
        Of the least sum of squares, with the reference and the kernel of the last.
    """
    T, covariance, effects = edges[0].T_reference_frame, edges[0].covariance, edges[0].effects
    for edge in edges[1:]:
        gain = covariance @ np.linalg.inv(covariance + edge.covariance)
        T = se3.normalize(T @ se3.exp(gain @ se3.log(se3.invert(T) @ edge.T_reference_frame)))
        covariance = gain @ edge.covariance
        covariance = 0.5 * (covariance + covariance.T)
        if effects is not None:
            effects = effects - gain @ effects
        if edge.effects is not None:
            effects = (0.0 if effects is None else effects) + gain @ edge.effects
    return replace(edges[-1], T_reference_frame=T, covariance=covariance, effects=effects)


def chi2(edge: Edge, T_reference_frame: FloatArray, covariance: FloatArray | None = None) -> float:
    """Return by how many squared sigmas an edge differs from a known relative pose.

    Parameters
    ----------
    edge : Edge
    T_reference_frame : ndarray of float64, shape (4, 4)
        The known one, in metres.
    covariance : ndarray of float64, shape (6, 6), optional
        Of T_reference_frame, independent of the edge; omitted, it is exact.

    Returns
    -------
    float
        Chi-square distributed with six degrees of freedom where both covariances are true.
    """
    residual = se3.log(se3.invert(edge.T_reference_frame) @ T_reference_frame)
    both = edge.covariance if covariance is None else edge.covariance + covariance
    return float(se3.mahalanobis(residual, both))
