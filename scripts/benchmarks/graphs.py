"""Optimize whole pose graphs beside GTSAM used by hand: errors, and CPU time from file to poses.

By hand means `readG2o`, a prior on the first pose, the better of the file's poses and the chordal
relaxation as the start, and Levenberg-Marquardt until it converges. Tori and garages are
generated, with starts that are off by more than a radian. Then ten false loops are planted among
ten true ones, and the positions compared with those without them.

Example: python scripts/benchmark.py graphs mine.g2o
"""

import argparse
import tempfile
import time
from pathlib import Path

import gtsam
import numpy as np

import gvo
from gvo.backend.batch import BatchOptimizer
from gvo.geometry import se3
from gvo.io.edges.opening import open_edges
from gvo.runs.smooth import SmoothingNotes, read_graph
from gvo.trajectory.g2o import format_edge, format_vertex
from gvo.types import FloatArray

from .tables import Table

EXAMPLES = ("sphere2500.txt", "pose3example-grid.txt", "pose3example.txt")
SIGMAS = np.array([0.02] * 3 + [0.05] * 3)
HEADER = (
    "graph",
    "poses, edges",
    "by hand",
    "gvo",
    "difference",
    "CPU by hand [s]",
    "CPU [s]",
    "ratio",
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this sub-command."""
    parser.add_argument("graphs", type=Path, nargs="*", help="g2o files, beside GTSAM's examples")


def measure(arguments: argparse.Namespace) -> None:
    """Print a row for each graph, then what false loops do."""
    examples = [Path(gtsam.findExampleDataFile(name)) for name in EXAMPLES]  # type: ignore[no-untyped-call]
    with tempfile.TemporaryDirectory() as folder:
        paths = [*arguments.graphs, *examples, *generated(Path(folder))]
        table = Table(HEADER, [path.name for path in paths])
        for path in paths:
            table.add(row(path))
    print()
    for seed in range(3):
        print(f"ten false loops among ten, seed {seed}: positions {false_loops(seed)}", flush=True)


def row(path: Path) -> list[str]:
    """Return the cells of a graph: the medians of three turns."""
    own, hand = zip(*[(by_gvo(path), by_hand(path)) for _ in range(3)], strict=True)
    errors = [turns[0][0] for turns in (hand, own)]
    times = [float(np.median([seconds for _, _, seconds in turns])) for turns in (hand, own)]
    return [
        path.name,
        own[0][1],
        *(f"{error:.7g}" for error in errors),
        f"{errors[1] / errors[0] - 1.0:.1e}",
        *(f"{seconds:.3f}" for seconds in times),
        f"{times[1] / times[0]:.2f}",
    ]


def by_hand(path: Path) -> tuple[float, str, float]:
    """Return error and CPU time of GTSAM's own functions."""
    begun = time.process_time()
    graph, values = gtsam.readG2o(str(path), True)
    first = min(graph.keyVector())
    T_first = values.atPose3(first) if values.size() else gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(first, T_first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)))
    start = gtsam.InitializePose3.initialize(graph)
    if values.size() and graph.error(values) < graph.error(start):
        start = values
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    optimizer.optimize()
    return optimizer.error(), "", time.process_time() - begun


def by_gvo(path: Path) -> tuple[float, str, float]:
    """Return error, size and CPU time of gvo."""
    begun = time.process_time()
    graph = read_graph(open_edges([path]), SmoothingNotes())
    optimizer = BatchOptimizer(graph)
    optimizer.run()
    optimizer.trajectory()
    seconds = time.process_time() - begun
    return optimizer.error, f"{len(graph.frame_ids)}, {len(graph.links)}", seconds


def generated(folder: Path) -> list[Path]:
    """Write a torus and a garage of some floors, with starts that are far off."""
    turns = np.linspace(0.0, 20.0 * np.pi, 1000)
    torus = [
        se3.exp(np.array([0.0, 0.0, a / 10.0, 0.0, 0.0, 0.0]))
        @ se3.exp(np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0]))
        @ se3.exp(np.array([0.0, a, 0.0, 0.0, 0.0, 0.0]))
        @ se3.exp(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
        for a in turns
    ]
    garage = [
        se3.make_transform(
            se3.exp(np.array([0.0, 0.0, a, 0.0, 0.0, 0.0]))[:3, :3],
            np.array([20.0 * np.cos(a), 12.0 * np.sin(a), 0.5 * a]),
        )
        for a in turns
    ]
    rng = np.random.default_rng(0)
    paths = []
    for name, poses in (("torus.g2o", np.array(torus)), ("garage.g2o", np.array(garage))):
        lines = [
            format_vertex(k, T @ se3.exp(rng.normal(0.0, [1.5] * 3 + [10.0] * 3) * (k > 0)))
            for k, T in enumerate(poses)
        ]
        lines += list(edge_lines(poses, ends_of(len(poses), 100), rng))
        paths.append(folder / name)
        paths[-1].write_text("\n".join(lines) + "\n")
    return paths


def ends_of(n: int, period: int) -> list[tuple[int, int]]:
    """Return odometry and a loop of every second pose to a round before."""
    return [(k, k + 1) for k in range(n - 1)] + [(k, k + period) for k in range(0, n - period, 2)]


def edge_lines(
    poses: FloatArray, ends: list[tuple[int, int]], rng: np.random.Generator
) -> list[str]:
    """Return edges with noise, as lines."""
    noises = se3.exp(rng.normal(0.0, SIGMAS, size=(len(ends), 6)))
    return [
        format_edge(a, b, se3.invert(poses[a]) @ poses[b] @ noise, np.diag(SIGMAS**2))
        for (a, b), noise in zip(ends, noises, strict=True)
    ]


def false_loops(seed: int) -> str:
    """Return how far off positions are with ten true loops, and with ten false ones besides."""
    rng = np.random.default_rng(seed)
    n = 300
    edges: dict[int, list[gvo.Edge]] = {}
    turns = np.linspace(0.0, 4.0 * np.pi, n)
    step = se3.exp(np.array([0.0, turns[1], 0.001, 0.0, 0.0, 0.5]))
    poses = np.array([np.linalg.matrix_power(step, k) for k in range(n)])
    true = [(int(k), int(k) + n // 2) for k in rng.choice(n // 2, 10, replace=False)]
    for a, b in [*((k, k + 1) for k in range(n - 1)), *true]:
        T = se3.invert(poses[a]) @ poses[b] @ se3.exp(rng.normal(0.0, 0.1 * SIGMAS))
        edge = gvo.Edge(reference_id=a, T_reference_frame=T, covariance=np.diag(SIGMAS**2) * 0.01)
        edges.setdefault(b, []).append(edge)
    errors = []
    for planted in (0, 10):
        for a, b in rng.choice(n, (planted, 2), replace=False):
            T = se3.exp(rng.normal(0.0, SIGMAS))
            edge = gvo.Edge(reference_id=int(a), T_reference_frame=T, covariance=np.diag(SIGMAS**2))
            edges[max(int(b), 1)].append(edge)
        found = gvo.optimize({k: edges.get(k, []) for k in range(n)}, robust="gnc")
        offsets = found.positions - poses[:, :3, 3]
        errors.append(float(np.sqrt((offsets**2).sum(axis=1).mean())))
    return f"{errors[0]:.4f} m off without, {errors[1]:.4f} m with them"
