"""Runs `gvo` commands one after another, and writes down what Python does to files and sockets.

A program of its own: an audit hook stays for the life of an interpreter. Its arguments are the
file to write, one JSON list a line, and the commands as JSON.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Which argument of an event is the path that is written to.
_PATHS = {"os.mkdir": 0, "os.rename": 1, "os.symlink": 1}
_SOCKETS = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo")
_PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn")


def _written(event: str, arguments: tuple[Any, ...]) -> Any:
    """Return the path that an event writes to, or None."""
    if event == "open":
        path, _, flags = arguments
        return path if isinstance(flags, int) and flags & _WRITING else None
    return arguments[_PATHS[event]] if event in _PATHS else None


def watch(log: int) -> None:
    """Write down what happens from now on, to the descriptor of an open file."""

    def note(kind: str, what: str) -> None:
        os.write(log, (json.dumps([kind, what]) + "\n").encode())

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        path = _written(event, arguments)
        if isinstance(path, str | bytes | os.PathLike):
            note("write", os.path.join(os.getcwd(), os.fsdecode(path)))  # noqa: PTH109, PTH118
        if event in _SOCKETS:
            note("socket", f"{event} {arguments[1:]}")
        if event in _PROGRAMS:
            note("program", str(arguments[0]))

    sys.addaudithook(hook)


def main() -> None:
    """Watch, then run the commands; 0 and 3 are fine."""
    watch(os.open(Path(sys.argv[1]), os.O_WRONLY | os.O_CREAT | os.O_APPEND))
    commands = json.loads(sys.argv[2])
    from gvo.cli import main as run

    for command in commands:
        sys.argv = ["gvo", *command]
        try:
            run()
        except SystemExit as end:
            if end.code not in (0, 1, 3, None):
                raise


if __name__ == "__main__":
    main()
