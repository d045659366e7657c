"""Each sub-command of the benchmark prints its tables, on small recordings; no time is judged."""

import re
from collections.abc import Callable
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.io.recording import Source
from gvo.testing.faults import Black, FaultySource
from gvo.types import FaultyFrame
from tests.acceptance.conftest import Script
from tests.conftest import run_of

pytestmark = pytest.mark.acceptance

Benchmark = Callable[..., str]


@pytest.fixture
def benchmark(script: Script) -> Benchmark:
    """Return a function that runs a sub-command and gives what it prints."""

    def run(*words: object) -> str:
        answer = script("benchmark", *words)
        assert answer.code == 0, answer.err
        return answer.out

    return run


def table(text: str, first: str, number: int = 0) -> dict[str, list[str]]:
    """Return the cells of a table, by those of its first column."""
    lines = text.splitlines()
    start = [n for n, line in enumerate(lines) if line.startswith(f"| {first} ")][number]
    rows = takewhile(lambda line: line.startswith("|"), lines[start + 2 :])
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return {name: numbers for name, *numbers in cells}


def ates_m(source: Source, *settings: str, first: int = 0) -> list[float]:
    """Return the errors of raw, causal and smoothed."""
    config = gvo.load_configuration(settings=settings)
    odometry = gvo.Odometry(source.info.camera, config)
    results = []
    for frame in islice(gvo.frames(source, config), first, None):
        assert not isinstance(frame, FaultyFrame)
        results.append(odometry.track(frame))
    finished = [each for result in results for each in result.finished]
    truth = source.ground_truth()
    assert truth is not None
    return [
        gvo.evaluate(truth, gvo.Trajectory.of(estimates), name="").ate_m
        for estimates in (
            [result.raw for result in results],
            [result.causal for result in results],
            [*finished, *odometry.finish()],
        )
    ]


def assert_close(cells: list[str], expected: Any) -> None:
    np.testing.assert_allclose(np.array(cells, dtype=float), expected, atol=6e-5)


def test_errors_of_recordings_are_those_of_a_run(
    benchmark: Benchmark, drive_bag: Path, room_bag: Path
) -> None:
    printed = benchmark("errors", drive_bag, room_bag)
    rows = table(printed, "recording")
    assert [row[0] for row in rows.values()] == ["20", "20"]
    for name, bag in zip(("drive", "room"), (drive_bag, room_bag), strict=True):
        assert_close(rows[name][1:4], ates_m(gvo.open_recording(bag)))
    assert [len(row) for row in table(printed, "recording", 1).values()] == [4, 4]


def test_the_cost_of_a_run_is_told_beside_the_yardstick(
    benchmark: Benchmark, drive_bag: Path
) -> None:
    printed = benchmark("cost", drive_bag, "--rounds", 1)
    for stage in ("read", "extract", "register", "links", "window", "loops", "total"):
        assert len(re.findall(rf"^{stage} +\d+\.\d\d +\d+\.\d\d$", printed, re.MULTILINE)) == 1
    cpu, wall, rate, yardstick, cpu_ratio, wall_ratio, peak, growth = map(
        float, table(printed, "recording")["drive"]
    )
    assert rate == pytest.approx(1000.0 / wall, rel=0.02)
    assert cpu_ratio == pytest.approx(cpu / yardstick, rel=0.05)
    assert wall_ratio == pytest.approx(wall / yardstick, rel=0.05)
    assert peak > growth


def checkout(folder: Path, main: str) -> Path:
    """Write another version of gvo, all of whose commands do the same, but tell of frames."""
    (folder / "gvo").mkdir(parents=True)
    (folder / "gvo" / "__init__.py").touch()
    frames = "'\\n' * (3 if '--duration' in sys.argv else 9)"
    (folder / "gvo" / "cli.py").write_text(
        f"import os, sys\n\ndef main():\n    {main}\n    os.mkdir(sys.argv[-1])\n"
        f"    open(sys.argv[-1] + '/frames.csv', 'w').write({frames})\n"
    )
    return folder


