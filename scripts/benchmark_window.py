"""Measure what the sliding window costs beside GTSAM alone, what it gives away, whether it ages.

By itself the script runs odometry over a recording and smooths the edges that the window accepted
in other ways: by iSAM2 without marginalization, and in a batch by Levenberg-Marquardt. Printed are
half the chi-square of all edges, how far it and the positions (RMS) are from those of the batch,
the ATE, and the CPU time per pose, covariances included.

`benchmark.py --window` feeds one simulated stream, three edges per pose, to the window and to
iSAM2 driven directly with the same parameters, a fixed lag and one marginal covariance per update.
What the window does beyond that is in its time: it checks and gates the edges, keeps a snapshot,
and gives the covariance of each pose that leaves. `benchmark.py --soak` feeds a window for a long
life, with outliers, gaps, loops, priors and edges that are none, and fails where an update or the
memory has grown.

Example: python scripts/benchmark_window.py room.bag; python scripts/benchmark.py --window
"""

import argparse
import math
import resource
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Literal, Protocol, get_args

import benchmark_tables as tables  # type: ignore[import-not-found]  # beside this one
import gtsam
import numpy as np

import gvo
from gvo.backend.factors import Factors, Measurement
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.io.recording import Source
from gvo.runs.summary import peak_memory_mb
from gvo.types import Edge, FaultyFrame, FloatArray, PosePrior, PositionPrior, Prior

STEP_NS = 100_000_000
SIZE = 5
N_KEYFRAMES = 12
MEAN_STEP = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3])
STEP_SIGMAS = np.repeat([0.05, 0.1], 3)
SIGMAS = np.repeat([1e-3, 5e-3], 3)
COVARIANCE = np.diag(SIGMAS**2)
N_CHUNK = 200
MAX_GROWTH = 1.1
# Of a window: which keyframes a pose is tied to. Those farthest apart make the densest graph.
Links = Literal["nearest", "random", "farthest"]
# What a long life brings, by share of the poses.
OUTLIER, GAP, LOOP, PRIOR, INVALID = 0.02, 0.005, 0.03, 0.002, 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamedPose:
    """A pose of a stream, the keyframes to release, and a late edge."""

    frame: int
    references: list[int] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    prior: Prior | None = None
    is_kept: bool = False
    released: list[int] = field(default_factory=list)
    loop: tuple[int, Edge] | None = None


