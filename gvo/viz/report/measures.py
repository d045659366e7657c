"""Errors, drift and consistency of estimates, as arrays to be drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import MAX_GAP_NS, AlignMode, alignment, pair
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, KITTI_STEP, segment_errors
from gvo.trajectory.trajectory import Trajectory
from gvo.types import BoolArray, FloatArray, IntArray

N_DOF = 6
"""Degrees of freedom of a pose and of an edge."""

_MIN_PATH_M = 0.1
_MAX_STARTS = 2000
_N_LENGTHS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """An estimate compared with its reference.

    Parameters
    ----------
    name : str
        Of the estimate.
    trajectory : Trajectory
        The whole estimate, aligned.
    reference, estimate : Trajectory
        The n associated poses of each, aligned.
    errors_m : ndarray of float64, shape (n,)
        Position errors, metres.
    errors_rad : ndarray of float64, shape (n,), or None
        Angles between the rotations since the first associated pose; None without rotations.
    """

    name: str
    trajectory: Trajectory
    reference: Trajectory
    estimate: Trajectory
    errors_m: FloatArray
    errors_rad: FloatArray | None

    @property
    def ate_m(self) -> float:
        """Root mean square of the position errors, metres."""
        return float(np.sqrt(np.mean(self.errors_m**2)))


def compare(truth: Trajectory, estimate: Trajectory, *, name: str, align: AlignMode) -> Comparison:
    """Associate and align an estimate, and compute its error at each pose.

    Rotations are compared since the first associated pose, not after alignment, which leaves the
    roll about a straight path undetermined.

    Raises
    ------
    TrajectoryError
        When nothing can be associated.
    """
    ref, est = _paired(truth, estimate, name)
    similarity = alignment(ref, est, align)
    moved = similarity.apply(est)
    errors_rad = None
    if ref.has_rotations and est.has_rotations:
        turned = [se3.invert(t.T_world_frame[:1]) @ t.T_world_frame for t in (ref, est)]
        errors_rad = se3.rotation_angle(se3.invert(turned[0]) @ turned[1])
    return Comparison(
        name=name,
        trajectory=similarity.apply(estimate),
        reference=ref,
        estimate=moved,
        errors_m=np.linalg.norm(ref.positions - moved.positions, axis=1),
        errors_rad=errors_rad,
    )


def _paired(truth: Trajectory, estimate: Trajectory, name: str) -> tuple[Trajectory, Trajectory]:
    try:
        return pair(truth, estimate, name=name)
    except TrajectoryError:
        if truth.stamps_from != "file":
            raise
        # the file may hold poses of a topic, of another rate and phase
        return pair(replace(truth, stamps_from="topic"), estimate, name=name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """Mean errors over segments of the path, by length.

    Parameters
    ----------
    lengths_m : ndarray of float64, shape (k,)
        Metres.
    translations_pct : ndarray of float64, shape (k,)
        Percent of the length.
    rotations_deg_per_m : ndarray of float64, shape (k,)
    n_segments : ndarray of int64, shape (k,)
    """

    lengths_m: FloatArray
    translations_pct: FloatArray
    rotations_deg_per_m: FloatArray
    n_segments: IntArray


def drift_lengths(path_m: float) -> tuple[float, ...]:
    """Return the segment lengths for a path.

    Parameters
    ----------
    path_m : float
        Length of the path, metres.

    Returns
    -------
    tuple of float
        KITTI's 100 to 800 m for a longer path, else round numbers up to four fifths of it; none
        for a path under 0.1 m.

    Examples
    --------
    >>> drift_lengths(60.0)
    (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
    """
    if path_m > KITTI_SEGMENTS_M[-1]:
        return KITTI_SEGMENTS_M
    if path_m < _MIN_PATH_M:
        return ()
    longest = 0.8 * path_m
    power = float(10.0 ** np.floor(np.log10(longest / _N_LENGTHS)))
    step = next(f * power for f in (5.0, 2.0, 1.0) if f * power <= longest / _N_LENGTHS)
    n_lengths = int(longest / step + 1e-9)
    every = max(1, round(n_lengths / _N_LENGTHS))
    return tuple(round(n * step, 9) for n in range(every, n_lengths + 1, every))


def drift(comparison: Comparison, lengths_m: Sequence[float]) -> Drift | None:
    """Return the drift by length; None if no segment fits."""
    n = len(comparison.reference)
    is_standard = tuple(lengths_m) == KITTI_SEGMENTS_M
    # a path in a room has many poses: starts are spread evenly
    step = KITTI_STEP if is_standard else max(1, n // _MAX_STARTS)
    rows = []
    for length in lengths_m:
        shares, turns = segment_errors(
            comparison.reference, comparison.estimate, lengths_m=[length], step=step
        )
        if len(shares) > 0:
            mean_deg = float(np.rad2deg(np.mean(turns)))
            rows.append((length, 100.0 * float(np.mean(shares)), mean_deg, len(shares)))
    if not rows:
        return None
    lengths, translations, rotations, counts = np.array(rows, dtype=np.float64).T
    return Drift(
        lengths_m=lengths,
        translations_pct=translations,
        rotations_deg_per_m=rotations,
        n_segments=counts.astype(np.int64),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consistency:
    """Errors of poses with their stated covariances.

    Parameters
    ----------
    name : str
    stamps_ns : ndarray of int64, shape (n,)
    errors : ndarray of float64, shape (n, 6)
        (rx, ry, rz, tx, ty, tz), radians and metres: right perturbations of the poses that give
        the true ones.
    sigmas : ndarray of float64, shape (n, 6)
        Stated standard deviations.
    nees : ndarray of float64, shape (n,)
        Squared Mahalanobis norms of the errors: 6 on average for consistent covariances.
    """

    name: str
    stamps_ns: IntArray
    errors: FloatArray
    sigmas: FloatArray
    nees: FloatArray

    def share_inside(self, n_sigmas: float) -> FloatArray:
        """Return the share of errors within a number of sigmas, shape (6,)."""
        return np.asarray(np.mean(np.abs(self.errors) <= n_sigmas * self.sigmas, axis=0))

    def share_of_nees(self) -> tuple[float, float, float]:
        """Return the shares of the NEES below, within and above its 95 % band."""
        low, high = nees_band()
        below, above = float(np.mean(self.nees < low)), float(np.mean(self.nees > high))
        return below, 1.0 - below - above, above


def nees_band() -> tuple[float, float]:
    """Return the central 95 % interval of chi-square with 6 degrees of freedom."""
    return chi2_bound(0.025), chi2_bound(0.975)


def chi2_bound(share: float) -> float:
    """Return a quantile of chi-square with 6 degrees of freedom.

    Examples
    --------
    >>> round(chi2_bound(0.95), 3)
    12.592
    """
    # scipy.stats takes longer to import than the report to write
    return 2.0 * float(gammaincinv(0.5 * N_DOF, share))


def chi2_density(values: FloatArray) -> FloatArray:
    """Return the density of chi-square with 6 degrees of freedom."""
    return np.asarray(values**2 * np.exp(-0.5 * values) / 16.0)


def consistency(truth: Trajectory, estimate: Trajectory, *, name: str) -> Consistency | None:
    """Compare errors with covariances.

    The covariances are those of the motion since the first pose, so the first poses are aligned
    and nothing is fitted. The truth is interpolated at the stamps of the estimate, lest a
    difference of milliseconds count as an error.

    Parameters
    ----------
    truth : Trajectory
        With rotations.
    estimate : Trajectory
        With covariances.
    name : str

    Returns
    -------
    Consistency or None
        Without the first pose; None if no pose is left.
    """
    if estimate.covariances is None or not truth.has_rotations or not estimate.has_rotations:
        return None
    true, est = _at_stamps_of(truth, estimate)
    if len(true) < 2 or est.covariances is None:
        return None
    origin = est.T_world_frame[0] @ se3.invert(true.T_world_frame[0])
    errors = se3.log(se3.invert(est.T_world_frame) @ origin @ true.T_world_frame)[1:]
    covariances = est.covariances[1:]
    is_usable = _is_positive(covariances)
    errors, covariances = errors[is_usable], covariances[is_usable]
    if len(errors) == 0:
        return None
    return Consistency(
        name=name,
        stamps_ns=est.stamps_ns[1:][is_usable],
        errors=errors,
        sigmas=np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
        nees=se3.mahalanobis(errors, covariances),
    )


def _at_stamps_of(truth: Trajectory, estimate: Trajectory) -> tuple[Trajectory, Trajectory]:
    inside = truth.interpolate(estimate.stamps_ns)
    true_ns = truth.stamps_ns
    after = np.minimum(np.searchsorted(true_ns, inside.stamps_ns), len(true_ns) - 1)
    gaps_ns = true_ns[after] - true_ns[np.maximum(after - 1, 0)]
    is_near = (true_ns[after] == inside.stamps_ns) | (gaps_ns <= MAX_GAP_NS)
    inside = inside.select(is_near)
    return inside, estimate.select(np.isin(estimate.stamps_ns, inside.stamps_ns))


def _is_positive(covariances: FloatArray) -> BoolArray:
    # normalized by the sigmas: metres and radians have different scales
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    scales = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    unit = covariances / (scales[:, :, np.newaxis] * scales[:, np.newaxis])
    smallest = np.linalg.eigvalsh(unit)[:, 0]
    return np.asarray(np.all(variances > 0.0, axis=1) & (smallest > 1e-12))
