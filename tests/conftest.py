"""Fixtures that several test modules share."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import settings

import gvo
from gvo.errors import GvoError
from gvo.kernels.jit import machine_code

# How long an example takes says something of the machine, nothing of the code. The examples are the
# same each time, so that only a change can break a test; HYPOTHESIS_PROFILE=explore draws others,
# four times as many.
settings.register_profile("gvo", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "gvo"))


# Tests with one of these marks may be skipped where what they need is missing; none in CI.
_OPTIONAL = {"browser", "dds", "realsense", "recorded", "rerun", "ros1"}
_IS_CI = os.environ.get("CI") == "true"


def pytest_sessionstart() -> None:
    """Compile the kernels once, of which a command would tell on standard error.

    Messages name flags, as they are written; `test_errors` tells what Python says instead.
    """
    GvoError.names_flags = True
    machine_code()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests of Linux elsewhere."""
    if sys.platform != "linux":
        others = [item for item in items if item.get_closest_marker("linux")]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item not in others]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, pytest.TestReport]:
    """Turn a skip into a failure: in CI each, elsewhere those without a mark of `_OPTIONAL`."""
    report: pytest.TestReport = yield
    names = {mark.name for mark in item.iter_markers()}
    if report.skipped and not hasattr(report, "wasxfail") and (_IS_CI or not names & _OPTIONAL):
        report.outcome, report.longrepr = "failed", f"may not be skipped: {report.longrepr}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, pytest.CollectReport]:
    """Turn the skip of a whole module into a failure in CI."""
    report: pytest.CollectReport = yield
    if report.skipped and _IS_CI:
        report.outcome, report.longrepr = "failed", f"may not be skipped: {report.longrepr}"
    return report


class Answer(NamedTuple):
    """What a command gave."""

    code: int
    out: str
    err: str


Command = Callable[..., Answer]
GVO = [sys.executable, "-c", "from gvo.cli import main; main()"]
"""The command in a process of its own."""
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(Path(gvo.__file__).parent.parent),
    "OMP_NUM_THREADS": "1",
}
"""Of a process that imports the same package as the tests do."""
TABLES = (
    *(f"{name}.txt" for name in ("raw", "causal", "smoothed")),
    *(f"{name}_covariance.csv" for name in ("raw", "causal", "smoothed")),
    "frames.csv",
    "edges.csv",
)
"""What two runs over the same recording have in common to the bit."""


def is_one_line(text: str) -> bool:
    """Tell whether a command said in one line what is wrong, and nothing else."""
    return text.startswith("gvo: error: ") and text.count("\n") == 1


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program, by the words that follow `python`, to its end; return what it said."""
    command = [sys.executable, *map(str, words)]
    asked: dict[str, Any] = {"capture_output": True, "text": True, "env": ENVIRONMENT}
    return subprocess.run(command, check=False, **asked | options)


def start(*arguments: object) -> subprocess.Popen[str]:
    """Begin a `gvo` command in a process of its own."""
    options: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    world = ENVIRONMENT | {"COLUMNS": "80"}
    return subprocess.Popen(
        [*GVO, *map(str, arguments)], **options, env=world, text=True, bufsize=1
    )


def interrupt_at_call(
    monkeypatch: pytest.MonkeyPatch,
    owner: object,
    name: str,
    n: int,
    number: int = signal.SIGTERM,
) -> None:
    """Raise a signal in this process at the nth call of a method."""
    calls = count(1)  # threads may call at once
    original = getattr(owner, name)

    def call(*arguments: Any, **options: Any) -> Any:
        if next(calls) == n:
            os.kill(os.getpid(), number)
        return original(*arguments, **options)

    monkeypatch.setattr(owner, name, call)


def refused(answer: Answer | subprocess.CompletedProcess[str]) -> str:
    """Check that a command refused in one line; return it."""
    if isinstance(answer, subprocess.CompletedProcess):
        answer = Answer(answer.returncode, answer.stdout, answer.stderr)
    assert answer.code == 2
    assert is_one_line(answer.err), answer.err
    return answer.err


def run_of(recording: Path | Any, out: Path, **options: Any) -> gvo.RunResult:
    """Run odometry over a recording or the path of one, by default without a report."""
    source = gvo.open_recording(recording) if isinstance(recording, Path) else recording
    given: dict[str, Any] = {"outputs": gvo.RunOutputs(report=False)} | options
    return gvo.run_recording(source, out, **given)


def assert_same_files(out: Path, expected: Path, names: Iterable[str] = TABLES) -> None:
    """Check that files of two runs are equal to the bit."""
    for name in names:
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name


def line_of_poses(path: Path, n: int = 20) -> Path:
    """Write a trajectory along x, a pose a second."""
    path.write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(n)))
    return path


def assert_open_to_this_machine_alone(port: int) -> None:
    """Check that a port listens on 127.0.0.1 only; 127.0.0.2 is this machine's too."""
    socket.create_connection(("127.0.0.1", port), timeout=60).close()
    with pytest.raises(OSError, match=r"refused|timed out|assign"):
        socket.create_connection(("127.0.0.2", port), timeout=5).close()


