"""The report of a run, and of estimates compared with a reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gvo._text import number_text
from gvo.config import Config
from gvo.errors import TrajectoryError
from gvo.io.run_folder.reader import RunRecord, Table, loop_ends
from gvo.io.run_folder.verdict import imu_words, loop_words, nees_table, reference_words, verdict
from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.consistency import consistency, motions_of_chain
from gvo.trajectory.evaluation import Evaluation, evaluate, evaluation_table
from gvo.trajectory.trajectory import Trajectory
from gvo.viz.figures import Plot, elapsed, evenly, style, write_plots
from gvo.viz.measures import truth_around
from gvo.viz.pages import write_page
from gvo.viz.report.paths import (
    TITLES,
    Line,
    World,
    lines_of,
    loop_lines,
    path_plots,
    turning_scene,
)
from gvo.viz.report.plots import (
    count_plot,
    covariance_plot,
    drift_plot,
    edge_plot,
    error_plots,
    not_drawn,
    pose_plots,
    status_plot,
    timing_plot,
)
from gvo.viz.report.rig import rig_plots

_TRUTH_PLOTS = ("errors_over_time", "errors_over_distance", "drift", "covariance")
_LOOP_COLUMNS = ("at [s]", "place of [s]", "inliers", "residual", "why refused")
_MAX_LOOPS = 20


def write_comparison_report(
    path: str | Path | None,
    truth: Trajectory,
    evaluations: Sequence[Evaluation],
    *,
    align: AlignMode,
    segments: Sequence[float] | None = None,
    plots: str | Path | None = None,
) -> None:
    """Write the report of estimates compared with a reference; equal input gives equal files.

    Parameters
    ----------
    path : str or Path, optional
        HTML file; only the plots are written where omitted.
    truth : Trajectory
        The reference.
    evaluations : sequence of Evaluation
        Of the estimates, at least one.
    align : {"none", "origin", "se3", "sim3"}
        How each was aligned with the reference.
    segments : sequence of float, optional
        Their lengths in metres, where they were asked for.
    plots : str or Path, optional
        Folder for the plots as PNG and PDF.

    Raises
    ------
    ConfigurationError
        When a file or the folder cannot be written.
    TrajectoryError
        When a plot cannot be written.
    ValueError
        When there is no estimate.
    """
    if not evaluations:
        raise ValueError("expected at least one estimate")
    world, shown = World.of(truth), truth_around(truth, evaluations)
    names = ", ".join(each.name for each in evaluations)
    facts = {"Estimates": names, "Poses of the reference": str(len(truth)), "Alignment": align}
    with style():
        lines = lines_of(shown, {c.name: c.trajectory for c in evaluations})
        drawn = path_plots(lines, world) + pose_plots(shown, evaluations, world)
        drawn += error_plots(evaluations, align)
        drawn.append(drift_plot(evaluations, asked_m=segments))
        if path is not None:
            header, rows = evaluation_table(evaluations)
            write_page(
                Path(path),
                "comparison.html",
                title=f"Comparison: {names}",
                facts=facts,
                table={"header": header, "rows": rows},
                plots=drawn,
                scene=turning_scene(lines, world),
            )
        if plots is not None:
            write_plots(drawn, Path(plots))


def write_run_report(
    path: str | Path, record: RunRecord, *, plots: str | Path | None = None
) -> None:
    """Write the report of a run; equal input gives equal files.

    Parameters
    ----------
    path : str or Path
        HTML file, replaced if it exists.
    record : RunRecord
        From `read_run`; the run may be unfinished.
    plots : str or Path, optional
        Folder for the plots as PNG and PDF.

    Raises
    ------
    ConfigurationError
        When the page or the folder cannot be written.
    TrajectoryError
        When a plot cannot be written.
    """
    estimates = record.comparable()
    compared, reason = _compare(record, estimates)
    with style():
        lines, world = _lines(record, estimates, compared)
        shown = estimates | {c.name: c.trajectory for c in compared}
        if record.loops:
            best = (trajectory for name, trajectory in shown.items() if "global" in name)
            lines += [line for each in best for line in loop_lines(loop_ends(record.loops, each))]
        drawn = [
            *_path_plots(lines, world),
            *_truth_plots(record, compared, reason),
            status_plot(record.frames),
            count_plot(record.frames),
            timing_plot(record.timings),
            edge_plot(record.edges, _first_ns(record)),
            *rig_plots(record.summary.get("rig")),
        ]
        # The page first: it must exist even if the folder cannot be written.
        scene = None if world is None else turning_scene(lines, world)
        write_page(Path(path), "report.html", **_words(record), plots=drawn, scene=scene)
        if plots is not None:
            write_plots(drawn, Path(plots))


def _compare(
    record: RunRecord, estimates: Mapping[str, Trajectory]
) -> tuple[list[Evaluation], str]:
    """Return the comparisons with the ground truth, or why there are none."""
    if record.truth is None or not estimates:
        found = str(record.summary.get("ground_truth") or "")
        return [], found.removeprefix("none: ") or "the run has no ground truth"
    try:
        return [
            evaluate(record.truth, estimate, name=name) for name, estimate in estimates.items()
        ], ""
    except TrajectoryError as error:
        return [], str(error)


def _lines(
    record: RunRecord, estimates: Mapping[str, Trajectory], compared: list[Evaluation]
) -> tuple[list[Line], World | None]:
    if compared and record.truth is not None:
        shown = truth_around(record.truth, compared)
        return lines_of(shown, {c.name: c.trajectory for c in compared}), World.of(record.truth)
    if not estimates:
        return [], None
    return lines_of(None, estimates), World.of(next(iter(estimates.values())))


def _path_plots(lines: list[Line], world: World | None) -> list[Plot]:
    if world is not None:
        return path_plots(lines, world)
    text = "Not drawn: the run has no poses."
    return [Plot(slug=slug, title=title, text=text) for slug, title in TITLES.items()]


def _truth_plots(record: RunRecord, compared: list[Evaluation], reason: str) -> list[Plot]:
    if not compared or record.truth is None:
        why = f"errors need ground truth, and {reason.removesuffix('.')}"
        return [not_drawn(slug, why) for slug in _TRUTH_PLOTS]
    return [
        *error_plots(compared, "se3"),
        drift_plot(compared),
        _covariance_plot(record, record.truth),
    ]


def _covariance_plot(record: RunRecord, truth: Trajectory) -> Plot:
    raw = record.trajectories["raw"]
    found = consistency(truth, motions_of_chain(raw)) if len(raw) else None
    if found is not None:
        return covariance_plot(found, _first_ns(record))
    reason = (
        "the ground truth holds no rotations, and covariances are of poses"
        if not truth.has_rotations
        else "no motion over a second has true poses and a covariance"
    )
    return not_drawn("covariance", reason)


def _first_ns(record: RunRecord) -> int:
    stamps_ns = record.frames["stamp_ns"]
    return int(stamps_ns[0]) if len(stamps_ns) > 0 else 0


def _words(record: RunRecord) -> dict[str, Any]:
    """Return what the page of a run says beside its plots."""
    summary = record.summary
    return {
        "title": f"gvo: {record.name}",
        "record": record,
        "summary": summary,
        "verdict": verdict(summary) if "frames" in summary else "",
        "loop_words": loop_words(summary),
        "imu_words": imu_words(summary),
        "nees": nees_table(summary.get("nees") or {}),
        "reference_words": reference_words(summary.get("reference")),
        "statuses": Counter(record.frames["status"]),
        "duration": _duration(record),
        "loops": _loops(record.loops, _first_ns(record)),
        "defaults": Config().model_dump(),
    }


def _loops(loops: Table, first_ns: int) -> dict[str, Any] | None:
    """Return the table of loops; of many, some all over the run."""
    if not loops or not len(loops["reason"]):
        return None
    n = len(loops["reason"])
    chosen = evenly(n, _MAX_LOOPS)
    ends = (
        elapsed(stamps_ns, first_ns) for stamps_ns in (loops["stamp_ns"], loops["reference_ns"])
    )
    columns = (
        *([f"{end_s:.1f}" for end_s in each] for each in ends),
        [str(count) for count in loops["n_inliers"]],
        [number_text(float(residual)) for residual in loops["residual"]],
        loops["reason"].tolist(),
    )
    rows = [[column[index] for column in columns] for index in chosen]
    rest = f"; {n - len(chosen)} more are in loops.csv" if n > len(chosen) else ""
    return {"header": _LOOP_COLUMNS, "rows": rows, "rest": rest}


def _duration(record: RunRecord) -> str:
    stamps_ns = np.unique(record.frames["stamp_ns"])  # repeated ones are skipped
    if len(stamps_ns) < 2:
        return ""
    rate = 1e9 / float(np.median(np.diff(stamps_ns)))
    return f"{float(stamps_ns[-1] - stamps_ns[0]) / 1e9:.1f} s, {rate:.3g} frames per second"
