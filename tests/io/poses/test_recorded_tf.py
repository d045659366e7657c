"""The tf buffer against the transforms of real recordings, composed by scipy alone."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from gvo.io.bag.messages import stamp_of
from gvo.io.bag.reader import BagReader
from gvo.io.poses.tf import TF_TYPES, TfBuffer, read_tf
from gvo.types import Failure, FloatArray, IntArray

pytestmark = pytest.mark.recorded

# Transforms of each file, and the poses that are compared with compositions by scipy.
RECORDINGS = {
    "tf_bz2.bag": (2689, 9354),
    "tf_lz4.bag": (2689, 9354),
    "tf_uncompressed.bag": (2689, 9354),
    "tf_example.bag": (518, 1551),
    "tf_example_ros2": (518, 1551),
    "nav2_turtlebot.mcap": (7313, 233081),
}


@dataclass(kw_only=True)
class RawEdge:
    """What a bag says of one child frame, as it stands there."""

    parent: str
    is_static: bool
    stamps_ns: list[int] = field(default_factory=list)
    t: list[list[float]] = field(default_factory=list)
    quaternions_xyzw: list[list[float]] = field(default_factory=list)

    def at(self, stamps_ns: IntArray) -> tuple[FloatArray, Rotation]:
        if self.is_static:
            n = len(stamps_ns)
            return np.tile(self.t[-1], (n, 1)), Rotation.from_quat([self.quaternions_xyzw[-1]] * n)
        zero = self.stamps_ns[0]
        known = [(stamp - zero) / 1e9 for stamp in self.stamps_ns]
        wanted = (stamps_ns - zero) / 1e9
        t = np.array(self.t)
        positions = np.column_stack([np.interp(wanted, known, t[:, axis]) for axis in range(3)])
        return positions, Slerp(known, Rotation.from_quat(np.array(self.quaternions_xyzw)))(wanted)


def raw_edges(reader: BagReader) -> dict[str, RawEdge]:
    edges: dict[str, RawEdge] = {}
    names = [topic.name for topic in reader.topics if topic.type in TF_TYPES]
    for message in reader.messages(names):
        for stamped in message.decode().transforms:
            edge = edges.setdefault(
                stamped.child_frame_id.lstrip("/"),
                RawEdge(
                    parent=stamped.header.frame_id.lstrip("/"),
                    is_static=message.topic.name == "/tf_static",
                ),
            )
            assert edge.parent == stamped.header.frame_id.lstrip("/")
            edge.stamps_ns.append(stamp_of(stamped.header))
            t, q = stamped.transform.translation, stamped.transform.rotation
            edge.t.append([t.x, t.y, t.z])
            edge.quaternions_xyzw.append([q.x, q.y, q.z, q.w])
    return edges


def in_the_root(
    edges: dict[str, RawEdge], frame: str, stamps_ns: IntArray
) -> tuple[FloatArray, Rotation]:
    """Return where a frame sits in the root, walking up and composing on the way."""
    t, R = np.zeros((len(stamps_ns), 3)), Rotation.identity(len(stamps_ns))
    while frame in edges:
        t_edge, R_edge = edges[frame].at(stamps_ns)
        t, R, frame = t_edge + R_edge.apply(t), R_edge * R, edges[frame].parent
    return t, R


def moving_above(edges: dict[str, RawEdge], frame: str) -> list[RawEdge]:
    found = []
    while frame in edges:
        found += [] if edges[frame].is_static else [edges[frame]]
        frame = edges[frame].parent
    return found


def check_pair(buffer: TfBuffer, edges: dict[str, RawEdge], target: str, source: str) -> int:
    """Compare a chain at every stamp of its tree where all of it is known; return how many."""
    moving = [*moving_above(edges, target), *moving_above(edges, source)]
    stamps = np.unique(np.concatenate([np.array(e.stamps_ns) for e in moving]))
    first = max(min(e.stamps_ns) for e in moving)
    stamps = stamps[(stamps >= first) & (stamps <= min(max(e.stamps_ns) for e in moving))]
    t_target, R_target = in_the_root(edges, target, stamps)
    t_source, R_source = in_the_root(edges, source, stamps)
    T, is_known = buffer.lookup_many(target, source, stamps)
    assert np.all(is_known)
    t = R_target.inv().apply(t_source - t_target)
    np.testing.assert_allclose(T[:, :3, 3], t, rtol=0, atol=1e-9)
    R = (R_target.inv() * R_source).as_matrix()
    np.testing.assert_allclose(T[:, :3, :3], R, rtol=0, atol=1e-9)
    return len(stamps)


@pytest.mark.parametrize("name", RECORDINGS)
def test_all_chains_are_those_that_scipy_composes(gvo_data: Path, name: str) -> None:
    reader = BagReader(gvo_data / "bags/good" / name)
    buffer, edges = read_tf(reader), raw_edges(reader)
    assert buffer.notes == []
    assert sum(len(edge.stamps_ns) for edge in edges.values()) == RECORDINGS[name][0]
    root = next(edge.parent for edge in edges.values() if edge.parent not in edges)
    last = sorted(edges)[-1]
    pairs = [(other, frame) for frame in edges for other in (root, last) if frame != other]
    n_poses = sum(check_pair(buffer, edges, target, source) for target, source in pairs)
    assert n_poses == RECORDINGS[name][1]


def test_the_robot_of_nav2_stands_in_its_map_by_the_camera(gvo_data: Path) -> None:
    reader = BagReader(gvo_data / "bags/good/nav2_turtlebot.mcap")
    camera = "oakd_left_camera_optical_frame"
    buffer = read_tf(reader, frames=["base_link", camera])
    assert buffer.chain("base_link", camera) == (
        "base_link",
        "shell_link",
        "oakd_camera_bracket",
        "oakd_link",
        "oakd_left_camera_frame",
        camera,
    )
    assert len(buffer.edge_stamps_ns("base_link", camera)) == 0
    T = buffer.lookup("base_link", camera, 0)
    assert not isinstance(T, Failure)
    # optical axes: z of the camera is forward, x of it the robot's right
    np.testing.assert_allclose(T[:3, 2], [1.0, 0.0, 0.0], atol=1e-2)
    np.testing.assert_allclose(T[:3, 0], [0.0, -1.0, 0.0], atol=1e-2)
