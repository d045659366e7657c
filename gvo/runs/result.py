"""What a run, or the smoothing of other front-ends' edges, came to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvo.trajectory.evaluation import Evaluation


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
