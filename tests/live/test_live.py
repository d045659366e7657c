"""Odometry of a camera that is running: what waits, what is dropped, pipes and devices."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import cv2
import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.io.sync import Pair
from gvo.live.odometry import LiveOdometry, WaitingPairs
from gvo.live.sources import Device, StandardInput
from gvo.types import FaultyFrame, Progress
from tests.conftest import ENVIRONMENT, GVO, TABLES, Command, assert_same_files, refused
from tests.live.conftest import N_FRAMES
from tests.live.pipe import LiveCommand, sent, write_calibration

TIED = Progress(n_done=3, n_total=0, n_tracked=2)
NO_REPORT = gvo.RunOutputs(report=False)
MILLISECOND_NS = 1_000_000


def piped(data: bytes, info: RecordingInfo) -> StandardInput:
    """Return what reads these bytes from a file."""
    with TemporaryFile() as file:
        file.write(data)
        file.seek(0)
        return StandardInput(info, number=os.dup(file.fileno()))


def pair(stamp_ms: int) -> Pair:
    first, second = (
        StampedImage(stream=stream, stamp_ns=stamp_ms * MILLISECOND_NS, load=lambda: np.eye(2))
        for stream in (0, 1)
    )
    return first, second


def taken(waiting: WaitingPairs) -> list[tuple[int, str]]:
    """Return the stamps in ms of all that waits, and the reasons of what was dropped."""
    waiting.close()
    found = []
    while (item := waiting.take()) is not None:
        if isinstance(item, FaultyFrame):
            found.append((item.stamp_ns // MILLISECOND_NS, item.reason))
        else:
            found.append((item[0].stamp_ns // MILLISECOND_NS, ""))
    return found


def test_for_one_more_the_oldest_is_dropped_and_says_so() -> None:
    waiting = WaitingPairs(max_waiting=2)
    waiting.note(TIED)
    for stamp_ms in range(1, 6):
        waiting.put(pair(stamp_ms))
    found = taken(waiting)
    assert [stamp for stamp, _ in found] == [1, 2, 3, 4, 5]
    assert ["2 pairs wait (--queue)" in reason for _, reason in found] == [True] * 3 + [False] * 2
    assert waiting.n_dropped == 3


def test_pairs_that_wait_take_512_mb() -> None:
    waiting = WaitingPairs(max_waiting=300)
    for stamp_ms in range(60):
        first, second = pair(stamp_ms)
        waiting.put((replace(first, n_bytes=10**7), replace(second, n_bytes=10**7)))
    reasons = [reason for _, reason in taken(waiting)]
    assert reasons.count("") == 25
    assert all("512 MB of pairs wait" in reason for reason in reasons[:-25])


def test_nothing_is_dropped_before_two_frames_are_tied() -> None:
    waiting = WaitingPairs(max_waiting=2, max_lag_s=0.001)
    for stamp_ms in range(50):
        waiting.put(pair(10 * stamp_ms))
    waiting.note(Progress(n_done=1, n_total=0, n_tracked=1))
    assert not any(isinstance(waiting.take(), FaultyFrame) for _ in range(2))
    assert waiting.n_dropped == 0
    for stamp_ms in range(50, 400):  # but memory has an end
        waiting.put(pair(10 * stamp_ms))
    assert waiting.n_dropped == 400 - 2 - 300


def test_what_is_too_old_is_dropped_when_it_is_taken() -> None:
    waiting = WaitingPairs(max_lag_s=60.0)
    waiting.note(TIED)
    for stamp_ms in (0, 50_000, 100_000):
        waiting.put(pair(stamp_ms))
    (dropped, reason), *rest = taken(waiting)
    assert dropped == 0
    assert reason == "dropped, tracking is behind: its pose would be 100.00 s late (--max-lag)"
    assert rest == [(50_000, ""), (100_000, "")]


def test_the_slowest_frame_of_late_counts_but_the_newest_is_taken() -> None:
    waiting = WaitingPairs(max_lag_s=0.03)
    waiting.note(TIED)
    for tracking_s in (0.05, 0.0):
        waiting.put(pair(0))
        waiting.take()
        time.sleep(tracking_s)  # as tracking takes
        waiting.note(TIED)
    for stamp_ms in (1, 2):
        waiting.put(pair(stamp_ms))
    (dropped, reason), newest = taken(waiting)
    assert (dropped, newest) == (1, (2, ""))
    assert "(--max-lag)" in reason


@pytest.mark.parametrize("arguments", [{"max_waiting": 0}, {"max_lag_s": 0.0}])
def test_a_queue_of_nothing_is_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="max_waiting >= 1 and max_lag_s > 0"):
        WaitingPairs(**arguments)


@pytest.mark.parametrize(("name", "compressed"), [("drive", "png"), ("room", "")])
def test_where_nothing_is_dropped_the_poses_are_those_of_a_run(
    name: str, compressed: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    source = gvo.open_recording(request.getfixturevalue(f"{name}_bag"))
    pipe = piped(sent(source, compressed=compressed), source.info)
    live = LiveOdometry(pipe, max_waiting=1000)
    ((folder, result),) = live.run(tmp_path / "live", outputs=NO_REPORT)
    assert result.is_complete
    assert folder == tmp_path / "live"
    assert live.n_dropped == 0
    run = request.getfixturevalue(f"{name}_run")
    assert_same_files(folder, run, (*TABLES, "global.txt", "graph.g2o"))


@pytest.fixture(scope="session")
def calibration(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_calibration(
        gvo.open_recording(drive_bag).info, tmp_path_factory.mktemp("calibration")
    )


def n_poses(out: Path) -> int:
    path = out / "causal.txt"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def live(*arguments: object, calibration: list[Path], out: Path) -> list[str]:
    given = [f"--calibration={path}" for path in calibration]
    return [*map(str, arguments), *given, "--rectified", "--no-report", f"--out={out}"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_pipe_is_tracked_until_a_signal(
    number: signal.Signals, drive_bag: Path, tmp_path: Path
) -> None:
    source = gvo.open_recording(drive_bag)
    with LiveCommand(source.info, tmp_path) as run:
        # half an image stays half, and the sender is silent
        run.feed(sent(source) + b'{"stream": "left", "stamp_ns": 0, "format": "png", "size": 9}\n.')
        while n_poses(run.out) < N_FRAMES:
            assert run.process.poll() is None
        assert run.interrupt(number) == 0, run.errors
    assert f"{N_FRAMES} frames, all tracked" in "".join(run.lines)
    summary = json.loads((run.out / "summary.json").read_text())
    assert summary["state"] == "complete"
    assert (run.out / "global.txt").exists()


@pytest.mark.parametrize("closed", ["", ">&- 2>&-"])
def test_a_run_goes_on_where_nobody_reads_what_it_says(
    closed: str, drive_bag: Path, calibration: list[Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = [*GVO, *live("live", "-", "--queue=1000", calibration=calibration, out=out)]
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", *words]
    reader, writer = os.pipe()
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=writer, stderr=writer, env=ENVIRONMENT
    )
    for end in (reader, writer):
        os.close(end)
    process.communicate(sent(gvo.open_recording(drive_bag)))
    assert process.returncode == 0
    assert n_poses(out) == N_FRAMES
    assert json.loads((out / "summary.json").read_text())["state"] == "complete"


@pytest.mark.parametrize(
    ("header", "fault"),
    [
        (b"left\n", "expected a line of JSON"),
        (b"[]\n", "expected an object of JSON"),
        (b'{"stream": "up", "stamp_ns": 0}\n', '"stream" must be one of'),
        (b'{"stream": "left"}\n', '"stamp_ns" must be a whole number'),
        (b'{"stream": "left", "stamp_ns": 1e3}\n', '"stamp_ns" must be a whole number'),
        (b'{"stream": "left", "stamp_ns": 1, "encoding": "mono8"}\n', '"width" must be a whole'),
        (
            b'{"stream":"left","stamp_ns":1,"encoding":"mono8","width":1000000,"height":1000000}\n',
            "pixels",
        ),
        (b'{"stream":"left","stamp_ns":1,"encoding":"grey","width":4,"height":4}\n', "grey"),
        (b'{"stream":"left","stamp_ns":1,"encoding":"mono8","width":4,"height":4}\n...', "ends"),
        (b'{"stream": "left", "stamp_ns": 1, "format": "png", "size": -1}\n', '"size" must be'),
        (b"x" * 100_000, "expected a line of JSON"),
        (b"[" * 50_000 + b"\n", "expected a line of JSON"),
    ],
)
def test_what_is_no_image_ends_in_one_line(header: bytes, fault: str, drive_bag: Path) -> None:
    pipe = piped(header, gvo.open_recording(drive_bag).info)
    with pytest.raises(RecordingError, match=fault) as raised:
        list(pipe.images())
    assert len(str(raised.value)) < 400


@pytest.fixture
def empty_input(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        yield


@pytest.mark.usefixtures("empty_input")
def test_a_stream_without_an_image_is_named(
    calibration: list[Path], tmp_path: Path, command: Command
) -> None:
    said = refused(command("live", *live("-", calibration=calibration, out=tmp_path / "out")))
    assert said == "gvo: error: standard input: no usable frame: it holds no image\n"
    assert not (tmp_path / "out").exists()


def test_a_stream_that_breaks_off_keeps_what_was_tracked(drive_bag: Path, tmp_path: Path) -> None:
    source = gvo.open_recording(drive_bag)
    pipe = piped(sent(source)[:-1000], source.info)
    ((_, result),) = LiveOdometry(pipe, max_waiting=1000).run(tmp_path / "out", outputs=NO_REPORT)
    assert not result.is_complete
    assert any("ends after" in line for line in result.warnings)
    assert n_poses(tmp_path / "out") == N_FRAMES - 1


@pytest.fixture(scope="session")
def films(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of pictures, which OpenCV reads as a film: left, right, side by side."""
    folder = tmp_path_factory.mktemp("films")
    for index, frame in enumerate(gvo.frames(gvo.open_recording(drive_bag))):
        assert isinstance(frame, gvo.StereoFrame)
        both = np.hstack([frame.left, frame.right])
        for name, pixels in (("left", frame.left), ("right", frame.right), ("both", both)):
            cv2.imwrite(str(folder / f"{name}{index:03}.png"), pixels)
    return folder


