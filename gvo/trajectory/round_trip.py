"""The error of a round trip: how far a recording run forward and backward ends off its start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvo._text import format_table, number_text
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

_HEADER = ("", "error [m]", "[%]", "[deg]", "[deg/100 m]", "chi2", "mean [m]", "median [m]")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoundTripError:
    """How far the poses of the same frames are apart, forward and backward.

    Parameters
    ----------
    forward : Trajectory
        The n poses of frames that have one backward too; the last is that of the turn.
    backward : Trajectory
        The poses of the same frames on the way back, in the order and with the stamps of `forward`.
    errors : ndarray of float64, shape (n, 4, 4)
        T_forward_backward of each frame: the error of the round trip from it to the turn and back.
        The identity at the turn.
    path_m : float
        Length of the path, both ways together, metres.
    chi2 : float or None
        Squared Mahalanobis norm of the first error under the covariance of the last pose, six
        degrees of freedom; None without an invertible covariance.
    """

    forward: Trajectory
    backward: Trajectory
    errors: FloatArray
    path_m: float
    chi2: float | None

    @property
    def errors_m(self) -> FloatArray:
        """Distances between both poses of a frame, shape (n,), metres."""
        return np.asarray(np.linalg.norm(self.errors[:, :3, 3], axis=1))

    @property
    def errors_deg(self) -> FloatArray:
        """Angles between both poses of a frame, shape (n,), degrees."""
        return np.degrees(se3.rotation_angle(self.errors))

    @property
    def error_m(self) -> float:
        """Distance of the end from the start, metres."""
        return float(self.errors_m[0])

    @property
    def error_deg(self) -> float:
        """Rotation from the start to the end, degrees."""
        return float(self.errors_deg[0])

    @property
    def error_pct(self) -> float | None:
        """Distance of the end from the start, % of the path; None without motion."""
        return 100.0 * self.error_m / self.path_m if self.path_m > 0 else None

    @property
    def error_deg_per_100m(self) -> float | None:
        """Rotation from the start to the end, degrees per 100 m; None without motion."""
        return 100.0 * self.error_deg / self.path_m if self.path_m > 0 else None

    def as_json(self) -> dict[str, Any]:
        """Return the numbers for a summary."""
        errors_m, errors_deg = self.errors_m[:-1], self.errors_deg[:-1]  # the turn has none
        return {
            "error_m": self.error_m,
            "error_pct": self.error_pct,
            "error_deg": self.error_deg,
            "error_deg_per_100m": self.error_deg_per_100m,
            "chi2": self.chi2,
            "mean_m": float(np.mean(errors_m)),
            "median_m": float(np.median(errors_m)),
            "mean_deg": float(np.mean(errors_deg)),
            "median_deg": float(np.median(errors_deg)),
        }


def round_trip_error(
    trajectory: Trajectory, turn_ns: int, *, path_m: float | None = None
) -> RoundTripError | Failure:
    """Compare the poses of the way back with those of the way there.

    Parameters
    ----------
    trajectory : Trajectory
        Of a round trip: on the way back a frame has the stamp 2 * turn - stamp.
    turn_ns : int
        Stamp of the frame at the turn, nanoseconds.
    path_m : float, optional
        Length of the path, metres; that of the trajectory where omitted.

    Returns
    -------
    RoundTripError or Failure
        The failure says which poses are missing.
    """
    mirrored_ns = 2 * turn_ns - trajectory.stamps_ns
    _, first, second = np.intersect1d(
        trajectory.stamps_ns, mirrored_ns, assume_unique=True, return_indices=True
    )
    is_forward = trajectory.stamps_ns[first] <= turn_ns
    first, second = first[is_forward], second[is_forward]
    if len(first) < 2:
        return Failure(reason=f"frames with a pose both ways: {len(first)}, expected 2 or more")
    if first[0] != 0 or second[0] != len(trajectory) - 1:
        return Failure(reason="the way back does not end at the first frame")
    poses = trajectory.T_world_frame
    errors = se3.invert(poses[first]) @ poses[second]
    forward = trajectory.select(first)
    return RoundTripError(
        forward=forward,
        backward=Trajectory(stamps_ns=forward.stamps_ns, T_world_frame=poses[second]),
        errors=errors,
        path_m=float(trajectory.distances()[-1]) if path_m is None else path_m,
        chi2=_chi2(errors[0], trajectory.covariances),
    )


def _chi2(error: FloatArray, covariances: FloatArray | None) -> float | None:
    """Return the squared Mahalanobis norm of the error of the last pose."""
    if covariances is None:
        return None
    try:
        chi2 = float(se3.mahalanobis(se3.log(error), covariances[-1]))
    except np.linalg.LinAlgError:
        return None
    return chi2 if np.isfinite(chi2) else None


def format_round_trip_errors(errors: Mapping[str, RoundTripError]) -> str:
    """Return a table of text with a row per trajectory, by name; "-" for missing values."""
    return format_table(_HEADER, [_row(name, error) for name, error in errors.items()])


def _row(name: str, error: RoundTripError) -> tuple[str, ...]:
    numbers = error.as_json()
    return (
        name,
        f"{error.error_m:.4f}",
        number_text(error.error_pct, ".3f"),
        f"{error.error_deg:.4f}",
        number_text(error.error_deg_per_100m, ".3f"),
        number_text(error.chi2, ".2f"),
        f"{numbers['mean_m']:.4f}",
        f"{numbers['median_m']:.4f}",
    )
