"""Measure accuracy, speed and memory on recordings.

Prints for each recording the errors of the three trajectories, milliseconds by stage (median
and 95th percentile), and what a whole run costs: CPU and elapsed time per frame as `gvo run`
spends them until the last frame is written, with reading ahead on its threads, peak memory, and
both times as multiples of a yardstick: reading the frames and finding 2000 ORB features in 8
octaves on their images (of RGB-D the colour image), CPU time on one thread. Whole run and
yardstick take turns for some rounds, and medians are printed: times depend on the machine and on
what else it does, ratios less so. Starting up and drawing are left out.

`--ablation` adds the errors under settings that leave a part of the method out.
`--seeds N` measures errors and NEES on rendered recordings of N seeds, a line for each (see
benchmark_seeds.py): `--kind drive` (stereo), `hand` (a fast one, RGB-D), `rest` (a drone that
hovers, stereo), `block` (a lap and more by car, stereo), `rooms` (alike, RGB-D), with a rolling
shutter by `--readout`. `--keep DIR` keeps what is rendered.
`--loops` judges loop closure on recordings with ground truth, named or of seeds, also with
`--drift` or with the light going out (`--dark`; see benchmark_loops.py).
`--live` measures how late poses of a running camera are, and what is dropped where its frames come
too fast (see benchmark_live.py).
`--window` and `--soak` measure the sliding window alone, on a simulated stream of edges: what
it costs beside GTSAM alone, and whether it ages (see benchmark_window.py).
`--graphs` optimizes whole pose graphs, those named, GTSAM's and generated ones, beside GTSAM used
by hand (see benchmark_graphs.py).
`--map` measures what the map of a long run costs, on a simulated stream (see benchmark_map.py).

Example: python scripts/benchmark.py kitti_06_start euroc_mh01_start
Example: python scripts/benchmark.py --seeds 10 --kind hand --readout 25 --keep rendered
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import benchmark_graphs  # type: ignore[import-not-found]  # beside this one
import benchmark_live  # type: ignore[import-not-found]
import benchmark_loops  # type: ignore[import-not-found]
import benchmark_map  # type: ignore[import-not-found]
import benchmark_passes as passes  # type: ignore[import-not-found]
import benchmark_seeds  # type: ignore[import-not-found]
import benchmark_tables as tables  # type: ignore[import-not-found]
import benchmark_window  # type: ignore[import-not-found]
import numpy as np

import gvo
from gvo.io.recording import Source


def main() -> None:
    """Parse the arguments and measure each recording."""
    arguments = parse()
    if arguments.window is not None:
        benchmark_window.measure_cost(arguments.window)
    if arguments.soak is not None:
        faults = benchmark_window.soak(arguments.soak, is_timed=not arguments.untimed)
        if faults:
            sys.exit("benchmark: " + "; ".join(faults))
    if arguments.graphs is not None:
        benchmark_graphs.measure(arguments.graphs)
    if arguments.map is not None:
        benchmark_map.measure(arguments.map)
    measure_recordings(arguments)


def parse() -> argparse.Namespace:
    """Return the arguments of the command line, checked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="*", help="bags or data-set folders")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--ablation", action="store_true", help="also leave out part after part")
    parser.add_argument(
        "--rounds", type=int, default=3, metavar="N", help="whole runs, each with a yardstick"
    )
    parser.add_argument(
        "--window", type=int, nargs="?", const=3000, metavar="N", help="cost, of N poses"
    )
    parser.add_argument(
        "--soak", type=int, nargs="?", const=1_000_000, metavar="N", help="a life of N poses"
    )
    parser.add_argument("--graphs", type=Path, nargs="*", metavar="G2O", help="whole pose graphs")
    parser.add_argument(
        "--map", type=int, nargs="?", const=10_000, metavar="N", help="a map, of N frames"
    )
    parser.add_argument("--untimed", action="store_true", help="let the soak ignore times")
    parser.add_argument("--loops", action="store_true", help="judge loop closure")
    parser.add_argument("--live", action="store_true", help="judge a running camera")
    parser.add_argument("--drift", type=float, default=0.0, metavar="PERCENT", help="of a lap")
    parser.add_argument("--dark", type=span, metavar="A-B", help="seconds without light")
    add_seeds(parser)
    arguments = parser.parse_args()
    lengths = [n for n in (arguments.window, arguments.soak, arguments.map) if n is not None]
    is_graphs = arguments.graphs is not None
    if not (arguments.recordings or arguments.seeds or lengths or is_graphs):
        parser.error("name recordings, or --seeds, --window, --soak, --map or --graphs")
    if min(lengths, default=1000) < 1000:
        parser.error("--window, --soak and --map take at least 1000 poses")
    if arguments.rounds < 1:
        parser.error("--rounds takes at least 1")
    if (arguments.drift or arguments.dark) and not arguments.loops:
        parser.error("--drift and --dark go with --loops")
    if not 0.0 <= arguments.drift <= 5.0:
        parser.error("--drift takes 0 to 5")
    return arguments


