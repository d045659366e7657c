"""The price of the window as a table, and the trajectories behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gvo.backend.comparison import MeasurementLog, Smoothing
from gvo.geometry import se3
from gvo.trajectory.formats import write_tum
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate

_ROUNDING = 1e-6
_HEADER = ("smoothing", "error", "above least [%]", "off least [m]", "ATE RMSE [m]", "ms per pose")
FILES = {"full iSAM2": "full_isam2.txt", "batch LM": "batch_lm.txt"}
"""Trajectories that `SmoothingComparison` writes, by the name of the smoothing."""


class SmoothingComparison:
    """Collects what a run measured and smoothed, and smooths it again in other ways."""

    def __init__(self) -> None:
        self.log = MeasurementLog()
        self._smoothed: list[Estimate] = []

    def add(self, estimates: Iterable[Estimate]) -> None:
        """Take smoothed poses that are final."""
        self._smoothed += estimates

    def conclude(
        self,
        folder: Path,
        *,
        measure: Callable[[Trajectory], float] | None = None,
        place: Callable[[Trajectory], Trajectory] | None = None,
    ) -> list[dict[str, Any]]:
        """Compare the ways, and write the trajectories of the two that the run did not take.

        Parameters
        ----------
        folder : Path
            Gets `FILES`.
        measure : callable, optional
            Returns the ATE of a trajectory, metres.
        place : callable, optional
            Brings a trajectory of the frame that was smoothed to the one that is written.

        Returns
        -------
        list of dict
            A row for the window (where poses left it), for iSAM2 without marginalization and for
            batch Levenberg-Marquardt: error (half the chi-square), by how much it and the
            positions (RMS) are off the least, ATE, milliseconds per pose.
        """
        smoothings = self.log.compare(self._smoothed)
        stamps_ns = {estimate.frame_id: estimate.stamp_ns for estimate in self._smoothed}
        trajectories = {
            smoothing.name: _trajectory(smoothing, stamps_ns) for smoothing in smoothings
        }
        if place is not None:
            trajectories = {name: place(trajectory) for name, trajectory in trajectories.items()}
        for name, file in FILES.items():
            write_tum(folder / file, trajectories[name])
        least = smoothings[-1]
        return [
            {
                "smoothing": smoothing.name,
                "error": smoothing.error,
                "above_least_pct": _percent_above(smoothing.error, least.error),
                "off_least_m": _distance(trajectories[smoothing.name], trajectories[least.name]),
                "ate_m": None if measure is None else measure(trajectories[smoothing.name]),
                "ms_per_pose": 1e3 * smoothing.elapsed_s / len(stamps_ns),
            }
            for smoothing in smoothings
        ]


def format_smoothings(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows of `SmoothingComparison.conclude` as a table, "-" where there is no value."""
    cells = [
        (
            row["smoothing"],
            f"{row['error']:.6g}",
            f"{row['above_least_pct']:.3f}",
            f"{row['off_least_m']:.4f}",
            "-" if row["ate_m"] is None else f"{row['ate_m']:.4f}",
            f"{row['ms_per_pose']:.2f}",
        )
        for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(_HEADER, *cells, strict=True)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
        for row in (_HEADER, *cells)
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"


def _trajectory(smoothing: Smoothing, stamps_ns: dict[Any, int]) -> Trajectory:
    frames = sorted(smoothing.poses, key=lambda frame_id: stamps_ns[frame_id])
    return Trajectory(
        stamps_ns=np.array([stamps_ns[frame_id] for frame_id in frames], dtype=np.int64),
        T_world_cam=se3.normalize(np.array([smoothing.poses[frame_id] for frame_id in frames])),
    )


def _distance(first: Trajectory, second: Trajectory) -> float:
    return float(np.sqrt(np.mean(np.sum((first.positions - second.positions) ** 2, axis=1))))


def _percent_above(error: float, least: float) -> float:
    # A chain alone has no error but that of rounding.
    return 100.0 * (error / least - 1.0) if error > _ROUNDING else 0.0
