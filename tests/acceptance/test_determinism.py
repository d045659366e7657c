"""The same input, configuration and version give the same files, bit by bit."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import gvo
from gvo.io.recording import Sensor

pytestmark = pytest.mark.acceptance

PROGRAM = Path(__file__).parent / "audited_commands.py"
# What a run measures of the machine it runs on, and the number of threads that it was given.
MEASURED = ("median_ms", "peak_memory_mb")
MEASURED_IN_REPORT = (
    r"<tr><th>Median per frame</th>.*?</tr>",
    r"<tr><th>Peak memory</th>.*?</tr>",
    r'<section id="timings">.*?</section>',
    r"<section><h3>runtime</h3>.*?</section>",
)


def results(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by name, without what was measured of the machine."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != "timings.csv":
            found[path.relative_to(folder).as_posix()] = unmeasured(path)
    return found


def unmeasured(path: Path) -> bytes:
    if path.name == "summary.json":
        summary = json.loads(path.read_text(encoding="utf-8"))
        assert {summary.pop(key) is not None for key in MEASURED if key in summary} <= {True}
        summary.get("configuration", {}).pop("runtime", None)  # a graph at once has none
        return json.dumps(summary).encode()
    if path.name == "report.html":
        text = path.read_text(encoding="utf-8")
        for pattern in MEASURED_IN_REPORT:
            text, n = re.subn(pattern, "", text, flags=re.DOTALL)
            assert n == 1, pattern
        return text.encode()
    return path.read_bytes()


def differing(a: dict[str, bytes], b: dict[str, bytes]) -> list[str]:
    return [name for name in sorted(a.keys() | b.keys()) if a.get(name) != b.get(name)]


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[Sensor, str]:
    folder, sensors = tmp_path_factory.mktemp("input"), get_args(Sensor)
    for sensor in sensors:
        recording = gvo.SyntheticRecording("handheld", sensor, n_frames=10, scale=0.3)
        gvo.convert(recording, folder / f"{sensor}.mcap")
    return {sensor: str(folder / f"{sensor}.mcap") for sensor in sensors}


def run_all(
    bags: dict[Sensor, str],
    folder: Path,
    *,
    threads: int,
    cores: set[int],
    environment: dict[str, str],
) -> dict[str, bytes]:
    """Run each kind of command in a process of its own, and return what it wrote."""
    out = folder / "out"
    out.mkdir(parents=True)
    thread_setting = ["--set", f"runtime.threads={threads}"]
    described = ["--set", "frontend.kind=descriptor", *thread_setting]
    whole = ["--set", "window.size=null", *thread_setting]
    stereo, rgbd = bags["stereo"], bags["rgbd"]
    commands = [
        ["run", stereo, "--out", f"{out}/klt", *thread_setting],
        ["run", stereo, "--out", f"{out}/descriptor", "--no-report", *described],
        ["run", rgbd, "--out", f"{out}/whole", "--no-report", *whole],
        ["smooth", f"{out}/klt/raw.txt", "--out", f"{out}/smoothed", "--sigma", "0.1,0.01"],
    ]
    variables = {**os.environ, "PYTHONPATH": str(Path(gvo.__file__).parent.parent), **environment}
    all_cores = affinity()
    limit_cores(cores or all_cores)
    try:
        answer = subprocess.run(
            [sys.executable, str(PROGRAM), os.devnull, json.dumps(commands)],
            cwd=folder,
            env=variables,
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        limit_cores(all_cores)
    assert answer.returncode == 0, answer.stderr
    return results(out)


def affinity() -> set[int]:
    return os.sched_getaffinity(0) if sys.platform == "linux" else set()


def limit_cores(cores: set[int]) -> None:
    if sys.platform == "linux":
        os.sched_setaffinity(0, cores)


def test_threads_cores_and_hashes_change_no_bit(bags: dict[Sensor, str], tmp_path: Path) -> None:
    one = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
    many = {"OMP_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "4", "PYTHONHASHSEED": "4711"}
    first_core = set(sorted(affinity())[:1])
    (tmp_path / "elsewhere").mkdir()
    elsewhere = {"TMPDIR": str(tmp_path / "elsewhere")}
    alone = run_all(bags, tmp_path / "a", threads=1, cores=first_core, environment=one)
    together = run_all(
        bags, tmp_path / "b" / "c", threads=3, cores=set(), environment=many | elsewhere
    )
    assert {"klt/report.html", "whole/summary.json", "smoothed/smoothed.txt"} <= alone.keys()
    assert differing(alone, together) == []
