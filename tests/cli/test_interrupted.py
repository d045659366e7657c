"""A signal while a command works: one line says what stands, and how to go on."""

import json
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gtsam
import pytest

import gvo
from gvo.io.bag.reader import BagMessage
from gvo.runs.smooth import Smoother
from gvo.viz.report import run as report
from tests.conftest import Command, interrupt_at_call, line_of_poses

ANEW = "the same command begins anew"
UNDRAWN = (
    "all is computed and in {out}, not drawn; --force begins anew, gvo compare --report draws it"
)
POSES_STAND = "the poses so far are in {out}; --force begins anew"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


Interrupt = Callable[..., None]


@pytest.fixture
def interrupt(monkeypatch: pytest.MonkeyPatch) -> Interrupt:
    """Return a function that makes a call of a method raise a signal in this process."""
    return partial(interrupt_at_call, monkeypatch)


@pytest.mark.parametrize(
    ("number", "words", "stands"),
    [
        (signal.SIGINT, "check {bag}", ANEW),
        (signal.SIGTERM, "convert {bag} {out}.bag", f"{{out}}.bag is not written; {ANEW}"),
        (signal.SIGHUP, "explain {bag} --frame 9 --out {out}", ANEW),
        (signal.SIGTERM, "run {bag} --out {out}", POSES_STAND),
    ],
)
def test_a_signal_while_a_recording_is_read_ends_in_one_line(
    command: Command,
    interrupt: Interrupt,
    drive_bag: Path,
    tmp_path: Path,
    number: signal.Signals,
    words: str,
    stands: str,
) -> None:
    out = tmp_path / "out"
    interrupt(BagMessage, "decode", 12, number)
    answer = command(*words.format(bag=drive_bag, out=out).split())
    assert answer.code == CODES[number]
    assert answer.err.startswith(f"gvo: interrupted; {stands.format(out=out)}")
    assert answer.err.count("\n") == 1
    left = {path.name for path in tmp_path.iterdir()} - {"out"}
    assert not left
    if "poses" in stands:
        n_poses = {len(gvo.read_trajectory(out / f"{name}.txt")) for name in ("raw", "smoothed")}
        assert len(n_poses) == 1
        assert "This run has not ended" in (out / "report.html").read_text()


def test_a_second_signal_ends_the_drawing_of_an_interrupted_run(
    command: Command, interrupt: Interrupt, drive_bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    interrupt(BagMessage, "decode", 12)
    interrupt(report, "status_plot", 1)
    answer = command("run", drive_bag, "--out", out)
    said = f"gvo: interrupted; {POSES_STAND.format(out=out)}\n"
    assert (answer.code, answer.err) == (143, said)
    assert not (out / "report.html").exists()


def test_a_signal_while_the_report_is_drawn_leaves_the_whole_run(
    command: Command, interrupt: Interrupt, drive_bag: Path, tmp_path: Path
) -> None:
    interrupt(report, "status_plot", 1)
    answer = command("run", drive_bag, "--out", tmp_path, "--duration", "0.3")
    said = f"gvo: interrupted; {UNDRAWN.format(out=tmp_path)}\n"
    assert (answer.code, answer.err) == (143, said)
    assert not (tmp_path / "report.html").exists()
    assert json.loads((tmp_path / "summary.json").read_text())["is_complete"]
    for name in ("raw", "causal", "smoothed"):
        assert len(gvo.read_trajectory(tmp_path / f"{name}.txt")) == 3


def test_a_signal_while_poses_are_smoothed_leaves_those_before(
    command: Command, interrupt: Interrupt, tmp_path: Path
) -> None:
    poses, out = line_of_poses(tmp_path / "poses.txt"), tmp_path / "out"
    interrupt(Smoother, "take", 7)
    answer = command("smooth", poses, "--window", "--out", out)
    assert answer.code == 143
    assert answer.err == f"gvo: interrupted; {POSES_STAND.format(out=out)}\n"
    for name in ("raw", "causal", "smoothed"):
        assert len(gvo.read_trajectory(out / f"{name}.txt")) == 7


def test_a_signal_while_a_graph_is_optimized_leaves_the_best_poses(
    command: Command, interrupt: Interrupt, tmp_path: Path
) -> None:
    path = gtsam.findExampleDataFile("pose3example-grid.txt")  # type: ignore[no-untyped-call]
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert command("smooth", path, "--out", whole).code == 0
    interrupt(gtsam.LevenbergMarquardtOptimizer, "iterate", 2)
    answer = command("smooth", path, "--out", out)
    assert answer.code == 143
    assert answer.err == f"gvo: interrupted; {POSES_STAND.format(out=out)}\n"
    graph, _ = gtsam.readG2o(path, True)
    ends = [gtsam.readG2o(str(run / "smoothed.g2o"), True)[1] for run in (whole, out)]
    starts = json.loads((whole / "summary.json").read_text())["batch"]["errors_of_starts"]
    assert graph.error(ends[0]) < graph.error(ends[1]) < min(starts.values())
    for name in ("raw", "smoothed"):
        assert len(gvo.read_trajectory(out / f"{name}.txt")) == 27
