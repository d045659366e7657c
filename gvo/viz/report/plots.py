"""Plots of errors, drift and covariances, and of what happened from frame to frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from gvo.io.run_folder.reader import Table
from gvo.trajectory.alignment import AlignMode
from gvo.trajectory.consistency import N_DOF, Consistency, chi2_bound
from gvo.trajectory.evaluation import KITTI_SEGMENTS_M, Evaluation
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray
from gvo.viz import palette
from gvo.viz.figures import (
    MANY,
    Plot,
    draw_curve,
    draw_segments,
    elapsed,
    legend_above,
    new_figure,
    plain,
    plain_decades,
)
from gvo.viz.measures import drift, drift_lengths
from gvo.viz.palette import Style, styles_of
from gvo.viz.report.paths import World
from gvo.viz.report.trajectories import ANGLES, POSITIONS, draw_values

_ROW_HEIGHT, _PATH_HEIGHT = 2.1, 4.2
# Axes of a camera turned to forward, left, up.
_FLU_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_SIGMAS = 3.0
_RAW = Style(color=palette.ESTIMATES["raw"], linewidth=1.1, zorder=3.0)
# index into errors, letter and unit: translations in the upper row, rotations below
_PANELS = (
    *((3, "x", "m"), (4, "y", "m"), (5, "z", "m")),
    *((0, "x", "deg"), (1, "y", "deg"), (2, "z", "deg")),
)
_UNKNOWN = "#999999"
_FLOOR = 1e-3  # of the logarithmic axis
_MARKERS = {"step": "o", "keyframe": "s", "depth": "^", "imu": "D"}


TITLES = {
    "error_path": "Errors along the path",
    "positions": "Position over time",
    "angles": "Roll, pitch and yaw over time",
    "errors_over_time": "Errors over time",
    "errors_over_distance": "Errors over distance travelled",
    "drift": "Drift by length of segment",
    "covariance": "Errors within their covariances",
    "status": "Status",
    "counts": "Features, matches and inliers",
    "timings": "Milliseconds per frame",
    "chi2": "Chi-square of the edges",
    "rig": "What calibration left",
}
"""Of the plots of a run, by slug, in their order."""


def not_drawn(slug: str, reason: str) -> Plot:
    """Return a plot that says why it is not drawn."""
    return Plot(slug=slug, title=TITLES[slug], text=f"Not drawn: {reason}.")


def _plot(slug: str, figure: Figure, **facts: object) -> Plot:
    """Return a plot, whose words are in `pages/plots.html`."""
    return Plot(slug=slug, title=TITLES[slug], figure=figure, facts=facts)


def pose_plots(truth: Trajectory, evaluations: Sequence[Evaluation], world: World) -> list[Plot]:
    """Return the paths coloured by their errors, and positions and angles over time."""
    estimates = {c.name: c.trajectory for c in evaluations}
    plots = [_plot("error_path", _error_path(truth, evaluations, world))]
    plots.append(_plot("positions", _values(truth, estimates, POSITIONS)))
    if not all(each.has_rotations for each in (truth, *estimates.values())):
        return [*plots, not_drawn("angles", "there are positions without rotations")]
    # an axis of the world points up, whichever it is
    R_flu_world = _FLU_CAMERA if world.is_up_negative else np.eye(3)

    def angles(trajectory: Trajectory) -> FloatArray:
        R = R_flu_world @ trajectory.T_world_frame[:, :3, :3] @ R_flu_world.T
        euler = np.asarray(Rotation.from_matrix(R).as_euler("xyz"))
        return np.rad2deg(np.unwrap(euler, axis=0))

    return [*plots, _plot("angles", _values(truth, estimates, ANGLES, angles))]


def _values(truth: Trajectory, estimates: dict[str, Trajectory], *what: Any) -> Figure:  # noqa: ANN401
    figure = new_figure(3 * _ROW_HEIGHT)
    panels = figure.subplots(3, 1, sharex=True)
    draw_values(panels, truth, estimates, *what)
    legend_above(figure, panels[0])
    return figure


def _error_path(truth: Trajectory, evaluations: Sequence[Evaluation], world: World) -> Figure:
    n, n_columns = len(evaluations), min(len(evaluations), 2)
    n_rows = -(-n // n_columns)
    figure = new_figure(_PATH_HEIGHT * n_rows)
    panels = [figure.add_subplot(n_rows, n_columns, number) for number in range(1, n + 1)]
    largest_m = max(float(c.errors_m.max()) for c in evaluations)
    for axes, c in zip(panels, evaluations, strict=True):
        axes.plot(*truth.positions[:, world.ground].T, color="black", ls="--", lw=0.7)
        points = c.estimate.positions[:, world.ground]
        looks: dict[str, Any] = {"cmap": "viridis", "clim": (0.0, largest_m), "linewidths": 2.5}
        drawn = draw_segments(axes, points[:-1], points[1:], array=c.errors_m[1:], **looks)
        axes.set_title(plain(c.name), loc="left")
        axes.set(xlabel=f"{'xyz'[world.ground[0]]} [m]", ylabel=f"{'xyz'[world.ground[1]]} [m]")
        axes.set_aspect("equal", adjustable="datalim")
    figure.colorbar(drawn, ax=panels, label="position error [m]")
    return figure


def error_plots(evaluations: Sequence[Evaluation], align: AlignMode) -> list[Plot]:
    """Return the errors over time and over the distance travelled."""
    first_ns = min(int(c.reference.stamps_ns[0]) for c in evaluations)
    is_by_row = any(c.reference.stamps_from == "rows" for c in evaluations)
    over_time = _curves(
        evaluations,
        lambda c: elapsed(c.reference.stamps_ns, first_ns),
        "row" if is_by_row else "elapsed [s]",
    )
    travelled = _curves(evaluations, lambda c: c.reference.distances(), "distance travelled [m]")
    has_rotations = any(c.errors_rad is not None for c in evaluations)
    return [
        _plot("errors_over_time", over_time, align=align, has_rotations=has_rotations),
        _plot("errors_over_distance", travelled),
    ]


def _curves(
    evaluations: Sequence[Evaluation], abscissa: Callable[[Evaluation], FloatArray], label: str
) -> Figure:
    has_rotations = any(c.errors_rad is not None for c in evaluations)
    n_rows = 2 if has_rotations else 1
    figure = new_figure(0.9 + n_rows * _ROW_HEIGHT)
    rows = figure.subplots(n_rows, 1, sharex=True, squeeze=False)[:, 0]
    for c, style in zip(evaluations, styles_of(c.name for c in evaluations), strict=True):
        x, seconds = abscissa(c), c.reference.stamps_ns / 1e9
        text = f"{c.name} (RMSE {c.ate_m:.3g} m)"
        draw_curve(rows[0], x, c.errors_m, style, seconds=seconds, label=text)
        if c.errors_rad is not None:
            draw_curve(rows[1], x, np.rad2deg(c.errors_rad), style, seconds=seconds)
    rows[0].set_ylabel("position error [m]")
    if has_rotations:
        rows[1].set_ylabel("rotation error [deg]")
    for axes in rows:
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.01)
    rows[-1].set_xlabel(label)
    legend_above(figure, rows[0])
    return figure


def drift_plot(
    evaluations: Sequence[Evaluation], *, asked_m: Sequence[float] | None = None
) -> Plot:
    """Return the drift by the length of segments."""
    path_m = max(float(c.reference.distances()[-1]) for c in evaluations)
    lengths = drift_lengths(path_m) if asked_m is None else asked_m
    found = {c.name: drift(c, lengths) for c in evaluations}
    counts = [int(rows[-1, 3]) for rows in found.values() if len(rows)]
    if not counts:
        reason = (
            "the ground truth holds no rotations, which segments are compared by"
            if any(c.errors_rad is None for c in evaluations)
            else f"the path of {path_m:.2g} m is too short for segments"
        )
        return not_drawn("drift", reason)
    origin = f"round lengths for a path of {path_m:.3g} m"
    if lengths == KITTI_SEGMENTS_M:
        origin = "the standard lengths of the KITTI benchmark"
    elif asked_m is not None:
        origin = "the lengths asked for"
    return _plot("drift", _drift_figure(found), origin=origin, n_segments=counts[0])


def _drift_figure(found: Mapping[str, FloatArray]) -> Figure:
    figure = new_figure(3.5)
    panels: Any = figure.subplots(1, 2)
    for (name, rows), style, marker in zip(
        found.items(), styles_of(found), cycle("osD^vP*X"), strict=False
    ):
        looks = {"color": style.color, "ls": style.linestyle, "marker": marker, "ms": 4.5}
        for axes, column in zip(panels, (1, 2), strict=True):
            axes.plot(rows[:, 0], rows[:, column], label=plain(name), **looks)
    for axes, label in zip(
        panels, ("translation error [%]", "rotation error [deg/m]"), strict=True
    ):
        axes.set(xlabel="length of segment [m]", ylabel=label, xlim=(0.0, None))
        axes.set_ylim(0.0, 1.1 * axes.dataLim.y1 or 1.0)
    legend_above(figure, panels[0])
    return figure


def covariance_plot(item: Consistency, first_ns: int) -> Plot:
    """Return errors of motions with their 3-sigma bands."""
    inside = 100.0 * np.mean(np.abs(item.errors) <= _SIGMAS * item.sigmas, axis=0)
    shares = {"position": inside[3:].mean(), "rotation": inside[:3].mean()}
    return _plot("covariance", _bands(item, first_ns), **shares)


def _bands(item: Consistency, first_ns: int) -> Figure:
    figure = new_figure(5.2)
    panels: Any = figure.subplots(2, 3, sharex=True)
    x = elapsed(item.end_ns, first_ns)
    is_many = len(x) > MANY
    band: dict[str, Any] = {"alpha": 0.2, "lw": 0, "rasterized": is_many, "label": "\u00b13 sigma"}
    for panel, (index, letter, unit) in zip(panels.flat, _PANELS, strict=True):
        factor = 1.0 if unit == "m" else float(np.rad2deg(1.0))
        reach = _SIGMAS * factor * item.sigmas[:, index]
        panel.fill_between(x, -reach, reach, color=_RAW.color, **band)
        y = factor * item.errors[:, index]
        draw_curve(panel, x, y, _RAW, label="raw over 1 s")
        kind = "position" if unit == "m" else "rotation"
        panel.set_ylabel(f"{kind} {letter} [{unit}]")
    for panel in panels[-1]:
        panel.set_xlabel("elapsed [s]")
    legend_above(figure, panels[0, 0])
    return figure


def status_plot(frames: Table) -> Plot:
    """Return the ribbon of statuses, a row for each that occurs."""
    if len(frames["stamp_ns"]) == 0:
        return not_drawn("status", "the run has no frame")
    return _plot("status", _ribbon(frames))


def _ribbon(frames: Table) -> Figure:
    counts = Counter(frames["status"])
    names = [name for name in dict.fromkeys([*palette.STATUSES, *counts]) if counts[name]]
    figure = new_figure(0.85 + 0.32 * len(names))
    axes = figure.subplots()
    x = elapsed(frames["stamp_ns"], int(frames["stamp_ns"][0]))
    period_s = float(np.median(np.diff(np.unique(x)))) if x[-1] > x[0] else 1.0
    statuses = frames["status"]
    for row, name in enumerate(names):
        colour, hatch = palette.STATUSES.get(name, _UNKNOWN), palette.HATCHES.get(name, "")
        spans = _spans(x[statuses == name], period_s)
        # The edge widens single frames to be seen.
        looks: dict[str, Any] = {"facecolor": colour, "edgecolor": colour, "linewidth": 1.0}
        axes.broken_barh(spans, (row - 0.4, 0.8), **looks)
        if hatch:
            looks = {"facecolor": "none", "edgecolor": "black", "linewidth": 0.0, "hatch": hatch}
            axes.broken_barh(spans, (row - 0.4, 0.8), **looks)
    axes.set_yticks(range(len(names)), [f"{name}: {counts[name]}" for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.margins(x=0.005)
    axes.set_xlabel("elapsed [s]")
    return figure


def _spans(seconds: FloatArray, period_s: float) -> list[tuple[float, float]]:
    """Return start and width of each stretch of frames that follow one another."""
    ordered = np.unique(seconds)
    parts = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1.5 * period_s) + 1)
    return [(float(part[0]), float(part[-1] - part[0]) + period_s) for part in parts]


def _time_axes(height: float, label: str) -> tuple[Figure, Axes]:
    figure = new_figure(height)
    axes = figure.subplots()
    axes.margins(x=0.01)
    axes.set(xlabel="elapsed [s]", ylabel=label)
    return figure, axes


def count_plot(frames: Table) -> Plot:
    """Return keypoints, points, matches and inliers per frame."""
    present = {n: frames[f"n_{n}"] for n in palette.COUNTS if f"n_{n}" in frames}
    has_pose = frames["status"] != "skipped"
    if not present or not np.any(has_pose):
        return not_drawn("counts", "the run has no counts; its edges were given")
    figure, axes = _time_axes(3.0, "number per frame [-]")
    x = elapsed(frames["stamp_ns"], int(frames["stamp_ns"][0]))
    for name, counts in present.items():
        y = np.where(has_pose, counts, np.nan).astype(np.float64)
        if name in ("matches", "inliers"):
            y[np.argmax(has_pose)] = np.nan  # nothing precedes the first frame
        draw_curve(axes, x, y, Style(color=palette.COUNTS[name]), label=name)
    axes.set_ylim(bottom=0.0)
    legend_above(figure, axes)
    return _plot("counts", figure, **_inlier_facts(frames))


def _inlier_facts(frames: Table) -> dict[str, float]:
    """Return inliers of the median and of the worst frame that was matched, if any was."""
    matches, inliers = frames.get("n_matches"), frames.get("n_inliers")
    if matches is None or inliers is None or not np.any(matches > 0):
        return {}
    matches, inliers = matches[matches > 0], inliers[matches > 0]
    share = 100.0 * float(np.median(inliers / matches))
    return {"median": np.median(inliers), "share": share, "fewest": inliers.min()}


def timing_plot(timings: Table) -> Plot:
    """Return the milliseconds per frame, stacked by stage."""
    stages_ms = {name: values for name, values in timings.items() if name.endswith("_ms")}
    if not stages_ms or len(timings["stamp_ns"]) == 0:
        return not_drawn("timings", "the run has no times of its stages")
    table = np.nan_to_num(np.stack(list(stages_ms.values())))
    total = table.sum(axis=0)
    median, slow = np.quantile(total, [0.5, 0.95])
    figure, axes = _time_axes(3.2, "milliseconds per frame [ms]")
    _stack(axes, timings, table)
    axes.axhline(median, color="black", lw=1.0, label=f"median {median:.1f}")
    axes.axhline(slow, color="black", lw=1.0, ls=":", label=f"95 %: {slow:.1f}")
    axes.set_ylim(0.0, 1.05 * float(total.max()) or 1.0)
    legend_above(figure, axes)
    period_ms = share = 0.0
    if len(total) > 1:
        period_ms = float(np.median(np.diff(np.sort(timings["stamp_ns"])))) / 1e6
        share = 100.0 * float(np.mean(total > period_ms))
    facts = {"median": median, "slow": slow, "slowest": total.max()}
    return _plot("timings", figure, period_ms=period_ms, share=share, **facts)


def _stack(axes: Axes, timings: Table, table: FloatArray) -> None:
    x = elapsed(timings["stamp_ns"], int(timings["stamp_ns"][0]))
    stages = [name.removesuffix("_ms") for name in timings if name.endswith("_ms")]
    labels = [f"{name} ({np.median(row):.1f})" for name, row in zip(stages, table, strict=True)]
    colours = [palette.STAGES.get(name, _UNKNOWN) for name in stages]
    looks: dict[str, Any] = {"step": "mid", "lw": 0, "rasterized": len(x) > MANY}
    axes.stackplot(x, table, labels=labels, colors=colours, **looks)


def edge_plot(edges: Table, first_ns: int) -> Plot:
    """Return the chi-square of the edges over time."""
    if not edges or not np.any(np.isfinite(edges["chi2"])):
        return not_drawn("chi2", "the run has no edges with residuals")
    bound = chi2_bound(0.95)
    n_refused = int(np.count_nonzero(~edges["is_accepted"]))
    numbers = {"floor": _FLOOR, "n_refused": n_refused, "n_edges": len(edges["chi2"])}
    parts = []
    for kind in palette.LINKS:
        values = edges["chi2"][_is_free(edges) & (edges["kind"] == kind)]
        if len(values) > 0:
            parts.append((kind, values.mean(), 100.0 * np.mean(values > bound)))
    return _plot("chi2", _dots(edges, first_ns, bound), bound=bound, parts=parts, **numbers)


def _is_free(edges: Table) -> Any:  # noqa: ANN401
    """Tell which edges have a residual, are accepted and not the only one of their frame."""
    _, inverse = np.unique(edges["stamp_ns"], return_inverse=True)
    n_accepted = np.bincount(inverse, weights=edges["is_accepted"])[inverse]
    return np.isfinite(edges["chi2"]) & edges["is_accepted"] & (n_accepted > 1)


def _dots(edges: Table, first_ns: int, bound: float) -> Figure:
    figure, axes = _time_axes(3.2, "chi-square [-]")
    is_known = np.isfinite(edges["chi2"])
    x = elapsed(edges["stamp_ns"], first_ns)
    y = np.maximum(np.where(is_known, edges["chi2"], 1.0), _FLOOR)
    for kind, colour in palette.LINKS.items():
        chosen = np.flatnonzero(is_known & edges["is_accepted"] & (edges["kind"] == kind))
        _scatter(axes, x[chosen], y[chosen], kind, ms=3.0, marker=_MARKERS[kind], color=colour)
    refused = np.flatnonzero(is_known & ~edges["is_accepted"])
    label = f"refused ({len(refused)})"
    _scatter(axes, x[refused], y[refused], label, ms=6.0, marker="x", color=palette.REFUSED)
    axes.axhline(N_DOF, color="black", lw=1.0, ls=":", label="6: mean of 6 dof")
    axes.axhline(bound, color="black", lw=1.0, ls="--", label=f"{bound:.1f}: 95 % bound of 6 dof")
    axes.set_yscale("log")
    plain_decades(axes.yaxis)
    axes.set_ylim(0.7 * _FLOOR, max(40.0, 2.0 * float(y.max())))
    legend_above(figure, axes)
    return figure


def _scatter(axes: Any, x: FloatArray, y: FloatArray, label: str, **looks: Any) -> None:  # noqa: ANN401
    if len(x) > 0:
        looks |= {"markeredgewidth": 0.8, "rasterized": len(x) > MANY}
        axes.plot(x, y, linestyle="", label=label, **looks)
