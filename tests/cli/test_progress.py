"""The progress bar: what a terminal shows while a command works, and a pipe does not."""

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import termios
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import GVO

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
# `12/20  10.5 frames/s,  92% tracked, 0:00:01 left`, however it is spaced.
_BAR = re.compile(
    r"(?P<done>\d+)/(?P<total>\d+)\s+(?P<rate>[\d.]+) frames/s,\s+(?P<tracked>\d+)% tracked,"
    r"\s+(?P<left>\d+:\d\d:\d\d|-:--:--) left"
)


class Shown(NamedTuple):
    """What a command gave: standard error is what the terminal got."""

    code: int
    out: str
    terminal: str

    def states(self) -> list[re.Match[str]]:
        """Return each state of the bar, in order."""
        return list(_BAR.finditer(_ESCAPES.sub("", self.terminal)))


def on_terminal(*arguments: object, columns: int = 80) -> Shown:
    """Run the command with standard error on a terminal of as many columns."""
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    unset = {"COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"}
    environment = {key: value for key, value in os.environ.items() if key not in unset}
    process = subprocess.Popen(
        [*GVO, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=terminal,
        env={**environment, "TERM": "xterm-256color"},
    )
    os.close(terminal)
    pieces = []
    try:
        while piece := os.read(reader, 65536):
            pieces.append(piece)
    except OSError:
        pass  # Linux says so where the last one closes a terminal
    finally:
        os.close(reader)
    out, _ = process.communicate(timeout=120)
    return Shown(process.returncode, out.decode(), b"".join(pieces).decode())


def test_a_terminal_shows_rate_time_left_and_tracked_share(room_bag: Path, tmp_path: Path) -> None:
    settings = ["--set", "ransac.min_inliers=5000"]
    options = ["--out", tmp_path, "--no-report", "--every", "2"]
    shown = on_terminal("run", room_bag, *options, *settings)
    assert shown.code == 3
    states = shown.states()
    assert states, shown.terminal
    done = [int(state["done"]) for state in states]
    assert done == sorted(done)
    last = states[-1]
    assert last["done"] == last["total"] == "10"
    assert float(last["rate"]) > 0.0
    assert re.fullmatch(r"\d+:\d\d:\d\d", last["left"])
    summary = json.loads((tmp_path / "summary.json").read_text())
    share = summary["tracked"] / summary["frames"]
    assert share < 0.5
    assert int(last["tracked"]) == pytest.approx(100 * share, abs=0.51)
    assert "room" in shown.terminal
    # The bar is gone at the end: what stays is what a pipe would get.
    assert "\x1b[2K" in shown.terminal
    assert "\x1b" not in shown.out