class Walk:
    """A random walk and noisy edges between its poses.

    Parameters
    ----------
    rng : numpy.random.Generator
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._steps = se3.exp(MEAN_STEP + STEP_SIGMAS * rng.normal(size=(997, 6)))
        self._noise = se3.exp(SIGMAS * rng.normal(size=(9973, 6)))
        self._n_measured = 0
        self.poses: dict[int, FloatArray] = {0: np.eye(4)}

    def advance(self, frame: int, alive: set[int]) -> None:
        """Go on to the next frame; of the others only those alive matter."""
        T = self.poses[frame - 1] @ self._steps[frame % len(self._steps)]
        self.poses[frame] = se3.normalize(T) if frame % 100 == 0 else T
        for old in [key for key in self.poses if key not in alive and key != frame]:
            del self.poses[old]

    def measure(self, references: list[int], frame: int) -> list[Edge]:
        """Return a noisy edge from each reference."""
        inverses = np.linalg.inv([self.poses[reference] for reference in references])
        indices = (self._n_measured + np.arange(len(references))) % len(self._noise)
        self._n_measured += len(references)
        T = inverses @ self.poses[frame] @ self._noise[indices]
        return [
            Edge(reference_id=reference, T_reference_frame=measured, covariance=COVARIANCE)
            for reference, measured in zip(references, T, strict=True)
        ]


def regular_stream(n: int, links: Links) -> Iterator[StreamedPose]:
    """Yield poses tied to their predecessor and two keyframes; every tenth becomes one."""
    rng = np.random.default_rng(0)
    walk, kept = Walk(rng), [0]
    yield StreamedPose(frame=0, is_kept=True)
    for frame in range(1, n):
        walk.advance(frame, {*kept, frame - 1})
        chosen = {
            "nearest": kept[-2:],
            "random": [int(key) for key in rng.permutation(kept)[:2]],
            "farthest": [kept[0], kept[-1]],
        }[links]
        references = list(dict.fromkeys([frame - 1, *chosen]))
        edges = walk.measure(references, frame)
        kept += [frame] if frame % 10 == 0 else []
        yield StreamedPose(
            frame=frame,
            references=references,
            edges=edges,
            is_kept=frame % 10 == 0,
            released=[kept.pop(0)] if len(kept) > N_KEYFRAMES else [],
        )


def long_life(n: int, seed: int = 0) -> Iterator[StreamedPose]:
    """Yield poses whose keyframes come and go at random, with all that can go wrong."""
    rng = np.random.default_rng(seed)
    walk, kept, recent = Walk(rng), [0], deque([0], maxlen=SIZE - 1)
    yield StreamedPose(frame=0, is_kept=True)
    for frame in range(1, n):
        walk.advance(frame, {*kept, *recent})
        others = [key for key in dict.fromkeys([*kept, *recent]) if key != frame - 1]
        references = [frame - 1, *map(int, rng.permutation(others)[:2])]
        edges = [] if rng.random() < GAP else walk.measure(references, frame)
        loop = None
        if others and rng.random() < LOOP:
            end = int(rng.choice([*others, frame]))
            loop = (end, walk.measure([frame - 1], end)[0])
        is_kept = rng.random() < 0.12
        released = _release(kept, rng)
        yield StreamedPose(
            frame=frame,
            references=references,
            edges=_spoil(edges, rng),
            prior=_prior(walk.poses[frame], rng) if rng.random() < PRIOR else None,
            is_kept=is_kept,
            released=released,
            loop=loop,
        )
        recent.append(frame)
        kept += [frame] if is_kept else []


def _release(kept: list[int], rng: np.random.Generator) -> list[int]:
    released: list[int] = []
    while len(kept) >= N_KEYFRAMES or (len(kept) > 2 and not released and rng.random() < 0.08):
        released.append(kept.pop(int(rng.integers(len(kept)))))
    return released


def _prior(T: FloatArray, rng: np.random.Generator) -> Prior:
    if rng.random() < 0.5:
        return PositionPrior(position_world=T[:3, 3], covariance=np.eye(3))
    return PosePrior(T_world_frame=T, covariance=np.diag(np.repeat([1e-2, 1.0], 3)))


def _spoil(edges: list[Edge], rng: np.random.Generator) -> list[Edge]:
    """Return the edges, seldom with one that is far off, or none at all."""
    if not edges:
        return edges
    chance = rng.random()
    index = int(rng.integers(len(edges)))
    edge = edges[index]
    if chance < OUTLIER:
        far = edge.T_reference_frame @ se3.exp(rng.normal(size=6))
        edge = replace(edge, T_reference_frame=far)
    elif chance < OUTLIER + INVALID:
        edge = [
            replace(edge, reference_id="unknown"),
            replace(edge, T_reference_frame=np.full((4, 4), np.nan)),
            replace(edge, T_reference_frame=2.0 * edge.T_reference_frame),
            replace(edge, covariance=-COVARIANCE),
            replace(edge, covariance=np.zeros((6, 6))),
        ][int(rng.integers(5))]
    return [*edges[:index], edge, *edges[index + 1 :]]


class Smoother(Protocol):
    """What takes the poses of a stream."""

    def add(self, arrival: StreamedPose) -> Sequence[object]:
        """Add a pose; return what came of it."""


class DirectSmoother:
    """The same graph in GTSAM, without a safety net."""

    # The parameters are those of `gvo.backend.pose_graph`.
    def __init__(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")
        parameters.setRelinearizeThreshold(0.001)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._isam = gtsam.ISAM2(parameters)
        self._huber = gtsam.noiseModel.mEstimator.Huber.Create(3.55)
        self._alive: list[int] = []
        self._kept: set[int] = set()

    def add(self, arrival: StreamedPose) -> list[FloatArray]:
        """Add a pose; return it with its covariance, and the poses that left."""
        factors, values = self._factors(arrival)
        n_old = max(len(self._alive) + 1 - SIZE, 0)
        leaving = [key for key in self._alive[:n_old] if key not in self._kept]
        if leaving:
            groups = {key: group for group, key in enumerate(leaving)}
            constrained, reeliminate = gtsam.KeyGroupMap(), gtsam.KeyList()
            for key in self._alive:
                constrained.insert2(key, groups.get(key, len(leaving)))
                reeliminate.push_back(key)
            constrained.insert2(arrival.frame, len(leaving))
            self._isam.update(factors, values, [], constrained, None, reeliminate, False)
        else:
            self._isam.update(factors, values)
        found = [self._isam.calculateEstimatePose3(arrival.frame).matrix()]
        found.append(self._isam.marginalCovariance(arrival.frame))
        for key in leaving:
            found.append(self._isam.calculateEstimatePose3(key).matrix())
            leaf = gtsam.KeyList()
            leaf.push_back(key)
            self._isam.marginalizeLeaves(leaf)
            self._alive.remove(key)
        self._alive.append(arrival.frame)
        self._kept |= {arrival.frame} if arrival.is_kept else set()
        self._kept -= set(arrival.released)
        return found

    def _factors(self, arrival: StreamedPose) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if not arrival.edges:
            sure = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
            factors.add(gtsam.PriorFactorPose3(arrival.frame, gtsam.Pose3(), sure))
            values.insert(arrival.frame, gtsam.Pose3())
            return factors, values
        for reference, edge in zip(arrival.references, arrival.edges, strict=True):
            gaussian = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
            noise = gtsam.noiseModel.Robust.Create(self._huber, gaussian)
            T = gtsam.Pose3(edge.T_reference_frame)
            factors.add(gtsam.BetweenFactorPose3(reference, arrival.frame, T, noise))
        start = self._isam.calculateEstimatePose3(arrival.references[0])
        step = gtsam.Pose3(arrival.edges[0].T_reference_frame)
        values.insert(arrival.frame, start.compose(step))
        return factors, values


class WindowSmoother:
    """The project's window, driven in the same way."""

    def __init__(self) -> None:
        self.window = gvo.SlidingWindow(WindowConfig(size=SIZE))

    def add(self, arrival: StreamedPose) -> list[gvo.Estimate]:
        """Add a pose; return it, and the poses that left."""
        stamp_ns = arrival.frame * STEP_NS
        edges = [  # what it costs to make them, too
            Edge(
                reference_id=edge.reference_id,
                T_reference_frame=edge.T_reference_frame,
                covariance=edge.covariance,
            )
            for edge in arrival.edges
        ]
        causal = self.window.add_pose(arrival.frame, stamp_ns, edges, arrival.prior)
        if arrival.is_kept:
            self.window.keep(arrival.frame)
        for frame in arrival.released:
            self.window.release(frame)
        if arrival.loop is not None:
            self.window.add_edge(*arrival.loop)
        return [causal, *self.window.pop_finished()]