@pytest.fixture(scope="session")
def gvo_data() -> Path:
    """Return the folder of real recordings; skip without it, fail where it is missing."""
    name = os.environ.get("GVO_DATA")
    if not name:
        pytest.skip("GVO_DATA is not set")
    folder = Path(name).resolve()
    if not folder.is_dir():
        pytest.fail(f"GVO_DATA={name} is no folder")
    return folder


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder, in which the test works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs the `gvo` command with its arguments."""

    from gvo.cli.main import main

    def run(*arguments: object) -> Answer:
        monkeypatch.setattr("sys.argv", ["gvo", *map(str, arguments)])
        monkeypatch.setattr(gvo.GvoError, "names_flags", False)  # the command sets it itself
        with pytest.raises(SystemExit) as exit_info:
            main()
        monkeypatch.setattr(gvo.GvoError, "names_flags", True)
        captured = capsys.readouterr()
        code = exit_info.value.code
        return Answer(code if isinstance(code, int) else 0, captured.out, captured.err)

    return run


def write_drive(path: Path, *, n_frames: int, scale: float) -> Path:
    """Write a rendered drive of a stereo camera as a bag; return its path."""
    gvo.convert(gvo.SyntheticRecording("driving", "stereo", n_frames=n_frames, scale=scale), path)
    return path


def write_room(path: Path, *, n_frames: int, scale: float) -> Path:
    """Write a walk of an RGB-D camera in a rendered room as a bag; return its path."""
    gvo.convert(gvo.SyntheticRecording("handheld", "rgbd", n_frames=n_frames, scale=scale), path)
    return path


def complete_run(bag: Path, out: Path) -> Path:
    """Run over a bag, which must succeed to the end; return the folder of the run."""
    assert run_of(bag, out).is_complete
    return out


@pytest.fixture(scope="session")
def drive_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a short rendered drive, a stereo camera at half size."""
    path = tmp_path_factory.mktemp("bags") / "drive.mcap"
    return write_drive(path, n_frames=20, scale=0.5)


@pytest.fixture(scope="session")
def room_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a short walk in a rendered room, an RGB-D camera at half size."""
    path = tmp_path_factory.mktemp("bags") / "room.bag"
    return write_room(path, n_frames=20, scale=0.5)


@pytest.fixture(scope="session")
def walk_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of `tests.make.rendered_walk`: nothing of the robot, no truth."""
    from tests.make.rendered_walk import Walk

    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    gvo.convert(Walk(), path)
    return path


@pytest.fixture(scope="session")
def walk_run(walk_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run over `walk_bag`: poses of the camera from the identity."""
    return complete_run(walk_bag, tmp_path_factory.mktemp("walk_run"))
