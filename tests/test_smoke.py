"""One short way through everything: what a newcomer types first."""

from pathlib import Path

import pytest

import gvo
from gvo.runs.demo import check_place
from tests.conftest import Command


def test_the_demo_its_comparison_and_its_smoothing(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "gvo-demo"
    monkeypatch.setattr("gvo.runs.demo.N_FRAMES", 4)
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # each process that renders makes the world
    assert command("demo", "--out", out).code == 0
    check_place(out, force=True)  # it may be made anew
    assert command("demo", "--out", out).code == 2
    assert {"drive.mcap", "robot.mcap", "summary.json", "report.html", "trajectories.png"} <= {
        path.name for path in out.iterdir()
    }
    estimates = [out / f"{name}.txt" for name in ("raw", "causal", "smoothed")]
    answer = command("compare", out / "drive.mcap", *estimates)
    assert answer.code == 0
    assert "smoothed" in answer.out
    assert command("smooth", estimates[0], "--out", tmp_path / "again").code == 0
    assert len(gvo.read_trajectory(tmp_path / "again/smoothed.txt")) == 4
