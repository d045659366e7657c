"""A window's graph, written for other programs and read by GTSAM."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.types import Edge, FrameId, PosePrior


def fill(names: list[FrameId]) -> SlidingWindow:
    rng = np.random.default_rng(5)
    window = SlidingWindow(WindowConfig(size=None, kernel="none", gate=None))
    start = PosePrior(T_world_frame=se3.exp(rng.normal(size=6)), covariance=1e-4 * np.eye(6))
    for index, name in enumerate(names):
        edges = []
        for reference in names[max(index - 2, 0) : index]:
            factor = 0.01 * (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
            T = se3.exp(0.1 * rng.normal(size=6))
            edges.append(
                Edge(reference_id=reference, T_reference_frame=T, covariance=factor @ factor.T)
            )
        window.add_pose(name, index, edges, None if index else start)
    return window


def test_gtsam_reads_the_graph_with_its_error(tmp_path: Path) -> None:
    window = fill([3, 7, 5, 11, 20])
    path = tmp_path / "window.g2o"
    window.write_g2o(path)
    graph, values = gtsam.readG2o(str(path), True)
    assert sorted(values.keys()) == [3, 5, 7, 11, 20]
    for name, pose in window.poses().items():
        assert isinstance(name, int)
        np.testing.assert_allclose(values.atPose3(name).matrix(), pose, atol=1e-12)
    chi2 = sum(edge.chi2 for edge in window.graph() if edge.reference_id is not None)
    assert graph.size() == 7
    assert graph.error(values) == pytest.approx(0.5 * chi2, rel=1e-9)
    assert chi2 > 1.0


@pytest.mark.parametrize(
    ("names", "is_numbered"),
    [
        ([5, "right", 7], True),
        ([4, -1], True),
        ([2.5, 3], True),
        ([-3, "a"], True),
        ([0, 7, 5], False),
        ([4, np.int64(0)], False),
    ],
)
def test_one_name_that_is_no_whole_number_is_enough_to_number_all(
    names: list[FrameId], is_numbered: bool, tmp_path: Path
) -> None:
    path = tmp_path / "window.g2o"
    fill(names).write_g2o(path)
    lines = path.read_text().splitlines()
    keys = list(range(len(names))) if is_numbered else names
    for key, name, line in zip(keys, names, lines, strict=False):
        assert line.startswith(f"VERTEX_SE3:QUAT {key} ")
        assert line.endswith(f"# {name!r}") if is_numbered else "#" not in line
    assert lines[len(names)].startswith(f"EDGE_SE3:QUAT {keys[0]} {keys[1]} ")
    _, values = gtsam.readG2o(str(path), True)
    assert sorted(values.keys()) == sorted(keys)  # type: ignore[type-var]


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(SmoothingError, match="cannot be written"):
        fill(["a"]).write_g2o(tmp_path / "no such folder" / "window.g2o")
