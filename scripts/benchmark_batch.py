"""Measure what a batch costs beside its runs.

--workers    renders recordings, runs them with one worker and with two, in turns, and prints the
             ratio of the times: from the first task to the last row, workers started and warm
--overhead   runs one small recording under many names with two workers, and prints what a task
             takes beyond the run itself, beside the same for tasks that do nothing; and how the
             client's memory grew from the second tenth of the tasks to the last

Both write into a temporary folder, without reports of the runs. Times on a machine with other
work mean little; ratios within one run mean more.

Example: python scripts/benchmark_batch.py --workers --overhead 1000
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from distributed import Client

import gvo.batch

N_ROUNDS = 3


def main() -> None:
    """Parse the arguments and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", action="store_true", help="one worker against two")
    parser.add_argument("--recordings", type=int, default=8, metavar="N", help="of --workers")
    parser.add_argument("--frames", type=int, default=60, metavar="N", help="of each recording")
    parser.add_argument("--overhead", type=int, metavar="N", help="tasks that are short")
    arguments = parser.parse_args()
    if not (arguments.workers or arguments.overhead):
        parser.error("name --workers or --overhead N")
    with tempfile.TemporaryDirectory() as folder:
        if arguments.workers:
            measure_workers(Path(folder), arguments.recordings, arguments.frames)
        if arguments.overhead:
            measure_overhead(Path(folder), arguments.overhead)


def measure_workers(folder: Path, n_recordings: int, n_frames: int) -> None:
    """Print the time of two workers over that of one."""
    bags = [render(folder / f"walk{seed}.mcap", n_frames, seed) for seed in range(n_recordings)]
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for round_ in range(N_ROUNDS):
        for n_workers, times in seconds.items():
            with gvo.batch.connected(None, n_workers) as client:
                run(bags[:n_workers], folder / f"warm{round_}{n_workers}", client)
                start = time.perf_counter()
                table = run(bags, folder / f"out{round_}{n_workers}", client)
                times.append(time.perf_counter() - start)
                if not (table["status"] == "complete").all():
                    sys.exit("benchmark: not all runs are complete")
    for n_workers, times in seconds.items():
        print(f"{n_workers} workers: {', '.join(f'{each:.1f}' for each in times)} s")
    ratios = [two / one for one, two in zip(seconds[1], seconds[2], strict=True)]
    print(
        f"{n_recordings} recordings of {n_frames} frames, two workers / one: "
        f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) of {N_ROUNDS}"
    )


def measure_overhead(folder: Path, n_tasks: int) -> None:
    """Print what a task takes beyond its run, and how the client's memory grew."""
    bag = render(folder / "short.mcap", 2, 0)
    links = folder / "links"
    links.mkdir()
    for number in range(n_tasks):
        (links / f"short{number:05d}.mcap").symlink_to(bag)
    memory: list[tuple[float, float]] = []

    def measure(progress: gvo.batch.BatchProgress) -> None:
        # Asking the workers takes time as well.
        if progress.row is not None and progress.n_done % max(n_tasks // 50, 1) == 0:
            memory.append((resident_mb(), max(client.run(resident_mb).values())))

    with gvo.batch.connected(None, 2) as client:
        run([bag], folder / "warm", client)
        start = time.perf_counter()
        futures = client.map(abs, range(n_tasks), pure=False)
        client.gather(futures)
        empty_s = time.perf_counter() - start
        del futures
        start = time.perf_counter()
        table = gvo.batch.run(
            links,
            out=folder / "many",
            client=client,
            options=gvo.batch.BatchOptions(report=False),
            on_progress=measure,
        )
        elapsed_s = time.perf_counter() - start
    runs_s = float(table["run_s"].sum())
    overhead_ms = 1e3 * (2 * elapsed_s - runs_s) / n_tasks
    print(
        f"{n_tasks} tasks on 2 workers: {elapsed_s:.1f} s, {1e3 * runs_s / n_tasks:.0f} ms per "
        f"run, {overhead_ms:.1f} ms per task beyond it (empty tasks: "
        f"{1e3 * 2 * empty_s / n_tasks:.1f} ms)"
    )
    for name, held in zip(("client", "largest worker"), zip(*memory, strict=True), strict=True):
        tenth = max(len(held) // 10, 1)
        early, late = max(held[tenth : 2 * tenth]), max(held[-tenth:])
        print(f"{name}: {early:.0f} MB in the second tenth of the tasks, {late:.0f} MB in the last")


def run(bags: Sequence[Path], out: Path, client: Client) -> pd.DataFrame:
    """Run a batch without reports of its runs."""
    options = gvo.batch.BatchOptions(report=False)
    return gvo.batch.run(bags, out=out, client=client, options=options)


def render(path: Path, n_frames: int, seed: int) -> Path:
    """Write a rendered recording as a bag."""
    scale = 0.25 if n_frames < 10 else 0.5
    walk = gvo.SyntheticRecording("handheld", "stereo", n_frames=n_frames, scale=scale, seed=seed)
    gvo.convert(walk, path)
    return path


def resident_mb() -> float:
    """Return the memory that this process holds, in 10^6 bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
