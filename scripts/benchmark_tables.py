"""The tables of benchmark.py, in Markdown, so that a page of documentation can take them over."""

from collections.abc import Sequence

import gvo

ERRORS_HEADER = (
    "recording",
    "frames",
    "ATE raw [m]",
    "ATE causal [m]",
    "ATE smoothed [m]",
    "t_err raw [%]",
    "t_err smoothed [%]",
    "r_err smoothed [deg/100 m]",
    "path ratio smoothed",
)
COSTS_HEADER = (
    "recording",
    "CPU [ms]",
    "wall [ms]",
    "frames/s",
    "yardstick [ms]",
    "CPU / yardstick",
    "wall / yardstick",
    "peak [MB]",
    "growth [MB]",
)
ABLATION_HEADER = (
    "settings",
    *(
        f"{measure} {name}"
        for name in ("raw", "smoothed")
        for measure in ("ATE [m]", "t_err [%]", "RPE [m]", "RPE [deg]")
    ),
)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown, its columns aligned: names to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rules = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    return "".join(markdown_row(row, widths) for row in (header, rules, *rows))


def markdown_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return a line of such a table, its columns so wide at least."""
    aligned = [cells[0].ljust(widths[0]), *map(str.rjust, cells[1:], widths[1:])]
    return f"| {' | '.join(aligned)} |\n"


def number(value: float | None, n_decimals: int) -> str:
    """Return a number with so many decimals, "-" where there is none."""
    return "-" if value is None else f"{value:.{n_decimals}f}"


def ablation_row(name: str, raw: gvo.Evaluation, smoothed: gvo.Evaluation) -> list[str]:
    """Return the cells of a row of the ablation."""
    cells = [name]
    for evaluation in (raw, smoothed):
        cells += [
            number(evaluation.ate_m, 4),
            number(evaluation.t_pct, 2),
            number(evaluation.rpe_m, 4),
            number(evaluation.rpe_deg, 3),
        ]
    return cells


def errors_row(
    name: str, raw: gvo.Evaluation, causal: gvo.Evaluation, smoothed: gvo.Evaluation
) -> list[str]:
    """Return the cells of a recording in the table of errors."""
    return [
        name,
        str(smoothed.n),
        number(raw.ate_m, 4),
        number(causal.ate_m, 4),
        number(smoothed.ate_m, 4),
        number(raw.t_pct, 2),
        number(smoothed.t_pct, 2),
        number(smoothed.r_deg_per_100m, 2),
        number(smoothed.path_ratio, 4),
    ]
