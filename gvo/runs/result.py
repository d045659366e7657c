"""What a run, or the smoothing of other front-ends' edges, came to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvo._text import visible
from gvo.errors import said
from gvo.io.run_folder.verdict import imu_words, loop_words, verdict
from gvo.trajectory.evaluation import Evaluation, format_evaluations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult:
    """The result of a run.

    Parameters
    ----------
    summary : dict
        As written to `summary.json`.
    evaluations : tuple of Evaluation
        Of raw, causal, smoothed and global poses; empty if there was no truth to compare with.
    is_complete : bool
        Whether no frame is missing, nearly all are tracked, and everything asked for was compared
        and drawn.
    warnings : tuple of str
        One line each.
    report : Path or None
        The page that was written, if any.
    """

    summary: dict[str, Any]
    evaluations: tuple[Evaluation, ...]
    is_complete: bool
    warnings: tuple[str, ...]
    report: Path | None = None

    def __repr__(self) -> str:
        """Return what the command line prints of it: errors and verdict."""
        return said("\n".join(map(visible, self._lines())))

    def _lines(self) -> Iterator[str]:
        summary, is_smoothed = self.summary, "base_frame" not in self.summary
        if not is_smoothed:
            yield f"base frame: {summary['base_frame']}"
            yield f"ground truth: {summary['ground_truth']}"
        if self.evaluations:
            yield from format_evaluations(self.evaluations).splitlines()
        if is_smoothed:
            yield from _smoothing_words(summary)
        else:
            yield from filter(None, [verdict(summary), loop_words(summary), imu_words(summary)])


def _smoothing_words(summary: Mapping[str, Any]) -> Iterator[str]:
    if summary["batch"] is not None:
        yield _error_words(summary["batch"])
    n_edges = summary["edges"] if "edges" in summary else summary["window"]["n_edges"]
    yield f"{summary['frames']} poses, {n_edges} edges"


def _error_words(batch: Mapping[str, Any]) -> str:
    """Return the error of a batch optimization as text."""
    if "error_isam2" in batch:
        return f"error {batch['error_isam2']:.6g} by iSAM2, {batch['error']:.6g} in a batch"
    refused = f", {batch['refused_edges']} edges refused" if batch["refused_edges"] else ""
    return f"error {batch['error']:.6g} after {batch['iterations']} iterations{refused}"