def add_seeds(parser: argparse.ArgumentParser) -> None:
    """Add the options of rendered recordings."""
    group = parser.add_argument_group("rendered recordings")
    group.add_argument("--seeds", type=seeds, metavar="N", help="0 to N - 1, or as in 10-19")
    group.add_argument("--kind", choices=benchmark_seeds.KINDS, default="drive")
    group.add_argument("--sensor", choices=["stereo", "rgbd"], help="default: the kind's")
    group.add_argument("--frames", type=int, choices=range(2, 100_000), metavar="N")
    group.add_argument("--readout", type=float, default=0.0, metavar="MS", help="rolling shutter")
    group.add_argument("--keep", type=Path, metavar="DIR", help="of bags, written once, then read")


def seeds(text: str) -> range:
    """Return so many seeds, or those from a first to a last one."""
    first, dash, last = text.partition("-")
    found = range(int(first), int(last) + 1) if dash else range(int(first))
    if not found:
        raise ValueError(text)
    return found


def span(text: str) -> tuple[float, float]:
    """Return from when to when, seconds."""
    first, end = map(float, text.split("-"))
    return first, end


def sources_of(arguments: argparse.Namespace) -> Iterator[Source]:
    """Yield the recordings that are named, then those of the seeds."""
    config = gvo.load_configuration(settings=arguments.set)
    for path in arguments.recordings:
        yield gvo.open_recording(path, config=config)
    for seed in arguments.seeds or ():
        yield recordings_of(arguments).of(seed)


def recordings_of(arguments: argparse.Namespace) -> benchmark_seeds.Recordings:
    """Return what the options of rendered recordings name."""
    kind = benchmark_seeds.KINDS[arguments.kind]
    return benchmark_seeds.Recordings(
        kind=arguments.kind,
        sensor=arguments.sensor or kind.sensor,
        n_frames=arguments.frames or kind.n_frames,
        readout_ms=arguments.readout,
        folder=arguments.keep,
    )


def measure_recordings(arguments: argparse.Namespace) -> None:
    """Measure what is asked for of the recordings."""
    if arguments.loops:
        spoiling = benchmark_loops.Spoiling(dark_s=arguments.dark, drift=arguments.drift)
        benchmark_loops.measure(sources_of(arguments), arguments.set, spoiling)
        return
    if arguments.live:
        for path in arguments.recordings:
            passes.in_child(benchmark_live.measure, path, arguments.set, n_rounds=arguments.rounds)
        return
    if arguments.seeds:
        benchmark_seeds.measure(recordings_of(arguments), arguments.seeds, arguments.set)
    measure_all(arguments)


