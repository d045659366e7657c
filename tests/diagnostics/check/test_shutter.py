"""A rolling shutter told by a check, planted in rendered recordings."""

from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from gvo.config import Config
from gvo.diagnostics.check import Finding, check_recording
from gvo.errors import RecordingError
from gvo.io.recording import Sensor, StampedImage
from gvo.io.synthetic import SyntheticRecording
from tests.diagnostics.check.planted import N_FRAMES, render
from tests.recordings import Held

PLANTED_MS = 25.0


@cache
def rolling(sensor: Sensor) -> Held:
    source = SyntheticRecording(
        "handheld", sensor, n_frames=N_FRAMES, seed=2, readout_ms=PLANTED_MS
    )
    return Held(info=source.info, items=list(source.images()))


def found_in(recording: Any, readout_ms: float | None = None) -> list[Finding]:
    config = Config.model_validate({"camera": {"readout_ms": readout_ms}})
    result = check_recording(recording, config, n_samples=4)
    return [finding for finding in result.findings if finding.name == "rolling shutter"]


@pytest.mark.parametrize("sensor", [pytest.param("stereo", marks=pytest.mark.acceptance), "rgbd"])
def test_a_rolling_shutter_is_told(sensor: Sensor) -> None:
    (finding,) = found_in(rolling(sensor))
    assert finding.verdict == "info"
    assert finding.value == pytest.approx(PLANTED_MS, abs=3.0)


@pytest.mark.acceptance
@pytest.mark.parametrize(("readout_ms", "verdict"), [(0.0, "warning"), (PLANTED_MS, "ok")])
def test_a_given_readout_is_compared_with_it(readout_ms: float, verdict: str) -> None:
    (finding,) = found_in(rolling("rgbd"), readout_ms)
    assert finding.verdict == verdict
    assert ("camera.readout_ms" in finding.fix) == (verdict == "warning")


def test_a_global_shutter_is_told() -> None:
    (finding,) = found_in(render("handheld", "stereo"), 0.0)
    assert finding.verdict == "ok"
    assert abs(float(finding.value)) < 2.0


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


def test_three_parts_are_decoded_where_the_camera_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gvo.diagnostics.check.shutter._N_FRAMES", 6)
    loaded = []

    def count(image: StampedImage, number: int) -> StampedImage:
        def load() -> Any:
            loaded.append(number)
            return image.load()

        return replace(image, load=load)

    found_in(render("handheld", "rgbd").mapped(count))
    # Samples of two frames, then three frames on either side of three of the samples.
    samples = {0, 1, 13, 14, 25, 26, 38, 39}
    of_parts = {number for number in loaded if loaded.count(number) > 2 * (number in samples)}
    assert 9 <= len(of_parts) <= 21
    assert all(any(abs(number - each) <= 3 for each in samples) for number in of_parts)


def test_a_recording_that_breaks_off_is_looked_at_up_to_there() -> None:
    recording = render("handheld", "stereo")
    broken = Held(info=recording.info, items=recording.items[:30], damage="torn")
    with pytest.raises(RecordingError):
        list(broken.images())
    assert len(found_in(broken)) <= 1
