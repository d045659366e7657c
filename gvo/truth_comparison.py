"""The trajectories of a run beside the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gvo.evaluation import Evaluation, evaluate
from gvo.sources.truth_frames import FramedTruth
from gvo.trajectory import Trajectory


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

    def measure(self, estimate: Trajectory) -> float:
        """Return the absolute trajectory error of another estimate, metres."""
        comparable = self.truth.comparable(estimate)
        return evaluate(self.truth.trajectory, comparable, name="").ate_m
