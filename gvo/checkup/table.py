"""The findings of a checkup as text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import takewhile

from gvo.checkup.report import Checkup, Finding

_HEADER = ("check", "value", "threshold", "verdict", "fix")


def format_checkup(checkup: Checkup) -> str:
    """Return what is told first, an aligned table of the rest, and a line that sums it up.

    Where two streams (left and right, colour and depth) were judged alike, and nothing is wrong,
    they share a line.

    Examples
    --------
    >>> findings = (
    ...     Finding(name="recording", value="stereo, 50 + 50 images"),
    ...     Finding(name="left: gaps", value=0.1, unit="s", threshold="<= 0.5 s", verdict="ok"),
    ...     Finding(name="right: gaps", value=0.2, unit="s", threshold="<= 0.5 s", verdict="ok"),
    ... )
    >>> print(format_checkup(Checkup(recording="drive", findings=findings)), end="")
    stereo, 50 + 50 images
    check              value          threshold  verdict  fix
    left, right: gaps  0.1 s | 0.2 s  <= 0.5 s   ok
    drive: healthy
    """
    head = [finding.value_text for finding in takewhile(_is_told, checkup.findings)]
    findings = list(_merged(checkup.findings[len(head) :]))
    rows = [_HEADER, *map(_row, findings)]
    # What is only told, however long, does not push the verdicts aside.
    judged = [_HEADER, *(_row(finding) for finding in findings if not _is_told(finding))]
    widths = [max(len(row[column]) for row in judged) for column in range(len(_HEADER))]
    widths[0] = max(len(row[0]) for row in rows)
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join([*head, *lines, _sum_up(checkup)]) + "\n"


def _is_told(finding: Finding) -> bool:
    return finding.verdict == "info"


def _merged(findings: Iterable[Finding]) -> Iterator[Finding]:
    """Yield the findings, those of two streams as one where they are alike and nothing is wrong."""
    left = list(findings)
    while left:
        finding = left.pop(0)
        partner = next((other for other in left if _are_alike(finding, other)), None)
        if partner is not None:
            left.remove(partner)
            finding = _joined(finding, partner)
        yield finding


def _are_alike(first: Finding, second: Finding) -> bool:
    (one, _, what), (other, _, its) = first.name.partition(": "), second.name.partition(": ")
    return (
        bool(what)
        and (what, first.threshold, first.verdict) == (its, second.threshold, second.verdict)
        and first.verdict in ("ok", "info")
        and one != other
    )


def _joined(first: Finding, second: Finding) -> Finding:
    (one, _, what), (other, *_) = first.name.partition(": "), second.name.partition(": ")
    values = dict.fromkeys((first.value_text, second.value_text))
    return replace(first, name=f"{one}, {other}: {what}", text=" | ".join(values))


def _row(finding: Finding) -> tuple[str, ...]:
    return (finding.name, finding.value_text, finding.threshold, finding.verdict, finding.fix)


def _sum_up(checkup: Checkup) -> str:
    counts = {
        "fault": len(checkup.with_verdict("fault")),
        "warning": len(checkup.with_verdict("warning")),
    }
    parts = [f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts.items() if n]
    return f"{checkup.recording}: {', '.join(parts) or 'healthy'}"
