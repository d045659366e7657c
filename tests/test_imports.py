"""What is loaded, and when: drawing and serving bring their libraries only when they happen."""

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

BATCHES = ("dask", "distributed", "pandas", "pyarrow", "fsspec", "cryptography")
HEAVY = ("matplotlib", "viser", "rerun", "selenium", *BATCHES)
# Runs the command as a terminal would, then tells which of the libraries came with it.
_PROGRAM = """
import json, sys
code = 0
try:
{lines}
except SystemExit as end:
    code = end.code
finally:
    loaded = sorted({{name.split(".")[0] for name in sys.modules}} & set({heavy!r}))
    sys.stdout.flush()
    print("\\n" + json.dumps([code, loaded]))
"""
_COMMAND = """
sys.argv = {argv!r}
from gvo.cli import main
main()
"""
_ODOMETRY = """
import itertools
import gvo
source = gvo.open_recording({path!r})
odometry = gvo.Odometry(source.info.camera)
frames = itertools.islice(gvo.frames(source, gvo.Config()), 3)
results = [odometry.track(frame) for frame in frames]
assert [result.status for result in results] == ["ok", "ok", "ok"]
"""


class Loaded(NamedTuple):
    """The exit code, and which of the libraries are loaded at the end."""

    code: int | None
    modules: list[str]


def loaded_after(lines: str) -> Loaded:
    """Run lines of Python in a process of their own."""
    indented = "\n".join(f"    {line}" for line in lines.strip().splitlines())
    program = _PROGRAM.format(lines=indented, heavy=HEAVY)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return Loaded(*json.loads(done.stdout.splitlines()[-1]))


def loaded_by(*arguments: object) -> Loaded:
    """Run the command in a process of its own."""
    return loaded_after(_COMMAND.format(argv=["gvo", *map(str, arguments)]))


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{i} {i * i} 0 {i} 0 0 0 1\n" for i in range(20)))
    return path


def test_the_package_and_its_names_load_nothing_that_draws() -> None:
    assert loaded_after("from gvo import *") == (0, [])


def test_batches_are_named_without_being_loaded() -> None:
    assert loaded_after("import gvo.batch; dir(gvo.batch)") == (0, [])
    code, loaded = loaded_after("from gvo.batch import Variant, make_variants; make_variants()")
    assert code == 0
    assert "matplotlib" not in loaded


def test_help_on_batches_loads_nothing() -> None:
    assert loaded_by("batch", "--help") == (0, [])


def test_odometry_over_frames_loads_nothing_that_draws(room_bag: Path) -> None:
    assert loaded_after(_ODOMETRY.format(path=str(room_bag))) == (0, [])


def test_help_loads_nothing_that_draws() -> None:
    assert loaded_by("--help") == (0, [])


def test_a_run_without_a_report_loads_nothing_that_draws(room_bag: Path, tmp_path: Path) -> None:
    options = ["--out", tmp_path / "out", "--duration", "0.15", "--no-report"]
    assert loaded_by("run", room_bag, *options) == (0, [])
    assert (tmp_path / "out/summary.json").is_file()


def test_a_film_needs_no_plots(room_bag: Path, tmp_path: Path) -> None:
    options = ["--out", tmp_path / "out", "--duration", "0.15", "--no-report"]
    options += ["--overlay", tmp_path / "film.webm"]
    assert loaded_by("run", room_bag, *options) == (0, [])
    assert (tmp_path / "film.webm").is_file()


def test_comparing_loads_what_plots_only_for_a_plot(poses: Path, tmp_path: Path) -> None:
    assert loaded_by("compare", poses, poses) == (0, [])
    plotted = loaded_by("compare", poses, poses, "--plot", tmp_path / "plot.png")
    assert plotted == (0, ["matplotlib"])
