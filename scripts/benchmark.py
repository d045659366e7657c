"""Measure speed, memory and accuracy on recordings.

Prints for each recording the errors of the three trajectories, milliseconds by stage (median
and 95th percentile), CPU time per frame, peak memory, and the ratio of the time per frame to a
yardstick measured in the same run: ORB with 8 octaves and 2000 features on the images of a
frame. Absolute times depend on the machine and on what else it does; ratios less so.

`--window` and `--soak` measure the sliding window alone, on a simulated stream of edges: what
it costs beside GTSAM alone, and whether it ages (see benchmark_window.py).

Example: python scripts/benchmark.py kitti_06_start euroc_mh01_start
"""

import argparse
import sys
import time
from pathlib import Path

import benchmark_window  # type: ignore[import-not-found]  # beside this one
import cv2
import numpy as np

import gvo
from gvo.runs import peak_memory_mb
from gvo.types import FaultyFrame, Frame


def main() -> None:
    """Parse the arguments and measure each recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="*", help="bags or data-set folders")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument(
        "--window", type=int, nargs="?", const=3000, metavar="N", help="cost, of N poses"
    )
    parser.add_argument(
        "--soak", type=int, nargs="?", const=1_000_000, metavar="N", help="a life of N poses"
    )
    parser.add_argument("--untimed", action="store_true", help="let the soak ignore times")
    arguments = parser.parse_args()
    lengths = [n for n in (arguments.window, arguments.soak) if n is not None]
    if not (arguments.recordings or lengths):
        parser.error("name recordings, or --window, or --soak")
    if min(lengths, default=1000) < 1000:
        parser.error("--window and --soak take at least 1000 poses")
    if arguments.window is not None:
        benchmark_window.measure_cost(arguments.window)
    if arguments.soak is not None:
        faults = benchmark_window.soak(arguments.soak, is_timed=not arguments.untimed)
        if faults:
            sys.exit("benchmark: " + "; ".join(faults))
    for path in arguments.recordings:
        measure(path, arguments.set)


def measure(path: Path, settings: list[str]) -> None:
    """Run odometry over one recording and print its figures."""
    config = gvo.load_configuration(settings=settings)
    source = gvo.open_recording(path, config=config)
    odometry = gvo.Odometry(source.info.camera, config)
    results: list[gvo.FrameResult] = []
    smoothed: list[gvo.Estimate] = []
    yardsticks_ms: list[float] = []
    stages: dict[str, list[float]] = {"read": []}
    cpu_s = 0.0
    # Read on this thread, so that decoding does not run beside the stages that are timed.
    alone = gvo.load_configuration(settings=[*settings, "runtime.threads=1"])
    items = gvo.frames(source, alone)
    while True:
        start = time.perf_counter()
        cpu_start = time.process_time()
        item = next(items, None)
        if item is None:
            break
        stages["read"].append(1e3 * (time.perf_counter() - start))
        if isinstance(item, FaultyFrame):
            continue
        result = odometry.track(item)
        cpu_s += time.process_time() - cpu_start
        yardsticks_ms.append(yardstick_ms(item))
        results.append(result)
        smoothed += result.finished
        for stage, elapsed in result.stage_ms.items():
            stages.setdefault(stage, []).append(elapsed)
    smoothed += odometry.finish()
    if not results:
        raise gvo.GvoError(f"{path}: no usable frame")
    print(f"\n{source.info.name}: {len(results)} frames")
    estimates = {
        "raw": [result.raw for result in results],
        "causal": [result.causal for result in results],
        "smoothed": sorted(smoothed, key=lambda estimate: estimate.stamp_ns),
    }
    print_errors(source.ground_truth(), estimates)
    print_times(stages, results, cpu_s=cpu_s, yardstick_ms=float(np.median(yardsticks_ms)))


def yardstick_ms(frame: Frame) -> float:
    """Return the milliseconds that ORB of 8 octaves takes on the images of a frame."""
    orb = cv2.ORB_create(nfeatures=2000, nlevels=8)  # type: ignore[attr-defined]
    images = [frame.left, frame.right] if isinstance(frame, gvo.StereoFrame) else [frame.image]
    start = time.perf_counter()
    for image in images:
        orb.detectAndCompute(image, None)
    return 1e3 * (time.perf_counter() - start)


def print_errors(truth: gvo.Trajectory | None, estimates: dict[str, list[gvo.Estimate]]) -> None:
    """Print the errors of the three trajectories where the truth is known."""
    if truth is None:
        return
    evaluations = []
    for name, poses in estimates.items():
        evaluations.append(gvo.evaluate(truth, gvo.Trajectory.of(poses), name=name))
    print(gvo.format_evaluations(evaluations), end="")


def print_times(
    stages: dict[str, list[float]],
    results: list[gvo.FrameResult],
    *,
    cpu_s: float,
    yardstick_ms: float,
) -> None:
    """Print milliseconds by stage, the total per frame, memory and the yardstick."""
    totals = [sum(result.stage_ms.values()) for result in results]
    print(f"{'stage':<10} {'median ms':>10} {'95 % ms':>10}")
    for stage, elapsed in [*stages.items(), ("total", totals)]:
        print(f"{stage:<10} {np.median(elapsed):>10.2f} {np.percentile(elapsed, 95):>10.2f}")
    print("total: decoded images to causal pose, reading apart")
    print(f"CPU {1e3 * cpu_s / len(results):.1f} ms per frame, peak {peak_memory_mb():.0f} MB")
    print(
        f"yardstick {yardstick_ms:.1f} ms; total / yardstick {np.median(totals) / yardstick_ms:.2f}"
    )


if __name__ == "__main__":
    try:
        main()
    except gvo.GvoError as error:
        print(f"benchmark: error: {error}", file=sys.stderr)
        sys.exit(2)
