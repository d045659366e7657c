"""Lines of g2o against GTSAM's own parser, written and read back."""

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.trajectory.g2o import (
    Measurement,
    Vertex,
    convert_line,
    format_edge,
    format_vertex,
    parse_line,
    parse_lines,
)
from tests.trajectory.paths import seeds

EXAMPLES = ("pose3example-grid.txt", "pose3example.txt", "pose3example-offdiagonal.txt")


def random_pose(rng: np.random.Generator) -> np.ndarray:
    R = Rotation.random(rng=rng).as_matrix()
    return se3.make_transform(np.asarray(R), rng.normal(0.0, 10.0, 3))


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(size=(6, 6))
    return np.asarray(A @ A.T + 0.1 * np.eye(6)) * 1e-3


@pytest.mark.parametrize("name", EXAMPLES)
def test_files_mean_what_gtsam_reads_in_them(name: str) -> None:
    path = str(gtsam.findExampleDataFile(name))  # type: ignore[no-untyped-call]
    graph, values = gtsam.readG2o(path, True)
    lines = [parse_line(line) for line in Path(path).read_text().splitlines()]
    vertices = [line for line in lines if isinstance(line, Vertex)]
    edges = [line for line in lines if isinstance(line, Measurement)]
    assert len(vertices) == values.size()
    assert len(edges) == graph.size()
    for vertex in vertices:
        expected = values.atPose3(vertex.frame_id).matrix()
        np.testing.assert_allclose(vertex.T_world_frame, expected, atol=1e-9)
    for index, edge in enumerate(edges):
        factor: Any = graph.at(index)
        assert list(factor.keys()) == [edge.reference_id, edge.frame_id]
        np.testing.assert_allclose(edge.T_reference_frame, factor.measured().matrix(), atol=1e-9)
        expected = factor.noiseModel().covariance()
        np.testing.assert_allclose(edge.covariance, expected, rtol=1e-9, atol=1e-15)


@given(seeds)
def test_gtsam_reads_the_formatted_lines_without_loss(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b, T_a_b = (random_pose(rng) for _ in range(3))
    covariance = random_covariance(rng)
    path = tmp_path_factory.mktemp("g2o") / "a.g2o"
    lines = [format_vertex(3, T_a), format_vertex(8, T_b), format_edge(3, 8, T_a_b, covariance)]
    path.write_text("\n".join(lines) + "\n")
    graph, values = gtsam.readG2o(str(path), True)
    error = se3.log(se3.invert(T_a_b) @ se3.invert(T_a) @ T_b)
    expected = 0.5 * error @ np.linalg.solve(covariance, error)
    assert graph.error(values) == pytest.approx(expected, rel=1e-6)


@given(seeds)
def test_a_converted_line_says_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = np.linalg.inv(random_covariance(rng))
    numbers = [*rng.normal(size=3), *rng.uniform(-1.5, 1.5, 3), *information[np.triu_indices(6)]]
    old = "EDGE3 4 9 " + " ".join(repr(float(value)) for value in numbers)
    new = convert_line(old)
    assert new.startswith("EDGE_SE3:QUAT 4 9 ")
    before, after = parse_line(old), parse_line(new)
    assert isinstance(before, Measurement)
    assert isinstance(after, Measurement)
    np.testing.assert_allclose(after.T_reference_frame, before.T_reference_frame, atol=1e-14)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    "text", ["", "# comment", "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", "EDGE_SE2 0"]
)
def test_lines_of_other_kinds_are_passed_over(text: str) -> None:
    assert parse_line(text) is None


@pytest.mark.parametrize(
    ("diagonal", "changes", "fault"),
    [
        ((4, 4, 4, 9, 9, 9), {}, ""),
        ((1e-9, 1e9, 1, 1e9, 1e-9, 1), {}, ""),
        ((4, 4, 0, 0, 0, 9), {}, "singular (z, roll, pitch are zero: a planar graph)"),
        ((0, 0, 0, 9, 9, 9), {}, "singular (x, y, z are zero)"),
        ((0,) * 6, {}, "singular (x, y, z, roll, pitch, yaw are zero: the edge says nothing)"),
        ((4, 4, 4, 9, 9, 9), {(0, 1): 4.0}, "singular"),
        ((4, 4, 4, 9, 9, 9), {(0, 3): 6.1}, "not positive definite"),
        ((4, 4, -4, 9, 9, 9), {}, "not positive definite"),
        ((-4, 0, 0, 0, 0, 0), {}, "not positive definite"),
        ((4, 4, np.nan, 9, 9, 9), {}, "not finite"),
        ((4, 4, np.inf, 9, 9, 9), {}, "not finite"),
    ],
)
def test_what_is_wrong_with_an_information_matrix_is_said(
    diagonal: tuple[float, ...], changes: dict[tuple[int, int], float], fault: str
) -> None:
    information = np.diag(np.array(diagonal, dtype=float))
    for (row, column), value in changes.items():
        information[row, column] = value
    numbers = " ".join(map(str, information[np.triu_indices(6)]))
    sound = "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1" + " 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    lines = parse_lines([sound, f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 {numbers}", sound])
    faults = [line.fault for line in lines if isinstance(line, Measurement)]
    is_known = [
        np.isfinite(line.covariance).all() for line in lines if isinstance(line, Measurement)
    ]
    assert faults[0] == faults[2] == ""
    assert faults[1].endswith(fault)
    assert is_known == [True, not fault, True]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0", "needs 8 numbers, got 7"),
        ("VERTEX_SE3:QUAT 0.5 1 2 3 0 0 0 1", "not a whole number"),
        ("VERTEX_SE3:QUAT 1_0 1 2 3 0 0 0 1", "not a whole number"),
        ("VERTEX_SE3:QUAT 0 1 2 3_0 0 0 0 1", "'3_0' is no decimal number"),
        ("VERTEX_SE3:QUAT 0 1 2 x 0 0 0 1", "x"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 2", "length 2"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 nan", "length nan"),
        ("EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1", "needs 30 numbers, got 9"),
    ],
)
def test_a_malformed_line_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_line(text)
