"""What runs on a worker of Dask: a task, with news for the client."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distributed import get_worker

from gvo.errors import GvoError

if TYPE_CHECKING:
    from gvo.batch.rows import BatchRow
    from gvo.batch.tasks import Task, TaskOptions
    from gvo.run_tally import Progress

_NEWS_S = 1.0


class BatchStoppedError(GvoError):
    """The batch that the task belongs to was stopped."""


def dask_setup(worker: object) -> None:
    """Ignore SIGINT in a worker of this machine, which Dask calls when it starts.

    A terminal sends Ctrl-C to all of its processes; the client ends its workers itself.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def work(task: Task, options: TaskOptions, topic: str, key: Any) -> BatchRow:  # noqa: ANN401
    """Run a task on the worker that calls this.

    Parameters
    ----------
    task : Task
    options : TaskOptions
    topic : str
        Under which the scheduler is told how many frames are done.
    key : tuple
        Of the task, as the scheduler knows it.
    """
    from gvo.batch.tasks import run_task

    worker: Any = get_worker()
    return run_task(
        task,
        options,
        scratch=Path(worker.local_directory),
        on_progress=_teller(worker, topic, key),
    )


def _teller(worker: Any, topic: str, key: Any) -> Callable[[Progress], None]:  # noqa: ANN401
    told_s = -_NEWS_S

    def tell(progress: Progress) -> None:
        nonlocal told_s
        now = time.monotonic()
        if now - told_s < _NEWS_S:
            return
        told_s = now
        if not _is_wanted(worker, key):
            raise BatchStoppedError("the batch was stopped")
        worker.log_event(topic, (key[1], progress.n_done, progress.n_total))

    return tell


def _is_wanted(worker: Any, key: Any) -> bool:  # noqa: ANN401
    # Dask has no other word for it: a task that runs is not told that its client went away.
    known = worker.state.tasks.get(key)
    return known is not None and known.state != "cancelled"
