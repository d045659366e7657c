"""The closing error of a drive there and back: how far it ends from where it began."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvo._text import format_table
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Failure, FloatArray

_HEADER = (
    "",
    "closing [m]",
    "[%]",
    "[deg]",
    "[deg/100 m]",
    "chi2",
    "mean [m]",
    "median [m]",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Closing:
    """What a trajectory there and back tells of its errors.

    Parameters
    ----------
    there : Trajectory
        The n poses on the way there that have one on the way back too; the last one is the turn.
    back : Trajectory
        The poses of the same frames on the way back, in the order and with the stamps of `there`.
    errors : ndarray of float64, shape (n, 4, 4)
        T_there_back of each frame: the closing error of a drive from it to the turn and back. Zero
        at the turn.
    path_m : float
        Length of the way there and back, metres.
    chi2 : float or None
        Squared Mahalanobis norm of the first error under the covariance of the last pose, six
        degrees of freedom; None without a covariance that can be inverted.
    """

    there: Trajectory
    back: Trajectory
    errors: FloatArray
    path_m: float
    chi2: float | None

    @property
    def errors_m(self) -> FloatArray:
        """Distance between there and back, shape (n,), metres."""
        return np.asarray(np.linalg.norm(self.errors[:, :3, 3], axis=1))

    @property
    def errors_deg(self) -> FloatArray:
        """Angle between there and back, shape (n,), degrees."""
        return np.degrees(se3.rotation_angle(self.errors))

    @property
    def closing_m(self) -> float:
        """Distance of the end from the start, metres."""
        return float(self.errors_m[0])

    @property
    def closing_deg(self) -> float:
        """Rotation from the start to the end, degrees."""
        return float(self.errors_deg[0])

    @property
    def closing_pct(self) -> float | None:
        """Distance of the end from the start, % of the path; None where nothing moved."""
        return 100.0 * self.closing_m / self.path_m if self.path_m > 0 else None

    @property
    def closing_deg_per_100m(self) -> float | None:
        """Rotation from the start to the end, degrees per 100 m; None where nothing moved."""
        return 100.0 * self.closing_deg / self.path_m if self.path_m > 0 else None

    def as_json(self) -> dict[str, Any]:
        """Return the numbers for a summary."""
        errors_m, errors_deg = self.errors_m[:-1], self.errors_deg[:-1]  # the turn has none
        return {
            "closing_m": self.closing_m,
            "closing_pct": self.closing_pct,
            "closing_deg": self.closing_deg,
            "closing_deg_per_100m": self.closing_deg_per_100m,
            "chi2": self.chi2,
            "mean_m": float(np.mean(errors_m)),
            "median_m": float(np.median(errors_m)),
            "mean_deg": float(np.mean(errors_deg)),
            "median_deg": float(np.median(errors_deg)),
        }


def close(
    trajectory: Trajectory, turn_ns: int, *, path_m: float | None = None
) -> Closing | Failure:
    """Compare the way there with the way back.

    Parameters
    ----------
    trajectory : Trajectory
        There and back: of each frame on the way there the stamp on the way back is
        2 * turn - stamp.
    turn_ns : int
        Stamp of the frame at the turn, nanoseconds.
    path_m : float, optional
        Length of the way there and back, metres; of the trajectory itself where omitted.

    Returns
    -------
    Closing or Failure
        The failure says what is missing.
    """
    mirrored_ns = 2 * turn_ns - trajectory.stamps_ns
    _, there, back = np.intersect1d(
        trajectory.stamps_ns, mirrored_ns, assume_unique=True, return_indices=True
    )
    is_there = trajectory.stamps_ns[there] <= turn_ns
    there, back = there[is_there], back[is_there]
    if len(there) < 2:
        return Failure(reason=f"frames with a pose both ways: {len(there)}, expected 2 or more")
    if there[0] != 0 or back[0] != len(trajectory) - 1:
        return Failure(reason="the way back does not end at the frame where the way there begins")
    poses = trajectory.T_world_cam
    errors = se3.invert(poses[there]) @ poses[back]
    outward = trajectory.select(there)
    return Closing(
        there=outward,
        back=Trajectory(stamps_ns=outward.stamps_ns, T_world_cam=poses[back]),
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


def format_closings(closings: Mapping[str, Closing]) -> str:
    """Return a table with a row for each trajectory.

    Parameters
    ----------
    closings : mapping of str to Closing
        By the names of the trajectories.

    Returns
    -------
    str
        Lines with line ends; a dash where there is no number.
    """
    return format_table(_HEADER, [_row(name, closing) for name, closing in closings.items()])


def _row(name: str, closing: Closing) -> tuple[str, ...]:
    numbers = closing.as_json()
    return (
        name,
        f"{closing.closing_m:.4f}",
        _optional(closing.closing_pct, ".3f"),
        f"{closing.closing_deg:.4f}",
        _optional(closing.closing_deg_per_100m, ".3f"),
        _optional(closing.chi2, ".2f"),
        f"{numbers['mean_m']:.4f}",
        f"{numbers['median_m']:.4f}",
    )


def _optional(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
