"""Tasks on a cluster of Dask: handed out, watched, tried again."""

from __future__ import annotations

import logging
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any

import dask
from distributed import CancelledError, Client, Future, KilledWorker, LocalCluster, Security

from gvo._text import cut
from gvo.batch.rows import BatchRow
from gvo.batch.tasks import Task, TaskOptions
from gvo.batch.worker import work
from gvo.errors import ConfigurationError, GvoError

# Handed out at once, at least: a cluster that grows with its work must see some.
_MIN_IN_FLIGHT = 100
_PER_THREAD = 2
_TICK_S = 0.2
_MAX_REASON = 500
_CONNECT_S = "30s"
# What a worker did in each hundredth of a second is kept for an hour: megabytes for each run.
_WORKERS_HERE = {"distributed.worker.profile.enabled": False}
# How often the workers are counted.
_COUNT_S = 2.0
_GONE = "the scheduler is gone; the same command goes on where the batch was"


class ClusterError(GvoError):
    """The scheduler cannot be reached, or not any more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchProgress:
    """How far a batch has come.

    Parameters
    ----------
    n_done, n_total : int
        Runs.
    n_found : int
        Of those done, the ones that an earlier batch had finished.
    n_failed : int
        Of those done, the ones without a trajectory.
    n_workers : int
    frames_per_s : float
        Of all workers together, since the start.
    left_s : float or None
        Time that is left; None before anything is known.
    row : BatchRow or None
        What has just ended.
    """

    n_done: int
    n_total: int
    n_found: int
    n_failed: int
    n_workers: int
    frames_per_s: float
    left_s: float | None
    row: BatchRow | None = None


@contextmanager
def connected(scheduler: str | None, n_workers: int | None) -> Iterator[Client]:
    """Connect to a scheduler, or start workers on this machine: one thread each.

    Parameters
    ----------
    scheduler : str or None
        Its address, such as tcp://host:8786.
    n_workers : int or None
        How many to start; as many as there are cores where omitted.

    Raises
    ------
    ClusterError
        When nobody answers there.
    ConfigurationError
        When a package is missing that workers here need.
    """
    if scheduler is None:
        with (
            dask.config.set(_WORKERS_HERE),
            LocalCluster(
                n_workers=n_workers,
                threads_per_worker=1,
                # Whoever has none is given port 8787, which another batch may have.
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,
                preload="gvo.batch.worker",
                # Else whoever has a login here could have the workers run what he likes.
                security=_make_security(),
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise ClusterError(f"{scheduler}: no scheduler of Dask answers: {error}") from error
    with _quiet(), client:
        yield client


def _make_security() -> Security:
    """Return keys for this batch alone."""
    try:
        security: Security = Security.temporary()
    except ImportError as error:
        raise ConfigurationError("batches need cryptography: pip install 'gvo[batch]'") from error
    return security


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep back what a client logs of a scheduler that it lost: it is said in a line."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


class Engine:
    """Hands tasks to a cluster and takes what comes back.

    A task whose worker dies is tried elsewhere by Dask, some times. Its neighbours are suspected
    with it, so whoever is given up is tried once more in the end, alone: then it was its fault.

    Parameters
    ----------
    client : Client
    options : TaskOptions
    on_progress : callable, optional
        Called whenever a run has ended, and several times a second.
    """

    def __init__(
        self,
        client: Client,
        options: TaskOptions,
        on_progress: Callable[[BatchProgress], None] | None = None,
    ) -> None:
        self._client = client
        self._options = options
        self._on_progress = on_progress
        self._id = f"gvo-batch-{uuid.uuid4().hex[:12]}"
        self._ended: SimpleQueue[Future[BatchRow]] = SimpleQueue()
        self._running: dict[Any, tuple[int, Task, Future[BatchRow]]] = {}
        self._frames: dict[int, tuple[int, int]] = {}
        self._tally = _Tally()
        self._counted_s: float | None = None
        self._n_threads = 0
        self._n_workers = 0

    def run(self, tasks: Sequence[Task]) -> Generator[BatchRow, None, None]:
        """Yield the row of each task as it ends.

        Raises
        ------
        ClusterError
            When the scheduler is lost.
        """
        self._tally = _Tally(n_total=len(tasks), start_s=time.monotonic())
        self._client.subscribe_topic(self._id, self._hear)
        suspects: list[Task] = []
        try:
            yield from self._run(deque(enumerate(tasks)), suspects)
            again = deque(enumerate(suspects, start=len(tasks)))
            yield from self._run(again, None)
        finally:
            self._client.cancel([future for _, _, future in self._running.values()])
            self._client.unsubscribe_topic(self._id)

    def _run(
        self, waiting: deque[tuple[int, Task]], suspects: list[Task] | None
    ) -> Iterator[BatchRow]:
        while waiting or self._running:
            self._count_workers()
            many = max(_MIN_IN_FLIGHT, _PER_THREAD * self._n_threads)
            while waiting and len(self._running) < (1 if suspects is None else many):
                self._submit(*waiting.popleft())
            row = self._next(suspects)
            if row is not None:
                self._tally.add(row)
                yield row
            if self._on_progress is not None:
                self._on_progress(self._progress(row))

    def _next(self, suspects: list[Task] | None) -> BatchRow | None:
        """Return the row of a task that has ended, where one does within a moment."""
        try:
            future = self._ended.get(timeout=_TICK_S)
        except Empty:
            return None
        number, task, _ = self._running.pop(future.key)
        self._frames.pop(number, None)
        return self._take(task, future, suspects)

    def _count_workers(self) -> None:
        now = time.monotonic()
        if self._counted_s is not None and now - self._counted_s < _COUNT_S:
            return
        self._counted_s = now
        try:
            threads = self._client.nthreads()
        except OSError as error:
            raise ClusterError(_GONE) from error
        self._n_workers, self._n_threads = len(threads), sum(threads.values())

    def _submit(self, number: int, task: Task) -> None:
        # By such a key the scheduler sees that they belong together, and keeps back what no
        # worker has a thread for.
        key = (self._id, number)
        future = self._client.submit(work, task, self._options, self._id, key, key=key, pure=False)
        self._running[key] = number, task, future
        future.add_done_callback(self._ended.put)

    def _take(
        self, task: Task, future: Future[BatchRow], suspects: list[Task] | None
    ) -> BatchRow | None:
        try:
            return future.result()
        except CancelledError as error:
            raise ClusterError(_GONE) from error
        except KilledWorker as error:
            if suspects is not None:
                suspects.append(task)
                return None
            return task.row("failed", f"its worker died, each time: killed for memory? ({error})")
        except Exception as error:  # noqa: BLE001 - nothing in one run may take the others with it
            text = cut(f"{type(error).__name__}: {error}".partition("\n")[0], _MAX_REASON)
            return task.row("failed", text)
        finally:
            future.release()

    async def _hear(self, event: tuple[float, tuple[int, int, int]]) -> None:
        number, n_done, n_total = event[1]
        self._frames[number] = n_done, n_total

    def _progress(self, row: BatchRow | None) -> BatchProgress:
        running = [self._frames[n] for n, _, _ in self._running.values() if n in self._frames]
        return self._tally.progress(running, self._n_workers, row)


@dataclass(slots=True, kw_only=True)
class _Tally:
    """Counts of a batch."""

    n_total: int = 0
    start_s: float = 0.0
    n_done: int = 0
    n_found: int = 0
    n_failed: int = 0
    n_frames: int = 0

    def add(self, row: BatchRow) -> None:
        self.n_done += 1
        self.n_found += row.is_found
        self.n_failed += row.status == "failed"
        self.n_frames += 0 if row.is_found else row.frames or 0

    def progress(
        self, running: Sequence[tuple[int, int]], n_workers: int, row: BatchRow | None
    ) -> BatchProgress:
        elapsed_s = max(time.monotonic() - self.start_s, 1e-9)
        n_frames = self.n_frames + sum(n_done for n_done, _ in running)
        shares = sum(min(n_done / max(n_total, 1), 1.0) for n_done, n_total in running)
        # What was found took no time, and tells nothing of what is left.
        worked = self.n_done - self.n_found + shares
        left = self.n_total - self.n_done - shares
        return BatchProgress(
            n_done=self.n_done,
            n_total=self.n_total,
            n_found=self.n_found,
            n_failed=self.n_failed,
            n_workers=n_workers,
            frames_per_s=n_frames / elapsed_s,
            left_s=elapsed_s * left / worked if worked > 0 else None,
            row=row,
        )
