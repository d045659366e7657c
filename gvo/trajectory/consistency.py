"""Covariances of motions against a reference, as it is and as far as its place can be known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from gvo.geometry import se3
from gvo.trajectory.alignment import MAX_GAP_NS
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, FloatArray, IntArray

SPANS_S = (1, 5)
"""Seconds over which motions are compared."""
N_DOF = 6
"""Degrees of freedom of a pose and of an edge."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motions:
    """Relative poses with their covariances.

    Parameters
    ----------
    name : str
        Whose they are, and over what.
    start_ns, end_ns : ndarray of int64, shape (n,)
        Stamps of the two poses, nanoseconds.
    T_start_end : ndarray of float64, shape (n, 4, 4)
        Metres.
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbations, at the end.
    """

    name: str
    start_ns: IntArray
    end_ns: IntArray
    T_start_end: FloatArray
    covariances: FloatArray

    @classmethod
    def of_chain(cls, chain: Trajectory, first: IntArray, last: IntArray, *, name: str) -> Motions:
        """Return the motions between poses of a chain with covariances: only there they subtract.

        Parameters
        ----------
        chain : Trajectory
            Each pose is the one before, moved by an independent measurement.
        first, last : ndarray of int64, shape (n,)
            Indices.
        name : str
        """
        if chain.covariances is None:
            chain = replace(chain, covariances=np.zeros((len(chain), 6, 6)))
        T_start_end, covariances = chain.motions(first, last)
        return cls(
            name=name,
            start_ns=chain.stamps_ns[first],
            end_ns=chain.stamps_ns[last],
            T_start_end=T_start_end,
            covariances=covariances,
        )


