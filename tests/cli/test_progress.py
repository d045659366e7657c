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

from tests.conftest import GVO, python

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


def check_order(shown: Shown) -> None:
    """Check that a bar grows to its end, tells a rate, and the time that is left."""
    states = shown.states()
    assert states, shown.terminal
    done = [int(state["done"]) for state in states]
    assert done == sorted(done)
    assert states[-1]["done"] == states[-1]["total"]
    assert float(states[-1]["rate"]) > 0.0
    assert re.fullmatch(r"\d+:\d\d:\d\d", states[-1]["left"])


def test_a_terminal_shows_rate_time_left_and_tracked_share(room_bag: Path, tmp_path: Path) -> None:
    shown = on_terminal("run", room_bag, "--out", tmp_path, "--no-report")
    assert shown.code == 0
    check_order(shown)
    last = shown.states()[-1]
    assert (last["total"], last["tracked"]) == ("20", "100")
    assert "room" in shown.terminal
    # The bar is gone at the end: what stays is what a pipe would get.
    assert shown.terminal.rstrip().endswith(("\x1b[2K", "\x1b[?25h"))
    assert "m in 20 frames, all tracked; " in shown.out
    assert "\x1b" not in shown.out


def test_the_tracked_share_is_that_of_the_run(room_bag: Path, tmp_path: Path) -> None:
    settings = ["--set", "ransac.min_inliers=5000", "--set", "window.lost_after_s=0.1"]
    options = ["--out", tmp_path, "--no-report", "--every", "2"]
    shown = on_terminal("run", room_bag, *options, *settings)
    assert shown.code == 3
    check_order(shown)
    summary = json.loads((tmp_path / "summary.json").read_text())
    share = summary["tracked"] / summary["frames"]
    assert share < 0.5
    assert int(shown.states()[-1]["tracked"]) == pytest.approx(100 * share, abs=0.51)


def test_a_pipe_gets_no_bar(room_bag: Path, tmp_path: Path) -> None:
    options = ["--out", tmp_path, "--duration", "0.2", "--no-report"]
    done = python(*GVO[1:], "run", room_bag, *options)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\x1b" not in done.stdout
    assert "frames/s" not in done.stdout
