"""CPU time, elapsed time and peak memory of `gvo run` and `gvo demo`.

For each recording: milliseconds by stage, read on the same thread (median and 95th percentile);
then CPU and elapsed time per frame as `gvo run` spends them until the last frame is written, with
reading ahead on its threads, peak memory, and both times as multiples of a yardstick: reading the
frames and finding 2000 ORB features in 8 octaves on their images (of RGB-D the colour image), CPU
time on one thread. Run and yardstick take turns for some rounds, and medians are printed. Starting
up and drawing are left out.

`--against CHECKOUT` compares with another version instead: `gvo run` of both in turns, as whole
processes without the report. In each round that of a moment is run too: what it takes is starting
up, the rest is that of the frames. Medians are printed; times depend on the machine and on what
else it does, ratios less so. `--demo` measures `gvo demo`, as a whole process in either case.

Example: python scripts/benchmark.py cost kitti_06_start
Example: python scripts/benchmark.py cost kitti_06_start --demo --against ../before --rounds 5
"""

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

import cv2
import numpy as np

import gvo
from gvo.io.frames import one_opencv_thread
from gvo.io.recording import Source
from gvo.runs.summary import peak_memory_mb
from gvo.types import FaultyFrame, Frame, Progress

from .recordings import at_least, usable_frames
from .tables import Table

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")
# Frames that are tracked before the clock starts: libraries set themselves up on the first ones.
N_WARM_UP = 3
GVO = (sys.executable, "-c", "from gvo.cli import main; main()")
# A process as small as this one starts the command: a command's peak is not less than what the
# process that starts it holds.
LAUNCHER = """
import resource, subprocess, sys, time
begun = time.perf_counter()
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, usage.ru_utime + usage.ru_stime, time.perf_counter() - begun, usage.ru_maxrss)
"""
COSTS_HEADER = (
    "recording",
    "CPU [ms]",
    "wall [ms]",
    "frames/s",
    "yardstick [ms]",
    "CPU / yardstick",
    "wall / yardstick",
    "peak [MB]",
    "growth [MB]",
)
PROCESS_FIGURES = {"CPU [s]": 2, "wall [s]": 2, "peak [MB]": 0}
"""What is printed of a process, and with how many decimals."""
FRAME_FIGURES = {"CPU/frame [ms]": 2, "wall/frame [ms]": 2, "start CPU [s]": 2, "peak [MB]": 0}
# Of a recording, to measure starting up: a few frames.
MOMENT_S = 0.15


class Round(NamedTuple):
    """A run and the yardstick right after it, milliseconds per frame; memory in MB."""

    cpu_ms: float
    wall_ms: float
    yardstick_ms: float
    peak_mb: float
    growth_mb: float


