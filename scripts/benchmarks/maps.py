"""Measure what the map of a long run costs, on a simulated stream: no images are read.

A drive around a block, a tenth of its frames keyframes, which comes back to its start for the last
fifth. Places are of the full size, with random descriptors in the real index; of a place that is
seen again a tenth of the bits differ. Printed are CPU times, of all threads, and memory. What
describing an image and registering it cost is left out.

Example: python scripts/benchmark.py map --frames 10000
"""

import argparse
import time
import tracemalloc
from dataclasses import dataclass

import numpy as np

from gvo import RelativePose, StereoCamera
from gvo.frontend.klt import KltPlace
from gvo.frontend.rig import FrameMotion
from gvo.geometry import se3
from gvo.odometry.graph import RunGraph
from gvo.odometry.loops import LoopDetector
from gvo.types import Edge, Estimate, Failure, FloatArray, Loop

from .recordings import at_least

# As KLT keeps them by default, and more.
N_POINTS = 160
EVERY = 10
PERIOD_NS = 33_333_333
STEP_M = 0.3
SIGMAS = np.array([0.0005] * 3 + [0.004] * 3)
CAMERA = StereoCamera(fx=500, fy=500, cx=320, cy=120, width=640, height=240, baseline=0.5)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    parser.add_argument("--frames", type=at_least(1000), default=10_000, metavar="N")


def measure(arguments: argparse.Namespace) -> None:
    """Print the costs of a run of so many frames, then its memory."""
    n_frames = arguments.frames
    stream = Stream(n_frames)
    stream.run()
    start = time.process_time()
    optimum = stream.graph.optimize()
    seconds = time.process_time() - start
    errors = np.array([each.T_world_frame[:3, 3] for each in optimum.estimates])
    errors -= stream.truth[:, :3, 3]
    n_loops = sum(not loop.reason for loop in optimum.loops)
    n_kept, n_places = len(stream.graph), len(stream.detector)
    print(f"frames {n_frames}, of which in the graph {n_kept}, places {n_places}")
    print(f"loops {n_loops}, errors {np.sqrt(np.mean(np.sum(errors**2, axis=1))):.3f} m")
    for name, spent in stream.spent_s.items():
        print(f"{name}: {1e3 * spent / n_frames:.2f} ms CPU per frame")
    print(f"end of the run: {seconds:.2f} s CPU, with covariances", flush=True)
    measure_memory(n_frames)


def measure_memory(n_frames: int) -> None:
    """Print what tracemalloc counts of places and of the graph."""
    tracemalloc.start()
    stream = Stream(n_frames)
    before = tracemalloc.get_traced_memory()[0]
    stream.run(is_graph=False)
    places = tracemalloc.get_traced_memory()[0] - before
    stream = Stream(n_frames)
    before = tracemalloc.get_traced_memory()[0]
    stream.run(is_detector=False)
    graph = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    print(f"memory: graph {1e-6 * graph:.1f} MB, places {1e-6 * places:.1f} MB")


@dataclass(frozen=True)
class Frontend:
    """Knows places by where they are; what it extracts of a frame is its place."""

    truth: FloatArray
    n_lap: int
    rng: np.random.Generator
    camera: StereoCamera = CAMERA

    def extract(self, number: int) -> KltPlace:
        """Return the place that a frame sees: the same in each lap, but for noise."""
        rng = np.random.default_rng(number % self.n_lap)
        words = rng.integers(0, 256, (N_POINTS, 32), dtype=np.uint8)
        flipped = np.packbits(self.rng.random((N_POINTS, 256)) < 0.1, axis=1)
        depths = rng.uniform(4.0, 20.0, (N_POINTS, 1))
        points = depths * np.c_[rng.uniform((-0.6, -0.2), (0.6, 0.2), (N_POINTS, 2)), depths**0]
        return KltPlace(
            stamp_ns=number * PERIOD_NS,
            uvd=np.zeros((N_POINTS, 3), np.float32),
            points=points.astype(np.float32),
            slopes=np.zeros((N_POINTS, 2), np.float32),
            patches=np.zeros((N_POINTS, 11, 11), np.uint8),
            descriptors_left=words ^ flipped,
            descriptors_wide=np.zeros_like(words),
            depth_points=None,
            motion=FrameMotion(),
        )

    def describe(self, place: KltPlace) -> KltPlace:
        """Return the place."""
        return place

    def recognize(
        self, reference: KltPlace, current: KltPlace, observations: KltPlace
    ) -> RelativePose | Failure:
        """Measure the motion from a place near by."""
        ends = reference.stamp_ns // PERIOD_NS, current.stamp_ns // PERIOD_NS
        edge = measured(self.truth, *ends, self.rng)
        if np.linalg.norm(edge.T_reference_frame[:3, 3]) > 5.0:
            return Failure(reason="somewhere else")
        return RelativePose(
            T_reference_current=edge.T_reference_frame,
            covariance=edge.covariance,
            matches=np.zeros((100, 2), dtype=np.int64),
            inliers=np.ones(100, dtype=np.bool_),
        )


