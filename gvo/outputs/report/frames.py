"""What each frame had, and what it cost: status, counts, milliseconds."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from gvo.outputs.palette import COUNTS, HATCHES, STAGES, STATUSES, Style
from gvo.outputs.report.decimation import N_COLUMNS, columns_of, kept_of_curve
from gvo.outputs.report.sheets import WIDE, Plot, arrange, draw_curve, elapsed, new_figure
from gvo.outputs.run_record import FrameTable, TimingTable
from gvo.types import FloatArray

# the ribbon's columns: a single frame is to be seen
_N_RIBBON = 400
_UNKNOWN = "#999999"


def status_plot(frames: FrameTable) -> Plot:
    """Return the ribbon of statuses, a row for each that occurs."""
    title = "Status"
    if len(frames.stamps_ns) == 0:
        return Plot(slug="status", title=title, text="Not drawn: the run holds no frame.")
    counts = Counter(frames.statuses)
    names = [*(s for s in STATUSES if counts[s]), *(s for s in counts if s not in STATUSES)]
    figure = new_figure(WIDE, 0.85 + 0.32 * len(names))
    axes = figure.subplots()
    x = elapsed(frames.stamps_ns, int(frames.stamps_ns[0]))
    statuses = np.array(frames.statuses)
    for row, name in enumerate(names):
        axes.broken_barh(
            _spans(x, statuses == name),
            (row - 0.4, 0.8),
            facecolor=STATUSES.get(name, _UNKNOWN),
            hatch=HATCHES.get(name, ""),
            edgecolor="black" if HATCHES.get(name) else "none",
            linewidth=0.0,
        )
    axes.set_yticks(range(len(names)), [f"{name}: {counts[name]}" for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.margins(x=0.005)
    axes.set_xlabel("elapsed [s]")
    arrange(figure, left=1.15)
    text = (
        "What ties each frame to those before it, a row for each status that occurs, with its "
        "frames; a single frame is widened to be seen. In a good run there is one row: ok."
    )
    return Plot(slug="status", title=title, text=text, figure=figure)


def _spans(x: FloatArray, is_there: Any) -> list[tuple[float, float]]:  # noqa: ANN401
    """Return start and width of the stretches of a status, each as wide as a column at least."""
    extent = max(float(x[-1] - x[0]), 1e-9)
    step = float(np.median(np.diff(x))) if len(x) > 1 else extent
    n_columns = max(1, min(_N_RIBBON, round(extent / step) + 1))
    marks = np.zeros(n_columns + 2, dtype=np.int64)
    marks[1 + columns_of(x, n_columns)[is_there]] = 1
    edges = np.flatnonzero(np.diff(marks)).reshape(-1, 2)
    width = (extent + step) / n_columns if len(x) > 1 else 1.0
    starts, widths = x[0] + edges[:, 0] * width, (edges[:, 1] - edges[:, 0]) * width
    return [(float(a), float(b)) for a, b in zip(starts, widths, strict=True)]


def count_plot(frames: FrameTable) -> Plot:
    """Return points, matches and inliers per frame."""
    title = "Features, matches and inliers"
    present = {n: frames.counts[n] for n in COUNTS if n in frames.counts}
    has_pose = np.array([status != "skipped" for status in frames.statuses], dtype=np.bool_)
    if not present or not np.any(has_pose):
        text = "Not drawn: the run counted none; its edges came from elsewhere."
        return Plot(slug="counts", title=title, text=text)
    figure = new_figure(WIDE, 3.0)
    axes = figure.subplots()
    x = elapsed(frames.stamps_ns, int(frames.stamps_ns[0]))
    for name, counts in present.items():
        y = np.where(has_pose, counts, np.nan).astype(np.float64)
        if name in ("matches", "inliers"):
            y[np.argmax(has_pose)] = np.nan  # the first frame has none to be matched with
        draw_curve(axes, x, y, Style(color=COUNTS[name]), label=name)
    axes.set(xlabel="elapsed [s]", ylabel="number per frame [-]")
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)
    arrange(figure, axes)
    text = (
        "Keypoints found, points with a depth, their matches in the frame before, and those that "
        "agree with the motion. Good curves lie near each other and far above "
        f"ransac.min_inliers; {_inlier_words(frames)}"
    )
    return Plot(slug="counts", title=title, text=text, figure=figure)


def _inlier_words(frames: FrameTable) -> str:
    matches, inliers = (frames.counts.get(name) for name in ("matches", "inliers"))
    if matches is None or inliers is None or not np.any(matches > 0):
        return "here no frame was matched."
    is_matched = matches > 0
    share = 100.0 * float(np.median(inliers[is_matched] / matches[is_matched]))
    median, fewest = np.median(inliers[is_matched]), inliers[is_matched].min()
    return (
        f"here the median frame has {median:.0f} inliers, {share:.0f} % of its matches, and the "
        f"worst matched one {fewest}."
    )


def timing_plot(timings: TimingTable | None) -> Plot:
    """Return the milliseconds per frame, stacked by stage."""
    title = "Milliseconds per frame"
    stages = {} if timings is None else timings.stages_ms
    if timings is None or len(timings.stamps_ns) == 0 or not stages:
        text = "Not drawn: the run wrote no times of its stages."
        return Plot(slug="timings", title=title, text=text)
    table = np.nan_to_num(np.stack(list(stages.values())))
    total = table.sum(axis=0)
    x = elapsed(timings.stamps_ns, int(timings.stamps_ns[0]))
    kept = kept_of_curve(x, total, n_columns=N_COLUMNS // 2)
    median, slow = np.quantile(total, [0.5, 0.95])
    figure = new_figure(WIDE, 3.2)
    axes = figure.subplots()
    parts = [f"{name} ({np.median(row):.1f})" for name, row in zip(stages, table, strict=True)]
    colours = [STAGES.get(name, _UNKNOWN) for name in stages]
    drawn = table[:, kept] if len(x) > 1 else np.repeat(table, 2, axis=1)
    at = x[kept] if len(x) > 1 else np.array([-0.5, 0.5])
    axes.stackplot(at, drawn, labels=parts, colors=colours, step="mid", lw=0)
    axes.axhline(median, color="black", lw=1.0, label=f"median {median:.1f}")
    axes.axhline(slow, color="black", lw=1.0, ls=":", label=f"95 %: {slow:.1f}")
    axes.set(xlabel="elapsed [s]", ylabel="milliseconds per frame [ms]")
    axes.set_ylim(0.0, 1.05 * float(total.max()) or 1.0)
    axes.margins(x=0.01)
    arrange(figure, axes)
    text = (
        "Wall time of the stages of each frame, one on top of the other; in brackets their "
        f"medians. The median frame took {median:.1f} ms, 95 % took less than {slow:.1f} ms, the "
        f"slowest {total.max():.1f} ms. {_rate_words(timings, total)}"
    )
    return Plot(slug="timings", title=title, text=text, figure=figure)


def _rate_words(timings: TimingTable, total: FloatArray) -> str:
    if len(timings.stamps_ns) < 2:
        return "A good run stays below the time between two frames."
    period_ms = float(np.median(np.diff(np.sort(timings.stamps_ns)))) / 1e6
    share = 100.0 * float(np.mean(total > period_ms))
    return (
        f"A good run stays below the time between two frames, {period_ms:.1f} ms; {share:.1f} % "
        "of the frames took longer."
    )
