"""The report of estimates compared with a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.evaluation import Evaluation, evaluation_table
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.report.errors import drift_plot, error_plots
from gvo.viz.report.measures import compare
from gvo.viz.report.page import facts_html, plots_html, table_html, write_page
from gvo.viz.report.paths import World, lines_of, path_plots
from gvo.viz.report.sheets import settings, write_plots


def write_comparison_report(
    path: str | Path | None,
    truth: Trajectory,
    trajectories: Mapping[str, Trajectory],
    evaluations: Sequence[Evaluation],
    *,
    align: AlignMode,
    plots: str | Path | None = None,
) -> None:
    """Write the report of estimates compared with a reference; equal input gives equal files.

    Parameters
    ----------
    path : str or Path, optional
        HTML file; only the plots are written where omitted.
    truth : Trajectory
        The reference.
    trajectories : mapping of str to Trajectory
        By name, at least one.
    evaluations : sequence of Evaluation
        Of the same estimates.
    align : {"none", "origin", "se3", "sim3"}
        Alignment of each estimate with the reference.
    plots : str or Path, optional
        Folder for the plots as PNG and PDF.

    Raises
    ------
    ConfigurationError
        When a file or the folder cannot be written.
    TrajectoryError
        When nothing can be associated, or a plot cannot be written.
    ValueError
        When there is no estimate.
    """
    if not trajectories:
        raise ValueError("expected at least one estimate")
    compared = [compare(truth, t, name=name, align=align) for name, t in trajectories.items()]
    asked_m = evaluations[0].segments_m if evaluations else None
    world = World.of(truth)
    shown = truth_around(truth, [c.reference for c in compared])
    with settings():
        lines = lines_of(shown, {c.name: c.trajectory for c in compared})
        sheets = path_plots(lines, world) + error_plots(compared, align)
        sheets.append(drift_plot(compared, asked_m=asked_m))
        if path is not None:
            names = ", ".join(trajectories)
            body = [*_head(names, truth, evaluations, align), *plots_html(sheets, lines, world)]
            write_page(Path(path), f"Comparison: {names}", body)
        if plots is not None:
            write_plots(sheets, Path(plots))


def _head(
    names: str, truth: Trajectory, evaluations: Sequence[Evaluation], align: AlignMode
) -> list[str]:
    facts = {"Estimates": names, "Poses of the reference": str(len(truth)), "Alignment": align}
    table = table_html(*evaluation_table(evaluations))
    return ["<h1>Comparison of trajectories</h1>", facts_html(facts), table]


def truth_around(truth: Trajectory, parts: Sequence[Trajectory]) -> Trajectory:
    """Return the ground truth within the span of the associated poses."""
    first_ns = min(int(part.stamps_ns[0]) for part in parts)
    last_ns = max(int(part.stamps_ns[-1]) for part in parts)
    return truth.select((truth.stamps_ns >= first_ns) & (truth.stamps_ns <= last_ns))
