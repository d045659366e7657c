"""Nothing is written elsewhere, nothing is sent; that nothing runs what it reads is ruff's (S)."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.io.convert.convert import convert
from gvo.io.recording import RecordingInfo
from gvo.io.synthetic import SyntheticRecording
from gvo.kernels.jit import cache_folder

pytestmark = pytest.mark.acceptance


@pytest.fixture(scope="module")
def recording() -> SyntheticRecording:
    return SyntheticRecording("handheld", "stereo", n_frames=6, scale=0.25)


@pytest.fixture(scope="module")
def small_bag(recording: SyntheticRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("input") / "walk.mcap"
    gvo.convert(recording, path)
    return path


class Watched:
    """Folders of a run of commands in which all that a program may write to is empty at first."""

    def __init__(self, folder: Path) -> None:
        self.out, self.log = folder / "out", folder / "log.txt"
        self.places = {
            name: folder / name for name in ("home", "cwd", "tmp", "matplotlib", "cache")
        }
        for place in (self.out, *self.places.values()):
            place.mkdir(parents=True)
        # Kernels are compiled; what compiling writes is looked at in tests/kernels.
        compiled = cache_folder()
        shutil.copytree(compiled, self.places["cache"] / "gvo" / compiled.name)

    def run(self, commands: list[list[str]]) -> list[tuple[str, str]]:
        """Run commands; return what they did: what kind of deed, and to what."""
        # What measures the coverage writes files of its own.
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("COVERAGE_")}
        environment = {
            **inherited,
            "HOME": str(self.places["home"]),
            "TMPDIR": str(self.places["tmp"]),
            "MPLCONFIGDIR": str(self.places["matplotlib"]),
            "XDG_CACHE_HOME": str(self.places["cache"]),
            "XDG_CONFIG_HOME": str(self.places["home"] / "config"),
            "PYTHONPATH": str(Path(gvo.__file__).parent.parent),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
        }
        program = Path(__file__).parent / "audited_commands.py"
        answer = subprocess.run(
            [sys.executable, str(program), str(self.log), json.dumps(commands)],
            cwd=self.places["cwd"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert answer.returncode == 0, answer.stderr
        rows = [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]
        return [(kind, what) for kind, what in rows]

    def assert_nothing_elsewhere(self, deeds: list[tuple[str, str]]) -> None:
        """Only `--out` and what is gone again was written to, and no socket was opened."""
        assert [what for kind, what in deeds if kind == "socket"] == []
        allowed = (self.out, self.places["tmp"], self.places["matplotlib"])
        written = [Path(what) for kind, what in deeds if kind == "write"]
        assert any(path.is_relative_to(self.out) for path in written)
        elsewhere = {p for p in written if not any(p.is_relative_to(a) for a in allowed)}
        assert elsewhere - {Path(os.devnull)} == set()
        # Libraries that are not written in Python tell no hook: what they leave is seen here.
        for name in ("home", "cwd", "tmp"):
            assert [str(path) for path in self.places[name].rglob("*")] == []
        left = [path for path in self.out.rglob("*") if path.name.startswith(".")]
        assert left == []


@pytest.fixture
def watched(tmp_path: Path) -> Watched:
    return Watched(tmp_path.resolve() / "watched")


@pytest.mark.linux
def test_commands_write_only_what_they_are_told_to(small_bag: Path, watched: Watched) -> None:
    bag, out = str(small_bag), str(watched.out)
    extras = ["--bag", f"{out}/run.mcap", "--overlay", f"{out}/film.webm"]
    if importlib.util.find_spec("rerun") is not None:
        extras += ["--rerun", f"{out}/run.rrd"]
    truth, raw = f"{out}/run/ground_truth.txt", f"{out}/run/raw.txt"
    deeds = watched.run(
        [
            ["run", bag, "--out", f"{out}/run", *extras],
            ["compare", truth, raw, "--plot", f"{out}/errors.png", "--report", f"{out}/page.html"],
            ["smooth", raw, "--out", f"{out}/smoothed"],
            ["convert", bag, f"{out}/drive.db3"],
            ["convert", bag, f"{out}/kitti", "--layout", "kitti"],
            ["check", bag],
            ["config"],
            ["explain", bag, "--frame", "3", "--out", f"{out}/explained"],
        ]
    )
    watched.assert_nothing_elsewhere(deeds)
    # Matplotlib looks for fonts once, and keeps the list in its own folder.
    assert {what for kind, what in deeds if kind == "program"} <= {"fc-list"}
    assert {path.name.partition("-")[0] for path in watched.places["matplotlib"].iterdir()} <= {
        "fontlist"
    }


class Named:
    """A rendered recording under another name, also that of its camera in tf."""

    def __init__(self, recording: SyntheticRecording, name: str) -> None:
        self._recording, self._name = recording, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    @property
    def info(self) -> RecordingInfo:
        return replace(
            self._recording.info, name=self._name, frame_id=self._name, decisions=[self._name]
        )


@pytest.mark.parametrize("name", ["../../outside", "{}/outside", ".."])
def test_a_recording_cannot_choose_where_it_is_written(
    recording: SyntheticRecording, tmp_path: Path, name: str
) -> None:
    name, parent = name.format(tmp_path), tmp_path / "a" / "b" / "c"
    source = Named(recording, name)
    outputs = gvo.RunOutputs(report=False)
    result = gvo.run_recording(source, parent / "out", outputs=outputs)
    assert result.summary["recording"] == name
    convert(source, parent / "folder", layout="euroc")
    convert(source, parent / "walk.db3")
    assert {path.parts[:3] for path in everything(tmp_path)} <= {
        ("a",),
        ("a", "b"),
        ("a", "b", "c"),
    }
    assert {path.name for path in parent.iterdir()} == {"out", "folder", "walk.db3"}


def everything(folder: Path) -> list[Path]:
    return [path.relative_to(folder) for path in folder.rglob("*")]
