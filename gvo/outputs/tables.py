"""Evaluations as a text table for people and as JSON for programs."""

from __future__ import annotations

from collections.abc import Sequence

from gvo.evaluation import Evaluation

_HEADER = (
    "estimate",
    "poses",
    "coverage [%]",
    "ATE RMSE [m]",
    "ATE max [m]",
    "RPE [m]",
    "RPE [deg]",
    "segments [m]",
    "t_err [%]",
    "r_err [deg/100 m]",
    "path ratio",
)


def format_evaluations(evaluations: Sequence[Evaluation]) -> str:
    """Return a table with a row per evaluation, columns aligned by blanks.

    Parameters
    ----------
    evaluations : sequence of Evaluation

    Returns
    -------
    str
        Lines ended by line feeds; "-" where there is no value, as for rotations against
        positions alone.
    """
    rows = [_HEADER, *(_cells(evaluation) for evaluation in evaluations)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        # names to the left, numbers to the right
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
        for row in rows
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"


def evaluations_json(
    evaluations: Sequence[Evaluation],
) -> dict[str, list[dict[str, str | int | float | None]]]:
    """Return the measures as plain values.

    Parameters
    ----------
    evaluations : sequence of Evaluation

    Returns
    -------
    dict
        `{"estimates": [{"name", "n", "ate_m", "rpe_m", "rpe_deg", "t_pct",
        "r_deg_per_100m"}]}`; None where no pair or no segment fits, or there are no rotations.
    """
    return {
        "estimates": [
            {
                "name": evaluation.name,
                "n": evaluation.n,
                "ate_m": evaluation.ate_m,
                "rpe_m": evaluation.rpe_m,
                "rpe_deg": evaluation.rpe_deg,
                "t_pct": evaluation.t_pct,
                "r_deg_per_100m": evaluation.r_deg_per_100m,
            }
            for evaluation in evaluations
        ]
    }


def _cells(evaluation: Evaluation) -> tuple[str, ...]:
    return (
        evaluation.name,
        str(evaluation.n),
        f"{100.0 * evaluation.coverage:.1f}",
        f"{evaluation.ate_m:.4f}",
        f"{evaluation.ate_max_m:.4f}",
        _number(evaluation.rpe_m, 4),
        _number(evaluation.rpe_deg, 4),
        _segments(evaluation),
        _number(evaluation.t_pct, 3),
        _number(evaluation.r_deg_per_100m, 3),
        _number(evaluation.path_ratio, 3),
    )


def _number(value: float | None, n_decimals: int) -> str:
    return "-" if value is None else f"{value:.{n_decimals}f}"


def _segments(evaluation: Evaluation) -> str:
    if evaluation.n_segments == 0:
        return "-"
    shortest, longest = min(evaluation.segments_m), max(evaluation.segments_m)
    return f"{shortest:g}" if shortest == longest else f"{shortest:g}..{longest:g}"
