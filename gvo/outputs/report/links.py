"""How well the window's poses fit the edges of each frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.outputs.palette import LINKS, REFUSED
from gvo.outputs.report.decimation import kept_of_dots
from gvo.outputs.report.measures import N_DOF, chi2_bound, chi2_density
from gvo.outputs.report.sheets import WIDE, Plot, arrange, elapsed, new_figure, plain_decades
from gvo.outputs.run_record import EdgeTable
from gvo.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# below it a value is drawn on the floor of the logarithmic axis
_FLOOR = 1e-3
_N_COLUMNS, _N_ROWS = 300, 60
_MARKERS = {"step": "o", "keyframe": "s", "standstill": "D"}
_HATCHES = {"step": "", "keyframe": "////", "standstill": "...."}
# of the histogram: powers of ten
_DECADES = (-3.0, 3.0)
_N_BINS = 60
_NONE = "Not drawn: the run wrote no edges whose residuals are known."


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
