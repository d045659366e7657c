"""Smoothed poses and measurements as a g2o file."""

from pathlib import Path

import numpy as np
import pytest

from gvo.errors import RecordingError
from gvo.io.edges.pose_graph import GRAPH, GraphFile
from gvo.types import Estimate


def estimate(number: int, stamp_ns: int) -> Estimate:
    T = np.eye(4)
    T[0, 3] = number
    return Estimate(stamp_ns=stamp_ns, T_world_cam=T, covariance=np.eye(6), frame_id=number)


def test_vertices_come_by_their_stamps_then_the_measurements(tmp_path: Path) -> None:
    graph = GraphFile(tmp_path / "new")
    graph.add([estimate(7, 300), estimate(5, 20)])
    graph.add([estimate(6, 100)])
    graph.close(["EDGE_SE3:QUAT 5 6", "EDGE_SE3:QUAT 6 7"])
    lines = (tmp_path / "new" / GRAPH).read_text().splitlines()
    assert [line.split()[:3] for line in lines[:3]] == [
        ["VERTEX_SE3:QUAT", str(number), f"{number}.0"] for number in (5, 6, 7)
    ]
    assert lines[3:] == ["EDGE_SE3:QUAT 5 6", "EDGE_SE3:QUAT 6 7"]
    assert [path.name for path in (tmp_path / "new").iterdir()] == [GRAPH]


def test_the_file_of_an_earlier_run_is_gone_from_the_start(tmp_path: Path) -> None:
    (tmp_path / GRAPH).write_text("old\n")
    graph = GraphFile(tmp_path)
    assert not (tmp_path / GRAPH).exists()
    graph.close([])
    assert (tmp_path / GRAPH).read_text() == ""


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=f"{GRAPH}: cannot be written"):
        GraphFile(tmp_path / "file")


def test_a_file_that_cannot_be_finished_is_told(tmp_path: Path) -> None:
    graph = GraphFile(tmp_path)
    (tmp_path / GRAPH).mkdir()
    with pytest.raises(RecordingError, match=f"{GRAPH}: cannot be written"):
        graph.close([])
