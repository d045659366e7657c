"""The edges that came with a frame: their kinds, their residuals, what the window refused."""

import numpy as np
import pytest

import gvo
from gvo.backend.window import SlidingWindow
from gvo.geometry import se3
from gvo.odometry.keyframes import judge_links
from gvo.types import Edge, LinkKind

Offered = list[tuple[LinkKind, Edge]]


def edge(reference_id: int, twist: list[float], sigma: float = 0.1) -> Edge:
    return Edge(
        reference_id=reference_id,
        T_reference_frame=se3.exp(np.array(twist, dtype=float)),
        covariance=sigma**2 * np.eye(6),
    )


def test_the_residuals_are_those_of_the_graph() -> None:
    window = SlidingWindow(gvo.WindowConfig(kernel="none", gate=None))
    window.add_pose(0, 0, [])
    window.add_pose(1, 1, [edge(0, [0, 0, 0, 0, 0, 1])])
    offered: Offered = [
        ("step", edge(1, [0, 0.02, 0, 0, 0, 1.1])),
        ("keyframe", edge(0, [0.01, 0, 0, 0.1, 0, 1.9])),
    ]
    window.add_pose(2, 2, [found for _, found in offered])
    links = judge_links(offered, 2, window)
    by_reference = {
        found.reference_id: found.chi2 for found in window.graph() if found.frame_id == 2
    }
    assert [link.kind for link in links] == ["step", "keyframe"]
    assert all(link.is_accepted for link in links)
    for link in links:
        assert link.chi2 == pytest.approx(by_reference[link.reference_ns], rel=1e-6)
        assert link.chi2 is not None
        assert link.chi2 > 0.1


def test_a_refused_edge_says_so_and_how_far_off_it_is() -> None:
    window = SlidingWindow()
    window.add_pose(0, 0, [])
    for stamp in (1, 2, 3):
        window.add_pose(stamp, stamp, [edge(stamp - 1, [0, 0, 0, 0, 0, 1], 0.01)])
    offered: Offered = [
        ("step", edge(3, [0, 0, 0, 0, 0, 1], 0.01)),
        ("keyframe", edge(2, [0, 0, 0, 0, 0, 2], 0.01)),
        ("keyframe", edge(1, [0, 0, 0, 0, 0, 9], 0.01)),
    ]
    window.add_pose(4, 4, [found for _, found in offered])
    links = judge_links(offered, 4, window)
    assert [link.is_accepted for link in links] == [True, True, False]
    assert links[2].chi2 == pytest.approx((6.0 / 0.01) ** 2, rel=0.01)


def test_an_edge_to_a_frame_that_is_gone_has_no_residual() -> None:
    window = SlidingWindow(gvo.WindowConfig(size=2))
    window.add_pose(0, 0, [])
    window.add_pose(1, 1, [edge(0, [0, 0, 0, 0, 0, 1])])
    offered: Offered = [
        ("step", edge(1, [0, 0, 0, 0, 0, 1])),
        ("keyframe", edge(0, [0, 0, 0, 0, 0, 2])),
    ]
    window.add_pose(2, 2, [found for _, found in offered])
    assert 0 not in window
    step, keyframe = judge_links(offered, 2, window)
    assert step.chi2 == pytest.approx(0.0, abs=1e-6)
    assert keyframe.chi2 is None


def test_each_frame_of_a_run_tells_what_it_is_tied_to() -> None:
    room = gvo.SyntheticRecording("handheld", "rgbd", n_frames=12, scale=0.5)
    odometry = gvo.Odometry(room.info.camera)
    stamps: list[int] = []
    for frame in gvo.frames(room, gvo.Config()):
        assert not isinstance(frame, gvo.FaultyFrame)
        result = odometry.track(frame)
        kinds = [link.kind for link in result.links]
        assert kinds[:1] == ["step"][: len(stamps)]
        assert set(kinds[1:]) <= {"keyframe"}
        assert {link.reference_ns for link in result.links} <= set(stamps)
        assert sum(link.is_accepted for link in result.links) == result.n_links
        stamps.append(result.stamp_ns)
        assert set(result.keyframes_ns) <= set(stamps)
        assert set(odometry.window.kept()) >= set(result.keyframes_ns)
