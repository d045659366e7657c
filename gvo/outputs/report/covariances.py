"""Stated covariances beside actual errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gvo.outputs.palette import ESTIMATES, Style
from gvo.outputs.report.decimation import kept_of_curve
from gvo.outputs.report.measures import N_DOF, Consistency, nees_band
from gvo.outputs.report.sheets import (
    WIDE,
    Plot,
    arrange,
    draw_curve,
    elapsed,
    new_figure,
    plain_decades,
)
from gvo.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_N_COLUMNS = 350
_SIGMAS = 3.0
# below it a value is drawn on the floor of the logarithmic axis
_FLOOR = 0.01
# rows of the figure: translations, then rotations
_PANELS = ((3, "x", "m"), (4, "y", "m"), (5, "z", "m"), (0, "x", "deg"), (1, "y", "deg"))
_ALL_PANELS = (*_PANELS, (2, "z", "deg"))


def covariance_plots(found: Sequence[Consistency], first_ns: int) -> list[Plot]:
    """Return errors with their 3-sigma bands, and the NEES.

    Parameters
    ----------
    found : sequence of Consistency
        Of causal and smoothed poses, at least one.
    first_ns : int
        Where the elapsed time is zero.
    """
    late_s = (min(int(item.stamps_ns[0]) for item in found) - first_ns) / 1e9
    step_s = float(np.median(np.diff(found[0].stamps_ns))) / 1e9 if len(found[0].nees) > 1 else 0.0
    late = (
        f" The truth begins {late_s:.2g} s after the first pose: the bands hold that time as well, "
        "the errors do not."
        if late_s > 3.0 * step_s > 0.0
        else ""
    )
    low, high = nees_band()
    return [
        Plot(
            slug="covariance",
            title="Errors within their covariances",
            text="Errors of the poses along their own axes, since the first pose, with the band "
            "of three stated sigmas (filled: smoothed; dashed: causal). Nothing is fitted: the "
            "first poses are laid onto each other, so noise of the first true pose counts as "
            f"error, the more the longer the path. {_inside(found)} In a good run 99.7 % are "
            f"inside, and the errors use more than a tenth of the band. Errors that leave it in "
            f"the first second and then stay level are those of the first true poses.{late}",
            figure=_bands(found, first_ns),
        ),
        Plot(
            slug="nees",
            title="Normalised squared error (NEES)",
            text="Error squared over stated covariance, of six degrees of freedom: "
            f"{N_DOF} on average, and 95 % between {low:.2f} and {high:.1f} (shaded), where the "
            "covariances are right. Errors of one run are tied to each other over time, so a "
            "single run may lie off for long. Above the band the run is too sure of itself, "
            f"below it too modest. {_nees_words(found)}",
            figure=_nees(found, first_ns),
        ),
    ]


def _inside(found: Sequence[Consistency]) -> str:
    parts = []
    for item in found:
        shares = 100.0 * item.share_inside(_SIGMAS)
        parts.append(
            f"{item.name}: {shares[3:].mean():.1f} % of the position and {shares[:3].mean():.1f} % "
            "of the rotation errors"
        )
    return f"Inside are, {'; '.join(parts)}."


def _nees_words(found: Sequence[Consistency]) -> str:
    parts = []
    for item in found:
        below, within, above = (100.0 * share for share in item.share_of_nees())
        parts.append(
            f"{item.name}: {within:.1f} % within, {below:.1f} % below, {above:.1f} % above, "
            f"mean {item.nees.mean():.3g}"
        )
    return f"Here, {'; '.join(parts)}."


def _bands(found: Sequence[Consistency], first_ns: int) -> Figure:
    figure = new_figure(WIDE, 5.2)
    panels: Any = figure.subplots(2, 3, sharex=True)
    for panel, (index, letter, unit) in zip(panels.flat, _ALL_PANELS, strict=True):
        factor = 1.0 if unit == "m" else float(np.rad2deg(1.0))
        for item in found:
            x = elapsed(item.stamps_ns, first_ns)
            _draw_band(panel, item.name, x, _SIGMAS * factor * item.sigmas[:, index])
        for item in found:
            x, style = elapsed(item.stamps_ns, first_ns), _style(item.name)
            y = factor * item.errors[:, index]
            draw_curve(panel, x, y, style, label=item.name, n_columns=_N_COLUMNS)
        kind = "position" if unit == "m" else "rotation"
        panel.set_ylabel(f"{kind} {letter} [{unit}]")
    for panel in panels[-1]:
        panel.set_xlabel("elapsed [s]")
    arrange(figure, panels[0, 0])
    figure.subplots_adjust(wspace=0.4, hspace=0.1)
    figure.align_ylabels()
    return figure


def _style(name: str) -> Style:
    return Style(color=ESTIMATES[name], linewidth=1.1, zorder=3.0)


def _draw_band(axes: Any, name: str, x: FloatArray, reach: FloatArray) -> None:  # noqa: ANN401
    kept = kept_of_curve(x, reach, n_columns=_N_COLUMNS)
    x, reach = x[kept], reach[kept]
    colour, label = ESTIMATES[name], f"\u00b13 sigma {name}"
    if len(x) == 1:  # a band of one pose has no area
        axes.plot([x[0], x[0]], [-reach[0], reach[0]], color=colour, marker="_", label=label)
        return
    if name == "smoothed":
        axes.fill_between(x, -reach, reach, color=colour, alpha=0.2, lw=0, label=label)
        return
    axes.plot(x, reach, color=colour, ls="--", lw=1.0, label=label)
    axes.plot(x, -reach, color=colour, ls="--", lw=1.0)


def _nees(found: Sequence[Consistency], first_ns: int) -> Figure:
    figure = new_figure(WIDE, 3.0)
    axes = figure.subplots()
    axes.axhspan(*nees_band(), color="0.9", lw=0, zorder=0.5, label="95 % band")
    axes.axhline(N_DOF, color="black", ls=":", lw=1.0, label="expected: 6")
    for item in found:
        x = elapsed(item.stamps_ns, first_ns)
        draw_curve(axes, x, np.maximum(item.nees, _FLOOR), _style(item.name), label=item.name)
    axes.set_yscale("log")
    plain_decades(axes.yaxis)
    low, high = axes.get_ylim()
    axes.set_ylim(max(min(low, 0.5), 0.7 * _FLOOR), max(high, 120.0))
    axes.margins(x=0.01)
    axes.set(xlabel="elapsed [s]", ylabel="NEES [-]")
    arrange(figure, axes)
    return figure
