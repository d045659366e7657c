"""An interrupted run loses nothing: whatever stopped it, it goes on as if nothing had."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import gvo
from gvo.config import Config
from gvo.errors import ConfigurationError, OutputError, RecordingError, ResumeError
from gvo.geometry import se3
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import OutputFrame
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.io.run_folder.reader import read_run
from gvo.io.run_folder.writer import JOURNAL
from gvo.io.synthetic.recording import SyntheticRecording
from gvo.resuming.journal import Journal
from gvo.run_tally import Progress
from gvo.trajectory.trajectory import Trajectory
from tests.conftest import Command

N = 12
NO_REPORT = gvo.RunOutputs(report=False)
# All but the times that things took.
TABLES = (
    *(f"{name}.txt" for name in ("raw", "causal", "smoothed")),
    *(f"{name}_covariance.csv" for name in ("raw", "causal", "smoothed")),
    "frames.csv",
    "edges.csv",
)
KINDS = [("stereo", "klt"), ("stereo", "descriptor"), ("rgbd", "klt"), ("rgbd", "descriptor")]


@cache
def _render(
    world: str, sensor: str
) -> tuple[RecordingInfo, list[tuple[StampedImage, NDArray[Any]]]]:
    source = SyntheticRecording(world, sensor, n_frames=N, scale=0.25)  # type: ignore[arg-type]
    return source.info, [(image, image.load()) for image in source.images()]


class Rendered:
    """A rendered recording, rendered once; it knows what was decoded."""

    def __init__(self, sensor: str = "stereo") -> None:
        world = "driving" if sensor == "stereo" else "handheld"
        self.info, images = _render(world, sensor)
        self.items = [self._loaded(*image) for image in images]
        self.decoded_ns: list[int] = []
        self.n_whole = len(self.items)

    def images(self) -> Iterator[StampedImage]:
        yield from self.items[: self.n_whole]

    def ground_truth(self) -> Trajectory | None:
        return None

    def _loaded(self, image: StampedImage, pixels: NDArray[Any]) -> StampedImage:
        def load() -> NDArray[Any]:
            self.decoded_ns.append(image.stamp_ns)
            return pixels

        return replace(image, load=load)

    def spoil(self, index: int) -> None:
        """Make the left image of a frame one that cannot be read."""

        def fail() -> NDArray[Any]:
            raise RecordingError("the image is cut off")

        self.items[2 * index] = replace(self.items[2 * index], load=fail)


@dataclass
class Reference:
    """A run that was never stopped, and what was on disk after each of its frames."""

    source: Rendered
    config: Config
    folder: Path
    killed: Path
    """Folders named by numbers of frames: what kill -9 would have left."""

    def copy(self, n_frames: int, path: Path) -> Path:
        return Path(shutil.copytree(self.killed / str(n_frames), path))

    def resume(self, out: Path, **options: Any) -> gvo.RunResult:
        asked: dict[str, Any] = {"config": self.config, "outputs": NO_REPORT, "resume": True}
        return gvo.run_recording(self.source, out, **{**asked, **options})

    def assert_same(self, out: Path) -> None:
        for name in TABLES:
            assert (out / name).read_bytes() == (self.folder / name).read_bytes(), name
        n_times = len((self.folder / "timings.csv").read_text().splitlines())
        assert len((out / "timings.csv").read_text().splitlines()) == n_times
        assert counts_of(out) == counts_of(self.folder)
        left = {path.name for path in out.iterdir()} - {path.name for path in self.folder.iterdir()}
        assert left == set()


def counts_of(out: Path) -> dict[str, Any]:
    """Return what a summary says but for times and memory."""
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return {name: summary[name] for name in summary if name not in ("median_ms", "peak_memory_mb")}


def make_reference(source: Rendered, config: Config, path: Path, **options: Any) -> Reference:
    folder = path / "whole"

    def keep(progress: Progress) -> None:
        shutil.copytree(folder, path / "killed" / str(progress.n_done))

    gvo.run_recording(source, folder, config=config, outputs=NO_REPORT, on_progress=keep, **options)
    return Reference(source=source, config=config, folder=folder, killed=path / "killed")


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def any_run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Reference:
    sensor, kind = request.param
    config = gvo.load_configuration(settings=[f"frontend.kind={kind}"])
    return make_reference(Rendered(sensor), config, tmp_path_factory.mktemp(f"{sensor}-{kind}"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    return make_reference(Rendered(), Config(), tmp_path_factory.mktemp("drive"))


def interrupt_at(n_frames: int) -> Callable[[Progress], None]:
    def check(progress: Progress) -> None:
        if progress.n_done >= n_frames:
            raise KeyboardInterrupt

    return check


def bytes_of(out: Path, *, without: Iterable[str] = ()) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name not in without}


def test_a_killed_run_goes_on_as_if_it_had_never_been_stopped(
    any_run: Reference, tmp_path: Path
) -> None:
    out = any_run.copy(5, tmp_path / "out")
    result = any_run.resume(out)
    assert result.exit_code == 0
    assert result.notes == ("resumed after 5 frames",)
    any_run.assert_same(out)


@pytest.mark.parametrize("n_frames", [1, 2, N - 1, N])
def test_whenever_it_was_killed_it_goes_on(drive: Reference, tmp_path: Path, n_frames: int) -> None:
    out = drive.copy(n_frames, tmp_path / "out")
    drive.resume(out)
    drive.assert_same(out)


def test_an_interrupted_run_goes_on_as_if_it_had_never_been_stopped(
    any_run: Reference, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        any_run.resume(tmp_path / "out", resume=False, on_progress=interrupt_at(8))
    smoothed = gvo.read_trajectory(tmp_path / "out" / "smoothed.txt")
    assert len(smoothed) == 8
    any_run.resume(tmp_path / "out")
    any_run.assert_same(tmp_path / "out")


def test_what_a_killed_run_leaves_is_the_beginning_of_the_whole_one(any_run: Reference) -> None:
    for n_frames in range(1, N + 1):
        left = any_run.killed / str(n_frames)
        for name in TABLES:
            lines = (left / name).read_bytes().splitlines(keepends=True)
            whole = (any_run.folder / name).read_bytes().splitlines(keepends=True)
            if name.startswith("smoothed"):
                assert set(lines) <= set(whole)
            else:
                assert lines == whole[: len(lines)]
        assert len((left / "raw.txt").read_bytes().splitlines()) == n_frames


def test_a_run_that_was_stopped_again_and_again_is_the_same(
    drive: Reference, tmp_path: Path
) -> None:
    out = drive.copy(2, tmp_path / "out")
    for n_frames in (4, 5, 9):
        with pytest.raises(KeyboardInterrupt):
            drive.resume(out, on_progress=interrupt_at(n_frames))
    assert drive.resume(out).notes == ("resumed after 9 frames",)
    drive.assert_same(out)


def test_interrupted_while_it_is_repeated_nothing_changes(drive: Reference, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        drive.resume(out, resume=False, on_progress=interrupt_at(7))
    before = bytes_of(out)
    with pytest.raises(KeyboardInterrupt):
        drive.resume(out, on_progress=interrupt_at(3))
    assert bytes_of(out) == before


def test_killed_while_it_resumes_it_loses_nothing(drive: Reference, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        drive.resume(out, resume=False, on_progress=interrupt_at(7))

    def keep(progress: Progress) -> None:
        shutil.copytree(out, tmp_path / str(progress.n_done))

    drive.resume(out, on_progress=keep)
    for n_frames in (2, 7, 8):
        assert (tmp_path / str(n_frames) / "smoothed.txt.resumed").exists() == (n_frames <= 7)
        drive.resume(tmp_path / str(n_frames))
        drive.assert_same(tmp_path / str(n_frames))


def test_only_frames_that_are_still_needed_are_decoded_again(
    drive: Reference, tmp_path: Path
) -> None:
    out = drive.copy(N, tmp_path / "out")
    drive.source.decoded_ns.clear()
    drive.resume(out)
    stamps = sorted({image.stamp_ns for image in drive.source.items})
    decoded = set(drive.source.decoded_ns)
    assert stamps[-1] in decoded
    assert len(decoded) < N


def test_lines_that_were_cut_off_are_made_whole(drive: Reference, tmp_path: Path) -> None:
    for n_cut in (1, 200, 10**6):
        out = drive.copy(6, tmp_path / str(n_cut))
        for name in (*TABLES, "timings.csv"):
            path = out / name
            os.truncate(path, max(path.stat().st_size - n_cut, 0))
        drive.resume(out)
        drive.assert_same(out)


def test_lines_that_are_there_stay_as_they_are(drive: Reference, tmp_path: Path) -> None:
    """Even where they are not what this machine would compute."""
    out = drive.copy(9, tmp_path / "out")
    for name in TABLES:
        content = (out / name).read_bytes()
        (out / name).write_bytes(content.replace(b"7\n", b"8\n"))
    before = {name: (out / name).read_bytes() for name in TABLES}
    drive.resume(out)
    for name, content in before.items():
        lines, after = content.splitlines(), (out / name).read_bytes().splitlines()
        assert set(lines) <= set(after) if "smoothed" in name else after[: len(lines)] == lines


def test_a_journal_without_its_end_costs_only_time(drive: Reference, tmp_path: Path) -> None:
    size = (drive.killed / "7" / JOURNAL).stat().st_size
    for n_cut in (1, 1000, size - 20, size):
        out = drive.copy(7, tmp_path / str(n_cut))
        os.truncate(out / JOURNAL, size - n_cut)
        drive.resume(out)
        drive.assert_same(out)


def test_a_journal_that_is_damaged_anywhere_costs_only_time(
    drive: Reference, tmp_path: Path
) -> None:
    content = (drive.killed / "8" / JOURNAL).read_bytes()
    for position in np.linspace(0, len(content) - 1, 5).astype(int):
        out = drive.copy(8, tmp_path / str(position))
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        (out / JOURNAL).write_bytes(damaged)
        drive.resume(out)
        drive.assert_same(out)


def test_frames_that_cannot_be_used_are_counted_once(tmp_path: Path) -> None:
    source = Rendered("rgbd")
    source.spoil(3)
    source.spoil(7)
    del source.items[2 * 9 + 1]  # colour without depth
    source.n_whole = len(source.items)
    reference = make_reference(source, Config(), tmp_path)
    for n_frames in (4, 8, 10):
        out = reference.copy(n_frames, tmp_path / f"out{n_frames}")
        assert reference.resume(out).exit_code == 3
        reference.assert_same(out)
    assert counts_of(reference.folder)["status_counts"]["skipped"] == 2
    assert counts_of(reference.folder)["unpaired_images"] == 1


def test_a_lost_camera_is_found_again_as_without_interruption(tmp_path: Path) -> None:
    source = Rendered("rgbd")
    pairs = [source.items[2 * n : 2 * n + 2] for n in range(N)]
    way = [*pairs[:4], *(_dark(pair) for pair in pairs[4:8]), *pairs[3::-1]]
    source.items = [
        replace(image, stamp_ns=pair[0].stamp_ns)
        for pair, shown in zip(pairs, way, strict=True)
        for image in shown
    ]
    config = gvo.load_configuration(settings=["window.lost_after_s=0.05"])
    reference = make_reference(source, config, tmp_path)
    assert len(counts_of(reference.folder)["segments"]) == 2
    for n_frames in (6, 9):
        out = reference.copy(n_frames, tmp_path / f"out{n_frames}")
        assert reference.resume(out).exit_code == 3
        reference.assert_same(out)


def _dark(pair: list[StampedImage]) -> list[StampedImage]:
    pixels = np.zeros_like(pair[0].load())
    return [replace(pair[0], load=lambda: pixels), pair[1]]


def test_poses_of_another_frame_from_another_start_go_on(tmp_path: Path) -> None:
    T = se3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]))

    def frame() -> OutputFrame:
        return OutputFrame("base_link", T, T_initial=T)

    reference = make_reference(Rendered(), Config(), tmp_path, frame=frame(), excerpt=Excerpt())
    out = reference.copy(5, tmp_path / "out")
    reference.resume(out, frame=frame())
    reference.assert_same(out)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"config": gvo.load_configuration(settings=["window.size=7"])}, "window.size was 5, is 7"),
        ({"excerpt": Excerpt(every=2)}, "excerpt.every was 1, is 2"),
        ({"excerpt": Excerpt(duration_s=5.0)}, "excerpt.duration_s was null, is 5.0"),
        ({"frame": OutputFrame("base_link")}, "output.frame was"),
        ({"frame": OutputFrame(T_initial=np.eye(4))}, "output.initial pose was"),
    ],
)
@pytest.mark.parametrize("is_complete", [False, True])
def test_a_run_of_another_kind_is_refused(
    drive: Reference, tmp_path: Path, options: dict[str, Any], said: str, is_complete: bool
) -> None:
    source = drive.folder if is_complete else drive.killed / "5"
    out = Path(shutil.copytree(source, tmp_path / "out"))
    before = bytes_of(out)
    with pytest.raises(ResumeError, match=f"{said}.*run without --resume"):
        drive.resume(out, **options)
    assert bytes_of(out) == before


def test_another_version_is_refused(
    drive: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = drive.copy(5, tmp_path / "out")
    monkeypatch.setattr("gvo.resuming.header.__version__", "99.0")
    with pytest.raises(ResumeError, match=r"version of gvo was .*, is \"99.0\""):
        drive.resume(out)


def test_another_recording_is_refused(drive: Reference, tmp_path: Path) -> None:
    out = drive.copy(5, tmp_path / "out")
    first = drive.source.items[0]
    brighter = Rendered()
    brighter.items[0] = replace(first, load=lambda: first.load() + 1)
    with pytest.raises(ResumeError, match=r"recording\.first images"):
        gvo.run_recording(brighter, out, outputs=NO_REPORT, resume=True)
    longer = Rendered()
    longer.info = replace(longer.info, n_images=99)
    with pytest.raises(ResumeError, match="number of images was 12, is 99"):
        gvo.run_recording(longer, out, outputs=NO_REPORT, resume=True)
    drive.resume(out)
    drive.assert_same(out)


@pytest.mark.parametrize("change", ["shorter", "without a frame"])
def test_a_recording_that_lost_frames_is_refused_and_nothing_is_lost(
    drive: Reference, tmp_path: Path, change: str
) -> None:
    out = drive.copy(8, tmp_path / "out")
    changed = Rendered()
    if change == "shorter":
        changed.n_whole = 12
    else:
        del changed.items[6:8]
    with pytest.raises(ResumeError, match="not the recording of that run"):
        gvo.run_recording(changed, out, outputs=NO_REPORT, resume=True)
    drive.resume(out)
    drive.assert_same(out)


def test_a_frame_that_cannot_be_read_again_is_named(drive: Reference, tmp_path: Path) -> None:
    out = drive.copy(8, tmp_path / "out")
    changed = Rendered()
    changed.spoil(7)
    with pytest.raises(ResumeError, match=r"cannot be read again.*cut off"):
        gvo.run_recording(changed, out, outputs=NO_REPORT, resume=True)


def test_tables_that_were_changed_are_refused(drive: Reference, tmp_path: Path) -> None:
    out = drive.copy(8, tmp_path / "out")
    lines = (out / "raw.txt").read_text().splitlines(keepends=True)
    (out / "raw.txt").write_text("".join(lines[2:]))
    with pytest.raises(ResumeError, match=r"raw\.txt.*was changed"):
        drive.resume(out)
    (out / "raw.txt").write_text("".join(lines))
    (out / "frames.csv").write_text("stamp,other\n")
    with pytest.raises(ResumeError, match=r"frames\.csv.*was changed"):
        drive.resume(out)


def test_a_run_that_another_process_writes_is_refused(drive: Reference, tmp_path: Path) -> None:
    out = drive.copy(5, tmp_path / "out")
    journal = Journal.open(out / JOURNAL)
    assert journal is not None
    with journal, pytest.raises(ResumeError, match="another process"):
        drive.resume(out)
    drive.resume(out)
    drive.assert_same(out)


@pytest.mark.parametrize("name", ["bag", "overlay", "rerun"])
def test_what_is_written_as_a_whole_is_refused(drive: Reference, tmp_path: Path, name: str) -> None:
    given: dict[str, Any] = {name: tmp_path / "file"}
    outputs = gvo.RunOutputs(report=False, **given)
    with pytest.raises(ConfigurationError, match=f"--resume does not go with --{name}"):
        drive.resume(drive.copy(5, tmp_path / "out"), outputs=outputs)


def test_a_complete_run_is_left_as_it_is(drive: Reference, tmp_path: Path) -> None:
    out = Path(shutil.copytree(drive.folder, tmp_path / "out"))
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()}
    drive.source.decoded_ns.clear()
    result = drive.resume(out)
    assert (result.exit_code, result.summary["frames"]) == (0, N)
    assert "complete" in result.notes[0]
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.iterdir()} == before
    assert len(drive.source.decoded_ns) == 2  # to tell that it is this recording


def test_without_a_run_it_begins(drive: Reference, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    begun = drive.copy(1, tmp_path / "begun")
    os.truncate(begun / JOURNAL, 100)
    for out in (tmp_path / "new", tmp_path / "empty", begun):
        assert "began with the first frame" in drive.resume(out).notes[0]
        drive.assert_same(out)


def test_without_resume_an_interrupted_run_is_replaced(drive: Reference, tmp_path: Path) -> None:
    out = drive.copy(5, tmp_path / "out")
    assert drive.resume(out, resume=False).notes == ()
    drive.assert_same(out)


def test_what_another_command_wrote_is_refused(drive: Reference, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text('{"recording": "poses"}')
    with pytest.raises(ResumeError, match="holds no run"):
        drive.resume(tmp_path)
    (tmp_path / "summary.json").write_text("[" * 100_000)
    with pytest.raises(ResumeError, match="cannot be read"):
        drive.resume(tmp_path)


def test_the_summary_says_how_far_the_run_is(drive: Reference, tmp_path: Path) -> None:
    running = counts_of(drive.killed / "4")
    assert running["state"] == "running"
    assert not read_run(drive.killed / "4").is_finished
    assert counts_of(drive.folder)["state"] == "complete"
    assert read_run(drive.folder).is_finished
    with pytest.raises(KeyboardInterrupt):
        drive.resume(tmp_path, resume=False, on_progress=interrupt_at(6))
    interrupted = counts_of(tmp_path)
    assert (interrupted["state"], interrupted["frames"]) == ("interrupted", 6)
    assert "--resume" in interrupted["warnings"][0]


def test_a_picture_that_cannot_be_drawn_takes_nothing_from_the_run(
    drive: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gvo.viz.plots.plot_trajectories", fail)
    result = drive.resume(tmp_path / "out", resume=False, outputs=gvo.RunOutputs())
    assert result.exit_code == 3
    assert "No space left" in result.warnings[-1]
    drive.assert_same(tmp_path / "out")


@pytest.mark.parametrize("name", ["raw.txt", "edges.csv", "smoothed.txt", JOURNAL])
@pytest.mark.parametrize("is_resumed", [False, True])
def test_a_full_disk_leaves_whole_lines_and_the_run_goes_on_when_there_is_room(
    drive: Reference,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    is_resumed: bool,
) -> None:
    out = drive.copy(4, tmp_path / "out") if is_resumed else tmp_path / "out"
    limit = (drive.killed / "7" / name).stat().st_size - 40
    full = _FullDisk(name, limit)
    with monkeypatch.context() as patch:
        patch.setattr("gvo.io.run_folder.line_file.io.FileIO", full.make)
        patch.setattr("gvo.resuming.record_file.io.FileIO", full.make)
        with pytest.raises(OutputError, match=f"{name}.*No space left.*--resume goes on") as caught:
            drive.resume(out, resume=is_resumed)
    assert caught.value.is_partly
    assert counts_of(out)["state"] == "interrupted"
    for table in TABLES:
        content = (out / table).read_bytes()
        assert content.endswith(b"\n") or not content
    drive.resume(out)
    drive.assert_same(out)


class _FullDisk:
    """Files of a disk on which one of them cannot grow beyond a size."""

    def __init__(self, name: str, limit: int) -> None:
        self._name, self._limit = name, limit

    def make(self, path: Path, mode: str) -> Any:
        full = self

        class File(FileIO):
            def write(self, data: Any) -> int:
                room = full._limit - self.tell()
                if not Path(str(self.name)).name.startswith(full._name) or room >= len(data):
                    return super().write(data) or 0
                if room <= 0:
                    raise OSError(28, "No space left on device")
                return super().write(bytes(data)[:room]) or 0

        return File(path, mode)


SLOW_RUN = """
import sys, time
import gvo.cli
def slow(show, check):
    def on_progress(progress):
        time.sleep(0.1)
        check(progress)
    return on_progress