def measured(truth: FloatArray, i: int, j: int, rng: np.random.Generator) -> Edge:
    """Return the edge between two frames, with noise."""
    T = se3.invert(truth[i]) @ truth[j] @ se3.exp(SIGMAS * rng.normal(size=6))
    return Edge(reference_id=i * PERIOD_NS, T_reference_frame=T, covariance=np.diag(SIGMAS**2))


class Stream:
    """A drive of so many frames."""

    def __init__(self, n_frames: int) -> None:
        n_lap = EVERY * (n_frames * 4 // 5 // EVERY)
        self.truth = around_the_block(n_frames, n_lap)
        self.rng = np.random.default_rng(0)
        self.graph = RunGraph()
        self.frontend = Frontend(self.truth, n_lap, self.rng)
        self.detector = LoopDetector(frontend=self.frontend, graph=self.graph)
        self.graph.loops = self.detector.loops
        self.spent_s = {"graph": 0.0, "loops": 0.0, "optimization on the way": 0.0}

    def run(self, *, is_graph: bool = True, is_detector: bool = True) -> None:
        """Take all frames: a step each, and links to the latest two keyframes."""
        T, kept = self.truth[0], list[int]()
        for j in range(len(self.truth)):
            edges = [
                measured(self.truth, i, j, self.rng) for i in {j - 1, *kept[-2:]} if 0 <= i < j
            ]
            steps = [edge for edge in edges if edge.reference_id == (j - 1) * PERIOD_NS]
            T = T @ steps[0].T_reference_frame if steps else T
            estimate = Estimate(stamp_ns=j * PERIOD_NS, T_world_frame=T, covariance=np.eye(6))
            is_keyframe = j % EVERY == 0
            loops = self._look(j, T, kept[-20:]) if is_keyframe and is_detector else ()
            if is_graph:
                self._add(estimate, edges, is_keyframe=is_keyframe, is_looped=bool(loops))
            kept += [j] if is_keyframe else []

    def _look(self, j: int, T: FloatArray, kept: list[int]) -> tuple[Loop, ...]:
        seen = self.frontend.extract(j)
        start = time.process_time()
        loops = self.detector.look(seen, T, near={k * PERIOD_NS for k in kept})
        self.spent_s["loops"] += time.process_time() - start
        return loops

    def _add(
        self, estimate: Estimate, edges: list[Edge], *, is_keyframe: bool, is_looped: bool
    ) -> None:
        start = time.process_time()
        is_place = estimate.stamp_ns in self.detector
        self.graph.add_frame(estimate, edges, is_place=is_place)
        self.spent_s["graph"] += time.process_time() - start
        start = time.process_time()
        if is_keyframe:
            self.graph.advance(is_looped=is_looped)
        self.spent_s["optimization on the way"] += time.process_time() - start


def around_the_block(n_frames: int, n_lap: int) -> FloatArray:
    """Return T_world_frame of a drive around a block with round corners."""
    sides, rest = np.divmod(4.0 * np.arange(n_frames) / n_lap, 1.0)
    yaw = 0.5 * np.pi * (sides + np.clip((rest - 0.9) / 0.1, 0.0, 1.0))
    forward = np.stack([np.sin(yaw), 0.0 * yaw, np.cos(yaw)], axis=1)
    steps = STEP_M * (forward - forward[:n_lap].mean(axis=0))
    turns = np.pad(yaw[:, np.newaxis], ((0, 0), (1, 4)))
    T = se3.exp(turns)
    T[:, :3, 3] = np.cumsum(steps, axis=0) - steps[0]
    return T
