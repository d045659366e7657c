"""Messages: of calibrations and transforms, by their fields and as they are serialised."""

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np

from gvo.io.bag.messages import (
    camera_fields,
    decode_compressed,
    decode_depth,
    decode_grey_or_color,
    stamp_of,
    transform_of,
)
from gvo.io.bag.reader import TF_TYPE, BagMessage, typestore
from gvo.io.bag.topics import COMPRESSED_TYPE, IMAGE_TYPE, Topic
from gvo.io.calibration.camera_info import make_calibration, make_rgbd_calibration
from gvo.io.poses.tf import TfBuffer
from tests.fuzz.target import Choices, Target

_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE, _INFO_TYPE, TF_TYPE)
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "", "x" * 300, "\n")
_NUMBERS = (0.0, 1.0, -1.0, 1e-9, 1e8, 1e300, -1e300, 5e-324, float("nan"), float("inf"))


def _number(choices: Choices, usual: float) -> float:
    """Return the usual number mostly, else an odd one or any."""
    kind = choices.below(16)
    if kind < 11:
        return usual
    if kind < 14:
        return choices.pick(_NUMBERS)
    if kind == 14:
        return usual * (1.0 + choices.integer(1) / 16.0)
    return float(struct.unpack("<d", choices.take(8))[0])


def _integer(choices: Choices, usual: int, n_bytes: int) -> int:
    return usual if choices.below(4) else choices.integer(n_bytes)


def _camera_info(data: bytes) -> None:
    choices = Choices(data)
    D_usual = [0.0, 0.1, -0.2, 0.01, 0.001][: choices.below(6)] or [0.0] * choices.below(16)
    message = SimpleNamespace(
        width=_integer(choices, 640, 4),
        height=_integer(choices, 480, 4),
        distortion_model=choices.pick(_MODELS),
        k=_array(choices, [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]),
        d=_array(choices, D_usual),
        r=_array(choices, np.eye(3).ravel().tolist()),
        p=_array(choices, [500, 0, 320, -50, 0, 500, 240, 0, 0, 0, 1, 0]),
        binning_x=_integer(choices, 1, 4),
        binning_y=_integer(choices, 1, 4),
        roi=SimpleNamespace(
            x_offset=_integer(choices, 0, 4),
            y_offset=_integer(choices, 0, 4),
            width=_integer(choices, 0, 4),
            height=_integer(choices, 0, 4),
        ),
        header=SimpleNamespace(frame_id="camera"),
    )
    make = make_rgbd_calibration if choices.below(2) else make_calibration
    calibration = make(camera_fields(message, "/info"), is_rectified=bool(choices.below(2)))
    if not np.all(np.isfinite(calibration.P)):
        raise AssertionError("a calibration that is not finite was taken")


def _array(choices: Choices, usual: list[float]) -> Any:
    if choices.below(4):
        return np.array(usual, dtype=np.float64)
    return np.array([_number(choices, value) for value in usual], dtype=np.float64)


def _transforms(data: bytes) -> None:
    choices, buffer = Choices(data), TfBuffer()
    names = ("map", "odom", "/odom", "base", "cam", "", "cam/", "ö" * 70)
    for _ in range(choices.below(12)):
        buffer.add_message(_transform(choices, names), is_static=choices.below(4) == 0)
    target, source = choices.pick(names), choices.pick(names)
    stamp_ns = choices.integer(8, signed=True) // 2
    found = buffer.lookup(target, source, stamp_ns)
    if isinstance(found, np.ndarray) and not np.all(np.isfinite(found)):
        raise AssertionError("a transform that is not finite was found")
    buffer.lookup_many(target, source, np.array([0, stamp_ns, -(2**62)], dtype=np.int64))
    buffer.lookup(choices.pick(names), "caam", 0)
    if buffer.frames and len(buffer.notes) > 3:
        raise AssertionError(buffer.notes)


def _transform(choices: Choices, names: tuple[str, ...]) -> Any:
    child = choices.pick(names)
    stamp = SimpleNamespace(sec=_integer(choices, 5, 4) - 2**31, nanosec=choices.integer(4))
    x, y, z, qx, qy, qz, qw = (_number(choices, usual) for usual in (1, 2, 3, 0, 0, 0, 1))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=choices.pick(names), stamp=stamp),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=z),
            rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw),
        ),
    )


def _serialised(data: bytes) -> None:
    choices = Choices(data)
    type_, is_ros1 = choices.pick(_TYPES), choices.below(2) == 1
    topic = Topic(name="/topic", type=type_, n_messages=1)
    content = BagMessage(topic=topic, log_time_ns=0, data=choices.rest, is_ros1=is_ros1).decode()
    if type_ == TF_TYPE:
        buffer = TfBuffer()
        for transform in content.transforms:
            buffer.add_message(transform)
            transform_of(transform.transform.translation, transform.transform.rotation)
        return
    stamp_of(content.header)
    if type_ == IMAGE_TYPE:
        read = decode_depth(content, 1000.0, "/topic") if content.encoding[:1] == "1" else None
        read if read is not None else decode_grey_or_color(content, "/topic")
    elif type_ == COMPRESSED_TYPE:
        decode_compressed(content, "/topic")
    else:
        make_calibration(camera_fields(content, "/topic"), is_rectified=False)


def make_messages(*, is_ros1: bool) -> dict[str, Any]:
    """Return a small valid message of each type by its name."""
    types = typestore(is_ros1=is_ros1).types
    first = {"seq": 0} if is_ros1 else {}
    stamp = types["builtin_interfaces/msg/Time"](sec=5, nanosec=6)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **first)
    K = np.array([8.0, 0, 4, 0, 8, 3, 0, 0, 1])
    P = np.array([8.0, 0, 4, -2, 0, 8, 3, 0, 0, 0, 1, 0])
    matrices = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": P}
    named = matrices if is_ros1 else {key.lower(): value for key, value in matrices.items()}
    roi = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    vector = types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    transform = types["geometry_msgs/msg/TransformStamped"](
        header=header,
        child_frame_id="base",
        transform=types["geometry_msgs/msg/Transform"](translation=vector, rotation=turn),
    )
    pixels = np.arange(48, dtype=np.uint8)
    return {
        IMAGE_TYPE: types[IMAGE_TYPE](
            header=header, height=6, width=8, encoding="mono8", is_bigendian=0, step=8, data=pixels
        ),
        COMPRESSED_TYPE: types[COMPRESSED_TYPE](header=header, format="png", data=pixels),
        _INFO_TYPE: types[_INFO_TYPE](
            header=header,
            height=6,
            width=8,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **named,
        ),
        TF_TYPE: types[TF_TYPE](transforms=[transform]),
    }


def serialise(message: Any, type_: str, *, is_ros1: bool) -> bytes:
    store = typestore(is_ros1=is_ros1)
    write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    return bytes(write(message, type_))


def _serialised_seeds() -> list[bytes]:
    seeds = []
    for is_ros1 in (False, True):
        for type_, message in make_messages(is_ros1=is_ros1).items():
            chosen = bytes([_TYPES.index(type_), is_ros1])
            seeds.append(chosen + serialise(message, type_, is_ros1=is_ros1))
    return seeds


def _random_seeds() -> list[bytes]:
    rng = np.random.default_rng(2)
    return [bytes(200), *(rng.bytes(n_bytes) for n_bytes in (20, 60, 120, 200, 400, 600))]


TARGETS = (
    Target(name="camera_info", run=_camera_info, seeds=_random_seeds),
    Target(name="transforms", run=_transforms, seeds=_random_seeds),
    Target(name="serialised_messages", run=_serialised, seeds=_serialised_seeds),
)
