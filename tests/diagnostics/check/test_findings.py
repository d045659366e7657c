"""Findings, limits, tables and JSON."""

from __future__ import annotations

import json
import math

from hypothesis import given
from hypothesis import strategies as st

from gvo.diagnostics.check import CheckResult, Finding, format_check
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
def test_the_table_has_an_entry_per_finding_and_names_the_worst(result: CheckResult) -> None:
    n_told = next((n for n, f in enumerate(result.findings) if f.verdict != "info"), None)
    told = result.findings[:n_told]
    text = format_check(result)
    assert text.endswith("\n")
    lines = text.splitlines()
    assert lines[: len(told)] == [finding.value_text for finding in told]
    header, *rows, last = lines[len(told) :]
    assert header.split() == ["verdict", "check", "value", "[threshold]"]
    entries = [row.split(maxsplit=2) for row in rows if not row.startswith(" ")]
    shown = result.findings[len(told) :]
    assert [entry[:2] for entry in entries] == [[f.verdict, f.name] for f in shown]
    assert [row.strip() for row in rows if row.startswith(" ")] == [f.fix for f in shown]
    worst = [*result.with_verdict("fault"), *result.with_verdict("warning")]
    assert last.startswith(result.recording)
    assert last.endswith(f"look first at {worst[0].name}" if worst else ": healthy")


def test_lines_fit_a_terminal_and_no_word_nor_threshold_is_broken() -> None:
    finding = Finding(
        name="colour/depth: frames without partner",
        value="14 of 120 at sync.max_difference_ms=20 and so on and on",
        threshold="<= 5 %",
        verdict="warning",
        fix=" ".join(["images-of-one-stream"] * 8),
    )
    lines = format_check(CheckResult(recording="drive", findings=(finding,))).splitlines()[1:-1]
    assert [line.strip() for line in lines] == [
        "warning  colour/depth: frames without partner  14 of 120 at",
        "sync.max_difference_ms=20 and so on and",
        "on [<= 5 %]",
        *[" ".join(["images-of-one-stream"] * n) for n in (3, 3, 2)],
    ]


def test_a_number_is_judged_by_its_rule_and_only_what_is_wrong_has_a_fix() -> None:
    fine, wrong = (measured("left/right: row spread", value) for value in (0.1, 2.1))
    assert (fine.verdict, fine.fix) == ("ok", "")
    assert wrong.verdict == "fault"
    assert wrong.fix
    share = measured("left: jitter", 0.45)
    assert (share.value_text, share.threshold, share.verdict) == ("45 %", "<= 30 %", "warning")
    # Another fix, and limits of the configuration.
    assert measured("corners", 20.0, fix="do").fix == "do"
    assert measured("corners", 20.0, fault_low=30.0).verdict == "fault"
