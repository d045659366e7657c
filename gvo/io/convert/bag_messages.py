"""Bags written: images, calibrations and poses as messages."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags import interfaces
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.geometry.camera import Calibration
from gvo.io.bag.reader import TF_TYPE, serialize, typestore
from gvo.io.bag.topics import CAMERA_INFO_TYPE, COMPRESSED_TYPE, IMAGE_TYPE, IMU_TYPE
from gvo.io.images import MILLIMETRES, encode_image, exact_counts
from gvo.types import DepthArray, FloatArray, ImageArray

# Version 8 is read by more releases of ROS 2 than 9, and holds the same.
_ROS2_VERSION: Final = 8
_MAX_SECONDS_ROS1 = 2**32 - 1
_MAX_SECONDS_ROS2 = 2**31 - 1
# That of tf2's static broadcaster: late subscribers still get the last message.
_LATCHED_QOS: Final = interfaces.Qos(
    history=interfaces.QosHistory.KEEP_LAST,
    depth=1,
    reliability=interfaces.QosReliability.RELIABLE,
    durability=interfaces.QosDurability.TRANSIENT_LOCAL,
    deadline=interfaces.QosTime(0, 0),
    lifespan=interfaces.QosTime(0, 0),
    liveliness=interfaces.QosLiveliness.SYSTEM_DEFAULT,
    liveliness_lease_duration=interfaces.QosTime(0, 0),
    avoid_ros_namespace_conventions=False,
)
# The header of compressedDepth: its quantisation parameters, which 16-bit counts do not use.
_DEPTH_HEADER = struct.pack("<iff", 0, 0.0, 0.0)


class Header(NamedTuple):
    """Stamp in nanoseconds and frame of a message."""

    stamp_ns: int
    frame_id: str


class FramePose(NamedTuple):
    """A pose of a child frame in its parent: stamp in nanoseconds, T_parent_child (4, 4)."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: FloatArray


class ImuSample(NamedTuple):
    """What an IMU measured: stamp in nanoseconds, rad/s (3,), m/s^2 (3,)."""

    stamp_ns: int
    gyro: FloatArray
    acceleration: FloatArray


class MessageWriter(ABC):
    """Makes messages of ROS 1 or ROS 2 and writes them to topics.

    Parameters
    ----------
    name : str
        Where to, for messages.
    is_ros1 : bool
    """

    def __init__(self, name: str, *, is_ros1: bool) -> None:
        self.is_ros1, self._name = is_ros1, name
        self._store = typestore(is_ros1=is_ros1)

    def make(self, type_: str, **fields: Any) -> Any:  # noqa: ANN401 - made at run time
        """Return a message of a type `package/msg/Name`; fields that are not given are empty."""
        definitions: Any = self._store.fielddefs[type_][1]
        for name, (kind, what) in definitions:
            if name not in fields:
                is_message = kind == interfaces.Nodetype.NAME
                fields[name] = self.make(what) if is_message else _nothing(kind, what)
        return self._store.types[type_](**fields)

    def header(self, header: Header) -> Any:  # noqa: ANN401 - made at run time
        """Return the message of a header; refuse a stamp that does not fit into it."""
        sec, nanosec = divmod(header.stamp_ns, 10**9)
        max_seconds = _MAX_SECONDS_ROS1 if self.is_ros1 else _MAX_SECONDS_ROS2
        if not 0 <= sec <= max_seconds:
            raise RecordingError(
                f"{self._name}: the stamp {header.stamp_ns} ns cannot be written, expected "
                f"0 to {max_seconds} s"
            )
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)

    def serialize(self, message: object, type_: str) -> bytes:
        """Return the bytes of a message, as ROS 1 has them or as CDR."""
        return serialize(message, type_, is_ros1=self.is_ros1)

    def is_wanted(self, topic: str) -> bool:
        """Tell whether anybody takes the messages of a topic; else none need be made."""
        return True

    @abstractmethod
    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        """Write a message.

        Parameters
        ----------
        topic, type_ : str
            Name, and type as `package/msg/Name`.
        message : object
            Made by `make`.
        stamp_ns : int
            Not negative, nanoseconds.
        is_latched : bool
            Of the topic, told with its first message: the last message is kept for those who
            subscribe later.
        """


