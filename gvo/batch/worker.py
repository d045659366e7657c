"""What a Dask worker runs: a task, until it ends or its batch is stopped."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Any

from distributed import get_worker

from gvo.batch.tasks import BatchRow, Task, TaskOptions, run_task
from gvo.errors import GvoError
from gvo.types import Progress

_LOOK_EVERY_S = 1.0


class BatchStoppedError(GvoError):
    """The batch that the task belongs to was stopped."""


def dask_setup(worker: object) -> None:
    """Let workers on this machine ignore signals; Dask calls this when one starts.

    A terminal sends Ctrl-C to all its processes, and the end of a session sends SIGTERM. The
    client ends its workers itself, and they write the poses so far.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def work(task: Task, options: TaskOptions, key: Any) -> BatchRow:  # noqa: ANN401
    """Run a task on this worker; `key` is its key on the scheduler."""
    return run_task(task, options, on_progress=_stopper(get_worker(), key))


def _stopper(worker: Any, key: Any) -> Callable[[Progress], None]:  # noqa: ANN401
    """Return a callback that ends a task that was cancelled: Dask does not interrupt it."""
    looked_s = -_LOOK_EVERY_S

    def look(progress: Progress) -> None:
        nonlocal looked_s
        now = time.monotonic()
        if now - looked_s < _LOOK_EVERY_S:
            return
        looked_s = now
        known = worker.state.tasks.get(key)
        if known is None or known.state == "cancelled":
            raise BatchStoppedError("the batch was stopped")

    return look