def measure_all(arguments: argparse.Namespace) -> None:
    """Measure each recording, and print all of them side by side."""
    errors: list[list[str]] = []
    costs: list[list[str]] = []
    for path in arguments.recordings:
        stages, rounds = measure(path, arguments.set, n_rounds=arguments.rounds)
        if stages.evaluations:
            errors.append(tables.errors_row(stages.name, **stages.evaluations))
        costs.append(costs_row(stages.name, rounds))
        if arguments.ablation:
            print_ablation(path, arguments.set)
    for header, rows in ((tables.ERRORS_HEADER, errors), (tables.COSTS_HEADER, costs)):
        if rows:
            print(f"\n{tables.markdown_table(header, rows)}", end="")


def measure(
    path: Path, settings: Sequence[str], *, n_rounds: int
) -> tuple[passes.Stages, list[passes.Round]]:
    """Run odometry over one recording and print its figures."""
    stages = passes.in_child(passes.run_by_stages, path, settings)
    print(f"\n{stages.name}: {stages.n_frames} frames")
    if stages.evaluations:
        print(gvo.format_evaluations(list(stages.evaluations.values())), end="")
    print(f"{'stage':<10} {'median ms':>10} {'95 % ms':>10}")
    for stage, elapsed_ms in stages.stage_ms.items():
        print(f"{stage:<10} {np.median(elapsed_ms):>10.2f} {np.percentile(elapsed_ms, 95):>10.2f}")
    print("total: decoded images to causal pose, reading apart", flush=True)
    rounds = [passes.in_child(passes.run_whole, path, settings) for _ in range(n_rounds)]
    print_costs(rounds)
    return stages, rounds


def median(rounds: list[passes.Round], name: str) -> float:
    """Return the median of a figure over the rounds."""
    return float(np.median([getattr(measured, name) for measured in rounds]))


def print_costs(rounds: list[passes.Round]) -> None:
    """Print what a frame of the whole run costs, by itself and against the yardstick."""
    wall_ms = median(rounds, "wall_ms")
    print(
        f"whole run: CPU {median(rounds, 'cpu_ms'):.1f} ms, wall {wall_ms:.1f} ms per frame, "
        f"{1e3 / wall_ms:.1f} frames/s"
    )
    print(
        f"memory: peak {median(rounds, 'peak_mb'):.0f} MB, "
        f"{median(rounds, 'growth_mb'):.1f} MB more than in the first third of the frames"
    )
    print(f"yardstick: CPU {median(rounds, 'yardstick_ms'):.1f} ms per frame, reading included")
    ratios = []
    for name in ("cpu_ratio", "wall_ratio"):
        values = sorted(getattr(measured, name) for measured in rounds)
        ratios.append(f"{median(rounds, name):.2f} ({values[0]:.2f} to {values[-1]:.2f})")
    print(
        f"whole run / yardstick: CPU {ratios[0]}, wall {ratios[1]}, of {len(rounds)} rounds",
        flush=True,
    )


def costs_row(name: str, rounds: list[passes.Round]) -> list[str]:
    """Return the cells of a recording in the table of costs."""
    wall_ms = median(rounds, "wall_ms")
    return [
        name,
        f"{median(rounds, 'cpu_ms'):.1f}",
        f"{wall_ms:.1f}",
        f"{1e3 / wall_ms:.1f}",
        f"{median(rounds, 'yardstick_ms'):.1f}",
        f"{median(rounds, 'cpu_ratio'):.2f}",
        f"{median(rounds, 'wall_ratio'):.2f}",
        f"{median(rounds, 'peak_mb'):.0f}",
        f"{median(rounds, 'growth_mb'):.1f}",
    ]


def print_ablation(path: Path, settings: Sequence[str]) -> None:
    """Print the errors under settings that leave a part of the method out."""
    found = passes.in_child(passes.ablate, path, settings)
    rows = [tables.ablation_row(name, e["raw"], e["smoothed"]) for name, e in found]
    print(f"\n{tables.markdown_table(tables.ABLATION_HEADER, rows)}", end="", flush=True)


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"benchmark: error: {error}", file=sys.stderr)
        sys.exit(2)