@pytest.mark.parametrize("names", [["both%03d.png"], ["left%03d.png", "right%03d.png"]])
def test_a_device_gives_the_images_of_both_cameras(
    names: list[str],
    films: Path,
    drive_run: Path,
    calibration: list[Path],
    tmp_path: Path,
    command: Command,
) -> None:
    devices = [films / name for name in names]
    out = tmp_path / "out"
    options = live("camera", *devices, "--queue=1000", calibration=calibration, out=out)
    answer = command("live", *options)
    assert answer.code == 0, answer.err
    assert f"{N_FRAMES} frames, all tracked" in answer.out
    tracked, expected = (gvo.read_trajectory(folder / "raw.txt") for folder in (out, drive_run))
    np.testing.assert_allclose(tracked.T_world_frame, expected.T_world_frame, atol=1e-3)


class VanishingCamera:
    """Gives images of a film, at no position, and then none."""

    def __init__(self, film: cv2.VideoCapture) -> None:
        self.isOpened, self.release = film.isOpened, film.release
        self.grab, self.retrieve = film.grab, film.retrieve

    def get(self, _: int) -> float:
        return 0.0


def test_a_camera_that_vanishes_is_told(
    films: Path, drive_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = cv2.VideoCapture(str(films / "both%03d.png"))
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: VanishingCamera(film))
    device = Device(["0"], gvo.open_recording(drive_bag).info)
    ((_, result),) = LiveOdometry(device, max_waiting=1000).run(tmp_path, outputs=NO_REPORT)
    assert not result.is_complete
    assert any("0: the camera gives no more images" in line for line in result.warnings)
    assert n_poses(tmp_path) == N_FRAMES


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("camera",), "or camera DEVICE"),
        (("-", "0"), "or camera DEVICE"),
        (("radio",), "or camera DEVICE"),
        (("camera", "/nowhere/film.avi"), "OpenCV opens no camera or film"),
        (("camera", "a", "b", "c"), "side by side, or two"),
        (("camera", "a", "--sensor=rgbd"), "has no depth"),
        (("camera", "²"), "OpenCV opens no camera or film"),
        (("-", "--left=/left"), "-: --left chooses a topic"),
        (("camera", "a", "--camera-info=/info"), "camera: --camera-info chooses a topic"),
        (("-", "--qos=system"), "--qos: only ROS 2"),
        (("-", "--queue=0"), "max_waiting >= 1"),
        (("-", "--max-lag=nan"), "max_lag_s > 0"),
    ],
)
@pytest.mark.usefixtures("empty_input")
def test_what_cannot_be_opened_is_refused(
    words: tuple[str, ...], fault: str, calibration: list[Path], tmp_path: Path, command: Command
) -> None:
    one = calibration[:1] if "--sensor=rgbd" in words else calibration
    said = refused(command("live", *live(*words, calibration=one, out=tmp_path / "out")))
    assert fault in said
    assert not (tmp_path / "out").exists()
