"""Covariances of motions against a reference, as it is and as far as its place can be known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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

_MIN_MOTIONS = 20.0  # that do not overlap
# Before any motion: of the rotation in radians, the lever arm in metres, the delay in seconds.
_PRIOR_SIGMAS = np.array([np.deg2rad(0.6)] * 3 + [0.02] * 3 + [0.01])
_AROUND_NS = 20_000_000  # the velocity of the truth is that over twice this, at least
# The last is that of a normal distribution: sigma over median deviation.
_N_STEPS, _HUBER_SIGMAS, _SIGMA_OF_MEDIAN = 6, 3.0, 1.4826


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motions:
    """Relative poses with their covariances.

    Parameters
    ----------
    start_ns, end_ns : ndarray of int64, shape (n,)
        Stamps of the two poses, nanoseconds.
    T_start_end : ndarray of float64, shape (n, 4, 4)
        Metres.
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbations, at the end.
    """

    start_ns: IntArray
    end_ns: IntArray
    T_start_end: FloatArray
    covariances: FloatArray


def motions_of_chain(chain: Trajectory, span_s: float = SPANS_S[0]) -> Motions:
    """Return the motions of a raw chain over a span, from each of its poses on.

    Without covariances of its poses those of the motions are zeros.
    """
    if chain.covariances is None:
        chain = replace(chain, covariances=np.zeros((len(chain), 6, 6)))
    stamps_ns, span_ns = chain.stamps_ns, round(1e9 * span_s)
    last = np.searchsorted(stamps_ns, stamps_ns + span_ns)
    first = np.flatnonzero(last < len(chain))
    first = first[stamps_ns[last[first]] - stamps_ns[first] <= 1.5 * span_ns]
    start_ns, end_ns = stamps_ns[first], stamps_ns[last[first]]
    T, covariances = chain.motions(first, last[first])
    return Motions(start_ns=start_ns, end_ns=end_ns, T_start_end=T, covariances=covariances)


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
        # Of a motion in the frame at its end; at rest along z.
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
        # Motions that overlap share their errors.
        n_dof = N_DOF * max(1.0, float(np.sum(_shares(self))))
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
        start_ns=start_ns,
        end_ns=end_ns,
        T_start_end=T_start_end,
        errors=se3.log(se3.invert(T_start_end) @ se3.invert(T_a) @ T_b),
        covariances=motions.covariances[are_known],
    )


class Reference(NamedTuple):
    """Where the frame of true poses lies on the frame of an estimate, and their delay.

    Parameters
    ----------
    values, sigmas : ndarray of float64, shape (7,)
        Rotation vector of T_reference_frame in radians, its translation in metres, and by how much
        the stamps of the reference are late, seconds.
    """

    values: FloatArray
    sigmas: FloatArray

    def corrected(self, truth: Trajectory) -> Trajectory:
        """Return the true poses of the frame of the estimate, with its stamps."""
        T_reference_frame = se3.exp(np.concatenate([self.values[:3], np.zeros(3)]))
        T_reference_frame[:3, 3] = self.values[3:6]
        stamps_ns = truth.stamps_ns - round(1e9 * self.values[6])
        return replace(truth.transformed(T_reference_frame), stamps_ns=stamps_ns)

    def as_json(self) -> dict[str, Any]:
        """Return what `summary.json` holds of it."""
        to_units = np.repeat([np.rad2deg(1.0), 1.0, 1e3], [3, 3, 1])
        values, sigmas = (
            {"rotation_deg": each[:3], "lever_m": each[3:6], "delay_ms": each[6]}
            for each in ((to_units * self.values).tolist(), (to_units * self.sigmas).tolist())
        )
        return values | {"sigmas": sigmas}


def fit_reference(truth: Trajectory, motions: Motions) -> Reference | None:
    """Fit where the reference lies on the frame of motions, and its delay, by Gauss-Newton.

    Errors of motions depend on both. By how much the others are larger than stated is taken for
    noise of the reference, with the weights of Huber. Motions that overlap count as one.

    Parameters
    ----------
    truth : Trajectory
        Poses of the reference.
    motions : Motions
        Over equal spans.

    Returns
    -------
    Reference or None
        None of fewer than 20 motions that do not overlap.
    """
    values, sigmas = np.zeros(7), _PRIOR_SIGMAS
    for _ in range(_N_STEPS):
        corrected = Reference(values, sigmas).corrected(truth)
        found = consistency(corrected, motions)
        if found is None or np.sum(weights := _shares(found)) < _MIN_MOTIONS:
            return None
        spread = _SIGMA_OF_MEDIAN * np.median(np.abs(found.errors), axis=0)
        more = np.maximum(spread**2 - np.median(found.sigmas, axis=0) ** 2, 0.0)
        C = found.covariances + np.diag(more)
        sizes = np.sqrt(se3.mahalanobis(found.errors, C))
        weights *= _HUBER_SIGMAS / np.maximum(sizes, _HUBER_SIGMAS)
        J = _derivatives(corrected, found)
        weighted = np.swapaxes(J, 1, 2) @ np.linalg.inv(C) * weights[:, np.newaxis, np.newaxis]
        H = np.diag(_PRIOR_SIGMAS**-2) + np.sum(weighted @ J, axis=0)
        gradient = values / _PRIOR_SIGMAS**2 + np.einsum("nij,nj->i", weighted, found.errors)
        values = values - np.linalg.solve(H, gradient)
        sigmas = np.sqrt(np.diag(np.linalg.inv(H)))
    return Reference(values, sigmas)


def _shares(motions: Motions) -> FloatArray:
    """Return one over how many motions each overlaps with by half or more, itself too."""
    half_ns = int(np.median(motions.end_ns - motions.start_ns)) // 2
    starts_ns = np.sort(motions.start_ns)
    first = np.searchsorted(starts_ns, motions.start_ns - half_ns)
    last = np.searchsorted(starts_ns, motions.start_ns + half_ns)
    return 1.0 / (last - first)


def _derivatives(truth: Trajectory, found: Consistency) -> FloatArray:
    """Return those of the errors by rotation, lever arm and delay, shape (n, 6, 7)."""
    Ad = se3.adjoint(se3.invert(found.T_start_end))
    at_start, at_end = (_velocities(truth, each) for each in (found.start_ns, found.end_ns))
    by_delay = at_end - (Ad @ at_start[..., np.newaxis])[..., 0]
    return np.concatenate([np.eye(6) - Ad, by_delay[..., np.newaxis]], axis=2)


def _velocities(truth: Trajectory, stamps_ns: IntArray) -> FloatArray:
    """Return twists per second of interpolated poses, shape (n, 6)."""
    # Not by the poses beside a stamp: their noise is in the errors, too, and would bias the delay.
    known_ns = truth.stamps_ns
    a = np.maximum(np.searchsorted(known_ns, stamps_ns - _AROUND_NS) - 2, 0)
    b = np.minimum(np.searchsorted(known_ns, stamps_ns + _AROUND_NS) + 1, len(truth) - 1)
    twists = se3.log(se3.invert(truth.T_world_frame[a]) @ truth.T_world_frame[b])
    return np.asarray(twists / (1e-9 * (known_ns[b] - known_ns[a]))[:, np.newaxis])


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
        `nees`, by estimate, span and way ("bare", "fitted"): see `Consistency.as_json`;
        `reference`, fitted to the window's motions over the shortest span, or "too short to fit";
        `truth_jump_m`.
    """
    found: dict[str, Any] = {"truth_jump_m": truth_jump(truth, raw), "reference": None, "nees": {}}
    if not truth.has_rotations:
        return found
    # The errors of the raw chain are larger, and go with the motion as those of a reference do.
    reference = fit_reference(truth, window[SPANS_S[0]])
    found["reference"] = reference.as_json() if reference else "too short to fit"
    ways = {"bare": truth} | ({"fitted": reference.corrected(truth)} if reference else {})
    of_chain = {span_s: motions_of_chain(raw, span_s) for span_s in SPANS_S}
    for name, of_spans in {"raw": of_chain, "window": window}.items():
        found["nees"][name] = of_name = {}
        for span_s, motions in of_spans.items():
            rows = {way: consistency(each, motions) for way, each in ways.items()}
            of_name[f"{span_s}s"] = {way: row.as_json() for way, row in rows.items() if row}
    return found


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


def chi2_bound(share: float, n_dof: float = N_DOF) -> float:
    """Return a quantile of chi-square, by default with 6 degrees of freedom.

    Examples
    --------
    >>> round(chi2_bound(0.95), 3)
    12.592
    """
    # scipy.stats takes longer to import than a report to write
    return 2.0 * float(gammaincinv(0.5 * n_dof, share))
