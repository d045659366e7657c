"""Bags of ROS 1 with images and `CameraInfo`, written message by message."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer

from gvo.io.bag.reader import typestore
from gvo.io.bag.topics import CAMERA_INFO_TYPE, IMAGE_TYPE

K = [50.0, 0, 23.5, 0, 50.0, 15.5, 0, 0, 1]

Message = tuple[str, str, int, object]
"""Topic, type, log time in nanoseconds, and the message; or its bytes."""


def make(type_: str, **fields: Any) -> Any:
    make_message: Any = typestore(is_ros1=True).types[type_]
    return make_message(**fields)


def header(frame_id: str = "camera", stamp_ns: int = 0) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame_id)


def camera_info(topic: str, frame_id: str = "camera", stamp_ns: int = 0, **changes: Any) -> Message:
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
        fields[name] = np.array(fields[name], dtype=np.float64).ravel()
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
    fields["roi"] = make("sensor_msgs/msg/RegionOfInterest", **(region | fields["roi"]))
    message = make(CAMERA_INFO_TYPE, header=header(frame_id, stamp_ns), **fields)
    return topic, CAMERA_INFO_TYPE, stamp_ns, message


def image(
    topic: str, pixels: Any, encoding: str = "mono8", stamp_ns: int = 0, **changes: Any
) -> Message:
    fields = {
        "header": header(stamp_ns=stamp_ns),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": np.frombuffer(pixels.tobytes(), np.uint8),
    }
    return topic, IMAGE_TYPE, stamp_ns, make(IMAGE_TYPE, **(fields | changes))


def write(path: Path, messages: Sequence[Message]) -> Path:
    store = typestore(is_ros1=True)
    with Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, type_, log_time_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=store)
            data = message if isinstance(message, bytes) else store.serialize_ros1(message, type_)
            writer.write(connections[topic], log_time_ns, data)
    return path
