"""Tasks on a Dask cluster: submitted, followed, tried again where a worker died."""

from __future__ import annotations

import logging
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import Any, TypeAlias

import dask
from distributed import CancelledError, Client, Future, KilledWorker, LocalCluster, Security

from gvo._text import cut
from gvo.batch.tasks import BatchRow, Task, TaskOptions
from gvo.batch.worker import work
from gvo.errors import GvoError, missing_extra

# Tasks given to the cluster at once: an adaptive one grows with the tasks that it sees.
_MIN_IN_FLIGHT = 100
_PER_THREAD = 2
_TICK_S = 0.2
_MAX_REASON = 500
_CONNECT_S = "30s"
# The statistical profiler keeps an hour of samples: megabytes for each run.
_LOCAL_WORKERS = {"distributed.worker.profile.enabled": False}
_LOST = "the scheduler is gone; the same command goes on where the batch was"


class ClusterError(GvoError):
    """The scheduler cannot be reached, or was lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchProgress:
    """How far a batch has come.

    Parameters
    ----------
    n_done, n_total : int
        Runs.
    n_found : int
        Of those done, finished by an earlier batch.
    n_failed : int
        Of those done, without a trajectory.
    n_workers : int
        Workers of the cluster.
    left_s : float or None
        Estimate of the time left, seconds; None before the first run has ended.
    row : BatchRow or None
        Row of the run that has just ended.
    """

    n_done: int = 0
    n_total: int = 0
    n_found: int = 0
    n_failed: int = 0
    n_workers: int = 0
    left_s: float | None = None
    row: BatchRow | None = None


@contextmanager
def connected(scheduler: str | None, n_workers: int | None) -> Iterator[Client]:
    """Connect to a scheduler, or start workers of one thread each on this machine.

    Parameters
    ----------
    scheduler : str or None
        Its address, such as tcp://host:8786.
    n_workers : int or None
        Workers to start; one per core if omitted.

    Raises
    ------
    ClusterError
        When no scheduler answers, or no worker can be started.
    ConfigurationError
        When a package is missing that local workers need.
    """
    if scheduler is None:
        with (
            dask.config.set(_LOCAL_WORKERS),
            _start_workers(n_workers) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = _ClosingClient(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:  # TypeError: TLS without a certificate
        raise ClusterError(f"{scheduler}: no scheduler of Dask answers: {error}") from error
    with _silenced_client(), client:
        yield client


class _ClosingClient(Client):
    """A client that is closed where it cannot connect: the garbage collector could deadlock."""

    def __init__(self, address: str, timeout: str) -> None:
        try:
            super().__init__(address, timeout=timeout)  # type: ignore[no-untyped-call]
        except BaseException:
            self.close()  # type: ignore[no-untyped-call]
            raise


def _start_workers(n_workers: int | None) -> LocalCluster:
    try:
        # Without keys any user of this machine could run code on the workers.
        security = Security.temporary()
    except ImportError as error:
        raise missing_extra("batches need cryptography", "batch") from error
    try:
        return LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            # By default it takes port 8787, which another batch may have.
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
            preload="gvo.batch.worker",
            security=security,
        )
    except (OSError, RuntimeError) as error:
        raise ClusterError(f"workers cannot be started: {error.__cause__ or error}") from error


@contextmanager
def _silenced_client() -> Iterator[None]:
    """Silence what a client logs when it loses its scheduler: `ClusterError` says it."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


_Numbered: TypeAlias = tuple[int, Task]


class Engine:
    """Submits tasks to a cluster and yields their rows.

    Dask runs a task whose worker dies on another worker, up to `allowed-failures` times. It blames
    all tasks that waited on the same worker, so those given up run once more at the end, one by
    one: the task that kills its worker then is to blame.
    """

    def __init__(
        self,
        client: Client,
        options: TaskOptions,
        on_progress: Callable[[BatchProgress], None] | None = None,
    ) -> None:
        self._client, self._options, self._on_progress = client, options, on_progress
        self._id = f"gvo-batch-{uuid.uuid4().hex[:12]}"
        self._done: SimpleQueue[Future[BatchRow]] = SimpleQueue()
        self._running: dict[Any, tuple[Task, Future[BatchRow]]] = {}
        self._state = BatchProgress()
        self._start_s = 0.0

    def run(self, tasks: Sequence[Task]) -> Generator[BatchRow, None, None]:
        """Yield the row of each task as it ends; raise `ClusterError` if the scheduler is lost."""
        self._state, self._start_s = BatchProgress(n_total=len(tasks)), time.monotonic()
        suspects: list[_Numbered] = []
        try:
            yield from self._run(deque(enumerate(tasks)), suspects)
            yield from self._run(deque(suspects), None)
        finally:
            self._client.cancel([future for _, future in self._running.values()])

    def _run(
        self, waiting: deque[_Numbered], suspects: list[_Numbered] | None
    ) -> Iterator[BatchRow]:
        while waiting or self._running:
            n_threads = self._count_workers()
            max_running = max(_MIN_IN_FLIGHT, _PER_THREAD * n_threads)
            while waiting and len(self._running) < (1 if suspects is None else max_running):
                self._submit(*waiting.popleft(), attempt=1 if suspects is None else 0)
            row = self._next(suspects)
            if row is not None:
                self._count(row)
                yield row
            if self._on_progress is not None:
                self._on_progress(replace(self._state, left_s=self._left_s(), row=row))

    def _next(self, suspects: list[_Numbered] | None) -> BatchRow | None:
        """Wait a moment for a task to end; return its row."""
        try:
            future = self._done.get(timeout=_TICK_S)
        except Empty:
            return None
        task, _ = self._running.pop(future.key)
        return self._result(task, future, suspects)

    def _count_workers(self) -> int:
        """Count the workers; return the number of their threads."""
        try:
            threads = self._client.nthreads()
        except OSError as error:
            raise ClusterError(_LOST) from error
        self._state = replace(self._state, n_workers=len(threads))
        return sum(threads.values())

    def _submit(self, number: int, task: Task, *, attempt: int) -> None:
        # Tasks whose keys share a prefix are one group, which the scheduler queues until a worker
        # has a free thread.
        key = (self._id, number, attempt)
        future = self._client.submit(work, task, self._options, key, key=key, pure=False)
        self._running[key] = task, future
        future.add_done_callback(self._done.put)

    def _result(
        self, task: Task, future: Future[BatchRow], suspects: list[_Numbered] | None
    ) -> BatchRow | None:
        try:
            return future.result()
        except CancelledError as error:
            raise ClusterError(_LOST) from error
        except KilledWorker as error:
            if suspects is not None:
                key: Any = future.key  # as `_submit` makes it
                suspects.append((key[1], task))
                return None
            return task.row("failed", f"its worker died each time: out of memory? ({error})")
        except Exception as error:  # noqa: BLE001 - one run must not end the batch
            text = cut(f"{type(error).__name__}: {error}".partition("\n")[0], _MAX_REASON)
            return task.row("failed", text)
        finally:
            future.release()

    def _count(self, row: BatchRow) -> None:
        state = self._state
        self._state = replace(
            state,
            n_done=state.n_done + 1,
            n_found=state.n_found + row.is_found,
            n_failed=state.n_failed + (row.status == "failed"),
        )

    def _left_s(self) -> float | None:
        state = self._state
        n_worked = state.n_done - state.n_found  # runs found finished took no time
        if n_worked == 0:
            return None
        return (time.monotonic() - self._start_s) * (state.n_total - state.n_done) / n_worked
