"""Small recordings, and a cluster of Dask whose processes can be killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

import gvo
from gvo.batch import BatchOptions
from gvo.io.synthetic import SyntheticRecording
from tests.conftest import GVO
from tests.make.recordings import Held, hold

N_FRAMES = 8
# Long enough to be stopped in the middle, also where the machine is busy.
N_LONG = 150
NO_REPORT = BatchOptions(report=False)
_PATIENCE_S = 60.0


def walk(number: int) -> Held:
    """Return some frames of a walk in a rendered room, those of another number elsewhere."""
    first, n_frames = number * N_FRAMES, (number + 1) * N_FRAMES
    whole = hold(SyntheticRecording("handheld", "stereo", n_frames=n_frames, scale=0.25))
    assert whole.truth is not None
    truth = whole.truth.select(slice(first, None))
    info = replace(whole.info, n_images=N_FRAMES)
    return Held(info=info, items=whole.items[2 * first :], truth=truth)


def there_and_back() -> Held:
    """Return a rendered recording that is walked to and fro again and again."""
    source = walk(0)
    start_ns = source.items[0].stamp_ns
    way = [*range(N_FRAMES), *range(N_FRAMES - 2, 0, -1)]
    items = [
        replace(image, stamp_ns=start_ns + number * 50_000_000)
        for number in range(N_LONG)
        for image in source.items[2 * way[number % len(way)] :][:2]
    ]
    return Held(info=replace(source.info, n_images=N_LONG), items=items)


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with three bags: walk0, walk1, walk2."""
    folder = tmp_path_factory.mktemp("bags")
    for number in range(3):
        gvo.convert(walk(number), folder / f"walk{number}.mcap")
    return folder


@pytest.fixture(scope="session")
def long_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag whose run takes some seconds."""
    path = tmp_path_factory.mktemp("long") / "long.mcap"
    gvo.convert(there_and_back(), path)
    return path


@pytest.fixture(scope="session")
def run_alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Path]:
    """Return a function that gives the folder of `gvo run` over a bag, on one thread."""
    runs: dict[Path, Path] = {}

    def run(bag: Path) -> Path:
        if bag not in runs:
            out = tmp_path_factory.mktemp("alone") / "out"
            command = [*GVO, "run", str(bag), "--out", str(out), "--no-report"]
            subprocess.run([*command, "--set", "runtime.threads=1"], check=True)
            runs[bag] = out
        return runs[bag]

    return run


@pytest.fixture
def blocked(tmp_path: Path) -> Path:
    """Return a recording that whoever opens it waits for, for ever."""
    camera = tmp_path / "blocked" / "mav0" / "cam0"
    camera.mkdir(parents=True)
    os.mkfifo(camera / "data.csv")
    return tmp_path / "blocked"


def state_of(out: Path) -> dict[Path, tuple[int, bytes]]:
    """Return what would tell that a file was written again."""
    files = [path for path in out.rglob("*") if path.is_file()]
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def wait_until(is_true: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + _PATIENCE_S
    while not is_true():
        if time.monotonic() > end_s:
            pytest.fail(f"waited in vain: {what}")
        time.sleep(0.02)


def is_under_way(out: Path) -> bool:
    """Tell whether some frames of a run are written."""
    path = out / "raw.txt"
    return path.exists() and path.read_bytes().count(b"\n") >= 10


def is_complete(out: Path) -> bool:
    try:
        state = json.loads((out / "summary.json").read_text())["state"]
    except FileNotFoundError:
        return False
    return bool(state == "complete")


class Cluster:
    """A scheduler and workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers = count()
        self._processes: list[subprocess.Popen[bytes]] = []
        self.workers: dict[str, subprocess.Popen[bytes]] = {}
        file = folder / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self.scheduler = self._start("scheduler", *options, "--scheduler-file", str(file))
        wait_until(lambda: file.exists() and file.read_text().endswith("}"), "the scheduler")
        self.address = str(json.loads(file.read_text())["address"])

    def add_worker(self, *options: str, cwd: Path | None = None) -> str:
        name = f"worker{next(self._numbers)}"
        place = ["--host", "127.0.0.1", "--local-directory", str(self._folder), "--name", name]
        rest = ["--nthreads", "1", "--no-nanny", "--no-dashboard", *options]
        self.workers[name] = self._start("worker", self.address, *place, *rest, cwd=cwd)
        return name

    def make_up(self, n_workers: int) -> None:
        alive = {name: each for name, each in self.workers.items() if each.poll() is None}
        self.workers = alive
        while len(self.workers) < n_workers:
            self.add_worker()

    def kill_worker(self, name: str) -> None:
        self.workers[name].send_signal(signal.SIGKILL)
        self.workers.pop(name).wait()

    def worker_at(self, number: int) -> str:
        """Return the name of the worker that has a recording of a batch, by its number there."""
        with Client(self.address) as client:
            (address,) = [
                address
                for address, keys in client.processing().items()
                if any(key[1] == number for key in keys if isinstance(key, tuple))
            ]
            return str(client.scheduler_info(n_workers=-1)["workers"][address]["name"])

    @contextmanager
    def frozen(self, name: str) -> Iterator[None]:
        """Let a worker do nothing for a while."""
        worker = self.workers[name]
        worker.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            worker.send_signal(signal.SIGCONT)

    def close(self) -> None:
        for process in reversed(self._processes):
            process.kill()
            process.wait()

    def _start(self, *arguments: str, cwd: Path | None = None) -> subprocess.Popen[bytes]:
        log = (self._folder / f"{arguments[0]}.log").open("ab")
        with log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments], stdout=log, stderr=log, cwd=cwd
            )
        self._processes.append(process)
        return process


@pytest.fixture(scope="module")
def any_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        yield cluster
    finally:
        cluster.close()


@pytest.fixture
def cluster(any_cluster: Cluster) -> Cluster:
    """Return a cluster with two workers, some of which may be killed."""
    any_cluster.make_up(2)
    with Client(any_cluster.address) as client:
        client.wait_for_workers(2)
    return any_cluster


@pytest.fixture(scope="module")
def near() -> Iterator[Client]:
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
        ) as threads,
        Client(threads) as client,
    ):
        yield client


def copy_of(bag: Path, folder: Path, name: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copy(bag, folder / name))
