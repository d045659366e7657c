"""What is loaded, and when: drawing and serving bring their libraries only when they happen."""

import json
from pathlib import Path

import pytest

from tests.conftest import python

BATCHES = ("dask", "distributed", "pandas", "pyarrow", "fsspec", "cryptography")
HEAVY = ("matplotlib", "viser", "rerun", "selenium", *BATCHES)
# The upper triangle of an identity, as pose graphs write it.
_INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
# What loads the compiled loops of tracking, and what compiles them, in a process of its own.
LOADER, COMPILER = "llvmlite", "numba"
# Does one thing after the other; tells of each how it ended, and which of the libraries came by it.
_PROGRAM = """
import io, json, sys
from contextlib import redirect_stdout

def command(*arguments):
    from gvo.cli import main
    sys.argv = ["gvo", *arguments]
    main()

def track(path):
    import itertools
    import gvo
    source = gvo.open_recording(path)
    odometry = gvo.Odometry(source.info.camera)
    frames = itertools.islice(gvo.frames(source, gvo.Config()), 3)
    assert [odometry.track(frame).status for frame in frames] == ["ok", "ok", "ok"]

found = []
for action in sys.argv[1:]:
    before, code = set(sys.modules), 0
    with redirect_stdout(io.StringIO()):
        try:
            exec(action)
        except SystemExit as end:
            code = end.code
    new = {{name.split(".")[0] for name in set(sys.modules) - before}}
    found.append([code, sorted(new & set({names!r}))])
print(json.dumps(found))
"""


def loaded_by(*actions: str, names: tuple[str, ...] = HEAVY) -> list[list[object]]:
    """Return exit code and libraries loaded of each line of Python, in a process of their own."""
    done = python("-c", _PROGRAM.format(names=names), *actions)
    assert (done.returncode, done.stderr) == (0, "")
    found: list[list[object]] = json.loads(done.stdout)
    return found


def command(*arguments: object) -> str:
    return f"command(*{[*map(str, arguments)]})"


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{i} {i * i} 0 {i} 0 0 0 1\n" for i in range(20)))
    return path


def test_nothing_large_is_loaded_before_needed(room_bag: Path, poses: Path, tmp_path: Path) -> None:
    options = [room_bag, "--duration", "0.15", "--no-report"]
    film = tmp_path / "film.webm"
    actions = [
        "from gvo import *",
        command("--help"),
        command("batch", "--help"),
        f"track({str(room_bag)!r})",
        command("compare", poses, poses),
        command("run", *options, "--out", tmp_path / "out", "--overlay", film),
    ]
    found = loaded_by(*actions)
    assert dict(zip(actions, found, strict=True)) == {action: [0, []] for action in actions}
    assert (tmp_path / "out/summary.json").is_file()
    assert film.is_file()


def test_batches_and_plots_load_what_they_need_alone(poses: Path, tmp_path: Path) -> None:
    plot = command("compare", poses, poses, "--plot", tmp_path / "plot.png")
    make = "from gvo.batch import make_variants; make_variants()"
    (code, loaded), plotted = loaded_by(make, plot)
    assert code == 0
    assert isinstance(loaded, list)
    assert "matplotlib" not in loaded
    assert plotted == [0, ["matplotlib"]]


def test_tracking_alone_loads_compiled_loops(room_bag: Path, poses: Path, tmp_path: Path) -> None:
    graph, page = tmp_path / "graph.g2o", tmp_path / "page.html"
    graph.write_text(
        "".join(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1\n" for i in range(3))
        + "".join(f"EDGE_SE3:QUAT {i} {i + 1} 1 0 0 0 0 0 1 {_INFORMATION}\n" for i in range(2))
    )
    actions = [
        command("--help"),
        command("config"),
        command("compare", poses, poses, "--report", page),
        command("smooth", graph, "--out", tmp_path / "smoothed"),
        command("smooth", graph, "--out", tmp_path / "by window", "--window"),
        command("convert", room_bag, tmp_path / "folder", "--layout", "tum"),
        f"track({str(room_bag)!r})",
    ]
    found = dict(zip(actions, loaded_by(*actions, names=(LOADER, COMPILER)), strict=True))
    assert found.pop(actions[-1]) == [0, [LOADER]]
    assert found == {action: [0, []] for action in actions[:-1]}
