"""A short walk in a rendered room as bags, with its true poses at any time."""

from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from gvo.geometry.se3 import make_transform
from gvo.io.recording import RecordingInfo, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.io.synthetic.worlds.motion import look_around
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, IntArray
from tests.make.bags import PoseBag

N_FRAMES = 16
CAMERA = "camera_left_optical"
LEFT, RIGHT = "/stereo/left/image_rect", "/stereo/right/image_rect"
TRAJECTORIES = ("raw", "causal", "smoothed")
GLOBAL = "global"
_EVERY = 3  # of the frames that are rendered, so that the camera moves between two of them
_RENDERED = SyntheticRecording("handheld", "stereo", n_frames=_EVERY * N_FRAMES, scale=0.4)
STAMPS_NS: IntArray = _RENDERED.ground_truth().stamps_ns[::_EVERY]
START_NS = int(STAMPS_NS[0])

# x ahead, y left, z up: the camera looks ahead and a little down.
T_BASE_LINK = make_transform(
    np.asarray(Rotation.from_euler("y", 0.2).as_matrix()), np.array([0.3, -0.1, 0.5])
)
T_LINK_CAM = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.02, 0.0])
)
T_BASE_CAM: FloatArray = T_BASE_LINK @ T_LINK_CAM


class Walk:
    """The recording; it knows its truth where that is wanted."""

    def __init__(self, *, has_truth: bool = False) -> None:
        self._has_truth = has_truth

    @property
    def info(self) -> RecordingInfo:
        return replace(_RENDERED.info, name="walk", n_images=N_FRAMES)

    def images(self) -> Iterator[StampedImage]:
        for index, image in enumerate(_RENDERED.images()):
            if index // 2 % _EVERY == 0:
                yield image

    def ground_truth(self) -> Trajectory | None:
        return self.true_poses() if self._has_truth else None

    def true_poses(self) -> Trajectory:
        """Return the exact poses of the frames."""
        return _RENDERED.ground_truth().select(slice(None, None, _EVERY))


def true_poses(stamps_ns: IntArray) -> FloatArray:
    """Return the exact T_world_cam at any time: the motion itself, asked between the frames."""
    T_map_first = look_around(np.zeros(1))[0]
    elapsed_s: FloatArray = np.asarray(1e-9 * (stamps_ns - START_NS), dtype=np.float64)
    return np.asarray(np.linalg.inv(T_map_first) @ look_around(elapsed_s))


def truth_stamps(rate_hz: int = 100, offset_ns: int = 3_700_000) -> IntArray:
    """Return stamps of another clock edge and rate, from before the first to after the last."""
    step_ns = 10**9 // rate_hz
    first, last = START_NS - step_ns, int(STAMPS_NS[-1]) + 2 * step_ns
    return np.arange(first + offset_ns % step_ns, last, step_ns, dtype=np.int64)


def moved_by_hand(
    T_world_cam: FloatArray, T_base_cam: FloatArray, T_initial: FloatArray | None = None
) -> FloatArray:
    """Return the poses (n, 4, 4) of a frame that carries the camera; each starts at its first."""
    mounts = np.broadcast_to(T_base_cam, T_world_cam.shape)
    poses = mounts[0] @ T_world_cam @ np.linalg.inv(mounts)
    return poses if T_initial is None else np.asarray(T_initial @ poses)


def ate_by_hand(positions: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance (m) after the best rotation and shift, by scipy."""
    a, b = truth - truth.mean(axis=0), positions - positions.mean(axis=0)
    _, distance = Rotation.align_vectors(a, b)
    return float(distance / np.sqrt(len(a)))


def read_bag(path: Path, topics: Container[str] = ()) -> dict[str, list[tuple[int, Any]]]:
    """Return log time and content of messages by topic (all without), as rosbags reads them."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        asked = [each for each in reader.connections if not topics or each.topic in topics]
        for connection, log_time_ns, data in reader.messages(asked):
            content = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append((log_time_ns, content))
    return messages


def copy_messages(
    paths: Sequence[Path], target: Path, keep: Callable[[str, int], bool] = lambda *_: True
) -> Path:
    """Write a part of the messages of ROS 2 bags, by topic and log time, as a single `.mcap`."""
    folder = target.with_suffix("")
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for path in paths:
            with AnyReader([path]) as reader:
                for connection, log_time_ns, data in reader.messages():
                    topic = connection.topic
                    if not keep(topic, log_time_ns):
                        continue
                    if topic not in connections:
                        connections[topic] = writer.add_connection(
                            topic, connection.msgtype, typestore=reader.typestore
                        )
                    writer.write(connections[topic], log_time_ns, data)
    return folder / target.name


def on_a_robot(path: Path) -> PoseBag:
    """Return a bag that hangs the camera on base_link, over a link of its own."""
    bag = PoseBag(path)
    bag.tf(START_NS, "base_link", "camera_link", T_BASE_LINK, is_static=True)
    bag.tf(START_NS, "camera_link", CAMERA, T_LINK_CAM, is_static=True)
    return bag


def geodetic(positions: FloatArray) -> list[tuple[float, float, float]]:
    """Return latitude and longitude (degrees) and height of points east, north, up of a place.

    By way of the earth's centre (WGS 84) and back by iteration.
    """
    a, e2 = 6378137.0, 6.69437999014e-3
    lat, lon, height = np.radians(47.3765), np.radians(8.5480), 450.0
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    origin = (n + height) * up - np.array([0.0, 0.0, e2 * n * np.sin(lat)])
    x, y, z = (origin + positions @ np.stack([east, np.cross(up, east), up])).T
    flat = np.hypot(x, y)
    lats = np.full(len(positions), lat)
    for _ in range(20):
        n = a / np.sqrt(1 - e2 * np.sin(lats) ** 2)
        lats = np.arctan2(z + e2 * n * np.sin(lats), flat)
    heights = flat * np.cos(lats) + z * np.sin(lats) - a * np.sqrt(1 - e2 * np.sin(lats) ** 2)
    lons = np.arctan2(y, x)
    return list(
        zip(np.degrees(lats).tolist(), np.degrees(lons).tolist(), heights.tolist(), strict=True)
    )
