"""Whatever stops a run: the lines on disk are whole, and the summary says how far it came."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

import gtsam
import pytest

import gvo
from gvo.errors import OutputError
from gvo.io.convert.bag_messages import BagWriter
from gvo.io.edges.opening import open_edges
from gvo.io.run_folder.reader import read_run
from gvo.runs.smooth import optimize_edges, smooth_edges, smooth_lines
from gvo.types import Progress
from tests.conftest import TABLES, Command, assert_same_files, line_of_poses, run_of

N = 12


@dataclass
class Reference:
    """A run that was never stopped, and what was on disk after each of its frames."""

    bag: Path
    folder: Path
    killed: Path
    """Folders named by numbers of frames: what kill -9 would have left."""

    def run(self, out: Path, **options: Any) -> gvo.RunResult:
        return run_of(self.bag, out, **options)

    def assert_same(self, out: Path) -> None:
        assert_same_files(out, self.folder)
        assert {path.name for path in out.iterdir()} == {
            path.name for path in self.folder.iterdir()
        }


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    path = tmp_path_factory.mktemp("drive")
    recording = gvo.SyntheticRecording("driving", "stereo", n_frames=N, scale=0.25)
    gvo.convert(recording, path / "drive.mcap")
    found = Reference(bag=path / "drive.mcap", folder=path / "whole", killed=path / "killed")

    def keep(progress: Progress) -> None:
        shutil.copytree(found.folder, found.killed / str(progress.n_done))

    found.run(found.folder, on_progress=keep)
    return found


def interrupt_at(n_frames: int) -> Callable[[Progress], None]:
    def check(progress: Progress) -> None:
        if progress.n_done >= n_frames:
            raise KeyboardInterrupt

    return check


def summary_of(out: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def assert_whole_lines(out: Path) -> None:
    for name in TABLES:
        content = (out / name).read_bytes()
        assert content.endswith(b"\n") or not content


def test_what_a_killed_run_leaves_is_the_beginning_of_the_whole_one(drive: Reference) -> None:
    for n_frames in range(1, N + 1):
        left = drive.killed / str(n_frames)
        for name in TABLES:
            lines = (left / name).read_bytes().splitlines(keepends=True)
            whole = (drive.folder / name).read_bytes().splitlines(keepends=True)
            if name.startswith("smoothed"):
                assert set(lines) <= set(whole)
            else:
                assert lines == whole[: len(lines)]
        assert len((left / "raw.txt").read_bytes().splitlines()) == n_frames


def test_the_summary_says_how_far_the_run_is(drive: Reference, tmp_path: Path) -> None:
    running = summary_of(drive.killed / "4")
    assert running["state"] == "running"
    assert not read_run(drive.killed / "4").is_finished
    assert summary_of(drive.folder)["state"] == "complete"
    assert read_run(drive.folder).is_finished
    with pytest.raises(KeyboardInterrupt):
        drive.run(tmp_path, on_progress=interrupt_at(6))
    interrupted = summary_of(tmp_path)
    assert (interrupted["state"], interrupted["frames"]) == ("interrupted", 6)
    assert interrupted["warnings"][0] == "interrupted"
    assert interrupted["run"] == running["run"] == summary_of(drive.folder)["run"]
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 6


def test_a_run_that_was_stopped_is_replaced_only_where_that_is_asked_for(
    drive: Reference, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(drive.killed / "5", out)
    (out / "run.lock").unlink()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(OutputError, match=r"out: holds an earlier result .*--force"):
        drive.run(out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert drive.run(out, force=True).is_complete
    drive.assert_same(out)


@pytest.mark.parametrize("name", ["raw.txt", "smoothed.txt"])
def test_a_full_disk_leaves_whole_lines(
    drive: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    full = _FullDisk(name, (drive.killed / "7" / name).stat().st_size - 40)
    with monkeypatch.context() as patch:
        patch.setattr("gvo.io.run_folder.line_file.io.FileIO", full.make)
        said = rf"{name}.*No space left.*; \d+ frames stand whole in {tmp_path}$"
        with pytest.raises(OutputError, match=said) as caught:
            drive.run(tmp_path, outputs=gvo.RunOutputs(bag=tmp_path / "run.mcap", report=False))
    assert caught.value.is_partly
    assert not [*tmp_path.glob("*run.mcap*"), *tmp_path.glob(".gvo-part-*")]  # it made room
    summary = summary_of(tmp_path)
    assert summary["state"] == "interrupted"
    assert "No space left" in summary["warnings"][0]
    assert_whole_lines(tmp_path)


def test_a_bag_on_a_full_disk_takes_nothing_from_the_run(
    drive: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    write = BagWriter.write

    def write_some(*arguments: Any, **options: Any) -> None:
        written.append(1)
        if len(written) > 20:
            raise OSError(28, "No space left on device")
        write(*arguments, **options)

    monkeypatch.setattr(BagWriter, "write", write_some)
    outputs = gvo.RunOutputs(bag=tmp_path / "run.mcap", report=False)
    result = drive.run(tmp_path / "out", outputs=outputs)
    assert not result.is_complete
    assert [line for line in result.warnings if "run.mcap" in line] == [
        f"{tmp_path / 'run.mcap'}: cannot be written: No space left on device"
    ]
    drive.assert_same(tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def smooth_file(folder: Path, out: Path) -> None:
    smooth_edges(open_edges([line_of_poses(folder / "poses.txt")]), out)


def smooth_stream(folder: Path, out: Path) -> None:
    smooth_lines(
        (f'{{"id": {k}, "stamp_ns": {k}000000000}}' for k in range(20)), lambda line: None, out
    )


@pytest.mark.parametrize("smooth", [smooth_file, smooth_stream])
def test_smoothing_on_a_full_disk_says_how_far_it_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, smooth: Callable[[Path, Path], None]
) -> None:
    full, out = _FullDisk("causal.txt", 500), tmp_path / "out"
    monkeypatch.setattr("gvo.io.run_folder.line_file.io.FileIO", full.make)
    said = rf"causal\.txt.*No space left.*; \d+ poses stand in {out}$"
    with pytest.raises(OutputError, match=said) as caught:
        smooth(tmp_path, out)
    assert caught.value.is_partly
    assert summary_of(out)["state"] == "interrupted"
    assert "No space left" in summary_of(out)["warnings"][0]
    for name in ("raw.txt", "causal.txt", "smoothed.txt", "frames.csv"):
        assert (out / name).read_bytes()[-1:] in (b"\n", b"")


@pytest.mark.parametrize(("name", "n_poses"), [("smoothed.txt", 4), ("summary", 27)])
def test_a_graph_optimized_onto_a_full_disk_says_how_many_poses_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, n_poses: int
) -> None:
    full, out = _FullDisk(name, 500), tmp_path / "out"
    monkeypatch.setattr("gvo.io.run_folder.line_file.io.FileIO", full.make)
    graph = gtsam.findExampleDataFile("pose3example-grid.txt")  # type: ignore[no-untyped-call]
    said = rf"{name}.*No space left.*; {n_poses} poses stand in {out}$"
    with pytest.raises(OutputError, match=said) as caught:
        optimize_edges(open_edges([Path(graph)]), out)
    assert caught.value.is_partly
    assert len(gvo.read_trajectory(out / "smoothed.txt")) == n_poses
    assert not list(out.glob("*.new"))


def test_a_graph_whose_error_still_falls_is_not_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = gtsam.findExampleDataFile("pose3example-grid.txt")  # type: ignore[no-untyped-call]
    assert optimize_edges(open_edges([Path(graph)]), tmp_path / "whole").is_complete
    monkeypatch.setattr("gvo.backend.batch._MAX_ITERATIONS", 1)
    result = optimize_edges(open_edges([Path(graph)]), tmp_path / "part")
    assert not result.is_complete
    assert "stopped after 1 iterations" in result.warnings[0]


class _FullDisk:
    """Files of a disk on which one of them cannot grow beyond a size."""

    def __init__(self, name: str, limit: int) -> None:
        self._name, self._limit = name, limit

    def make(self, path: Path, mode: str, **options: Any) -> Any:
        full = self

        class File(FileIO):
            def write(self, data: Any) -> int:
                room = full._limit - self.tell()
                if not Path(str(self.name)).name.startswith(full._name) or room >= len(data):
                    return super().write(data) or 0
                if room <= 0:
                    raise OSError(28, "No space left on device")
                return super().write(bytes(data)[:room]) or 0

        return File(path, mode, **options)


def test_a_full_disk_ends_the_command_partly(
    drive: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.setattr("gvo.io.run_folder.line_file.io.FileIO", _FullDisk("raw.txt", 500).make)
    answer = command("run", drive.bag, "--out", tmp_path, "--no-report")
    assert answer.code == 3, answer.err
    assert answer.err.endswith(f"frames stand whole in {tmp_path}\n")
    assert answer.err.count("\n") == 1
    assert_whole_lines(tmp_path)