def _nothing(kind: interfaces.Nodetype, what: Any) -> Any:  # noqa: ANN401 - as rosbags defines fields
    """Return an empty text, zero, or a sequence of nothing."""
    if kind == interfaces.Nodetype.BASE:
        return {"string": "", "bool": False}.get(what[0], 0)
    of, element = what[0]
    return np.zeros(0, element[0]) if of == interfaces.Nodetype.BASE else []


class BagWriter(MessageWriter):
    """A new bag, open inside a `with` block.

    The log time of a message is its stamp, but never goes back.

    Parameters
    ----------
    path : Path
        `.bag`: ROS 1. `.mcap` or `.db3`: a file of ROS 2, made inside a folder of the same
        name without the suffix. No suffix: a ROS 2 bag folder.
    keeps_order : bool
        Every reader is to give the messages in the order in which they were written: one whose
        stamp goes back, or repeats within its topic, is logged a nanosecond after the last.

    Attributes
    ----------
    result : Path
        The finished file or folder.
    """

    def __init__(self, path: Path, *, keeps_order: bool = False) -> None:
        super().__init__(path.name, is_ros1=path.suffix == ".bag")
        self.result = path
        self._writer: Writer1 | Writer2
        if self.is_ros1:
            self._writer = Writer1(path)
        else:
            folder = path.with_suffix("")
            is_mcap = path.suffix == ".mcap"
            plugin = StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3
            self._writer = Writer2(folder, version=_ROS2_VERSION, storage_plugin=plugin)
            if path.suffix:
                self.result = folder / path.name
        self._connections: dict[str, interfaces.Connection] = {}
        self._log_time_ns = 0
        self._keeps_order = keeps_order
        self._newest_ns: dict[str, int] = {}  # log times by topic

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *exception: Any) -> None:  # noqa: ANN401 - its type, itself, its traceback
        self._writer.__exit__(*exception)

    def write(
        self, topic: str, type_: str, message: object, stamp_ns: int, *, is_latched: bool = False
    ) -> None:
        """Write a message; its log time is the stamp, but never goes back, see `keeps_order`."""
        # Readers sort by log time: a frame whose stamp goes back must stay where it was. Those of
        # one log time some readers sort by topic.
        is_behind = stamp_ns < self._log_time_ns or stamp_ns == self._newest_ns.get(topic)
        step_ns = 1 if self._keeps_order and is_behind else 0
        self._log_time_ns = max(self._log_time_ns + step_ns, stamp_ns)
        self._newest_ns[topic] = self._log_time_ns
        if topic not in self._connections:
            self._connections[topic] = self._connect(topic, type_, is_latched=is_latched)
        data = self.serialize(message, type_)
        self._writer.write(self._connections[topic], self._log_time_ns, data)

    def _connect(self, topic: str, type_: str, *, is_latched: bool) -> interfaces.Connection:
        if isinstance(self._writer, Writer1):
            return self._writer.add_connection(
                topic, type_, typestore=self._store, latching=1 if is_latched else None
            )
        return self._writer.add_connection(
            topic,
            type_,
            typestore=self._store,
            offered_qos_profiles=[_LATCHED_QOS] if is_latched else [],
        )


def write_image(writer: MessageWriter, topic: str, pixels: NDArray[Any], header: Header) -> None:
    """Write an image: uint8 (h, w) as mono8, uint8 (h, w, 3) as bgr8, float32 (h, w) as 32FC1."""
    encoding = {2: "mono8", 3: "bgr8"}[pixels.ndim]
    if pixels.dtype == np.float32:
        encoding = "32FC1"
    height, width = pixels.shape[:2]
    # Bags of both generations are little-endian, whatever the machine.
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
    message = writer.make(
        IMAGE_TYPE,
        header=writer.header(header),
        height=height,
        width=width,
        encoding=encoding,
        step=data.nbytes // height,
        data=data.view(np.uint8).ravel(),
    )
    writer.write(topic, IMAGE_TYPE, message, header.stamp_ns)


def write_compressed(
    writer: MessageWriter,
    topic: str,
    pixels: ImageArray,
    header: Header,
    suffix: Literal[".png", ".jpg"] = ".png",
) -> None:
    """Write an image, uint8 (h, w) or BGR (h, w, 3), as a file; the topic ends in `/compressed`."""
    encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    kind = f"{encoding}; png compressed {'' if pixels.ndim == 2 else encoding}"
    kind = kind if suffix == ".png" else "jpeg"
    _write(writer, topic, kind, encode_image(pixels, suffix), header)