def measure_cost(n: int) -> None:
    """Print the time per update of the window and of GTSAM alone, and their ratio."""
    print(f"{'keyframes':<10} {'GTSAM ms':>9} {'window ms':>9} {'ratio':>6}    per update, CPU")
    for links in get_args(Links):
        times_ms = _times_ms(n, links)
        gtsam_ms, window_ms = np.median(times_ms, axis=0)
        ratio = np.median(times_ms[:, 1] / times_ms[:, 0])
        print(f"{links:<10} {gtsam_ms:>9.3f} {window_ms:>9.3f} {ratio:>6.2f}")


def _times_ms(n: int, links: Links) -> FloatArray:
    """Return the times of GTSAM and of the window, shape (chunks, 2), per update."""
    smoothers: list[Smoother] = [DirectSmoother(), WindowSmoother()]
    stream = regular_stream(n, links)
    rows = []
    while chunk := list(islice(stream, N_CHUNK)):
        row = []
        # In turns, so that what else the machine does hits both.
        for smoother in smoothers:
            start = time.process_time()
            for arrival in chunk:
                smoother.add(arrival)
            row.append(1e3 * (time.process_time() - start) / len(chunk))
        rows.append(row)
    return np.array(rows[1:])  # the first chunk fills the window


class Life:
    """What a soak saw: which poses came out, and what each tenth cost.

    Parameters
    ----------
    n : int
        Poses to come.
    """

    def __init__(self, n: int) -> None:
        self._n_handed_over = bytearray(n)
        self._n_not_finite = 0
        self._times_ms: list[float] = []
        self._memories_mb: list[float] = []

    def take(self, causal: gvo.Estimate | None, finished: list[gvo.Estimate]) -> None:
        """Look at the estimates of an update."""
        for estimate in finished if causal is None else [causal, *finished]:
            total = estimate.T_world_frame.sum() + estimate.covariance.sum()
            self._n_not_finite += not math.isfinite(total)
        for estimate in finished:
            if isinstance(estimate.frame_id, int):
                self._n_handed_over[estimate.frame_id] += 1

    def end_tenth(self, elapsed_s: float) -> None:
        """Note and print what a tenth cost."""
        self._times_ms.append(1e4 * elapsed_s / len(self._n_handed_over))
        self._memories_mb.append(resident_memory_mb())
        tenth, time_ms, memory_mb = len(self._times_ms), self._times_ms[-1], self._memories_mb[-1]
        print(f"{tenth:>5} {time_ms:>14.3f} {memory_mb:>12.1f}", flush=True)

    def faults(self, *, is_timed: bool) -> list[str]:
        """Return what went wrong."""
        n_wrong = sum(count != 1 for count in self._n_handed_over)
        found = [
            f"{n_wrong} poses were not handed over exactly once" if n_wrong else "",
            f"{self._n_not_finite} estimates are not finite" if self._n_not_finite else "",
            _growth("memory", self._memories_mb),
            _growth("time per update", self._times_ms) if is_timed else "",
        ]
        return [fault for fault in found if fault]