gvo.cli.both = slow
sys.argv = ["gvo", *sys.argv[1:]]
gvo.cli.main()
"""


@pytest.fixture(scope="module")
def whole_drive(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    gvo.run_recording(gvo.open_recording(drive_bag), out, outputs=NO_REPORT)
    return out


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -signal.SIGKILL)],
)
def test_a_process_that_was_ended_is_resumed_by_the_command(
    drive_bag: Path,
    whole_drive: Path,
    tmp_path: Path,
    command: Command,
    number: signal.Signals,
    code: int,
) -> None:
    out = tmp_path / "out"
    arguments = ["run", str(drive_bag), "--out", str(out), "--no-report"]
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW_RUN, *arguments], stderr=subprocess.PIPE, text=True
    )
    while not (out / "raw.txt").exists() or (out / "raw.txt").read_bytes().count(b"\n") < 5:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code
    assert ("--resume goes on" in said) == (number is not signal.SIGKILL)
    answer = command(*arguments, "--resume")
    assert (answer.code, answer.err) == (0, "")
    assert "resumed after" in answer.out
    for name in TABLES:
        assert (out / name).read_bytes() == (whole_drive / name).read_bytes(), name
    again = command(*arguments, "--resume")
    assert again.code == 0
    assert "nothing was left to do" in again.out
    other = command(*arguments, "--resume", "--every", 2)
    assert other.code == 2
    assert other.err.count("\n") == 1


def test_a_file_that_may_not_grow_ends_the_command_partly(
    drive_bag: Path, whole_drive: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "out"
    arguments = ["run", str(drive_bag), "--out", str(out), "--no-report"]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))

    ended = subprocess.run(
        [sys.executable, "-c", "import gvo.cli; gvo.cli.main()", *arguments],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 3, ended.stderr
    assert "journal.bin: cannot be written" in ended.stderr
    assert "--resume goes on" in ended.stderr
    assert command(*arguments, "--resume").code == 0
    for name in TABLES:
        assert (out / name).read_bytes() == (whole_drive / name).read_bytes(), name
