"""The benchmark of rendered recordings prints the errors of each seed, and reads what it kept."""

import subprocess
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.io.recording import Source
from gvo.types import FaultyFrame
from tests.acceptance.conftest import Script
from tests.conftest import python

pytestmark = pytest.mark.acceptance

BENCHMARK = Path(__file__).parents[2] / "scripts/benchmark.py"
N_FRAMES = 34  # just over a second, which the NEES needs


def benchmark(*options: object) -> subprocess.CompletedProcess[str]:
    return python(BENCHMARK, "--frames", N_FRAMES, *options)


def rows_of(table: str) -> dict[str, list[str]]:
    lines = [line.strip("| \n").split("|") for line in table.splitlines() if line.startswith("|")]
    return {name.strip(): [cell.strip() for cell in cells] for name, *cells in lines}


def ates_m(source: Source) -> tuple[float, float]:
    odometry = gvo.Odometry(source.info.camera, gvo.Config())
    raw: list[gvo.Estimate] = []
    smoothed: list[gvo.Estimate] = []
    for frame in gvo.frames(source, gvo.Config()):
        assert not isinstance(frame, FaultyFrame)
        result = odometry.track(frame)
        raw.append(result.raw)
        smoothed += result.finished
    smoothed = sorted([*smoothed, *odometry.finish()], key=lambda estimate: estimate.stamp_ns)
    truth = source.ground_truth()
    assert truth is not None
    first, second = (
        gvo.evaluate(truth, gvo.Trajectory.of(estimates), name="").ate_m
        for estimates in (raw, smoothed)
    )
    return first, second


def test_the_table_shows_the_errors_of_each_seed_again_from_the_kept_bags(tmp_path: Path) -> None:
    options = ["--seeds", "3-4", "--kind", "room", "--readout", 20]
    answer = benchmark(*options, "--keep", tmp_path)
    assert answer.returncode == 0, answer.stderr
    rows = rows_of(answer.stdout)
    assert list(rows)[2:] == ["3", "4", "median", "worst"]
    paths = sorted(tmp_path.iterdir())
    recordings = [gvo.open_recording(path) for path in paths]
    for seed, recording in zip((3, 4), recordings, strict=True):
        rendered = gvo.SyntheticRecording(
            "handheld", "rgbd", n_frames=N_FRAMES, seed=seed, scale=0.5, readout_ms=20.0
        )
        for one, other in zip(islice(rendered.images(), 4), recording.images(), strict=False):
            np.testing.assert_array_equal(one.load(), other.load())
    expected = np.array([ates_m(recording) for recording in recordings])
    for name, values in zip(
        ["3", "4", "median", "worst"],
        [*expected, np.median(expected, axis=0), expected.max(axis=0)],
        strict=True,
    ):
        np.testing.assert_allclose(np.array(rows[name][4:6], dtype=float), values, atol=6e-5)
    n_better = np.count_nonzero(expected[:, 1] <= expected[:, 0])
    assert answer.stdout.endswith(f"smoothed ATE <= raw ATE on {n_better} of 2\n")
    # The raw chain and the window hold poses a second apart, not ten.
    assert ["-" in rows["3"][column] for column in (6, 7, 8, 9)] == [False, True, False, True]
    kept = {path: path.stat().st_mtime_ns for path in paths}
    assert benchmark(*options, "--keep", tmp_path).stdout == answer.stdout
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == kept


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "1", "--kind", "hand", "--readout", "50"], r"readout_ms must be in"),
        (["--seeds", "1", "--keep", str(BENCHMARK)], "cannot be written"),
        (["--seeds", "0"], "argument --seeds"),
    ],
)
def test_options_out_of_range_are_refused(script: Script, options: list[str], message: str) -> None:
    assert message in script("benchmark", ["--frames", N_FRAMES, *options])
