"""What a Dask worker runs: a task, reporting its progress to the client."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distributed import get_worker

from gvo.errors import GvoError

if TYPE_CHECKING:
    from gvo.batch.tasks import BatchRow, Task, TaskOptions
    from gvo.types import Progress

_REPORT_EVERY_S = 1.0


class BatchStoppedError(GvoError):
    """The batch that the task belongs to was stopped."""


def dask_setup(worker: object) -> None:
    """Ignore what ends a batch in a worker of this machine, which Dask calls when it starts.

    A terminal sends Ctrl-C to all of its processes, and an end of the session SIGTERM; the client
    ends its workers itself, and they write the poses so far.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def work(task: Task, options: TaskOptions, topic: str, key: Any) -> BatchRow:  # noqa: ANN401
    """Run a task on this worker.

    Parameters
    ----------
    task : Task
    options : TaskOptions
    topic : str
        Topic of the events that report how many frames are done.
    key : tuple
        Key of the task on the scheduler.
    """
    from gvo.batch.tasks import run_task

    worker: Any = get_worker()
    scratch, report = Path(worker.local_directory), _reporter(worker, topic, key)
    return run_task(task, options, scratch=scratch, on_progress=report)


def _reporter(worker: Any, topic: str, key: Any) -> Callable[[Progress], None]:  # noqa: ANN401
    reported_s = -_REPORT_EVERY_S

    def report(progress: Progress) -> None:
        nonlocal reported_s
        now = time.monotonic()
        if now - reported_s < _REPORT_EVERY_S:
            return
        reported_s = now
        if not _is_wanted(worker, key):
            raise BatchStoppedError("the batch was stopped")
        worker.log_event(topic, (key[1], progress.n_done, progress.n_total))

    return report


def _is_wanted(worker: Any, key: Any) -> bool:  # noqa: ANN401
    # Dask does not interrupt a running task that was cancelled, or whose client is gone.
    known = worker.state.tasks.get(key)
    return known is not None and known.state != "cancelled"