def write_compressed_depth(
    writer: MessageWriter, topic: str, depth: DepthArray, header: Header
) -> None:
    """Write depth without loss: in whole millimetres as the transport `compressedDepth` does.

    Parameters
    ----------
    writer : MessageWriter
    topic : str
        Ends in `/compressedDepth`.
    depth : ndarray of float32, shape (h, w)
        Metres, NaN = unknown; as TIFF where it is not of whole millimetres, or beyond 65.5 m.
    header : Header
    """
    counts = exact_counts(depth, MILLIMETRES)
    if counts is None:
        _write(writer, topic, "32FC1; tiff compressed ", encode_image(depth, ".tiff"), header)
    else:
        data = _DEPTH_HEADER + encode_image(counts, ".png")
        _write(writer, topic, "16UC1; compressedDepth", data, header)


def _write(writer: MessageWriter, topic: str, kind: str, data: bytes, header: Header) -> None:
    message = writer.make(
        COMPRESSED_TYPE,
        header=writer.header(header),
        format=kind,
        data=np.frombuffer(data, dtype=np.uint8),
    )
    writer.write(topic, COMPRESSED_TYPE, message, header.stamp_ns)


def write_camera_info(
    writer: MessageWriter, topic: str, calibration: Calibration, header: Header
) -> None:
    """Write a calibration as `CameraInfo`, all numbers without loss."""
    matrices = {name: getattr(calibration, name).ravel() for name in "DKRP"}
    message = writer.make(
        CAMERA_INFO_TYPE,
        header=writer.header(header),
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.model,
        **{name if writer.is_ros1 else name.lower(): M for name, M in matrices.items()},
    )
    writer.write(topic, CAMERA_INFO_TYPE, message, header.stamp_ns)


def write_imu(writer: MessageWriter, topic: str, sample: ImuSample, frame_id: str) -> None:
    """Write a sample of an IMU without loss, as one that tells no orientation."""
    vectors = {"angular_velocity": sample.gyro, "linear_acceleration": sample.acceleration}
    fields: dict[str, Any] = {"orientation_covariance": np.array([-1.0, *[0.0] * 8])}
    for name, vector in vectors.items():
        numbers = dict(zip("xyz", vector.tolist(), strict=True))
        fields[name] = writer.make("geometry_msgs/msg/Vector3", **numbers)
        fields[f"{name}_covariance"] = np.zeros(9)
    header = writer.header(Header(sample.stamp_ns, frame_id))
    message = writer.make(IMU_TYPE, header=header, **fields)
    writer.write(topic, IMU_TYPE, message, sample.stamp_ns)


def write_transforms(
    writer: MessageWriter, topic: str, poses: Iterable[FramePose], *, is_latched: bool = False
) -> None:
    """Write poses of frames as one `tf2_msgs/TFMessage`; of none: nothing.

    Parameters
    ----------
    writer : MessageWriter
    topic : str
        `/tf`, or `/tf_static` for what never moves, with `is_latched`.
    poses : iterable of FramePose
    is_latched : bool
        As for `BagWriter.write`.
    """
    poses = tuple(poses)
    if poses:
        message = writer.make(TF_TYPE, transforms=[_transform(writer, pose) for pose in poses])
        stamp_ns = max(pose.stamp_ns for pose in poses)
        writer.write(topic, TF_TYPE, message, stamp_ns, is_latched=is_latched)


def _transform(writer: MessageWriter, pose: FramePose) -> Any:  # noqa: ANN401 - made at run time
    x, y, z, *q = pose_numbers(pose.T_parent_child).tolist()
    transform = writer.make(
        "geometry_msgs/msg/Transform",
        translation=writer.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=writer.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
    )
    return writer.make(
        "geometry_msgs/msg/TransformStamped",
        header=writer.header(Header(pose.stamp_ns, pose.parent)),
        child_frame_id=pose.child,
        transform=transform,
    )


def pose_numbers(T_parent_child: FloatArray) -> FloatArray:
    """Return position and quaternion (x, y, z, qx, qy, qz, qw), shape (7,), of a pose (4, 4)."""
    quaternion_xyzw = Rotation.from_matrix(T_parent_child[:3, :3]).as_quat()
    return np.concatenate([T_parent_child[:3, 3], quaternion_xyzw])
