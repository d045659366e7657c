"""What is no file: devices, pipes, sockets, folders without permission. One line, exit code 2."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.conftest import GVO, Command, line_of_poses, python, refused

# The most memory of a child is no less than that of the process that started it: a small one.
MEASURED = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(done.returncode)
"""
# All commands open recordings by one function.
RECORDING_COMMANDS = (("check", "{}"), ("view", "{}", "--port", "0"))
POSE_COMMANDS = (
    ("smooth", "{}", "--out", "{out}"),
    ("smooth", "{poses}", "--out", "{out}", "--ground-truth", "{}"),
    ("compare", "{}", "{poses}"),
    ("compare", "{poses}", "{}"),
)
TEXT_COMMANDS = (*POSE_COMMANDS, ("config", "--config", "{}"))


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    return line_of_poses(tmp_path / "poses.txt")


def filled(words: tuple[str, ...], path: object, poses: Path) -> list[str]:
    out = poses.parent / "out"
    return [word.format(path, out=out, poses=poses) for word in words]


def make_socket(path: Path) -> None:
    # the name of a socket is short, the folder of a test is not
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(before)


@pytest.mark.parametrize(
    ("words", "name", "reason"),
    [
        *(
            (words, name, "is a pipe, a socket or a device")
            for words in RECORDING_COMMANDS
            for name in ("/dev/null", "/dev/zero", "pipe.bag", "socket.bag")
        ),
        *((words, "/dev/zero", "more than") for words in TEXT_COMMANDS),
        *((words, "/dev/null", "holds no poses") for words in POSE_COMMANDS),
        *((words, "socket.txt", "socket.txt: ") for words in TEXT_COMMANDS),
    ],
)
def test_what_is_no_file_is_refused(
    command: Command, poses: Path, words: tuple[str, ...], name: str, reason: str
) -> None:
    path = poses.parent / name  # that of a device stays as it is
    if name.startswith("pipe"):
        os.mkfifo(path)
    elif name.startswith("socket"):
        make_socket(path)
    assert reason in refused(command(*filled(words, path, poses)))


def test_a_line_of_a_pose_graph_without_an_end_is_refused(command: Command, poses: Path) -> None:
    graph = poses.with_name("endless.g2o")
    with graph.open("wb") as file:
        file.write(b"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
        file.truncate(1 << 33)  # a hole in the file takes no room on the disk
    said = refused(command("smooth", graph, "--out", poses.with_name("out")))
    assert "a line has more than" in said


def test_endless_input_without_poses_is_refused(tmp_path: Path) -> None:
    with subprocess.Popen(["yes"], stdout=subprocess.PIPE) as source:
        answer = python(*GVO[1:], "smooth", "-", "--out", tmp_path / "out", stdin=source.stdout)
        source.kill()
    assert "1000 lines hold no pose" in refused(answer)


@pytest.mark.acceptance
@pytest.mark.parametrize("words", [RECORDING_COMMANDS[0], POSE_COMMANDS[0], POSE_COMMANDS[2]])
def test_what_has_no_end_needs_no_memory(poses: Path, words: tuple[str, ...]) -> None:
    with subprocess.Popen(["yes"], stdout=subprocess.PIPE) as source:
        answer = python(
            "-c", MEASURED, *GVO, *filled(words, "/dev/stdin", poses), stdin=source.stdout
        )
        source.kill()
    refused(answer)
    assert int(answer.stdout) * (1 if sys.platform == "darwin" else 1024) < 1 << 30


@contextmanager
def without_rights(path: Path) -> Iterator[None]:
    """Take all rights to a path, and from the process those of root."""
    mode = path.stat().st_mode
    path.chmod(0)
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)
        path.chmod(mode)


@pytest.mark.parametrize("words", [*RECORDING_COMMANDS, *POSE_COMMANDS])
@pytest.mark.parametrize("inside", ["", "deep/a.bag"])
def test_a_folder_without_permission_is_named(
    command: Command, poses: Path, words: tuple[str, ...], inside: str
) -> None:
    folder = poses.with_name("locked")
    (folder / "deep").mkdir(parents=True)
    for path in (folder / "a.bag", folder / "deep" / "a.bag"):
        path.write_bytes(b"#ROSBAG V2.0\n")
    command(*filled(words, "/dev/null", poses))  # loads what the command imports
    for parent in (poses.parent, poses.parent.parent, poses.parent.parent.parent):
        parent.chmod(parent.stat().st_mode | 0o055)
    with without_rights(folder):
        answer = command(*filled(words, folder / inside, poses))
    assert answer.code == 2
    assert "Permission denied" in answer.err or "not readable" in answer.err