def test_whole_runs_of_two_versions_take_turns(
    benchmark: Benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log"
    note = f"open({str(log)!r}, 'a').write(' '.join(['{{}}', *sys.argv[1:-1]]) + '\\n')"
    other = checkout(tmp_path / "other", note.format("other"))
    own = checkout(tmp_path / "own", f"{note.format('own')}; text = 'x' * 10**8; text.count('y')")
    monkeypatch.setattr("gvo.__file__", str(own / "gvo" / "__init__.py"))
    options = ["--demo", "--rounds", 1, "--set", "klt.n_corners=9", "--against", other]
    printed = benchmark("cost", "room.bag", *options)
    of_frames, whole = table(printed, "command")["room.bag"], table(printed, "command", 1)["demo"]
    # Of a recording after CPU and elapsed time per frame, which importing is no part of.
    for row, places in ((of_frames, (6, 9)), (whole, (0, 6))):
        cpu, memory = (list(map(float, row[k : k + 3])) for k in places)
        assert cpu[0] > cpu[1] > 0.0
        assert memory[0] > memory[1] + 80.0
        assert memory[2] == pytest.approx(memory[0] / memory[1], rel=0.1)
    run = f"run {tmp_path / 'room.bag'} --no-report --set klt.n_corners=9"
    runs = [f"{run} --out", f"{run} --duration 0.15 --out"]
    words = [
        f"{who} {what}"
        for commands in (runs, ["demo --out"])
        for _ in "12"
        for who in ("own", "other")
        for what in commands
    ]
    assert log.read_text().splitlines() == words


def test_global_poses_are_judged_as_the_runs_tell_them(
    benchmark: Benchmark, tmp_path: Path
) -> None:
    options = [
        "--seeds",
        "2-2",
        "--kind",
        "room",
        "--frames",
        40,
        "--dark",
        "0.5-0.8",
        "--scale",
        0.3,
    ]
    cells = table(benchmark("loops", *options), "recording")["handheld-rgbd"]
    room = gvo.SyntheticRecording("handheld", "rgbd", n_frames=40, seed=2, scale=0.3)
    run_of(FaultySource(room, Black(first=15, end=24)), tmp_path / "dark")
    run_of(room, tmp_path / "unbroken")
    rows = (tmp_path / "dark/frames.csv").read_text().splitlines()[1:]
    is_lit = np.array([row.split(",")[1] in ("ok", "resumed") for row in rows])
    assert 28 <= is_lit.sum() <= 31
    ates = [
        gvo.evaluate(
            room.ground_truth(), gvo.read_trajectory(tmp_path / name).select(is_lit), name=name
        ).ate_m
        for name in ("dark/smoothed.txt", "dark/global.txt", "unbroken/global.txt")
    ]
    assert_close([cells[0], cells[1], cells[13]], ates)
    assert cells[3:5] == ["0", "-, -"]  # it is too short to come back
    assert cells[6:13] == ["-", "0", "0", "0", "0", "0", "1"]


def test_whole_graphs_are_optimized_beside_gtsam_by_hand(
    benchmark: Benchmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.graphs.EXAMPLES", ("pose3example.txt",))
    printed = benchmark("graphs")
    rows = table(printed, "graph")
    assert list(rows) == ["pose3example.txt", "torus.g2o", "garage.g2o"]
    assert all(abs(float(row[3])) < 1e-6 for row in rows.values())
    false_loops = re.findall(r"([\d.]+) m off without, ([\d.]+) m with them", printed)
    assert len(false_loops) == 3
    assert all(abs(float(a) - float(b)) < 1e-3 for a, b in false_loops)


def test_the_map_of_a_long_run_is_measured(benchmark: Benchmark) -> None:
    printed = benchmark("map", "--frames", 1000)
    n_loops, error_m = re.findall(r"loops (\d+), errors ([\d.]+) m", printed)[0]
    assert int(n_loops) > 5
    assert float(error_m) < 0.5
    assert "memory: graph " in printed


def test_frames_that_come_too_fast_are_accounted_for(benchmark: Benchmark, drive_bag: Path) -> None:
    lines = benchmark("live", drive_bag, "--rounds", 1).splitlines()
    assert any(line.startswith("ratio of the medians: ") for line in lines)
    (n_sent,) = (int(line.split()[0]) for line in lines if "--max-lag" in line)
    (counts,) = (line for line in lines if line.endswith(" faulty"))
    assert sum(map(int, re.findall(r"\d+", counts))) == n_sent


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "the following arguments are required: COMMAND"),
        ("errors", "expected recordings or --seeds"),
        ("errors --seeds 1 --kind hand --readout 50", "readout_ms must be in"),
        (f"errors --seeds 1 --keep {__file__}", "cannot be written"),
        ("cost missing.bag --against .", "expected a checkout"),
        ("loops x.bag --set loops.enabled=false", "expected loops.enabled"),
        ("loops --kind room --frames 9 --scale 0.1 --seeds 1 --dark 1-9", "--dark: expected a"),
        ("graphs missing.g2o", "missing.g2o"),
        ("live missing.bag", "missing.bag"),
    ],
)
def test_what_cannot_be_measured_is_told_in_one_line(
    script: Script, words: str, message: str
) -> None:
    answer = script("benchmark", *words.split())
    assert answer.code == 2
    assert message in answer.err.splitlines()[-1]
    assert "Traceback" not in answer.err


def test_each_part_tells_how_it_is_used(benchmark: Benchmark) -> None:
    for name in ("errors", "cost", "loops", "graphs", "map", "live"):
        assert f"benchmark.py {name} [-h]" in benchmark(name, "--help")
