"""Whole recordings: clean ones are healthy, each planted fault is found by its own finding."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gvo.config import Config
from gvo.diagnostics.check import check_recording
from gvo.diagnostics.check.shutter import Looked
from gvo.io.opening import open_recording
from gvo.testing import FaultySource
from tests import faults as made
from tests.diagnostics.check.planted import check, complaints, find, render
from tests.make.recordings import Held

Fault = made.Fault | Callable[[Held], Held]


def planted(fault: Fault, recording: Held) -> FaultySource | Held:
    if isinstance(fault, made.Fault):
        return FaultySource(recording, fault)
    return fault(recording)


@pytest.mark.parametrize(
    ("world", "sensor", "seed"),
    [
        ("handheld", "stereo", 0),
        ("handheld", "rgbd", 0),
    ],
)
def test_clean_recordings_give_no_complaints(world: str, sensor: str, seed: int) -> None:
    result = check(render(world, sensor, seed))
    assert complaints(result) == set()
    assert not result.with_verdict("unknown")
    assert result.is_healthy


def shifted_rows(recording: Any) -> Any:
    return recording.with_pixels(lambda image: moved(image, 0.0, 1.5), stream=1)


def rotated(recording: Any) -> Any:
    def turn(image: NDArray[Any]) -> NDArray[Any]:
        height, width = image.shape
        M = cv2.getRotationMatrix2D((width / 2, height / 2), 1.5, 1.0)
        return np.asarray(cv2.warpAffine(image, M, (width, height)))

    return recording.with_pixels(turn, stream=1)


def out_of_step(n_frames: int) -> Callable[[Held], Held]:
    """Return the fault that right images show what left ones showed so many frames before."""

    def delay(recording: Any) -> Any:
        right = recording.stream(1)

        def take(image: Any, number: int) -> Any:
            if not 0 <= number - n_frames < len(right):
                return None
            return replace(image, load=right[number - n_frames].load) if image.stream else image

        return recording.mapped(take)

    return delay


def moved(image: NDArray[Any], du: float, dv: float) -> NDArray[Any]:
    M = np.array([[1.0, 0.0, du], [0.0, 1.0, dv]])
    return np.asarray(cv2.warpAffine(image, M, image.shape[::-1], borderMode=cv2.BORDER_REFLECT))


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (shifted_rows, {"left/right: row offset", "left/right: row field"}),
        (rotated, {"left/right: row spread", "left/right: row field"}),
        (made.Exchanged(), {"left/right: order"}),
    ],
)
def test_stereo_faults_alone_are_found(fault: Fault, expected: set[str]) -> None:
    result = check(planted(fault, render("handheld", "stereo")))
    found = complaints(result)
    # A turn of the image moves its rows at the middle hardly, but not by exactly nothing.
    assert expected <= found <= expected | {"left/right: row offset"}
    if isinstance(fault, made.Exchanged):
        assert find(result, "left/right: order").fix.startswith("exchange --left and --right; if P")
        assert not result.is_healthy


@pytest.mark.parametrize(("n_frames", "word"), [(1, "late"), (-1, "early")])
def test_a_stream_a_frame_late_is_found_in_its_images(n_frames: int, word: str) -> None:
    result = check(out_of_step(n_frames)(render("handheld", "stereo")))
    finding = find(result, "left/right: same moment")
    assert finding.verdict == "fault"
    assert f"a frame {word}" in finding.fix
    # Images that were not taken at once have no disparities to speak of.
    others = {f"left/right: {name}" for name in ("row spread", "row field", "order", "trigger")}
    assert complaints(result) <= {finding.name, "left/right: lens distortion"} | others


def test_a_lens_not_rectified_is_found_though_rows_hardly_differ() -> None:
    recording = render("handheld", "stereo")
    camera, k1 = recording.info.camera, -0.3
    distorted = recording.with_pixels(lambda image: through_lens(image, camera.K, k1))
    finding = find(check(distorted, n_samples=8), "left/right: lens distortion")
    assert finding.verdict == "fault"
    # The series of a strong distortion ends later than with its first term.
    assert 0.6 < float(finding.value) / k1 < 1.7


def through_lens(image: NDArray[Any], K: NDArray[Any], k1: float) -> NDArray[Any]:
    """Return what a lens with distortion shows of an ideal image."""
    height, width = image.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    ideal = cv2.undistortPoints(
        pixels.reshape(-1, 1, 2).astype(np.float64), K, np.array([k1, 0.0, 0.0, 0.0]), P=K
    ).reshape(height, width, 2)
    maps = ideal.astype(np.float32)
    return np.asarray(cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR))


def zoomed_depth(recording: Any) -> Any:
    def zoom(depth: NDArray[Any]) -> NDArray[Any]:
        height, width = depth.shape
        M = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, 1.1)
        return np.asarray(cv2.warpAffine(depth, M, (width, height), flags=cv2.INTER_NEAREST))

    return recording.with_pixels(zoom, stream=1)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (made.of_depth(made.holes, part=0.6), {"depth: unknown"}),
        (made.of_all(made.shifted, columns=4, rows=-5, streams=(1,)), {"depth: misregistration"}),
        (zoomed_depth, {"depth: misregistration"}),
    ],
)
def test_faults_of_depth_are_found_and_nothing_else(fault: Fault, expected: set[str]) -> None:
    assert complaints(check(planted(fault, render("handheld", "rgbd")))) == expected


def noise_alone(recording: Held) -> Held:
    def noise(image: NDArray[Any]) -> NDArray[Any]:
        rng = np.random.default_rng(int(image.astype(np.int64).sum()))
        return np.asarray(np.rint(rng.normal(110, 2, image.shape)), dtype=np.uint8)

    return recording.with_pixels(noise, stream=0)


WITH_DEPTH = "depth: corners with depth"


@pytest.mark.parametrize(
    ("fault", "expected", "tolerated"),
    [
        (
            made.spoilt(made.exposed, factor=3.0),
            {"colour: clipped pixels"},
            {"colour: brightness", "colour: corners", WITH_DEPTH},
        ),
        (made.spoilt(made.blurred, sigma_px=2.5), {"colour: blur"}, set()),
        (noise_alone, {"colour: corners"}, {"colour: corners found again", WITH_DEPTH}),
    ],
)
def test_faults_of_images_are_found_and_nothing_else(
    fault: Fault, expected: set[str], tolerated: set[str]
) -> None:
    found = complaints(check(planted(fault, render("handheld", "rgbd"))))
    assert expected <= found <= expected | tolerated


def test_images_that_do_not_decode_are_counted_and_quoted() -> None:
    fault = made.Unloadable(end=12, streams=(1,), message="/camera: the JPEG image is truncated")
    result = check(FaultySource(render("handheld", "rgbd"), fault))
    assert complaints(result) == {"frames that cannot be used"}
    fix = find(result, "frames that cannot be used").fix
    assert fix == "depth image: /camera: the JPEG image is truncated"


def test_damage_ends_the_reading_but_not_the_check() -> None:
    fault = made.BrokenOff(first=20, message="a.bag: truncated at 61 %")
    result = check(FaultySource(render("handheld", "rgbd"), fault))
    assert complaints(result) == {"reading"}
    assert find(result, "reading").value == "a.bag: truncated at 61 %"
    assert find(result, "depth: scale").verdict == "ok"


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("n_items", [0, 1, 3])
def test_hardly_any_images_are_reported_and_nothing_breaks(sensor: str, n_items: int) -> None:
    recording = render("handheld", sensor)
    result = check(replace(recording, items=recording.items[:n_items]))
    # a depth image less than colour is no loss, a right one less than left is
    assert result.is_healthy == ((n_items, sensor) == (3, "rgbd"))
    assert json.loads(json.dumps(result.as_json(), allow_nan=False))


def test_only_the_samples_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    # And what shows a rolling shutter.
    nothing = lambda *_: Looked([], [])  # noqa: E731
    monkeypatch.setattr("gvo.diagnostics.check.recording.look_closely", nothing)
    loaded = []

    def count(image: Any, number: int) -> Any:
        def load() -> NDArray[Any]:
            loaded.append((image.stream, number))
            return np.asarray(image.load())

        return replace(image, load=load)

    check(render("handheld", "rgbd").mapped(count), n_samples=3)
    assert sorted(loaded) == [(s, n) for s in (0, 1) for n in (0, 1, 12, 13, 24, 25)]


@pytest.mark.recorded
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("kitti_06_start", {"left/right: row field"}),  # as a run learns it
        pytest.param("euroc_mh01_start", set(), marks=pytest.mark.acceptance),
    ],
)
def test_recorded_stereo_is_healthy(gvo_data: Path, name: str, expected: set[str]) -> None:
    result = check_recording(open_recording(gvo_data / name), Config(), n_samples=6)
    assert complaints(result) == expected


@pytest.mark.recorded
def test_a_free_running_kinect_is_usable_with_its_known_flaws(gvo_data: Path) -> None:
    source = open_recording(gvo_data / "rgbd_dataset_freiburg1_xyz_start")
    result = check_recording(source, Config())
    assert result.is_healthy
    # Colour and depth are half a period apart; its driver registers to about three pixels.
    known = {"colour/depth: stamp difference", "depth: misregistration"}
    assert "colour/depth: stamp difference" in complaints(result) <= known


@pytest.mark.recorded
@pytest.mark.acceptance
def test_depth_that_is_not_registered_is_found_in_a_recorded_sequence(gvo_data: Path) -> None:
    result = check_recording(open_recording(gvo_data / "sevenscenes_start"), Config())
    finding = find(result, "depth: misregistration")
    assert finding.verdict == "fault"
    # Focal lengths of a Kinect: 525 px of colour, 585 px of depth.
    assert "zoom 0.90" in finding.text
    # Some of its images are the same as the one before, byte by byte.
    frozen = {"colour: frozen images", "depth: frozen images"}
    assert complaints(result) <= {finding.name} | frozen
