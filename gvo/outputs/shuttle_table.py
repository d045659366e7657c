"""The closing errors of a drive there and back as a table."""

from __future__ import annotations

from collections.abc import Mapping

from gvo.trajectory.round_trip import Closing

_HEADER = (
    "",
    "closing [m]",
    "[%]",
    "[deg]",
    "[deg/100 m]",
    "chi2",
    "mean [m]",
    "median [m]",
)


def format_closings(closings: Mapping[str, Closing]) -> str:
    """Return a table with a row for each trajectory.

    Parameters
    ----------
    closings : mapping of str to Closing
        By the names of the trajectories.

    Returns
    -------
    str
        Lines with line ends; a dash where there is no number.
    """
    rows = [_HEADER, *(_row(name, closing) for name, closing in closings.items())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADER))]
    lines = []
    for first, *rest in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(rest, widths[1:], strict=True)]
        lines.append("  ".join([f"{first:<{widths[0]}}", *cells]) + "\n")
    return "".join(lines)


def _row(name: str, closing: Closing) -> tuple[str, ...]:
    numbers = closing.as_json()
    return (
        name,
        f"{closing.closing_m:.4f}",
        _optional(closing.closing_pct, ".3f"),
        f"{closing.closing_deg:.4f}",
        _optional(closing.closing_deg_per_100m, ".3f"),
        _optional(closing.chi2, ".2f"),
        f"{numbers['mean_m']:.4f}",
        f"{numbers['median_m']:.4f}",
    )


def _optional(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
