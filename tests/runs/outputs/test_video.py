"""Films of runs, decoded again."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvo.io.recording import Sensor
from gvo.io.synthetic import WorldName
from gvo.runs.outputs.video import RunOverlay, film_width
from gvo.types import FaultyFrame, ImageArray
from gvo.viz.overlay import compose_faulty, compose_overlay
from tests.make.results import loop_of
from tests.make.tracked import N_FRAMES, Tracked, tracked


@pytest.fixture(scope="module")
def drive() -> Tracked:
    return tracked("driving", "stereo")


def _decoded(path: Path) -> Iterator[ImageArray]:
    capture = cv2.VideoCapture(str(path))
    while (answer := capture.read())[0]:
        yield np.asarray(answer[1], dtype=np.uint8)


@pytest.mark.parametrize(
    ("world", "sensor", "name"), [("driving", "stereo", "a.mp4"), ("handheld", "rgbd", "a.webm")]
)
def test_a_film_shows_the_picture_of_each_frame(
    world: WorldName, sensor: Sensor, name: str, tmp_path: Path
) -> None:
    run, path = tracked(world, sensor), tmp_path / name
    camera = run.recording.info.camera
    with RunOverlay(path, camera) as output:
        for frame, result in run.pairs():
            output.add_frame(frame, result)
        output.add_smoothed([])
    pictures = list(_decoded(path))
    assert len(pictures) == N_FRAMES
    for index, ((frame, result), picture) in enumerate(zip(run.pairs(), pictures, strict=True)):
        width = film_width(camera)
        expected = compose_overlay(frame, result, camera, index=index, max_width=width)
        assert picture.shape == expected.shape
        assert np.abs(picture.astype(int) - expected).mean() < 8.0
    period_ns = np.median(np.diff([frame.stamp_ns for frame in run.frames]))
    rate_hz = cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS)
    assert rate_hz == pytest.approx(1e9 / period_ns, rel=2e-3)


def test_faulty_frames_have_dark_pictures_in_their_place(drive: Tracked, tmp_path: Path) -> None:
    camera, pairs = drive.recording.info.camera, drive.pairs()
    faulty = FaultyFrame(stamp_ns=pairs[4][0].stamp_ns, reason="image_0/000004.png: is cut off")
    with RunOverlay(tmp_path / "film.mp4", camera) as output:
        for n, (frame, result) in enumerate(pairs):
            if n == 4:
                output.add_faulty(faulty)
            else:
                output.add_frame(frame, result)
    pictures = list(_decoded(tmp_path / "film.mp4"))
    assert len(pictures) == N_FRAMES
    expected = compose_faulty(faulty, camera, index=4, max_width=film_width(camera))
    assert np.abs(pictures[4].astype(int) - expected).mean() < 4.0
    assert pictures[4].mean() < 0.3 * pictures[5].mean()


@pytest.mark.parametrize(("suffix", "n_done"), [(".webm", 3)])
def test_an_interrupted_run_leaves_a_film_of_what_was_done(
    drive: Tracked, tmp_path: Path, suffix: str, n_done: int
) -> None:
    camera, pairs = drive.recording.info.camera, drive.pairs()
    path = tmp_path / "new" / f"film{suffix}"
    output = RunOverlay(path, camera)

    def run() -> None:
        with output:
            for frame, result in pairs[:n_done]:
                output.add_frame(frame, result)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert len(list(_decoded(path))) == n_done
    output.close()
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_a_loop_is_marked_for_a_second(drive: Tracked, tmp_path: Path) -> None:
    camera, pairs = drive.recording.info.camera, drive.pairs()
    loop = loop_of(pairs[2][0].stamp_ns, pairs[0][0].stamp_ns)
    ends_ns = loop.stamp_ns + 1_000_000_000
    late = [
        (replace(frame, stamp_ns=ends_ns + n), result)
        for n, (frame, result) in enumerate(pairs[5:7])
    ]
    shown = [*pairs[:4], *late]
    with RunOverlay(tmp_path / "frames", camera) as output:
        for n, (frame, result) in enumerate(shown):
            raw = replace(result.raw, stamp_ns=frame.stamp_ns)
            shown[n] = frame, replace(result, raw=raw)
            output.add_frame(frame, replace(shown[n][1], loops=(loop,) if n == 2 else ()))
    files = sorted((tmp_path / "frames").iterdir())
    is_marked = []
    for n, (file, (frame, result)) in enumerate(zip(files, shown, strict=True)):
        plain = compose_overlay(frame, result, camera, index=n, max_width=film_width(camera))
        is_marked.append(bool(np.any(cv2.imread(str(file)) != plain)))
    assert is_marked == [False, False, True, True, True, False]