class ProcessCost(NamedTuple):
    """What a command cost, and of how many frames it wrote poses."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    n_frames: int


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    parser.add_argument("recordings", type=Path, nargs="*", help="bags or data-set folders")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--demo", action="store_true", help="also gvo demo")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="of another version")
    parser.add_argument("--rounds", type=at_least(1), default=3, metavar="N")


def measure(arguments: argparse.Namespace) -> None:
    """Print what is asked for."""
    if not arguments.recordings and not arguments.demo:
        raise gvo.GvoError("expected recordings or --demo, got neither")
    checkouts = [Path(gvo.__file__).parents[1]]
    if arguments.against is not None:
        checkouts.append(arguments.against.resolve())
        if not (checkouts[1] / "gvo" / "__init__.py").is_file():
            raise gvo.GvoError(f"{arguments.against}: expected a checkout that holds gvo/")
    commands = {"demo": ["demo"]} if arguments.demo else {}
    if arguments.against is not None:
        settings = [word for each in arguments.set for word in ("--set", each)]
        named = {
            each.name: ["run", str(each.resolve()), "--no-report", *settings]
            for each in arguments.recordings
        }
        compare(named, checkouts, arguments.rounds, frame_costs, FRAME_FIGURES)
    else:
        measure_recordings(arguments.recordings, arguments.set, arguments.rounds)
    compare(commands, checkouts, arguments.rounds, process_costs, PROCESS_FIGURES)


def compare(
    commands: dict[str, list[str]],
    checkouts: Sequence[Path],
    n_rounds: int,
    costs: Callable[[Sequence[str], Path], tuple[float, ...]],
    figures: dict[str, int],
) -> None:
    """Print what commands cost as processes, by one checkout or by two in turns."""
    if not commands:
        return
    kinds = ("here", "there", "ratio") if len(checkouts) > 1 else ("",)
    table = Table(
        ["command", *(f"{name} {kind}".strip() for name in figures for kind in kinds)], commands
    )
    for name, words in commands.items():
        rounds = [[costs(words, each) for each in checkouts] for _ in range(n_rounds + 1)]
        medians = np.median(rounds[1:], axis=0)  # the first one compiles, and fills caches
        cells = []
        for measured, n_decimals in zip(medians.T, figures.values(), strict=True):
            cells += [f"{figure:.{n_decimals}f}" for figure in measured]
            if len(checkouts) > 1:
                cells.append(f"{measured[0] / measured[1]:.3f}")
        table.add([name, *cells])


def frame_costs(words: Sequence[str], checkout: Path) -> tuple[float, float, float, float]:
    """Return CPU and elapsed ms per frame of a run, CPU seconds to start, and the peak in MB."""
    whole = process_cost(words, checkout)
    moment = process_cost([*words, "--duration", str(MOMENT_S)], checkout)
    n_frames = whole.n_frames - moment.n_frames
    if n_frames < 1:
        raise gvo.GvoError(f"{words[1]}: expected more than {MOMENT_S} s")
    cpu_s, wall_s = whole.cpu_s - moment.cpu_s, whole.wall_s - moment.wall_s
    start_s = moment.cpu_s - moment.n_frames * cpu_s / n_frames
    return 1e3 * cpu_s / n_frames, 1e3 * wall_s / n_frames, start_s, whole.peak_mb


def process_costs(words: Sequence[str], checkout: Path) -> tuple[float, float, float]:
    """Return CPU seconds, elapsed seconds and the peak in MB of a gvo command of a checkout."""
    cost = process_cost(words, checkout)
    return cost.cpu_s, cost.wall_s, cost.peak_mb


def process_cost(words: Sequence[str], checkout: Path) -> ProcessCost:
    """Run a gvo command of a checkout."""
    with tempfile.TemporaryDirectory() as folder:
        answer = subprocess.run(
            [sys.executable, "-c", LAUNCHER, *GVO, *words, "--out", f"{folder}/out"],
            check=False,
            capture_output=True,
            text=True,
            env=os.environ | {"PYTHONPATH": str(checkout)},
            cwd=folder,
        )
        frames = Path(folder, "out", "frames.csv")
        n_frames = frames.read_text("utf-8").count("\n") - 1 if frames.is_file() else 0
    code, cpu_s, wall_s, peak = map(float, answer.stdout.split())
    if code not in (0, 3):  # 3: some frames are missing
        last = answer.stderr.strip().rpartition("\n")[2]
        raise gvo.GvoError(f"gvo {' '.join(words)} of {checkout} failed: {last}")
    unit = 2**20 if sys.platform == "darwin" else 2**10  # bytes there, else kB
    return ProcessCost(cpu_s=cpu_s, wall_s=wall_s, peak_mb=peak / unit, n_frames=n_frames)


def measure_recordings(paths: Sequence[Path], settings: Sequence[str], n_rounds: int) -> None:
    """Print stages of each recording, then what the runs cost."""
    rows = []
    for path in paths:
        name, stage_ms = in_child(run_by_stages, path, settings)
        print(f"\n{name}: {len(stage_ms['total'])} frames")
        print(f"{'stage':<10} {'median ms':>10} {'95 % ms':>10}")
        for stage, elapsed_ms in stage_ms.items():
            median, high = np.percentile(elapsed_ms, [50, 95])
            print(f"{stage:<10} {median:>10.2f} {high:>10.2f}")
        print("total: decoded images to causal pose, reading apart", flush=True)
        rounds = [in_child(run_whole, path, settings) for _ in range(n_rounds)]
        rows.append([name, *costs_cells(rounds)])
    if rows:
        table = Table(COSTS_HEADER, [row[0] for row in rows])
        for row in rows:
            table.add(row)


def costs_cells(rounds: Sequence[Round]) -> list[str]:
    """Return the medians over rounds, as cells behind a recording's name."""
    cpu_ms, wall_ms, yardstick_ms, peak_mb, growth_mb = np.median(rounds, axis=0)
    cpu, wall, yardstick = np.array(rounds)[:, :3].T
    return [
        f"{cpu_ms:.1f}",
        f"{wall_ms:.1f}",
        f"{1e3 / wall_ms:.1f}",
        f"{yardstick_ms:.1f}",
        f"{np.median(cpu / yardstick):.2f}",
        f"{np.median(wall / yardstick):.2f}",
        f"{peak_mb:.0f}",
        f"{growth_mb:.1f}",
    ]


