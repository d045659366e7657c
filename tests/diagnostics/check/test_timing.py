"""Stamps: planted faults of rate, order, partners and clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.config import Config
from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.sampling import StreamStamps, Survey
from gvo.diagnostics.check.timing import check_timing
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.recording import RecordingInfo
from tests.diagnostics.check.planted import check, complaints, find, render

MS = 1_000_000
PERIOD_NS = 33_333_333
Change = Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]

CAMERA = PinholeCamera(fx=500.0, fy=500.0, cx=319.5, cy=239.5, width=640, height=480)
INFO = RecordingInfo(
    name="stamps", sensor="rgbd", calibrations=(Calibration.from_camera(CAMERA),), n_images=1
)


def regular(n: int = 300) -> np.ndarray[Any, Any]:
    return 1_700_000_000_000_000_000 + PERIOD_NS * np.arange(n, dtype=np.int64)


def stream(stamps_ns: np.ndarray[Any, Any], logs_ns: np.ndarray[Any, Any] | None) -> StreamStamps:
    none = np.zeros(0, dtype=np.int64)
    return StreamStamps(
        stamps_ns=stamps_ns,
        log_times_ns=none if logs_ns is None else logs_ns.astype(np.int64),
        headers_ns=none if logs_ns is None else stamps_ns,
    )


def timing(
    colour: np.ndarray[Any, Any],
    depth: np.ndarray[Any, Any] | None = None,
    *,
    n_pairs: int | None = None,
    logs_ns: np.ndarray[Any, Any] | None = None,
) -> dict[str, Finding]:
    depth = colour if depth is None else depth
    survey = Survey(
        streams=(stream(colour, logs_ns), stream(depth, None)),
        n_pairs=len(colour) if n_pairs is None else n_pairs,
        samples=(),
        damage="",
    )
    return {finding.name: finding for finding in check_timing(survey, INFO, Config())}


@given(st.integers(10, 400), st.integers(1, 200), st.floats(0, 0.08), st.integers(0, 2**32 - 1))
def test_regular_stamps_are_in_order(n: int, period_ms: int, jitter: float, seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, n) * period_ms * MS
    stamps_ns = np.arange(n, dtype=np.int64) * period_ms * MS + noise.astype(np.int64)
    findings = timing(stamps_ns)
    assert complaints(findings) == set()
    assert all(finding.verdict != "unknown" for finding in findings.values())


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (lambda t: np.delete(t, np.arange(5, 295, 9)), {"dropped frames"}),
        (lambda t: np.where(np.arange(300) < 150, t, t + 2_000 * MS), {"gaps", "dropped frames"}),
        (lambda t: np.where(np.arange(300) < 150, t, t + 700 * MS), {"gaps", "dropped frames"}),
        (lambda t: np.where(np.arange(300) % 8 == 1, np.roll(t, 1), t), {"stamps"}),
        (
            lambda t: t + np.random.default_rng(0).uniform(-8 * MS, 8 * MS, 300).astype(np.int64),
            {"jitter"},
        ),
    ],
    ids=["dropped", "gap of 2 s", "gap of 0.7 s", "repeated", "jitter"],
)
def test_each_fault_of_one_stream_has_its_own_finding(fault: Change, expected: set[str]) -> None:
    # The same in both streams, so that their partners are where they were.
    findings = timing(fault(regular()))
    wanted = {f"{name}: {what}" for name in ("colour", "depth") for what in expected}
    if expected == {"stamps"}:  # an image fewer between two others is a longer step, too
        wanted |= {f"{name}: dropped frames" for name in ("colour", "depth")}
    assert wanted >= complaints(findings)
    assert {f"{name}: {what}" for name in ("colour", "depth") for what in expected} <= (
        complaints(findings) | {"colour: dropped frames", "depth: dropped frames"}
    )
    assert complaints(findings)


def test_the_numbers_of_drops_and_gaps_are_those_planted() -> None:
    findings = timing(np.delete(regular(), [10, 11, 12, 40, 100]))
    assert findings["colour: dropped frames"].text == "5 of 300"
    assert findings["colour: gaps"].text == "1, longest 0.133 s"
    assert findings["colour: gaps"].value == pytest.approx(4 * PERIOD_NS / 1e9)


def test_a_gap_after_which_odometry_is_lost_is_a_fault() -> None:
    stamps_ns = np.where(np.arange(300) < 150, regular(), regular() + 2_000 * MS)
    assert timing(stamps_ns)["colour: gaps"].verdict == "fault"


@pytest.mark.parametrize("offset_ms", [15, -15])
def test_depth_beside_colour_by_15_ms_is_found_with_its_sign(offset_ms: int) -> None:
    findings = timing(regular(), regular() + offset_ms * MS)
    finding = findings["colour/depth: stamp difference"]
    assert complaints(findings) == {finding.name}
    assert finding.value == pytest.approx(15.0)
    assert f"({offset_ms:+d} signed)" in finding.text


@pytest.mark.parametrize("is_depth_slower", [True, False])
def test_a_stream_of_half_the_rate_lacks_nothing(is_depth_slower: bool) -> None:
    streams = [regular(), regular()[::2]]
    first, second = streams if is_depth_slower else streams[::-1]
    assert complaints(timing(first, second, n_pairs=150)) == set()


def test_missing_partners_are_counted_and_blamed_on_the_stream() -> None:
    findings = timing(regular(), regular()[::2], n_pairs=75)
    finding = findings["colour/depth: frames without partner"]
    assert (finding.verdict, finding.value) == ("fault", 50.0)
    assert "dropped frames" in finding.fix


@pytest.mark.parametrize(("late_ms", "fix"), [(70, "max_difference_ms=70"), (102, "by one signal")])
def test_no_tolerance_is_advised_that_pairs_wrong_frames(late_ms: int, fix: str) -> None:
    colour = np.arange(60, dtype=np.int64) * 205 * MS
    findings = timing(colour, colour + late_ms * MS, n_pairs=0)
    assert fix in findings["colour/depth: frames without partner"].fix
    # at any phase: neither clock follows the other
    findings = timing(colour, np.arange(60, dtype=np.int64) * 197 * MS, n_pairs=20)
    assert "by one signal" in findings["colour/depth: frames without partner"].fix


def test_a_tolerance_that_is_too_small_is_named_with_one_that_is_not() -> None:
    def late(stamp_ns: int, _: int) -> int:
        return stamp_ns + 5 * MS - 1000

    result = check(render("handheld", "stereo").with_stamps(late, stream=1))
    finding = find(result, "left/right: frames without partner")
    assert (finding.verdict, finding.value) == ("fault", 100.0)
    assert "--set sync.stereo_tolerance_ms=5" in finding.fix
    # The images are looked at all the same.
    assert find(result, "left/right: row offset").verdict == "ok"


def test_dropped_images_of_a_rendered_recording_are_found() -> None:
    recording = render("handheld", "rgbd")
    thinned = recording.mapped(lambda image, number: None if number % 7 == 3 else image)
    assert complaints(check(thinned)) == {"colour: dropped frames", "depth: dropped frames"}


@pytest.mark.parametrize("offset_ns", [0, 3 * MS, 86_400_000 * MS, -5_000 * MS])
def test_clocks_that_differ_by_a_constant_and_by_late_messages_are_fine(offset_ns: int) -> None:
    late_ns = np.random.default_rng(1).exponential(8 * MS, 300)
    assert complaints(timing(regular(), logs_ns=regular() + offset_ns + late_ns)) == set()


def test_drift_between_the_clocks_is_measured() -> None:
    late_ns = np.random.default_rng(1).exponential(2 * MS, 300)
    elapsed_ns = regular() - regular()[0]
    findings = timing(regular(), logs_ns=regular() + 0.005 * elapsed_ns + late_ns)
    assert complaints(findings) == {"colour: clock drift"}
    assert findings["colour: clock drift"].value == pytest.approx(300.0, rel=0.1)  # ms a minute


def test_a_clock_that_is_set_while_recording_is_found() -> None:
    logs_ns = regular() + 2 * MS + np.where(np.arange(300) < 170, 0, 400 * MS)
    findings = timing(regular(), logs_ns=logs_ns)
    assert complaints(findings) == {"colour: clock jump"}
    assert findings["colour: clock jump"].value == pytest.approx(400.0)


def test_the_recording_clock_reaches_the_check_from_the_images() -> None:
    recording = render("handheld", "rgbd").mapped(
        lambda image, number: replace(image, log_time_ns=image.stamp_ns + 7 * MS)
    )
    result = check(recording)
    assert find(result, "colour: recording clock").value == "7 ms after the header"
    assert find(result, "depth: clock drift").value == pytest.approx(0.0, abs=1e-9)
    assert complaints(result) == set()
