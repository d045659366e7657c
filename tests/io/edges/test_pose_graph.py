"""Pose graphs read as events, and written with smoothed poses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvo.errors import ConfigurationError, TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.events import Event, PoseEvent
from gvo.io.edges.opening import open_edges, parse_sigma
from gvo.io.edges.pose_graph import GRAPH, PoseGraphSource, write_graph
from gvo.trajectory.g2o import Measurement, format_edge, format_vertex, parse_line
from gvo.types import FloatArray, PosePrior


def translation(x: float) -> FloatArray:
    return se3.make_transform(np.eye(3), np.array([x, 0.0, 0.0]))


def edge_line(a: int, b: int) -> str:
    """Return an exact edge of poses that lie on a line, number n at n metres."""
    return format_edge(a, b, translation(b - a), 1e-2 * np.eye(6))


def write(folder: Path, *lines: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def events_of(path: Path) -> list[Event]:
    return list(PoseGraphSource(path).events())


def describe(event: Event) -> tuple[object, ...]:
    if isinstance(event, PoseEvent):
        return ("pose", event.frame_id, *(edge.reference_id for edge in event.edges))
    return ("edge", event.edge.reference_id, event.frame_id)


def test_an_edge_from_a_new_pose_is_turned_round(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    T = se3.exp(rng.normal(size=6))
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T + np.eye(6)
    lines = [edge_line(0, 1), format_edge(2, 1, T, covariance)]
    (event,) = [e for e in events_of(write(tmp_path, *lines)) if describe(e)[:2] == ("pose", 2)]
    assert isinstance(event, PoseEvent)
    (edge,) = event.edges
    assert edge.reference_id == 1
    np.testing.assert_allclose(edge.T_reference_frame @ T, np.eye(4), atol=1e-12)
    # any poses: the chi-square of both readings agrees
    T_1, T_2 = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
    before = se3.log(se3.invert(T) @ se3.invert(T_2) @ T_1)
    after = se3.log(se3.invert(edge.T_reference_frame) @ se3.invert(T_1) @ T_2)
    assert after @ np.linalg.solve(edge.covariance, after) == pytest.approx(
        before @ np.linalg.solve(covariance, before)
    )


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.lists(st.tuples(st.integers(-3, 12), st.integers(-3, 12)), min_size=1, max_size=40))
def test_connected_edges_come_once_after_poses(tmp_path: Path, ends: list[tuple[int, int]]) -> None:
    source = PoseGraphSource(write(tmp_path, *(edge_line(*pair) for pair in ends)))
    known: set[object] = set()
    n_edges = 0
    T_world: dict[object, FloatArray] = {}
    for event in source.events():
        if isinstance(event, PoseEvent):
            assert event.frame_id not in known
            assert bool(event.edges) == bool(known)
            edges = event.edges
            known.add(event.frame_id)
            T_world[event.frame_id] = translation(float(event.frame_id))  # type: ignore[arg-type]
        else:
            assert event.frame_id in known
            edges = (event.edge,)
        for edge in edges:
            n_edges += 1
            step = se3.invert(T_world[edge.reference_id]) @ T_world[event.frame_id]
            np.testing.assert_allclose(edge.T_reference_frame, step, atol=1e-12)
    reached = {ends[0][0]}
    for _ in ends:
        reached |= {end for pair in ends if reached & set(pair) for end in pair}
    connected = [pair for pair in ends if set(pair) <= reached]
    assert known == reached
    assert n_edges == len(connected)
    assert bool(source.faults.warnings()) == (len(connected) < len(ends))


def test_what_is_not_connected_is_told(tmp_path: Path) -> None:
    lines = [format_vertex(n, translation(n)) for n in (0, 1, 4)]
    source = PoseGraphSource(write(tmp_path, *lines, edge_line(0, 1), edge_line(5, 6)))
    assert len(list(source.events())) == 2
    warnings = "\n".join(source.faults.warnings())
    assert "1 edges are not connected with the first pose" in warnings
    assert "the first: 5 6" in warnings
    assert "1 vertices have no edge" in warnings


@pytest.mark.parametrize("position", [0, 3, 5])
def test_a_fixed_pose_holds_the_world_wherever_it_stands(tmp_path: Path, position: int) -> None:
    lines = [format_vertex(n, translation(10.0 + n)) for n in (0, 1, 2)]
    lines += [edge_line(0, 1), edge_line(1, 2)]
    lines.insert(position, "FIX 1")
    first, *others = events_of(write(tmp_path, *lines))
    assert describe(first) == ("pose", 1)
    assert isinstance(first, PoseEvent)
    assert isinstance(first.prior, PosePrior)
    np.testing.assert_allclose(first.prior.T_world_frame, translation(11.0))
    assert all(event.prior is None for event in others if isinstance(event, PoseEvent))


def test_the_first_vertex_holds_the_world_where_nothing_is_fixed(tmp_path: Path) -> None:
    lines = [format_vertex(n, translation(10.0 + n)) for n in (2, 0)]
    first = events_of(write(tmp_path, *lines, edge_line(0, 2)))[0]
    assert isinstance(first, PoseEvent)
    assert first.frame_id == 2
    assert isinstance(first.prior, PosePrior)
    np.testing.assert_allclose(first.prior.T_world_frame, translation(12.0))


def test_foreign_tags_are_counted(tmp_path: Path) -> None:
    lines = ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", "VERTEX_TRACKXYZ 9 0 0 3", edge_line(0, 1)]
    source = PoseGraphSource(write(tmp_path, *lines))
    assert len(list(source.events())) == 2
    (warning,) = source.faults.warnings()
    assert "VERTEX_TRACKXYZ in line 2" in warning


_PLANAR = "EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 4 0 0 0 0 0 4 0 0 0 0 0 0 0 0 0 0 0 0 0 9"


def test_edges_without_information_are_refused_with_their_number(tmp_path: Path) -> None:
    indefinite = _PLANAR.replace(" 9", " -9")
    lines = [edge_line(0, 1), _PLANAR, indefinite, edge_line(1, 2), indefinite]
    source = PoseGraphSource(write(tmp_path, *lines))
    assert [describe(event)[0] for event in source.events()] == ["pose"] * 3
    assert source.measurement_lines == [edge_line(0, 1), edge_line(1, 2)]
    planar, others = source.faults.warnings()
    assert planar.startswith("1 edges were refused: their information is singular (z, roll, pitch")
    assert others.startswith("2 edges were refused: their information is not positive definite")
    assert others.endswith("the first: 1 2")
    with pytest.raises(TrajectoryError, match=r"no edge .* a planar graph\), give --sigma DEG,M"):
        PoseGraphSource(write(tmp_path, _PLANAR))


def test_edges_without_information_take_the_noise_that_is_given(tmp_path: Path) -> None:
    path = write(tmp_path, edge_line(0, 1), _PLANAR)
    source = open_edges([path], sigmas=[parse_sigma("0.5,0.25")])
    assert isinstance(source, PoseGraphSource)
    *_, last = source.events()
    assert isinstance(last, PoseEvent)
    sigmas = np.repeat([np.radians(0.5), 0.25], 3)
    np.testing.assert_allclose(last.edges[0].covariance, np.diag(sigmas**2))
    (stated,) = [line for line in map(parse_line, source.measurement_lines[1:]) if line]
    assert isinstance(stated, Measurement)
    np.testing.assert_allclose(stated.covariance, np.diag(sigmas**2))
    assert "0.5 deg, 0.25 m" in source.decisions[-1]
    with pytest.raises(ConfigurationError, match="states the noise of its edges itself"):
        open_edges([write(tmp_path, edge_line(0, 1))], sigmas=[parse_sigma("0.5,0.25")])
    with pytest.raises(ConfigurationError, match="give it once"):
        open_edges([path], sigmas=[parse_sigma("0.5,0.25")] * 2)


def test_ids_given_twice_are_named(tmp_path: Path) -> None:
    vertices = [format_vertex(n, translation(n)) for n in (*range(20), *range(14), 5)]
    with pytest.raises(TrajectoryError, match=r"ids .* vertex: 0, 1, .*, 11 and 2 more"):
        PoseGraphSource(write(tmp_path, *vertices, edge_line(0, 1)))


def test_measurements_are_given_as_they_were_read(tmp_path: Path) -> None:
    path = write(tmp_path, edge_line(0, 1), "FIX 0", "EDGE3 1 2 1 0 0 0 0 0", edge_line(2, 1))
    first, fix, old, last = PoseGraphSource(path).measurement_lines
    assert (first, fix, last) == (edge_line(0, 1), "FIX 0", edge_line(2, 1))
    assert old.startswith("EDGE_SE3:QUAT 1 2 1.0 0.0 0.0 0.0 0.0 0.0 1.0 1.0 0.0")


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "holds no edge"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"], "EDGE_SE2"),
        (["EDGE_SE3:QUAT 0 1 1 2"], "graph.g2o:1: EDGE_SE3:QUAT needs 30 numbers"),
        (
            ["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "EDGE_SE3:QUAT 0 1 1 2"],
            "graph.g2o:2: EDGE_SE3:QUAT needs 30 numbers",
        ),
        (
            ["FIX 0", "VERTEX_SE3:QUAT 0 0 0", edge_line(0, 1)],
            "graph.g2o:2: VERTEX_SE3:QUAT needs 8 numbers",
        ),
        (["<xml>"], "graph.g2o:1"),
    ],
)
def test_what_is_no_graph_is_refused(tmp_path: Path, lines: list[str], words: str) -> None:
    with pytest.raises(TrajectoryError, match=words) as caught:
        PoseGraphSource(write(tmp_path, *lines))
    assert "\n" not in str(caught.value)


def test_a_malformed_line_further_on_ends_the_stream_with_its_number(tmp_path: Path) -> None:
    source = PoseGraphSource(write(tmp_path, edge_line(0, 1), edge_line(1, 2), "EDGE3 1 2"))
    events = source.events()
    assert describe(next(events)) == ("pose", 0)
    with pytest.raises(TrajectoryError, match=r"graph\.g2o:3"):
        list(events)


def test_vertices_come_by_their_stamps_then_the_measurements(tmp_path: Path) -> None:
    poses = [(stamp_ns, n, translation(n)) for n, stamp_ns in ((7, 300), (5, 20), (6, 100))]
    write_graph(tmp_path, poses, ["EDGE_SE3:QUAT 5 6", "EDGE_SE3:QUAT 6 7"])
    lines = (tmp_path / GRAPH).read_text().splitlines()
    assert [line.split()[:3] for line in lines[:3]] == [
        ["VERTEX_SE3:QUAT", str(number), f"{number}.0"] for number in (5, 6, 7)
    ]
    assert lines[3:] == ["EDGE_SE3:QUAT 5 6", "EDGE_SE3:QUAT 6 7"]
    assert [path.name for path in tmp_path.iterdir()] == [GRAPH]
