"""Tasks are handed out, watched and tried again; none is lost, none is kept."""

import json
import os
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client

from gvo.batch.engine import BatchProgress, Engine, connected
from gvo.batch.inputs import make_variants
from gvo.batch.running import make_tasks
from gvo.batch.tasks import MARK, Task, TaskOptions
from tests.batch.conftest import NO_REPORT, is_complete, wait_until

N_MANY = 300


@pytest.fixture
def options(tmp_path: Path) -> TaskOptions:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / MARK).write_text(json.dumps({"mark": "x"}))
    return TaskOptions(out=tmp_path / "out", mark="x", batch=NO_REPORT)


def tasks_of(*sources: object) -> list[Task]:
    recordings = {f"r{number}": str(source) for number, source in enumerate(sources)}
    return make_tasks(recordings, make_variants())


def missing(n_tasks: int) -> list[Task]:
    """Return tasks that take no time: their recordings are not there."""
    return tasks_of(*(f"/none/{number}.bag" for number in range(n_tasks)))


def known_to_scheduler(client: Client) -> int:
    def count(dask_scheduler: Any) -> int:
        return sum(str(key).startswith("('gvo-batch") for key in dask_scheduler.tasks)

    return int(client.run_on_scheduler(count))


@contextmanager
def forgiving(n_failures: int) -> Iterator[None]:
    """Let the scheduler give a task up after so many dead workers."""
    with dask.config.set({"distributed.scheduler.allowed-failures": n_failures}):
        yield


def test_nothing_is_kept_nor_all_handed_out_at_once(near: Client, options: TaskOptions) -> None:
    n_held: list[int] = []
    n_known: list[int] = []

    def count(progress: BatchProgress) -> None:
        n_held.append(len(near.futures))
        if progress.n_done % 50 == 0:
            n_known.append(known_to_scheduler(near))

    engine = Engine(near, options, count)
    assert len(list(engine.run(missing(N_MANY)))) == N_MANY
    assert max(n_held) <= 101
    assert max(n_known) <= 110
    assert min(n_held[-5:]) < 10
    assert near.futures == {}
    wait_until(lambda: known_to_scheduler(near) == 0, "the scheduler forgets them")


def test_an_exception_of_any_kind_is_a_row_with_its_reason(
    near: Client, options: TaskOptions, bags: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(source: Any, *_: Any, **__: Any) -> None:
        raise LookupError(f"what?\n{'x' * 1000}")

    monkeypatch.setattr("gvo.batch.tasks.run_recording", fail)
    tasks = tasks_of(bags / "walk0.mcap", "/none.bag")
    rows = {row.folder: row for row in Engine(near, options).run(tasks)}
    assert (rows["r0"].status, rows["r0"].reason) == ("failed", "LookupError: what?")
    assert "does not exist" in rows["r1"].reason


class Killer:
    """Kills each worker that runs a task, by its number."""

    def __init__(self, client: Client, number: int) -> None:
        self._client, self._number = client, number
        self.killed: set[int] = set()

    def __call__(self, progress: BatchProgress) -> None:
        # Asking the workers themselves would wait for those that are just dying.
        cluster: Any = self._client.cluster
        pids = {nanny.worker_address: nanny.pid for nanny in cluster.workers.values()}
        for worker, keys in self._client.processing().items():
            pid = pids.get(worker)
            is_due = any(key[1] == self._number for key in keys if isinstance(key, tuple))
            if is_due and pid is not None and pid not in self.killed:
                self.killed.add(pid)
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


@pytest.mark.acceptance
def test_who_kills_each_worker_fails_and_the_neighbours_complete(
    options: TaskOptions, bags: Path, blocked: Path
) -> None:
    tasks = tasks_of(blocked, *[bags / f"walk{n}.mcap" for n in range(3)], "/none.bag")
    with forgiving(0), connected(None, 2) as client:
        killer = Killer(client, 0)
        rows = {row.folder: row for row in Engine(client, options, killer).run(tasks)}
        assert len(client.futures) == 0
    assert Counter(row.status for row in rows.values()) == {"complete": 3, "failed": 2}
    assert rows["r0"].reason.startswith("its worker died each time")
    assert "does not exist" in rows["r4"].reason
    assert len(killer.killed) >= 2
    assert all(is_complete(options.out / f"r{n}") for n in (1, 2, 3))
