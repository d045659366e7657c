"""Nothing runs what it reads, nothing is written elsewhere, nothing is sent."""

import ast
import importlib.util
import json
import os
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

pytestmark = pytest.mark.acceptance

ROOT = Path(__file__).parents[2]
PROGRAMS = [*sorted((ROOT / "gvo").rglob("*.py")), *sorted((ROOT / "scripts").rglob("*.py"))]

# What turns data into code, or a name into a file that another program may have made meanwhile.
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib"} | {
    "marshal",
    "shelve",
    "code",
    "codeop",
}
FORBIDDEN_NAMES = {"eval", "exec", "__import__"}
FORBIDDEN_CALLS = {
    *(f"os.{name}" for name in ("system", "popen", "startfile")),
    *(f"subprocess.{name}" for name in ("getoutput", "getstatusoutput")),
    *(f"yaml.{name}" for name in ("unsafe_load", "unsafe_load_all", "full_load", "full_load_all")),
    "tempfile.mktemp",
    "pandas.read_pickle",
}
UNSAFE_KEYWORDS = {"shell", "allow_pickle"}


class Reader(ast.NodeVisitor):
    """Collects what a program must not do."""

    def __init__(self, tree: ast.Module) -> None:
        self.faults: list[str] = []
        self.names: dict[str, str] = {}
        self.safe_loaders: set[str] = {"yaml.SafeLoader", "yaml.CSafeLoader"}
        self.visit(tree)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self.names[alias.asname or alias.name.partition(".")[0]] = (
                alias.name if alias.asname else alias.name.partition(".")[0]
            )
            self._module(alias.name, node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        for alias in node.names:
            self.names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
            self._module(node.module or "", node)
            self._call(f"{node.module}.{alias.name}", node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        if any(self._full(base) in self.safe_loaders for base in node.bases):
            self.safe_loaders.add(node.name)
        self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in FORBIDDEN_NAMES:
            self._note(node.id, node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self._call(self._full(node), node)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        for keyword in node.keywords:
            is_false = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            if keyword.arg in UNSAFE_KEYWORDS and not is_false:
                self._note(f"{keyword.arg}=...", node)
        if self._full(node.func) in ("yaml.load", "yaml.load_all"):
            loaders = [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "Loader")]
            if not any(self._full(loader) in self.safe_loaders for loader in loaders):
                self._note("yaml.load without a safe loader", node)
        self.generic_visit(node)

    def _full(self, node: ast.expr) -> str:
        """Return the name of a function as if it were spelt out."""
        if isinstance(node, ast.Attribute):
            return f"{self._full(node.value)}.{node.attr}"
        return self.names.get(node.id, node.id) if isinstance(node, ast.Name) else ""

    def _module(self, name: str, node: ast.stmt) -> None:
        if name.partition(".")[0] in FORBIDDEN_MODULES:
            self._note(name, node)

    def _call(self, name: str, node: ast.AST) -> None:
        if name in FORBIDDEN_CALLS or name.startswith(("os.exec", "os.spawn")):
            self._note(name, node)

    def _note(self, what: str, node: Any) -> None:
        self.faults.append(f"line {node.lineno}: {what}")


def faults(text: str) -> list[str]:
    return Reader(ast.parse(text)).faults


def test_no_program_runs_what_it_reads() -> None:
    for path in PROGRAMS:
        name = path.relative_to(ROOT).as_posix()
        found = faults(path.read_text(encoding="utf-8"))
        assert found == [], name


@pytest.mark.parametrize(
    "text",
    [
        *("from pickle import loads", "eval('1')", "import os as o; o.execv('a', [])"),
        "import yaml as y; y.load_all(text, Loader=y.FullLoader)",
        "import numpy as np; np.load('a', allow_pickle=is_trusted)",
        "import subprocess; subprocess.run('ls', shell=True)",
    ],
)
def test_what_runs_data_is_seen(text: str) -> None:
    assert faults(text)


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
        self.places = {name: folder / name for name in ("home", "cwd", "tmp", "matplotlib")}
        for place in (self.out, *self.places.values()):
            place.mkdir(parents=True)

    def run(self, commands: list[list[str]]) -> list[tuple[str, str]]:
        """Run commands; return what they did: what kind of deed, and to what."""
        # What measures the coverage writes files of its own.
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("COVERAGE_")}
        environment = {
            **inherited,
            "HOME": str(self.places["home"]),
            "TMPDIR": str(self.places["tmp"]),
            "MPLCONFIGDIR": str(self.places["matplotlib"]),
            "XDG_CACHE_HOME": str(self.places["home"] / "cache"),
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
            ["explain", bag, "--frame", "3", "--out", f"{out}/explained"],
        ]
    )
    watched.assert_nothing_elsewhere(deeds)
    # Matplotlib looks for fonts once, and keeps the list in its own folder.
    assert {what for kind, what in deeds if kind == "program"} <= {"fc-list"}
    assert {path.name.partition("-")[0] for path in watched.places["matplotlib"].iterdir()} <= {
        "fontlist"
    }


@pytest.mark.linux
def test_a_run_without_report_writes_nothing_else_at_all(small_bag: Path, watched: Watched) -> None:
    commands = [
        ["run", str(small_bag), "--out", str(watched.out / "run"), "--no-report"],
        ["check", str(small_bag)],
        ["config"],
    ]
    deeds = watched.run(commands)
    watched.assert_nothing_elsewhere(deeds)
    assert {what for kind, what in deeds if kind == "program"} == set()
    assert list(watched.places["matplotlib"].iterdir()) == []


PAYLOAD = "</script><script src=x></script><xss-tag onload='x'>\"'><xss-tag>&lt;"


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


@pytest.mark.parametrize("name", ["../../outside", "{}/outside", "..", "a/b", PAYLOAD])
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
