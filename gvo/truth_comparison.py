"""The trajectories of a run beside the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gvo.sources.truth_frames import FramedTruth
from gvo.trajectory.evaluation import Evaluation, evaluate
from gvo.trajectory.trajectory import Trajectory

# A truth that stands while the estimate moves is none of it.
_MIN_EXTENT_M = 0.1
_MIN_SHARE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthComparison:
    """Estimates as those of what the truth is of, and their errors.

    Parameters
    ----------
    truth : FramedTruth
    estimates : dict of str to Trajectory
        By name; of the point that the truth measured, where that holds positions only.
    evaluations : tuple of Evaluation
        In the same order.
    """

    truth: FramedTruth
    estimates: dict[str, Trajectory]
    evaluations: tuple[Evaluation, ...]

    @classmethod
    def of(cls, truth: FramedTruth, estimates: Mapping[str, Trajectory]) -> TruthComparison:
        """Compare estimates of the frame that was asked for.

        Parameters
        ----------
        truth : FramedTruth
        estimates : mapping of str to Trajectory

        Raises
        ------
        TrajectoryError
            Where nothing can be associated.
        """
        comparable = {name: truth.comparable(estimate) for name, estimate in estimates.items()}
        evaluations = tuple(
            evaluate(truth.trajectory, estimate, name=name) for name, estimate in comparable.items()
        )
        return cls(truth=truth, estimates=comparable, evaluations=evaluations)

    def warnings(self) -> list[str]:
        """Return what the errors are to be taken with, a line each."""
        warnings = [self.truth.warning] if self.truth.warning else []
        true_m = _extent(self.truth.trajectory)
        estimated_m = max(map(_extent, self.estimates.values()))
        if estimated_m > _MIN_EXTENT_M and true_m < _MIN_SHARE * estimated_m:
            warnings.append(
                f"it moves by {true_m:.2g} m where the estimate moves by {estimated_m:.2g} m: is "
                "it of another frame, are PARENT and CHILD exchanged?"
            )
        return warnings


def _extent(trajectory: Trajectory) -> float:
    """Return the diagonal of the box around the positions, metres."""
    return float(np.linalg.norm(np.ptp(trajectory.positions, axis=0)))