def soak(n: int, *, is_timed: bool = True) -> list[str]:
    """Feed a window for a long life, print what each tenth cost, return what went wrong."""
    smoother, life, elapsed_s = WindowSmoother(), Life(n), 0.0
    print(f"{'tenth':>5} {'ms per update':>14} {'resident MB':>12}")
    for arrival in long_life(n):
        start = time.process_time()
        causal, *finished = smoother.add(arrival)
        elapsed_s += time.process_time() - start
        life.take(causal, finished)
        if (arrival.frame + 1) % (n // 10) == 0:
            life.end_tenth(elapsed_s)
            elapsed_s = 0.0
    life.take(None, smoother.window.finish())
    print(smoother.window.counts)
    return life.faults(is_timed=is_timed)


def _growth(name: str, tenths: list[float]) -> str:
    growth = tenths[-1] / tenths[1]
    return f"{name} grew to {growth:.2f} of the second tenth" if growth > MAX_GROWTH else ""


def resident_memory_mb() -> float:
    """Return what the process holds now; where the system does not tell, what it ever held."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return peak_memory_mb()
    return int(statm.read_text().split()[1]) * resource.getpagesize() / 2**20


SMOOTHINGS_HEADER = (
    "smoothing", "error", "above least [%]", "off least [m]", "ATE RMSE [m]", "ms per pose"
)  # fmt: skip
# A chain alone has no error but that of rounding.
ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedPose:
    """A pose of odometry, its accepted edges, and the keyframes after it."""

    stamp_ns: int
    edges: tuple[Edge, ...]
    kept_ns: tuple[int, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothing:
    """One way of smoothing: T_world_frame by stamp, and the seconds it took."""

    name: str
    poses: dict[int, FloatArray]
    elapsed_s: float


def compare_smoothings(path: Path, settings: Sequence[str]) -> None:
    """Print what the window's edges give in a window, without marginalization, and in a batch."""
    config = gvo.load_configuration(None, settings)
    source = gvo.open_recording(path, config=config)
    tracked = track(source, config)
    smoothings = smooth_whole(tracked, config.window)
    if config.window.size is not None:
        smoothings.insert(0, smooth_in_window(tracked, config.window))
    graph = edge_graph(tracked, config.window)
    truth = source.ground_truth()
    rows = [smoothing_row(smoothing, smoothings[-1], graph, truth) for smoothing in smoothings]
    print(tables.markdown_table(SMOOTHINGS_HEADER, rows), end="")


def track(source: Source, config: gvo.Config) -> list[TrackedPose]:
    """Run odometry over a recording; return what its window accepted."""
    odometry, tracked = gvo.Odometry(source.info.camera, config), []
    for frame in gvo.frames(source, config):
        if isinstance(frame, FaultyFrame):
            continue
        odometry.track(frame)
        window, stamp_ns = odometry.window, frame.stamp_ns
        kept_ns = tuple(stamp for stamp in window.kept() if isinstance(stamp, int))
        edges = window.edges(stamp_ns)
        tracked.append(TrackedPose(stamp_ns=stamp_ns, edges=edges, kept_ns=kept_ns))
    return tracked


def replay(tracked: Sequence[TrackedPose], config: WindowConfig) -> gvo.SlidingWindow:
    """Return a window that was given the same edges and keyframes."""
    window = gvo.SlidingWindow(config.model_copy(update={"gate": None}))
    for pose in tracked:
        window.add_pose(pose.stamp_ns, pose.stamp_ns, pose.edges)
        for stamp_ns in {*window.kept()}.difference(pose.kept_ns):
            window.release(stamp_ns)
        for stamp_ns in pose.kept_ns:
            window.keep(stamp_ns)
    return window


def smooth_in_window(tracked: Sequence[TrackedPose], config: WindowConfig) -> Smoothing:
    """Smooth in a window of the configured size."""
    start = time.process_time()
    estimates = replay(tracked, config).finish()
    elapsed_s = time.process_time() - start
    return Smoothing(name="window", poses=poses_of(estimates), elapsed_s=elapsed_s)


def smooth_whole(tracked: Sequence[TrackedPose], config: WindowConfig) -> list[Smoothing]:
    """Smooth by iSAM2 without marginalization, and on from there in a batch."""
    start = time.process_time()
    window = replay(tracked, config.model_copy(update={"size": None}))
    incremental_s = time.process_time() - start
    poses = {pose.stamp_ns: window.pose(pose.stamp_ns) for pose in tracked}
    start = time.process_time()
    estimates = window.finish()
    batch_s = time.process_time() - start
    return [
        Smoothing(name="full iSAM2", poses=poses, elapsed_s=incremental_s),
        Smoothing(name="batch LM", poses=poses_of(estimates), elapsed_s=batch_s),
    ]


def poses_of(estimates: Sequence[gvo.Estimate]) -> dict[int, FloatArray]:
    """Return T_world_frame by stamp."""
    return {estimate.stamp_ns: estimate.T_world_frame for estimate in estimates}


def edge_graph(tracked: Sequence[TrackedPose], config: WindowConfig) -> gtsam.NonlinearFactorGraph:
    """Return the factors of all edges, the stamps as keys."""
    graph, factors = gtsam.NonlinearFactorGraph(), Factors(config)
    for pose in tracked:
        for edge in pose.edges:
            if isinstance(edge.reference_id, int):
                measurement = Measurement.of(edge)
                graph.add(factors.between(edge.reference_id, pose.stamp_ns, measurement))
    return graph


def smoothing_row(
    smoothing: Smoothing,
    least: Smoothing,
    graph: gtsam.NonlinearFactorGraph,
    truth: gvo.Trajectory | None,
) -> list[str]:
    """Return a row of the table."""
    error, least_error = edge_error(graph, smoothing), edge_error(graph, least)
    above_percent = 100.0 * (error / least_error - 1.0) if error > ROUNDING else 0.0
    trajectory = trajectory_of(smoothing)
    offsets = trajectory.positions - trajectory_of(least).positions
    off_m = np.sqrt(np.mean(np.sum(offsets**2, axis=1)))
    ate = "-" if truth is None else f"{gvo.evaluate(truth, trajectory, name='').ate_m:.4f}"
    ms_per_pose = 1e3 * smoothing.elapsed_s / len(smoothing.poses)
    numbers = [f"{error:.6g}", f"{above_percent:.3f}", f"{off_m:.4f}", ate, f"{ms_per_pose:.2f}"]
    return [smoothing.name, *numbers]


def edge_error(graph: gtsam.NonlinearFactorGraph, smoothing: Smoothing) -> float:
    """Return half the chi-square of all edges (of their kernels' costs)."""
    values = gtsam.Values()
    for stamp_ns, T_world_frame in smoothing.poses.items():
        values.insert(stamp_ns, gtsam.Pose3(T_world_frame))
    return float(graph.error(values))


def trajectory_of(smoothing: Smoothing) -> gvo.Trajectory:
    """Return the poses as a trajectory, by stamp."""
    stamps_ns = np.array(sorted(smoothing.poses), dtype=np.int64)
    T = se3.normalize(np.array([smoothing.poses[stamp_ns] for stamp_ns in stamps_ns.tolist()]))
    return gvo.Trajectory(stamps_ns=stamps_ns, T_world_frame=T)


def main() -> None:
    """Parse the arguments and compare the smoothings of a recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="bag or data-set folder")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()
    compare_smoothings(arguments.recording, arguments.set)


if __name__ == "__main__":
    main()
