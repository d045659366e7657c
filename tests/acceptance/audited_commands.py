"""Runs `gvo` commands one after another, and writes down what Python does to files and sockets.

A program of its own: an audit hook stays for the life of an interpreter. Its arguments are the
file to write, one JSON list a line, and the commands as JSON.
"""

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Event by event: where its paths are among the arguments, and the descriptors they start from.
_PATHS = {
    "os.mkdir": ((0, 2),),
    "os.remove": ((0, 1),),
    "os.rmdir": ((0, 1),),
    "os.rename": ((0, 2), (1, 3)),
    "os.link": ((0, 2), (1, 3)),
    "os.symlink": ((1, 2),),
    "os.chmod": ((0, 2),),
    "os.chown": ((0, 3),),
    "os.utime": ((0, 3),),
    "os.truncate": ((0, None),),
    "sqlite3.connect": ((0, None),),
}
_SOCKETS = ("socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo")
_PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.startfile")


def _absolute(path: Any, folder: Any) -> str:
    if isinstance(path, int):
        return str(Path(f"/proc/self/fd/{path}").readlink())
    is_given = isinstance(folder, int) and folder >= 0
    start = Path(f"/proc/self/fd/{folder}").readlink() if is_given else Path()
    name = os.fsdecode(path)
    if name.startswith("file:"):  # as SQLite takes them
        name = unquote(urlsplit(name).path)
    return str(Path(start, name).resolve())


def _written(event: str, arguments: Sequence[Any]) -> list[str]:
    """Return the paths that an event writes to."""
    if event == "open":
        path, _, flags = arguments
        is_writing = isinstance(flags, int) and flags & _WRITING and not isinstance(path, int)
        return [_absolute(path, None)] if is_writing else []
    return [
        _absolute(arguments[place], None if folder is None else arguments[folder])
        for place, folder in _PATHS.get(event, ())
    ]


class _Hook:
    """Writes down what happens.

    Parameters
    ----------
    log : int
        Descriptor of an open file.
    """

    def __init__(self, log: int) -> None:
        self._log = log
        self._is_inside = False

    def __call__(self, event: str, arguments: Sequence[Any]) -> None:
        """Take an audit event."""
        if self._is_inside:  # what looking itself does
            return
        self._is_inside = True
        try:
            for path in _written(event, arguments):
                self._note("write", path)
            if event in _SOCKETS:
                self._note("socket", f"{event} {arguments[1:]}")
            if event in _PROGRAMS:
                self._note("program", str(arguments[0]))
        finally:
            self._is_inside = False

    def _note(self, kind: str, what: str) -> None:
        os.write(self._log, (json.dumps([kind, what]) + "\n").encode())


def main() -> None:
    """Watch, then run the commands; 0 and 3 are fine."""
    sys.addaudithook(_Hook(os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_APPEND)))
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
