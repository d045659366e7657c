"""A worker goes on when its terminal is interrupted: the client ends it."""

from tests.conftest import python

_PROGRAM = """
import os, signal
from gvo.batch.worker import dask_setup
dask_setup(None)
os.kill(os.getpid(), signal.SIGINT)
os.kill(os.getpid(), signal.SIGTERM)
print("goes on")
"""


def test_a_worker_goes_on_when_all_processes_are_asked_to_end() -> None:
    answer = python("-c", _PROGRAM)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "goes on\n", "")
