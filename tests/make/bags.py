"""Bags, written message by message: cameras, poses, positions and transforms."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.spatial.transform import Rotation

from gvo.io.bag.reader import TF_TYPE, serialize, typestore
from gvo.io.bag.topics import CAMERA_INFO_TYPE, IMAGE_TYPE, IMU_TYPE
from gvo.io.poses.tf import TfBuffer
from gvo.types import FloatArray

ODOMETRY = "nav_msgs/msg/Odometry"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
STAMPED = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POINT = "geometry_msgs/msg/PointStamped"
FIX = "sensor_msgs/msg/NavSatFix"
K = [50.0, 0, 23.5, 0, 50.0, 15.5, 0, 0, 1]

Message = tuple[str, str, int, object]
"""Topic, type, log time in nanoseconds, and the message; or its bytes."""


def write(
    path: Path, messages: Sequence[Message], *, compression: str = "", n_in_chunk: int = 0
) -> Path:
    """Write a bag of ROS 1 (`.bag`) or ROS 2; of the latter return the file in its folder.

    A path without suffix is a folder. A type that nobody knows has a definition that is none.
    Chunks of MCAP hold so many messages, those of ROS 1 about as many of 300 bytes.
    """
    is_ros1 = path.suffix == ".bag"
    store = typestore(is_ros1=is_ros1)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    writer: Any = Writer1(path) if is_ros1 else None
    writer = writer or Writer2(path.with_suffix(""), version=8, storage_plugin=plugin)
    if compression and is_ros1:
        writer.set_compression(Writer1.CompressionFormat[compression])
    elif compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    if n_in_chunk and is_ros1:
        writer.chunk_threshold = 333 * n_in_chunk
    foreign = {"msgdef": "no definition (", "md5sum" if is_ros1 else "rihs01": "RIHS01_" + "0" * 64}
    with writer:
        connections: dict[str, Any] = {}
        for n, (topic, type_, log_time_ns, message) in enumerate(messages, 1):
            if topic not in connections:
                known = {"typestore": store} if type_ in store.fielddefs else foreign
                connections[topic] = writer.add_connection(topic, type_, **known)
            is_bytes = isinstance(message, bytes)
            data = message if is_bytes else serialize(message, type_, is_ros1=is_ros1)
            writer.write(connections[topic], log_time_ns, data)
            if n_in_chunk and path.suffix == ".mcap" and n % n_in_chunk == 0:
                writer.storage.close_chunk()
    if is_ros1 or not path.suffix:
        return path
    (file,) = path.with_suffix("").glob(f"{path.name}*")
    return file


def make(type_: str, *, is_ros1: bool = True, **fields: Any) -> Any:
    return typestore(is_ros1=is_ros1).types[type_](**fields)


def header(frame_id: str = "camera", stamp_ns: int = 0, *, is_ros1: bool = True) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", is_ros1=is_ros1, sec=sec, nanosec=nanosec)
    sequence = {"seq": 0} if is_ros1 else {}
    return make("std_msgs/msg/Header", is_ros1=is_ros1, stamp=stamp, frame_id=frame_id, **sequence)


def camera_info(
    topic: str,
    frame_id: str = "camera",
    stamp_ns: int = 0,
    *,
    is_ros1: bool = True,
    **changes: Any,
) -> Message:
    """Return a `CameraInfo` of 48 x 32 pixels without R and P; `roi` takes a part of its fields."""
    fields: dict[str, Any] = {
        "height": 32,
        "width": 48,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": K,
        "R": np.zeros(9),
        "P": np.zeros(12),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {},
    } | changes
    for name in "DKRP":
        matrix = np.array(fields.pop(name), dtype=np.float64).ravel()
        fields[name if is_ros1 else name.lower()] = matrix
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
    region |= fields["roi"]
    fields["roi"] = make("sensor_msgs/msg/RegionOfInterest", is_ros1=is_ros1, **region)
    fields["header"] = header(frame_id, stamp_ns, is_ros1=is_ros1)
    message = make(CAMERA_INFO_TYPE, is_ros1=is_ros1, **fields)
    return topic, CAMERA_INFO_TYPE, stamp_ns, message


def image(
    topic: str,
    pixels: Any,
    encoding: str = "mono8",
    stamp_ns: int = 0,
    *,
    is_ros1: bool = True,
    **changes: Any,
) -> Message:
    fields = {
        "header": header(stamp_ns=stamp_ns, is_ros1=is_ros1),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": np.frombuffer(pixels.tobytes(), np.uint8),
    }
    return topic, IMAGE_TYPE, stamp_ns, make(IMAGE_TYPE, is_ros1=is_ros1, **(fields | changes))


def _vector(type_: str, numbers: ArrayLike, *, is_ros1: bool = True) -> Any:
    values = zip("xyzw", np.asarray(numbers).tolist(), strict=False)
    return make(f"geometry_msgs/msg/{type_}", is_ros1=is_ros1, **dict(values))


def transform(T: FloatArray, *, is_ros1: bool = True) -> Any:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return make(
        "geometry_msgs/msg/Transform",
        is_ros1=is_ros1,
        translation=_vector("Vector3", T[:3, 3], is_ros1=is_ros1),
        rotation=_vector("Quaternion", quaternion, is_ros1=is_ros1),
    )


def stamped_transform(
    parent: str, child: str, T: FloatArray, stamp_ns: int = 0, *, is_ros1: bool = True
) -> Any:
    return make(
        TRANSFORM,
        is_ros1=is_ros1,
        header=header(parent, stamp_ns, is_ros1=is_ros1),
        child_frame_id=child,
        transform=transform(T, is_ros1=is_ros1),
    )


def tf(
    topic: str,
    parent: str,
    child: str,
    T: FloatArray,
    stamp_ns: int = 0,
    *,
    is_ros1: bool = True,
) -> Message:
    transforms = [stamped_transform(parent, child, T, stamp_ns, is_ros1=is_ros1)]
    return topic, TF_TYPE, stamp_ns, make(TF_TYPE, is_ros1=is_ros1, transforms=transforms)


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
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=parent),
        child_frame_id=child,
        transform=transform(T),
    )
    buffer.add_message(message, is_static=is_static)


def imu(
    topic: str,
    stamp_ns: int,
    gyro: ArrayLike = (0.0, 0.0, 0.0),
    acceleration: ArrayLike = (0.0, 0.0, 0.0),
    *,
    frame_id: str = "imu",
    log_time_ns: int | None = None,
    denied: Sequence[str] = (),
    is_ros1: bool = True,
) -> Message:
    """Return a sample; vectors of names that are denied have the covariance of absent ones."""
    fields: dict[str, Any] = {
        "orientation": _vector("Quaternion", (0.0, 0.0, 0.0, 1.0), is_ros1=is_ros1),
        "angular_velocity": _vector("Vector3", gyro, is_ros1=is_ros1),
        "linear_acceleration": _vector("Vector3", acceleration, is_ros1=is_ros1),
    }
    for name in tuple(fields):
        fields[f"{name}_covariance"] = np.array([-1.0 if name in denied else 0.01, *[0.0] * 8])
    message = make(
        IMU_TYPE, is_ros1=is_ros1, header=header(frame_id, stamp_ns, is_ros1=is_ros1), **fields
    )
    return topic, IMU_TYPE, stamp_ns if log_time_ns is None else log_time_ns, message


class PoseBag:
    """Collects messages, then writes them in the order they came in.

    The name of the file decides about ROS 1 (`.bag`) or ROS 2 (`.mcap`, `.db3`).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._of = {"is_ros1": path.suffix == ".bag"}
        self._messages: list[Message] = []

    def _add(self, topic: str, type_: str, message: object) -> None:
        self._messages.append((topic, type_, len(self._messages), message))

    def tf(
        self, stamp_ns: int, parent: str, child: str, T: FloatArray, *, is_static: bool = False
    ) -> None:
        topic = "/tf_static" if is_static else "/tf"
        self._add(topic, TF_TYPE, tf(topic, parent, child, T, stamp_ns, **self._of)[3])

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
        if type_ == TRANSFORM:
            self._add(topic, type_, stamped_transform(parent, child, T, stamp_ns, **self._of))
            return
        quaternion = norm * Rotation.from_matrix(T[:3, :3]).as_quat()
        pose = make(
            "geometry_msgs/msg/Pose",
            position=_vector("Point", T[:3, 3], **self._of),
            orientation=_vector("Quaternion", quaternion, **self._of),
            **self._of,
        )
        fields: dict[str, Any] = {"pose": pose}
        if type_ != STAMPED:
            numbers = np.zeros(36) if covariance is None else covariance.ravel()
            fields["pose"] = make(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=numbers, **self._of
            )
        if type_ == ODOMETRY:
            fields |= {"child_frame_id": child, "twist": self._twist()}
        stamped = header(parent, stamp_ns, **self._of)
        self._add(topic, type_, make(type_, header=stamped, **fields, **self._of))

    def _twist(self) -> Any:
        zero = _vector("Vector3", (0.0, 0.0, 0.0), **self._of)
        twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero, **self._of)
        return make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=twist,
            covariance=np.zeros(36),
            **self._of,
        )

    def fix(
        self, stamp_ns: int, place: Sequence[float], *, frame: str = "gps", status: int = 0
    ) -> None:
        """Add latitude and longitude in degrees, and height."""
        message = make(
            FIX,
            header=header(frame, stamp_ns, **self._of),
            status=make("sensor_msgs/msg/NavSatStatus", status=status, service=1, **self._of),
            latitude=float(place[0]),
            longitude=float(place[1]),
            altitude=float(place[2]),
            position_covariance=np.zeros(9),
            position_covariance_type=0,
            **self._of,
        )
        self._add("/fix", FIX, message)

    def point(self, topic: str, stamp_ns: int, position: Sequence[float], *, frame: str) -> None:
        point = _vector("Point", position, **self._of)
        stamped = header(frame, stamp_ns, **self._of)
        self._add(topic, POINT, make(POINT, header=stamped, point=point, **self._of))

    def write(self) -> Path:
        """Write the file; of ROS 2 the one inside of its folder."""
        return write(self._path, self._messages)