def motions_of_chain(chain: Trajectory, span_s: float = SPANS_S[0]) -> Motions:
    """Return the motions of a raw chain over a span, from each of its poses on."""
    stamps_ns, span_ns = chain.stamps_ns, round(1e9 * span_s)
    last = np.searchsorted(stamps_ns, stamps_ns + span_ns)
    first = np.flatnonzero(last < len(chain))
    first = first[stamps_ns[last[first]] - stamps_ns[first] <= 1.5 * span_ns]
    return Motions.of_chain(chain, first, last[first], name=f"raw over {span_s} s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consistency(Motions):
    """Motions with their errors, and covariances as stated.

    Parameters
    ----------
    errors : ndarray of float64, shape (n, 6)
        (rx, ry, rz, tx, ty, tz), radians and metres: right perturbations of the motions that give
        the true ones.
    """

    errors: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """Stated standard deviations, shape (n, 6)."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    def mean_nees(self) -> tuple[float, float, float]:
        """Return the mean NEES per degree of freedom: rotation, translation, along the way."""
        T, C = self.T_start_end, self.covariances
        # Of a motion in the frame at its end; at rest along the optical axis.
        way = (np.swapaxes(T[:, :3, :3], 1, 2) @ T[:, :3, 3:])[..., 0] + [0.0, 0.0, 1e-9]
        along = np.sum(way * self.errors[:, 3:], axis=1) ** 2
        along /= np.einsum("ni,nij,nj->n", way, C[:, 3:, 3:], way)
        rotation, translation = (
            float(np.mean(se3.mahalanobis(self.errors[:, each], C[:, each, each]))) / 3.0
            for each in (slice(0, 3), slice(3, 6))
        )
        return rotation, translation, float(np.mean(along))

    def as_json(self) -> dict[str, int | float]:
        """Return what `summary.json` holds of it; NEES are means per degree of freedom.

        `low` and `high` bound 95 % of what chance makes of consistent covariances.
        """
        rotation, translation, along = self.mean_nees()
        span_ns = np.median(self.end_ns - self.start_ns)
        # Motions that overlap share their errors.
        n_apart = max(1, int((self.end_ns.max() - self.start_ns.min()) // span_ns))
        n_dof = N_DOF * min(n_apart, len(self.errors))
        return {
            "rotation": rotation,
            "translation": translation,
            "along": along,
            "n": len(self.errors),
            "low": chi2_bound(0.025, n_dof) / n_dof,
            "high": chi2_bound(0.975, n_dof) / n_dof,
            "error_deg": float(np.rad2deg(np.sqrt(np.mean(self.errors[:, :3] ** 2) * 3))),
            "error_m": float(np.sqrt(np.mean(self.errors[:, 3:] ** 2) * 3)),
        }


def consistency(truth: Trajectory, motions: Motions) -> Consistency | None:
    """Compare motions with the true ones, interpolated at their stamps.

    Relative motions are compared, since an error of the first true pose would turn all that
    follows.

    Returns
    -------
    Consistency or None
        None where no motion has both true poses and a covariance, or the truth no rotations.
    """
    if not truth.has_rotations:
        return None
    stamps_ns = np.unique([motions.start_ns, motions.end_ns])
    true = truth.interpolate(stamps_ns, max_gap_ns=MAX_GAP_NS)
    are_known = np.isin([motions.start_ns, motions.end_ns], true.stamps_ns).all(axis=0)
    are_known &= _is_positive(motions.covariances)
    if not are_known.any():
        return None
    start_ns, end_ns = motions.start_ns[are_known], motions.end_ns[are_known]
    T_a, T_b = (true.T_world_frame[np.searchsorted(true.stamps_ns, s)] for s in (start_ns, end_ns))
    T_start_end = motions.T_start_end[are_known]
    return Consistency(
        name=motions.name,
        start_ns=start_ns,
        end_ns=end_ns,
        T_start_end=T_start_end,
        errors=se3.log(se3.invert(T_start_end) @ se3.invert(T_a) @ T_b),
        covariances=motions.covariances[are_known],
    )


def judged(truth: Trajectory, raw: Trajectory, window: Mapping[int, Motions]) -> dict[str, Any]:
    """Return what `summary.json` holds of covariances compared with the truth.

    Parameters
    ----------
    truth : Trajectory
        Poses of the same frame as the motions.
    raw : Trajectory
        The raw chain, with covariances.
    window : mapping of int to Motions
        Those of the window, by their spans in seconds.

    Returns
    -------
    dict
        `nees`, by estimate, span and way: see `Consistency.as_json`.
    """
    motions = {"raw": {s: motions_of_chain(raw, s) for s in SPANS_S}, "window": window}
    ways = {"bare": truth}
    return {
        "nees": {
            name: {
                f"{span_s}s": {
                    way: found.as_json()
                    for way, each in ways.items()
                    if (found := consistency(each, of_span)) is not None
                }
                for span_s, of_span in of_spans.items()
            }
            for name, of_spans in motions.items()
        }
    }


def truth_jump(truth: Trajectory, estimate: Trajectory) -> float | None:
    """Return by how much the noise of true positions moves them from frame to frame, metres.

    Of how a step differs from the one before, the motion is in both trajectories; what of it the
    truth has alone is its own noise, what the estimate has alone is not counted.

    Returns
    -------
    float or None
        None for fewer than three poses in common, or without rotations.
    """
    true = truth.interpolate(estimate.stamps_ns, max_gap_ns=MAX_GAP_NS)
    poses = estimate.select(np.isin(estimate.stamps_ns, true.stamps_ns)).T_world_frame
    if len(poses) < 3 or not (truth.has_rotations and estimate.has_rotations):
        return None
    true_steps, steps = (se3.invert(T[:-1]) @ T[1:] for T in (true.T_world_frame, poses))
    changes, others = (np.diff(each[:, :3, 3], axis=0) for each in (true_steps, steps))
    # the median, as an estimate that is lost does not share the motion; noise of a position has
    # the variance 2 in a step, 6 in the difference of two
    shared = np.median(np.sum(changes * (changes - others), axis=1))
    return float(np.sqrt(max(shared, 0.0) / 3.0))


def _is_positive(covariances: FloatArray) -> BoolArray:
    # normalized by the sigmas: metres and radians have different scales
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    scales = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    unit = covariances / (scales[:, :, np.newaxis] * scales[:, np.newaxis])
    smallest = np.linalg.eigvalsh(unit)[:, 0]
    return np.asarray(np.all(variances > 0.0, axis=1) & (smallest > 1e-12))


def chi2_bound(share: float, n_dof: int = N_DOF) -> float:
    """Return a quantile of chi-square, by default with 6 degrees of freedom.

    Examples
    --------
    >>> round(chi2_bound(0.95), 3)
    12.592
    """
    # scipy.stats takes longer to import than a report to write
    return 2.0 * float(gammaincinv(0.5 * n_dof, share))
