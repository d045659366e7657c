"""Bags of poses, positions and transforms, written message by message."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.spatial.transform import Rotation

from gvo.io.bag.reader import TF_TYPE, typestore
from gvo.io.poses.tf import TfBuffer
from gvo.types import FloatArray

ODOMETRY = "nav_msgs/msg/Odometry"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
STAMPED = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POINT = "geometry_msgs/msg/PointStamped"
FIX = "sensor_msgs/msg/NavSatFix"


def add_transform(
    buffer: TfBuffer,
    parent: str,
    child: str,
    stamp_ns: int,
    T: FloatArray,
    *,
    is_static: bool = False,
) -> None:
    """Give a buffer a transform, shape (4, 4), as a message of tf does."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
    rotation = dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), strict=True))
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", T[:3, 3].tolist(), strict=True))),
            rotation=SimpleNamespace(**rotation),
        ),
    )
    buffer.add_message(message, is_static=is_static)


class PoseBag:
    """Collects messages, then writes them in the order they came in.

    The name of the file decides about ROS 1 (`.bag`) or ROS 2 (`.mcap`, `.db3`).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._is_ros1 = path.suffix == ".bag"
        self._store = typestore(is_ros1=self._is_ros1)
        self._messages: list[tuple[str, str, Any]] = []

    def _make(self, type_: str, **fields: Any) -> Any:
        package, _, name = type_.rpartition("/")
        return self._store.types[f"{package}/msg/{name}" if "/msg" not in type_ else type_](
            **fields
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = self._make("builtin_interfaces/Time", sec=sec, nanosec=nanosec)
        sequence = {"seq": 0} if self._is_ros1 else {}
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame, **sequence)

    def _vector(self, type_: str, numbers: ArrayLike) -> Any:
        return self._make(type_, **dict(zip("xyzw", np.asarray(numbers).tolist(), strict=False)))

    def _transform(self, stamp_ns: int, parent: str, child: str, T: FloatArray) -> Any:
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
        return self._make(
            TRANSFORM,
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=self._make(
                "geometry_msgs/Transform",
                translation=self._vector("geometry_msgs/Vector3", T[:3, 3]),
                rotation=self._vector("geometry_msgs/Quaternion", quaternion),
            ),
        )

    def tf(
        self, stamp_ns: int, parent: str, child: str, T: FloatArray, *, is_static: bool = False
    ) -> None:
        transform = self._transform(stamp_ns, parent, child, T)
        topic = "/tf_static" if is_static else "/tf"
        self._messages.append((topic, TF_TYPE, self._make(TF_TYPE, transforms=[transform])))

    def pose(
        self,
        topic: str,
        type_: str,
        stamp_ns: int,
        T: FloatArray,
        *,
        parent: str = "map",
        child: str = "base",
        norm: float = 1.0,
        covariance: FloatArray | None = None,
    ) -> None:
        header = self._header(stamp_ns, parent)
        quaternion = norm * Rotation.from_matrix(T[:3, :3]).as_quat()
        pose = self._make(
            "geometry_msgs/Pose",
            position=self._vector("geometry_msgs/Point", T[:3, 3]),
            orientation=self._vector("geometry_msgs/Quaternion", quaternion),
        )
        if type_ == TRANSFORM:
            message = self._transform(stamp_ns, parent, child, T)
        elif type_ == STAMPED:
            message = self._make(type_, header=header, pose=pose)
        else:
            numbers = np.zeros(36) if covariance is None else covariance.ravel()
            spread = self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=numbers)
            more = {} if type_ == WITH_COVARIANCE else self._odometry_fields(child)
            message = self._make(type_, header=header, pose=spread, **more)
        self._messages.append((topic, type_, message))

    def _odometry_fields(self, child: str) -> dict[str, Any]:
        zero = self._vector("geometry_msgs/Vector3", (0.0, 0.0, 0.0))
        twist = self._make("geometry_msgs/Twist", linear=zero, angular=zero)
        spread = self._make(
            "geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
        )
        return {"child_frame_id": child, "twist": spread}

    def fix(
        self, stamp_ns: int, place: Sequence[float], *, frame: str = "gps", status: int = 0
    ) -> None:
        """Add latitude and longitude in degrees, and height."""
        message = self._make(
            FIX,
            header=self._header(stamp_ns, frame),
            status=self._make("sensor_msgs/NavSatStatus", status=status, service=1),
            latitude=float(place[0]),
            longitude=float(place[1]),
            altitude=float(place[2]),
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )
        self._messages.append(("/fix", FIX, message))

    def point(self, topic: str, stamp_ns: int, position: Sequence[float], *, frame: str) -> None:
        point = self._vector("geometry_msgs/Point", position)
        header = self._header(stamp_ns, frame)
        self._messages.append((topic, POINT, self._make(POINT, header=header, point=point)))

    def write(self) -> Path:
        """Write the file; of ROS 2 the one inside of its folder."""
        writer: Any = Writer1(self._path) if self._is_ros1 else None
        if writer is None:
            folder = self._path.with_suffix("")
            is_mcap = self._path.suffix == ".mcap"
            plugin = StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3
            writer = Writer2(folder, version=8, storage_plugin=plugin)
        serialize = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for n, (topic, type_, message) in enumerate(self._messages):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, type_, typestore=self._store)
                writer.write(connections[topic], n, serialize(message, type_))
        return self._path if self._is_ros1 else folder / self._path.name