def in_child(
    function: Callable[Arguments, Answer], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Answer:
    """Call a function in a new process, which holds nothing else, and return what it answers."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(function, *arguments, **options).result()


def run_by_stages(path: Path, settings: Sequence[str]) -> tuple[str, dict[str, list[float]]]:
    """Track one frame after the other; return the recording's name, and milliseconds by stage."""
    # Read on this thread, so that decoding does not run beside the stages that are timed.
    config = gvo.load_configuration(settings=[*settings, "runtime.threads=1"])
    source = gvo.open_recording(path, config=config)
    odometry = gvo.Odometry(source.info.camera, config)
    items = gvo.frames(source, config)
    stage_ms: dict[str, list[float]] = {"read": []}
    totals: list[float] = []
    begun = time.perf_counter()
    for item in items:
        if not isinstance(item, FaultyFrame):
            stage_ms["read"].append(1e3 * (time.perf_counter() - begun))
            spent_ms = odometry.track(item).stage_ms
            totals.append(sum(spent_ms.values()))
            for stage, elapsed_ms in spent_ms.items():
                stage_ms.setdefault(stage, []).append(elapsed_ms)
        begun = time.perf_counter()
    if not totals:
        raise gvo.GvoError(f"{source.info.name}: no usable frame")
    return source.info.name, stage_ms | {"total": totals}


def run_whole(path: Path, settings: Sequence[str]) -> Round:
    """Run as `gvo run` does, until the last frame is written; then the yardstick."""
    config = gvo.load_configuration(settings=settings)
    source = gvo.open_recording(path, config=config)
    warm_up = gvo.Odometry(source.info.camera, config)
    for frame in islice(usable_frames(source, config), N_WARM_UP):
        warm_up.track(frame)
    run_recording = gvo.run_recording  # imports what it needs, as does the command at its start
    instants: list[tuple[float, float, float]] = []

    def note(_: Progress | None = None) -> None:
        instants.append((time.process_time(), time.perf_counter(), peak_memory_mb()))

    note()
    with tempfile.TemporaryDirectory() as folder:
        run_recording(source, folder, config=config, on_progress=note)
    n_frames = len(instants) - 1
    (cpu_s, wall_s, _), (cpu_end_s, wall_end_s, peak_mb) = instants[0], instants[-1]
    return Round(
        cpu_ms=1e3 * (cpu_end_s - cpu_s) / n_frames,
        wall_ms=1e3 * (wall_end_s - wall_s) / n_frames,
        yardstick_ms=yardstick_ms(source, settings),
        peak_mb=peak_mb,
        growth_mb=peak_mb - instants[-(-n_frames // 3)][2],
    )


def yardstick_ms(source: Source, settings: Sequence[str]) -> float:
    """Return the CPU milliseconds per frame of reading it and of ORB, on one thread."""
    alone = gvo.load_configuration(settings=[*settings, "runtime.threads=1"])
    orb = cv2.ORB_create(nfeatures=2000, nlevels=8)  # type: ignore[attr-defined]
    n_frames = 0
    with one_opencv_thread():
        for frame in islice(usable_frames(source, alone), N_WARM_UP):
            detect(orb, frame)
        begun = time.process_time()
        for frame in usable_frames(source, alone):
            detect(orb, frame)
            n_frames += 1
        return 1e3 * (time.process_time() - begun) / n_frames


def detect(orb: cv2.Feature2D, frame: Frame) -> None:
    """Find features in both images of a pair, or in the colour image."""
    images = [frame.left, frame.right] if isinstance(frame, gvo.StereoFrame) else [frame.image]
    for image in images:
        orb.detectAndCompute(image, None)
