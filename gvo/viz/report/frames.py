"""Counts, times and links of frames."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.io.run_folder.reader import EdgeTable, FrameTable, TimingTable
from gvo.types import FloatArray
from gvo.viz.palette import COUNTS, HATCHES, LINKS, REFUSED, STAGES, STATUSES, Style
from gvo.viz.report.measures import N_DOF, chi2_bound, chi2_density
from gvo.viz.report.sheets import (
    N_COLUMNS,
    WIDE,
    Plot,
    arrange,
    columns_of,
    draw_curve,
    elapsed,
    kept_of_curve,
    kept_of_dots,
    new_figure,
    plain_decades,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# the ribbon's columns: a single frame is to be seen
_N_RIBBON = 400
_UNKNOWN = "#999999"
# below it a value is drawn on the floor of the logarithmic axis
_FLOOR = 1e-3
_N_COLUMNS, _N_ROWS = 300, 60
_MARKERS = {"step": "o", "keyframe": "s", "standstill": "D"}
_HATCHES = {"step": "", "keyframe": "////", "standstill": "...."}
# of the histogram: powers of ten
_DECADES = (-3.0, 3.0)
_N_BINS = 60
_NONE = "Not drawn: the run wrote no edges whose residuals are known."


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


def edge_plots(edges: EdgeTable | None, first_ns: int, link_factor: float | None) -> list[Plot]:
    """Return the chi-square of the edges over time and its histogram.

    Parameters
    ----------
    edges : EdgeTable or None
    first_ns : int
        Where the elapsed time is zero.
    link_factor : float or None
        `window.link_sigma_factor`, by which the sigmas of links to keyframes are widened.
    """
    titles = ("Chi-square of the edges", "Distribution of chi-square")
    if edges is None or not np.any(np.isfinite(edges.chi2)):
        slugs = ("chi2", "chi2_histogram")
        return [Plot(slug=s, title=t, text=_NONE) for s, t in zip(slugs, titles, strict=True)]
    bound = chi2_bound(0.95)
    n_refused = int(np.count_nonzero(~edges.is_accepted))
    return [
        Plot(
            slug="chi2",
            title=titles[0],
            text="Squared residual of each edge of a frame over its stated covariance, after the "
            f"window took the frame; values under {_FLOOR:g} lie on the floor. A residual of six "
            f"degrees of freedom would be {N_DOF} on average and under {bound:.1f} in 95 % of the "
            f"cases. {_reserve_words(link_factor)} Look for stretches near the bound and for "
            f"refused edges: {n_refused} of {len(edges.chi2)} here.",
            figure=_dots(edges, first_ns, bound),
        ),
        Plot(
            slug="chi2_histogram",
            title=titles[1],
            text="The same of the edges that were accepted, beside the density of six degrees of "
            f"freedom; the outermost bins hold all beyond. {_mean_words(edges, bound)} Bars to "
            "the left of the curve mean covariances with reserve, bars to the right too small "
            "ones. Frames with a single edge fit it exactly and are left out.",
            figure=_histogram(edges, bound),
        ),
    ]


def _reserve_words(link_factor: float | None) -> str:
    words = "These lie lower: the poses are fitted to the edges"
    if link_factor is None or link_factor == 1.0:
        return f"{words}."
    return (
        f"{words}, and the sigmas of links to keyframes are widened by {link_factor:g} "
        "(window.link_sigma_factor), since links to frames that see the same are not independent."
    )


def _is_free(edges: EdgeTable) -> Any:  # noqa: ANN401
    """Tell which edges are known, accepted and not alone with their frame."""
    _, inverse = np.unique(edges.stamps_ns, return_inverse=True)
    n_accepted = np.bincount(inverse, weights=edges.is_accepted)[inverse]
    return np.isfinite(edges.chi2) & edges.is_accepted & (n_accepted > 1)


def _mean_words(edges: EdgeTable, bound: float) -> str:
    is_free, parts = _is_free(edges), []
    for kind in LINKS:
        values = edges.chi2[is_free & (edges.kinds == kind)]
        if len(values) > 0:
            above = 100.0 * float(np.mean(values > bound))
            parts.append(f"{kind}: mean {values.mean():.2g}, {above:.1f} % above {bound:.1f}")
    return f"Here, {'; '.join(parts)}." if parts else "No frame here has more than one edge."


def _dots(edges: EdgeTable, first_ns: int, bound: float) -> Figure:
    figure = new_figure(WIDE, 3.2)
    axes = figure.subplots()
    is_known = np.isfinite(edges.chi2)
    x = elapsed(edges.stamps_ns, first_ns)
    y = np.maximum(np.where(is_known, edges.chi2, 1.0), _FLOOR)
    for kind, colour in LINKS.items():
        chosen = np.flatnonzero(is_known & edges.is_accepted & (edges.kinds == kind))
        _scatter(axes, x[chosen], y[chosen], kind, ms=3.0, marker=_MARKERS[kind], color=colour)
    refused = np.flatnonzero(is_known & ~edges.is_accepted)
    label = f"refused ({len(refused)})"
    _scatter(axes, x[refused], y[refused], label, ms=6.0, marker="x", color=REFUSED)
    axes.axhline(N_DOF, color="black", lw=1.0, ls=":", label="6: mean of 6 dof")
    axes.axhline(bound, color="black", lw=1.0, ls="--", label=f"{bound:.1f}: 95 % bound of 6 dof")
    axes.set_yscale("log")
    plain_decades(axes.yaxis)
    axes.set_ylim(0.7 * _FLOOR, max(40.0, 2.0 * float(y.max())))
    axes.margins(x=0.01)
    axes.set(xlabel="elapsed [s]", ylabel="chi-square [-]")
    arrange(figure, axes)
    return figure


def _scatter(axes: Any, x: FloatArray, y: FloatArray, label: str, **looks: Any) -> None:  # noqa: ANN401
    if len(x) == 0:
        return
    kept = kept_of_dots(x, np.log10(y), n_columns=_N_COLUMNS, n_rows=_N_ROWS)
    axes.plot(x[kept], y[kept], linestyle="", markeredgewidth=0.8, label=label, **looks)


def _histogram(edges: EdgeTable, bound: float) -> Figure:
    figure = new_figure(WIDE, 3.0)
    axes: Any = figure.subplots()
    is_free = _is_free(edges)
    bins = np.linspace(*_DECADES, _N_BINS + 1)
    for kind, colour in LINKS.items():
        values = edges.chi2[is_free & (edges.kinds == kind)]
        if len(values) == 0:
            continue
        shown = np.clip(np.log10(np.maximum(values, 1e-300)), *_DECADES)
        looks = {"histtype": "stepfilled", "facecolor": colour, "edgecolor": "black"}
        label, hatch = f"{kind} ({len(values)})", _HATCHES[kind]
        axes.hist(shown, bins, density=True, alpha=0.5, hatch=hatch, label=label, **looks)
    grid = np.linspace(*_DECADES, 400)
    # the density of the decimal logarithm
    density = chi2_density(10.0**grid) * 10.0**grid * np.log(10.0)
    axes.plot(grid, density, color="black", ls="--", label="chi-square of 6 dof")
    axes.axvline(np.log10(bound), color="black", ls=":", label=f"95 % bound: {bound:.1f}")
    decades = range(int(_DECADES[0]), int(_DECADES[1]) + 1)
    axes.set_xticks(list(decades), [f"{10.0**decade:g}" for decade in decades])
    axes.set_xlim(*_DECADES)
    axes.set_ylim(bottom=0.0)
    axes.set(xlabel="chi-square [-]", ylabel="density per decade [-]")
    arrange(figure, axes)
    return figure
