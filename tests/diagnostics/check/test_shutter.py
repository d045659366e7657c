"""A rolling shutter told by a check, planted in rendered recordings."""

from functools import cache
from typing import Any

import pytest

from gvo.config import Config
from gvo.diagnostics.check import Finding, check_recording
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from tests.diagnostics.check.planted import render
from tests.make.recordings import Held

PLANTED_MS = 25.0


@cache
def rolling(sensor: Sensor) -> Held:
    source = SyntheticRecording(
        "handheld", sensor, n_frames=30, seed=2, scale=0.5, readout_ms=PLANTED_MS
    )
    return Held(info=source.info, items=list(source.images()))


def found_in(recording: Any, readout_ms: float | None = None) -> list[Finding]:
    config = Config.model_validate({"camera": {"readout_ms": readout_ms}})
    result = check_recording(recording, config, n_samples=4)
    return [finding for finding in result.findings if finding.name == "rolling shutter"]


@pytest.mark.parametrize(
    ("readout_ms", "verdict"),
    [
        (0.0, "warning"),
        pytest.param(PLANTED_MS, "ok", marks=pytest.mark.acceptance),
    ],
)
def test_a_rolling_shutter_is_told_and_compared_with_the_readout_given(
    readout_ms: float | None, verdict: str
) -> None:
    (finding,) = found_in(rolling("rgbd"), readout_ms)
    assert finding.verdict == verdict
    assert finding.value == pytest.approx(PLANTED_MS, abs=3.0)
    assert ("camera.readout_ms" in finding.fix) == (verdict == "warning")


def test_a_global_shutter_is_told() -> None:
    (finding,) = found_in(render("handheld", "rgbd"), 0.0)
    assert finding.verdict == "ok"
    assert abs(float(finding.value)) < 3.0


def test_a_camera_that_stands_tells_nothing_of_its_shutter() -> None:
    recording = render("handheld", "stereo")
    first = [recording.stream(number)[0] for number in (0, 1)]
    still = recording.mapped(lambda image, _: image)
    items = [
        type(image)(stream=image.stream, stamp_ns=image.stamp_ns, load=first[image.stream].load)
        for image in still.items
    ]
    assert found_in(Held(info=recording.info, items=items)) == []
    assert found_in(Held(info=recording.info, items=items[:2])) == []
