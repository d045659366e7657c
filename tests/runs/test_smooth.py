"""Edges in, a run folder out: against GTSAM's own optimizer, and never half of it."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError
from gvo.geometry import se3
from gvo.io.edges.events import Event, InputFaults, PoseEvent
from gvo.io.edges.opening import open_edges
from gvo.io.run_folder.reader import read_run
from gvo.runs.result import RunResult
from gvo.runs.smooth import optimize_edges, smooth_edges
from gvo.trajectory.formats import read_covariances, write_tum
from gvo.trajectory.g2o import format_edge, format_vertex
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, FloatArray
from tests.conftest import Command

TRAJECTORIES = ("raw", "causal", "smoothed")
SECOND = 1_000_000_000


class ListSource:
    """Events in memory; ends in an error where one is given."""

    name = "list"
    has_made_up_stamps = False

    def __init__(self, events: list[Event], error: BaseException | None = None) -> None:
        self._events = events
        self._error = error
        self.decisions: list[str] = []
        self.faults = InputFaults()
        self.n_poses = len(events)

    def events(self) -> Iterator[Event]:
        yield from self._events
        if self._error is not None:
            raise self._error


def example(name: str) -> Path:
    return Path(gtsam.findExampleDataFile(name))  # type: ignore[no-untyped-call]


def step(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return se3.exp(np.concatenate([0.1 * rng.normal(size=3), [0.0, 0.0, 1.0]]))


def edge(reference: int, T: FloatArray) -> Edge:
    return Edge(reference_id=reference, T_reference_frame=T, covariance=1e-4 * np.eye(6))


def chain(n: int) -> list[Event]:
    """Return poses tied to their predecessors only."""
    events: list[Event] = [PoseEvent(frame_id=0, stamp_ns=5)]
    events += [
        PoseEvent(frame_id=i, stamp_ns=5 + i * SECOND, edges=(edge(i - 1, step(i)),))
        for i in range(1, n)
    ]
    return events


def errors_by_gtsam(path: Path, graph_of: Path) -> float:
    """Return the error of the poses of one file in the graph of another, both read by GTSAM."""
    _, values = gtsam.readG2o(str(path), True)
    graph, _ = gtsam.readG2o(str(graph_of), True)
    return float(graph.error(values))


def least_error(path: Path) -> float:
    """Return the error of GTSAM's batch Levenberg-Marquardt, from the file's own vertices."""
    graph, values = gtsam.readG2o(str(path), True)
    first = min(values.keys())
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    graph.add(gtsam.PriorFactorPose3(first, values.atPose3(first), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    optimizer.optimize()
    return float(optimizer.error())


def optimize_file(path: str | Path, out: Path, **options: Any) -> RunResult:
    return optimize_edges(open_edges([path]), out, **options)


def test_a_chain_without_redundant_edges_stays_as_it_is(tmp_path: Path) -> None:
    assert smooth_edges(ListSource(chain(30)), tmp_path).is_complete
    raw, causal, smoothed = (gvo.read_trajectory(tmp_path / f"{n}.txt") for n in TRAJECTORIES)
    T = np.eye(4)
    for i in range(1, 30):
        T = T @ step(i)
    np.testing.assert_allclose(raw.T_world_frame[-1], T, atol=1e-8)
    np.testing.assert_allclose(causal.T_world_frame, raw.T_world_frame, atol=1e-6)
    np.testing.assert_allclose(smoothed.T_world_frame, raw.T_world_frame, atol=1e-6)
    raw_C, smoothed_C = (
        read_covariances(tmp_path / f"{n}_covariance.csv")[1] for n in ("raw", "smoothed")
    )
    scale = np.sqrt(np.einsum("nii,njj->nij", raw_C, raw_C))
    assert np.abs((raw_C - smoothed_C) / scale).max() < 1e-3


def test_a_pose_graph_reaches_the_error_of_batch_optimization(tmp_path: Path) -> None:
    path = example("pose3example-grid.txt")
    result = optimize_file(path, tmp_path)
    assert result.is_complete
    expected = least_error(path)
    reread = errors_by_gtsam(tmp_path / "smoothed.g2o", tmp_path / "smoothed.g2o")
    assert reread == pytest.approx(expected, rel=1e-6)
    assert errors_by_gtsam(tmp_path / "smoothed.g2o", path) == pytest.approx(expected, rel=1e-6)
    assert result.summary["batch"]["error"] == pytest.approx(expected, rel=1e-6)
    starts = result.summary["batch"]["errors_of_starts"]
    assert set(starts) == {"given", "odometry", "chordal"}
    assert min(starts.values()) >= expected * (1 - 1e-9)
    assert len(gvo.read_trajectory(tmp_path / "raw.txt")) == result.summary["frames"]
    assert {path.name for path in tmp_path.iterdir()} == {
        *("raw.txt", "smoothed.txt", "smoothed.g2o", "frames.csv", "summary.json"),
        "trajectories.png",
    }


def test_covariances_are_those_of_gtsam_and_can_be_read_back(tmp_path: Path) -> None:
    path = example("pose3example-grid.txt")
    optimize_file(path, tmp_path, covariances=True)
    graph, _ = gtsam.readG2o(str(path), True)
    _, values = gtsam.readG2o(str(tmp_path / "smoothed.g2o"), True)
    first = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), first))
    marginals = gtsam.Marginals(graph, values)
    expected = [marginals.marginalCovariance(key) for key in range(27)]
    record = read_run(tmp_path)
    found = record.trajectories["smoothed"].covariances
    assert found is not None
    np.testing.assert_allclose(found, np.array(expected), rtol=1e-3, atol=1e-8)
    assert record.trajectories["raw"].covariances is None
    assert len(record.trajectories["causal"]) == 0
    assert record.frames["status"].tolist() == ["ok"] * 27


def test_poses_whose_covariances_fail_are_written_without_them(
    tmp_path: Path, command: Command
) -> None:
    sigmas = [1e4 if k == 2 else 1e-6 for k in range(5)]
    lines = [format_edge(k, k + 1, step(k), s**2 * np.eye(6)) for k, s in enumerate(sigmas)]
    path, out = tmp_path / "tree.g2o", tmp_path / "out"
    path.write_text("\n".join(lines) + "\n")
    answer = command("smooth", path, "--covariances", "--out", out)
    assert answer.code == 3
    assert "no covariances" in answer.err
    record = read_run(out)
    assert record.trajectories["smoothed"].covariances is None
    assert len(record.trajectories["smoothed"]) == 6
    assert "no covariances" in json.loads((out / "summary.json").read_text())["warnings"][0]
    assert (out / "trajectories.png").exists()


def test_false_edges_are_refused_and_named_in_the_table(tmp_path: Path) -> None:
    lines = [format_edge(k, k + 1, step(k), 1e-4 * np.eye(6)) for k in range(9)]
    lines.append(format_edge(0, 9, np.eye(4), 1e-4 * np.eye(6)))
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    result = optimize_file(path, tmp_path / "out", robust="gnc")
    assert result.is_complete
    assert result.summary["batch"]["refused_edges"] == 1
    assert result.summary["batch"]["error"] == pytest.approx(0.0, abs=1e-9)
    with (tmp_path / "out/frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["n_rejected"] for row in rows] == ["1", *"00000000", "1"]
    assert rows[9]["reason"]


def test_the_smoothed_graph_keeps_ids_order_and_edges(tmp_path: Path) -> None:
    lines = [format_vertex(n, se3.exp(np.full(6, 0.1 * n))) for n in (12, 3, 40)]
    edges = [format_edge(a, b, step(a), 1e-3 * np.eye(6)) for a, b in [(3, 12), (40, 3), (12, 40)]]
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join([*lines, "FIX 3", *edges]) + "\n")
    optimize_file(path, tmp_path / "out")
    written = (tmp_path / "out/smoothed.g2o").read_text().splitlines()
    assert [line.split()[1] for line in written[:3]] == ["3", "12", "40"]
    assert written[3:] == ["FIX 3", *edges]
    _, values = gtsam.readG2o(str(tmp_path / "out/smoothed.g2o"), True)
    np.testing.assert_allclose(values.atPose3(3).matrix(), se3.exp(np.full(6, 0.3)), atol=1e-9)


def test_a_pose_without_a_usable_edge_is_in_all_trajectories(tmp_path: Path) -> None:
    events = chain(10)
    assert isinstance(events[5], PoseEvent)
    bad = Edge(reference_id=4, T_reference_frame=np.full((4, 4), np.nan), covariance=np.eye(6))
    events[5] = replace(events[5], edges=(bad,))
    result = smooth_edges(ListSource(events), tmp_path)
    assert not result.is_complete
    for name in TRAJECTORIES:
        assert len(gvo.read_trajectory(tmp_path / f"{name}.txt")) == 10
    assert result.summary["status_counts"]["coasting"] == 1
    text = "\n".join(result.warnings)
    assert "1 of 10 poses have no usable edge" in text
    assert "not finite" in text


def test_what_was_computed_stays_where_the_input_breaks_off(tmp_path: Path) -> None:
    source = ListSource(chain(8), RecordingError("the file ends in the middle of a message"))
    result = smooth_edges(source, tmp_path)
    assert not result.is_complete
    assert "broke off after 8 poses" in result.warnings[0]
    assert len(gvo.read_trajectory(tmp_path / "smoothed.txt")) == 8


def test_an_input_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing to smooth"):
        smooth_edges(ListSource([]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_fusing_independent_chains_is_better_than_the_worse(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 150
    truth, drifting = [np.eye(4)], [[np.eye(4)], [np.eye(4)]]
    for i in range(1, n):
        truth.append(truth[-1] @ step(i))
        for poses, sigma in zip(drifting, (0.002, 0.006), strict=True):
            noise = se3.exp(rng.normal(0.0, [sigma] * 3 + [5 * sigma] * 3))
            poses.append(poses[-1] @ step(i) @ noise)
    stamps_ns = np.arange(n) * SECOND // 10
    paths = [tmp_path / "a.txt", tmp_path / "b.txt"]
    for path, poses in zip(paths, drifting, strict=True):
        write_tum(path, Trajectory(stamps_ns=stamps_ns, T_world_frame=np.stack(poses)))
    reference = Trajectory(stamps_ns=stamps_ns, T_world_frame=np.stack(truth))
    result = smooth_edges(open_edges(paths), tmp_path / "out", ground_truth=reference)
    rpe = {e.name: e.rpe_m for e in result.evaluations}
    ends = [gvo.evaluate(reference, gvo.read_trajectory(path), name="x").rpe_m for path in paths]
    fused, worse = rpe["smoothed"], ends[1]
    assert fused is not None
    assert worse is not None
    assert fused < 0.7 * worse
    assert result.is_complete
