"""A worker goes on when its terminal is interrupted: the client ends it."""

import os
import signal

from gvo.batch.worker import dask_setup


def test_a_worker_goes_on_when_all_processes_are_asked_to_end() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    try:
        dask_setup(None)
        for number in numbers:
            os.kill(os.getpid(), number)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
