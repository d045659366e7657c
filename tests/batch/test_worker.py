"""A worker tells how far it is, and stops where nobody wants the answer any more."""

from types import SimpleNamespace
from typing import Any

import pytest

from gvo.batch.worker import BatchStoppedError, _reporter
from gvo.types import Progress
from tests.conftest import python

KEY = ("batch", 7)
_PROGRAM = """
import os, signal
from gvo.batch.worker import dask_setup
dask_setup(None)
os.kill(os.getpid(), signal.SIGINT)
os.kill(os.getpid(), signal.SIGTERM)
print("goes on")
"""


class Worker:
    """What a task sees of its worker."""

    def __init__(self, states: dict[Any, str]) -> None:
        tasks = {key: SimpleNamespace(state=state) for key, state in states.items()}
        self.state = SimpleNamespace(tasks=tasks)
        self.events: list[tuple[str, object]] = []

    def log_event(self, topic: str, event: object) -> None:
        self.events.append((topic, event))


def progress(n_done: int) -> Progress:
    return Progress(n_done=n_done, n_total=90, n_tracked=n_done)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr("gvo.batch.worker.time.monotonic", lambda: clock.now)
    return clock


def test_news_are_sent_now_and_then(clock: SimpleNamespace) -> None:
    worker = Worker({KEY: "executing"})
    tell = _reporter(worker, "topic", KEY)
    for n_done in range(1, 31):
        tell(progress(n_done))
        clock.now += 0.125
    assert worker.events == [("topic", (7, n_done, 90)) for n_done in (1, 9, 17, 25)]


@pytest.mark.parametrize("states", [{}, {KEY: "cancelled"}, {("batch", 8): "executing"}])
def test_a_task_that_nobody_wants_stops(clock: SimpleNamespace, states: dict[Any, str]) -> None:
    worker = Worker({KEY: "executing"})
    tell = _reporter(worker, "topic", KEY)
    tell(progress(1))
    worker.state = Worker(states).state
    tell(progress(2))
    clock.now += 1.5
    with pytest.raises(BatchStoppedError):
        tell(progress(3))
    assert len(worker.events) == 1


def test_a_worker_goes_on_when_all_processes_are_asked_to_end() -> None:
    answer = python("-c", _PROGRAM)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "goes on\n", "")
