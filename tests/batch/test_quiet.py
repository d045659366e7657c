"""Ctrl-C in a terminal goes to all processes; the workers leave it to the client."""

import subprocess
import sys

_PROGRAM = """
import os, signal
from gvo.batch.quiet import dask_setup
dask_setup(None)
os.kill(os.getpid(), signal.SIGINT)
print("goes on")
"""


def test_a_worker_goes_on_when_ctrl_c_is_pressed() -> None:
    command = [sys.executable, "-c", _PROGRAM]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "goes on\n", "")
