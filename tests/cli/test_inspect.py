"""The commands that show: what they write, what they refuse, how they end."""

import json
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import pytest

import gvo
from gvo.frontend.klt import KltFrontend
from gvo.io.excerpt import Excerpt
from tests.conftest import (
    Command,
    assert_open_to_this_machine_alone,
    assert_same_files,
    interrupt_at_call,
    refused,
    run_of,
    start,
)
from tests.make.rendered_walk import read_bag
from tests.viz.explanation.test_explanation import TRACKS

COMMANDS = (
    *("demo", "run", "check", "smooth", "compare", "convert", "config"),
    *("batch", "live", "explain", "view"),
)
FILE_STARTS = {".png": b"\x89PNG\r\n\x1a\n", ".pdf": b"%PDF-", ".rrd": b"RRF"}
# Of rendered recordings.
FIRST_NS = 1_700_000_000_000_000_000
# From reading a URL to drawing or fetching it; xmlns names and links in text do not ask for it.
OUTSIDE = re.compile(r"""(?:src|href)\s*=\s*["']?\s*(?:https?:)?//|url\(\s*["']?https?:|@import""")


def starts_rightly(path: Path) -> bool:
    return path.read_bytes().startswith(FILE_STARTS[path.suffix])


def names_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def count_rows(table: Path) -> int:
    return table.read_text().count("\n") - 1


def film_frames(path: Path) -> list[np.ndarray[Any, Any]]:
    film = cv2.VideoCapture(str(path))
    frames = []
    while (answer := film.read())[0]:
        frames.append(answer[1])
    film.release()
    return frames


def test_help_names_all_commands_on_a_screen(command: Command) -> None:
    answer = command("--help")
    assert len(answer.out.splitlines()) <= 24
    listed = re.findall(r"^│ ([a-z-]+) +[A-Z]", answer.out, re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)


# gvo run and gvo compare


@pytest.fixture(scope="module")
def drawn(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of which all is drawn that can be."""
    out = tmp_path_factory.mktemp("drawn")
    outputs = gvo.RunOutputs(overlay=out / "film.webm")
    result = run_of(drive_bag, out, excerpt=Excerpt(duration_s=0.4), outputs=outputs)
    assert result.is_complete
    assert result.report == out / "report.html"
    return out


def test_drawing_changes_nothing_of_the_run(
    command: Command, drive_bag: Path, drawn: Path, tmp_path: Path
) -> None:
    arguments = ["run", drive_bag, "--out", tmp_path, "--duration", "0.4", "--no-report"]
    answer = command(*arguments)
    assert (answer.code, answer.err) == (0, "")
    assert "m in 4 frames, all tracked; " in answer.out
    assert_same_files(tmp_path, drawn)
    drawings = {"trajectories.png", "report.html", "film.webm"}
    assert names_of(drawn) - names_of(tmp_path) == drawings


@pytest.mark.rerun
def test_a_run_is_written_for_rerun_beside_the_same_files(
    command: Command, drive_bag: Path, drawn: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    stream, out = tmp_path / "run.rrd", tmp_path / "out"
    options = ["--duration", "0.4", "--no-report", "--rerun", stream]
    answer = command("run", drive_bag, "--out", out, *options)
    assert (answer.code, answer.err) == (0, "")
    assert starts_rightly(stream)
    assert_same_files(out, drawn)
    refused_stream = command("run", drive_bag, "--out", tmp_path / "o", "--rerun", "run.rr")
    assert ".rrd" in refused(refused_stream)


def poses(path: Path, *, factor: float = 1.0) -> Path:
    rows = (f"{i} {factor * i * i} {0.1 * (i % 3)} {i} 0 0 0 1\n" for i in range(20))
    path.write_text("".join(rows))
    return path


def test_compare_reports_what_it_prints(command: Command, tmp_path: Path) -> None:
    truth, estimate = poses(tmp_path / "truth.txt"), poses(tmp_path / "estimate.txt", factor=1.01)
    page, plots = tmp_path / "page.html", tmp_path / "new/plots"
    answer = command("compare", truth, estimate, "--json", "--report", page, "--plots", plots)
    assert (answer.code, answer.err) == (0, "")
    errors = json.loads(answer.out)["estimates"][0]
    text = page.read_text(encoding="utf-8")
    assert not OUTSIDE.search(text)
    for key, n_decimals in (("ate_m", 4), ("rpe_m", 4), ("t_pct", 3)):
        assert f">{errors[key]:.{n_decimals}f}<" in text, key
    stems = {path.stem for path in plots.iterdir()}
    assert names_of(plots) == {f"{stem}{suffix}" for stem in stems for suffix in (".png", ".pdf")}
    assert "01_above" in stems


def test_what_is_written_beside_an_interrupted_run_holds_all_frames_until_then(
    command: Command, monkeypatch: pytest.MonkeyPatch, drive_bag: Path, tmp_path: Path
) -> None:
    film, bag = tmp_path / "film.webm", tmp_path / "run.mcap"
    options = ["--overlay", film, "--bag", bag, "--no-report"]
    interrupt_at_call(monkeypatch, KltFrontend, "extract", 4)
    answer = command("run", drive_bag, "--out", tmp_path, *options)
    assert (answer.code, answer.err.count("\n")) == (143, 1)
    assert answer.err.startswith("gvo: interrupted; ")
    assert len(film_frames(film)) == count_rows(tmp_path / "frames.csv") < 20
    messages = read_bag(bag)
    for name in ("raw", "causal", "smoothed"):
        n_poses = len(gvo.read_trajectory(tmp_path / f"{name}.txt"))
        assert (
            len(messages[f"/gvo/{name}/odometry"]) == n_poses == count_rows(tmp_path / "frames.csv")
        )


# gvo explain


def test_a_frame_is_explained_by_a_page_and_its_pictures(
    command: Command, drive_bag: Path, tmp_path: Path
) -> None:
    answer = command("explain", drive_bag, "--frame", "2", "--every", "2", "--out", tmp_path)
    assert (answer.code, answer.err) == (0, "")
    names = {*(f"{name}.png" for name in TRACKS), "explanation.html"}
    assert names_of(tmp_path) == names
    assert {Path(line) for line in answer.out.splitlines()} == {tmp_path / name for name in names}
    assert all(starts_rightly(path) for path in tmp_path.glob("*.png"))
    page = (tmp_path / "explanation.html").read_text(encoding="utf-8")
    assert not OUTSIDE.search(page)
    assert page.count("<img") >= len(TRACKS)
    assert f"Stamp {FIRST_NS + 4 * 100_000_000} ns, front-end klt, status ok." in page


# gvo view


@contextmanager
def viewing(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Start `gvo view`; give the process and the port of the address that it prints."""
    process = start("view", *arguments)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)\n", line)
        assert found, f"no address in {line!r}; {rest(process.stderr, line)}"
        yield process, int(found[1])
    finally:
        process.kill()
        process.communicate()


