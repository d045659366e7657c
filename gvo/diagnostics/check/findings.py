"""Findings of a check: values with limits, verdicts and fixes, and their table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from typing import Literal, TypeAlias

from gvo._text import visible, wrapped
from gvo.errors import said

Verdict: TypeAlias = Literal["ok", "warning", "fault", "info", "unknown"]
_N_DIGITS = 3
_MAX_PLAIN = 1e7
# Where names and values begin; a longer name moves its value.
_NAME_COLUMN, _VALUE_COLUMN = 9, 41
_HEADER = f"{'verdict':9}{'check':32}value [threshold]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One result of a check; line breaks in its texts become blanks.

    Parameters
    ----------
    name : str
        What was checked, unique within a check.
    value : float or str
        A number in `unit`, or text. Shares are in percent.
    unit : str
        Unit of the number; may be empty.
    text : str
        Shown in place of the number, if not empty.
    threshold : str
        What the value is compared with; may be empty.
    verdict : {"ok", "warning", "fault", "info", "unknown"}
        A warning costs accuracy or frames, a fault most of them; unknown: the recording lacks
        what the check needs.
    fix : str
        What to do, one line; may be empty.
    """

    name: str
    value: float | str
    unit: str = ""
    text: str = ""
    threshold: str = ""
    verdict: Verdict = "info"
    fix: str = ""

    def __post_init__(self) -> None:
        """Make each text one line: names and reasons may come from damaged files."""
        for key in ("name", "value", "text", "threshold", "fix"):
            value = getattr(self, key)
            if isinstance(value, str):
                object.__setattr__(self, key, " ".join(value.split()))

    @property
    def value_text(self) -> str:
        """The value with its unit."""
        if self.text or isinstance(self.value, str):
            return self.text or str(self.value)
        return f"{number_text(self.value)} {self.unit}".strip()


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """All findings on a recording.

    Parameters
    ----------
    recording : str
        Its name.
    findings : tuple of Finding
        In the order of the checks.
    """

    recording: str
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        """Return what `gvo check` prints."""
        return said(format_check(self).rstrip())

    @property
    def is_healthy(self) -> bool:
        """Whether there is no fault; warnings do not count."""
        return not any(finding.verdict == "fault" for finding in self.findings)

    def with_verdict(self, *verdicts: Verdict) -> tuple[Finding, ...]:
        """Return the findings of these verdicts."""
        return tuple(finding for finding in self.findings if finding.verdict in verdicts)

    def as_json(self) -> dict[str, object]:
        """Return the content as JSON holds it: no NaN, no infinity."""
        findings = [asdict(finding) for finding in self.findings]
        for finding in findings:
            if isinstance(finding["value"], float) and not math.isfinite(finding["value"]):
                finding["value"] = None
        return {
            "recording": self.recording,
            "is_healthy": self.is_healthy,
            "n_warnings": len(self.with_verdict("warning")),
            "n_faults": len(self.with_verdict("fault")),
            "findings": findings,
        }


def number_text(value: float) -> str:
    """Return a number with three digits."""
    if math.isnan(value):
        return "-"
    if value == 0 or 10 ** (_N_DIGITS - 1) <= abs(value) < _MAX_PLAIN:
        return f"{value:.0f}"
    return f"{value:.{_N_DIGITS}g}"


def format_check(result: CheckResult) -> str:
    """Return the first infos, the other findings with their verdicts, and a summary.

    Two streams (left and right, colour and depth) share an entry if both are ok. No line is longer
    than 80 characters, unless a word is.

    Examples
    --------
    >>> findings = (
    ...     Finding(name="recording", value="stereo, 50 + 50 images"),
    ...     Finding(name="left: gaps", value=0.1, unit="s", threshold="<= 0.5 s", verdict="ok"),
    ...     Finding(name="right: gaps", value=0.2, unit="s", threshold="<= 0.5 s", verdict="ok"),
    ...     Finding(
    ...         name="baseline",
    ...         value=53.7,
    ...         unit="m",
    ...         threshold="0.01 .. 3 m",
    ...         verdict="warning",
    ...         fix="check the unit",
    ...     ),
    ... )
    >>> print(format_check(CheckResult(recording="drive", findings=findings)), end="")
    stereo, 50 + 50 images
    verdict  check                           value [threshold]
    ok       left, right: gaps               0.1 s | 0.2 s [<= 0.5 s]
    warning  baseline                        53.7 m [0.01 .. 3 m]
             check the unit
    drive: 1 warning; look first at baseline
    """
    head = [finding.value_text for finding in takewhile(_is_info, result.findings)]
    others = _merged(result.findings[len(head) :])
    entries = (line for finding in others for line in _entry(finding))
    lines = [*(line for text in head for line in wrapped(visible(text))), _HEADER, *entries]
    return "".join(f"{line}\n" for line in [*lines, visible(_sum_up(result))])


def _entry(finding: Finding) -> Iterator[str]:
    """Yield the lines of a finding: verdict, name, value and threshold; below them the fix."""
    threshold = f" [{finding.threshold}]" if finding.threshold else ""
    start = f"{finding.verdict:9}{finding.name:30}  {finding.value_text}"
    # a threshold is not broken
    text = visible(start) + threshold[:1] + threshold[1:].replace(" ", "\xa0")
    for line in wrapped(text, " " * _VALUE_COLUMN):
        yield line.replace("\xa0", " ")
    if finding.fix:
        yield from wrapped(f"{' ' * _NAME_COLUMN}{visible(finding.fix)}", " " * _NAME_COLUMN)


def _is_info(finding: Finding) -> bool:
    return finding.verdict == "info"


def _merged(findings: Iterable[Finding]) -> Iterator[Finding]:
    """Yield the findings, those of two streams joined where both have the same, good verdict."""
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


def _sum_up(result: CheckResult) -> str:
    verdicts: tuple[Verdict, ...] = ("fault", "warning")
    counts = [(len(result.with_verdict(verdict)), verdict) for verdict in verdicts]
    parts = [f"{n} {verdict}{'s' if n > 1 else ''}" for n, verdict in counts if n]
    worst = [each.name for verdict in verdicts for each in result.with_verdict(verdict)]
    look = f"; look first at {worst[0]}" if worst else ""
    return f"{result.recording}: {', '.join(parts) or 'healthy'}{look}"
