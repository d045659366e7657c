"""Stamps: planted faults of rate, order, partners and the recording's clock."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import pytest

from gvo.diagnostics.check import Finding
from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.recording import RecordingInfo, StampedImage
from tests.diagnostics.check.planted import check, complaints, find, render
from tests.make.recordings import Held

MS = 1_000_000
PERIOD_NS = 33_333_333
Stamps: TypeAlias = np.ndarray[Any, Any]

CAMERA = PinholeCamera(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)
IMAGES = np.full((24, 32), 90, np.uint8), np.full((24, 32), 2.0, np.float32)
NOW = 1_700_000_000_000_000_000
REGULAR = NOW + PERIOD_NS * np.arange(300, dtype=np.int64)
IS_FIRST_HALF = np.arange(300) < 150


OF_STAMPS = (
    *("stamps", "period", "jitter", "gaps", "dropped frames", "stamp difference"),
    *("frames without partner", "recording clock"),
)


def timing(
    colour: Stamps, depth: Stamps | None = None, *, logs_ns: Stamps | None = None
) -> dict[str, Finding]:
    """Check small plain images of these stamps; return what is told of the stamps."""
    streams = (colour, colour if depth is None else depth)
    images = [
        StampedImage(
            stream=stream,
            stamp_ns=int(streams[stream][number]),
            load=partial(IMAGES.__getitem__, stream),
            log_time_ns=None if logs_ns is None or stream else int(logs_ns[number]),
        )
        for _, stream, number in sorted(
            (number / len(stamps_ns), stream, number)
            for stream, stamps_ns in enumerate(streams)
            for number in range(len(stamps_ns))
        )
    ]
    calibrations = (Calibration.from_camera(CAMERA),)
    info = RecordingInfo(
        name="stamps", sensor="rgbd", calibrations=calibrations, n_images=len(colour)
    )
    result = check(Held(info=info, items=images), n_samples=1)
    return {each.name: each for each in result.findings if each.name.endswith(OF_STAMPS)}


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (lambda t: np.delete(t, np.arange(5, 295, 9)), {"dropped frames"}),
        (lambda t: np.where(IS_FIRST_HALF, t, t + 2_000 * MS), {"gaps", "dropped frames"}),
        (lambda t: np.where(IS_FIRST_HALF, t, t + 700 * MS), {"gaps", "dropped frames"}),
        # An image fewer between two others is a longer step, too.
        (
            lambda t: np.where(np.arange(300) % 8 == 1, np.roll(t, 1), t),
            {"stamps", "dropped frames"},
        ),
        (
            lambda t: t + np.random.default_rng(0).uniform(-8 * MS, 8 * MS, 300).astype(np.int64),
            {"jitter"},
        ),
    ],
    ids=["dropped", "gap of 2 s", "gap of 0.7 s", "repeated", "jitter"],
)
def test_each_fault_of_one_stream_has_its_own_finding(
    fault: Callable[[Stamps], Stamps], expected: set[str]
) -> None:
    # The same in both streams, so that their partners are where they were.
    found = complaints(timing(fault(REGULAR)))
    told = {name.partition(": ")[2] for name in found if not name.startswith("colour/depth")}
    assert told == expected or told == expected - {"dropped frames"}


def test_the_numbers_of_drops_and_gaps_are_those_planted() -> None:
    findings = timing(np.delete(REGULAR, [10, 11, 12, 40, 100]))
    assert findings["colour: dropped frames"].text == "5 of 300"
    assert findings["colour: gaps"].value == pytest.approx(4 * PERIOD_NS / 1e9)
    lost = timing(np.where(IS_FIRST_HALF, REGULAR, REGULAR + 2_000 * MS))
    assert lost["colour: gaps"].verdict == "fault"  # odometry is lost after it


@pytest.mark.parametrize("offset_ms", [15, -15])
def test_depth_beside_colour_by_15_ms_is_found_with_its_sign(offset_ms: int) -> None:
    findings = timing(REGULAR, REGULAR + offset_ms * MS)
    finding = findings["colour/depth: stamp difference"]
    assert complaints(findings) == {finding.name}
    assert finding.value == pytest.approx(15.0)
    assert f"({offset_ms:+d} signed)" in finding.text


@pytest.mark.parametrize("is_depth_slower", [True, False])
def test_a_stream_of_half_the_rate_lacks_nothing(is_depth_slower: bool) -> None:
    streams = [REGULAR, REGULAR[::2]]
    assert complaints(timing(*(streams if is_depth_slower else streams[::-1]))) == set()


COLOUR = np.arange(60, dtype=np.int64) * 205 * MS
OF_A_PIECE = np.where(np.arange(60) < 30, COLOUR, COLOUR + 20_000 * MS)


@pytest.mark.parametrize(
    ("depth", "fix"),
    [
        (COLOUR + 70 * MS, "sync.max_difference_ms=70 pairs"),
        (COLOUR + 102 * MS, "by one signal"),
        # At any phase: neither clock follows the other.
        (np.arange(60, dtype=np.int64) * 197 * MS, "by one signal"),
        (OF_A_PIECE, "dropped frames"),
    ],
    ids=["late", "half a period", "own clock", "missing"],
)
def test_missing_partners_are_counted_and_explained(depth: Stamps, fix: str) -> None:
    finding = timing(COLOUR, depth)["colour/depth: frames without partner"]
    assert finding.verdict == "fault"
    assert fix in finding.fix


def test_a_tolerance_that_is_too_small_is_named_with_one_that_is_not() -> None:
    def late(stamp_ns: int, _: int) -> int:
        return stamp_ns + 5 * MS - 1000

    result = check(render("handheld", "stereo").with_stamps(late, stream=1))
    finding = find(result, "left/right: frames without partner")
    assert (finding.verdict, finding.value) == ("fault", 100.0)
    assert "--set sync.stereo_tolerance_ms=5" in finding.fix
    # The images are looked at all the same.
    assert find(result, "left/right: row offset").verdict == "ok"


LATE = np.random.default_rng(1).exponential(2 * MS, 300)
ELAPSED = REGULAR - REGULAR[0]


@pytest.mark.parametrize(
    ("delays_ns", "spread_ms"),
    [
        *((offset_ns + 4 * LATE, 0.0) for offset_ns in (0, 86_400_000 * MS, -5_000 * MS)),
        (0.02 * ELAPSED + LATE, 190.0),
        (np.where(np.arange(300) < 170, 2, 402) * MS, 400.0),
    ],
    ids=["late", "a day apart", "ahead", "drift", "set"],
)
def test_clocks_that_drift_or_are_set_are_found(delays_ns: Stamps, spread_ms: float) -> None:
    findings = timing(REGULAR, logs_ns=REGULAR + delays_ns)
    name = "colour: recording clock"
    assert complaints(findings) == ({name} if spread_ms else set())
    assert findings[name].value == pytest.approx(spread_ms, rel=0.1, abs=10.0)