def rest(stream: IO[str] | None, line: str) -> str:
    """Return what a process that said nothing wrote to standard error."""
    return stream.read() if stream is not None and not line else ""


def fetch(port: int) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as answer:
        assert answer.status == 200
        return str(answer.read().decode())


def test_a_recording_is_served_to_this_machine_alone_until_a_signal(drive_bag: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        taken = holder.getsockname()[1]
        with viewing(drive_bag, "--port", taken) as (process, port):
            assert port != taken
            assert f"<title>gvo {drive_bag.stem}" in fetch(port)
            assert_open_to_this_machine_alone(port)
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert errors.startswith("gvo: warning: ")
    assert errors.count("\n") == 1
    assert str(taken) in errors


def test_the_folder_of_a_run_is_refused_with_the_way_to_its_report(
    command: Command, tmp_path: Path
) -> None:
    (tmp_path / "frames.csv").touch()
    said = refused(command("view", tmp_path))
    assert str(tmp_path / "report.html") in said
    assert "Rerun" in said


# Wrong use


@pytest.mark.parametrize(
    "arguments",
    [
        ["explain", "{bag}", "--frame", "-1", "--out", "out"],
        ["explain", "{bag}", "--out", "out"],
        ["view", "{bag}", "--port", "70000"],
        ["view", "{bag}", "--prot", "0"],
        ["viwe", "{bag}"],
        ["view", "{bag}", "--port", "9" * 5000],
    ],
)
def test_a_command_line_that_cannot_be_is_refused_as_all_else(
    command: Command, room_bag: Path, *, arguments: list[str]
) -> None:
    answer = command(*(argument.format(bag=room_bag) for argument in arguments))
    assert len(refused(answer)) < 300
    assert answer.out == ""
    assert re.search(r"; see `gvo( view| explain)? --help`$", answer.err)


@pytest.mark.parametrize(
    "words",
    [
        ("viser", "[view]'", "view", "{bag}", "--port", "0"),
        ("rerun", "[rerun]'", "run", "{bag}", "--out", "out", "--rerun", "run.rrd"),
    ],
)
def test_an_extra_that_is_not_installed_is_named(
    command: Command, monkeypatch: pytest.MonkeyPatch, room_bag: Path, here: Path, words: list[str]
) -> None:
    module, extra, *arguments = words
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "gvo.runs.outputs.rerun", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    said = refused(command(*(argument.format(bag=room_bag) for argument in arguments)))
    assert extra in said
    assert names_of(here) == set()
