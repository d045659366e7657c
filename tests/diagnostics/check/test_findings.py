"""Findings, limits, tables and JSON."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.diagnostics.check import CheckResult, Finding, format_check
from gvo.diagnostics.check.findings import Limits
from gvo.diagnostics.check.limits import measured

WORDS = st.text(st.characters(codec="ascii", categories=["L", "N"]), min_size=1, max_size=12)
VERDICTS = st.sampled_from(["ok", "warning", "fault", "info", "unknown"])
FINDINGS = st.builds(
    Finding,
    name=WORDS,
    value=st.one_of(st.floats(), WORDS),
    unit=st.sampled_from(["", "px", "%"]),
    threshold=st.sampled_from(["", "<= 2 px"]),
    verdict=VERDICTS,
    fix=WORDS,
)
RESULTS = st.builds(CheckResult, recording=WORDS, findings=st.lists(FINDINGS).map(tuple))


@given(RESULTS)
def test_json_holds_every_finding_and_no_nan(result: CheckResult) -> None:
    content = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert [row["name"] for row in content["findings"]] == [f.name for f in result.findings]
    assert content["is_healthy"] == (content["n_faults"] == 0)
    for row, finding in zip(content["findings"], result.findings, strict=True):
        is_number = isinstance(finding.value, float)
        if is_number and not math.isfinite(float(finding.value)):
            assert row["value"] is None
        else:
            assert row["value"] == finding.value


@given(RESULTS)
def test_the_table_has_a_line_per_finding_and_aligned_columns(result: CheckResult) -> None:
    n_told = next((n for n, f in enumerate(result.findings) if f.verdict != "info"), None)
    told = result.findings[:n_told]
    text = format_check(result)
    assert text.endswith("\n")
    lines = text.splitlines()
    assert lines[: len(told)] == [finding.value_text for finding in told]
    header, *rows, last = lines[len(told) :]
    assert last.startswith(result.recording)
    column = header.index("verdict")
    for row, finding in zip(rows, result.findings[len(told) :], strict=True):
        assert row.startswith(finding.name)
        if finding.verdict != "info":
            assert row[column:].startswith(finding.verdict)
        assert row.endswith(finding.fix)


@given(st.floats(-10, 10), st.floats(-1, 1), st.floats(2, 3))
def test_farther_out_is_never_judged_milder(value: float, limit: float, fault: float) -> None:
    limits = Limits(low=-limit, high=limit + 1, fault_low=-fault, fault_high=fault)
    ranks = {"ok": 0, "warning": 1, "fault": 2}
    outward = 1.5 * value if abs(value) > fault else math.copysign(fault + 1, value)
    assert ranks[limits.judge(outward)] >= ranks[limits.judge(value)]
    assert ranks[limits.judge(outward)] == 2


def test_the_limits_themselves_are_still_within() -> None:
    limits = Limits(low=1.0, high=2.0, fault_high=3.0)
    assert [limits.judge(value) for value in (1.0, 2.0, 2.1, 3.0, 3.1, 0.9)] == [
        *("ok", "ok", "warning", "warning", "fault", "warning"),
    ]
    assert limits.judge(math.nan) == "unknown"
    assert limits.describe("m") == "1 .. 2 m"


def test_only_what_is_wrong_has_a_fix() -> None:
    fine, wrong = (measured("row spread", value, fix="calibrate") for value in (0.1, 2.1))
    assert (fine.verdict, fine.fix) == ("ok", "")
    assert (wrong.verdict, wrong.fix) == ("fault", "calibrate")


def test_shares_are_shown_in_percent() -> None:
    finding = measured("jitter", 0.45, stream="left")
    assert (finding.name, finding.value_text) == ("left: jitter", "45 %")
    assert (finding.threshold, finding.verdict) == ("<= 30 %", "warning")


def test_a_limit_may_come_from_the_configuration() -> None:
    assert measured("corners", 20.0).verdict == "warning"
    assert measured("corners", 20.0, fault_low=30.0).verdict == "fault"


def test_warnings_alone_do_not_make_a_recording_unusable() -> None:
    warning = Finding(name="a", value=1.0, verdict="warning", fix="do")
    fault = Finding(name="b", value=1.0, verdict="fault", fix="do")
    assert CheckResult(recording="r", findings=(warning,)).is_healthy
    result = CheckResult(recording="r", findings=(warning, fault, warning))
    assert not result.is_healthy
    assert format_check(result).endswith("\nr: 1 fault, 2 warnings\n")


def _of_streams(**second: str) -> list[str]:
    first = {"name": "left: rows", "value": "3", "threshold": "<= 5", "verdict": "ok"}
    findings = (Finding(**first), Finding(**(first | second)))  # type: ignore[arg-type]
    return format_check(CheckResult(recording="r", findings=findings)).splitlines()[1:-1]


def test_two_streams_share_a_line_where_both_are_well() -> None:
    (row,) = _of_streams(name="right: rows", value="4")
    assert row.split("  ")[0] == "left, right: rows"
    assert "3 | 4" in row
    (row,) = _of_streams(name="right: rows")
    assert "|" not in row


@pytest.mark.parametrize(
    "second",
    [
        {"name": "right: rows", "verdict": "warning", "fix": "do"},
        {"name": "right: rows", "threshold": "<= 6"},
        {"name": "right: columns"},
    ],
)
def test_what_differs_in_more_than_the_value_has_a_line_of_its_own(second: dict[str, str]) -> None:
    assert len(_of_streams(**second)) == 2


def test_line_ends_in_damaged_names_do_not_break_the_table() -> None:
    finding = Finding(name="tf: a\nb", value="c\r\nd", fix="e\n")
    assert (finding.name, finding.value, finding.fix) == ("tf: a b", "c d", "e")


@pytest.mark.parametrize("content", [{"name": ""}, {"name": " \n"}, {"verdict": "fault"}])
def test_what_would_break_a_table_is_refused(content: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"finding|needs a fix"):
        Finding(**({"name": "rows", "value": 1.0} | content))  # type: ignore[arg-type]
