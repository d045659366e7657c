"""Whole bag files, read through the package's readers, and single messages as they are serialised.

Bags are also walked over without their index.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gvo.errors import GvoError
from gvo.io.bag.image_encodings import DEPTHS, IMAGES
from gvo.io.bag.messages import (
    camera_fields,
    decode_compressed,
    decode_depth,
    decode_grey_or_color,
    stamp_of,
)
from gvo.io.bag.reader import TF_TYPE, BagMessage, BagReader, serialize
from gvo.io.bag.recovery.inflate import DamageError
from gvo.io.bag.recovery.mcap import McapScan
from gvo.io.bag.recovery.ros1 import Ros1Scan
from gvo.io.bag.recovery.scan import Channel, Scan
from gvo.io.bag.source import BagSource
from gvo.io.bag.topics import CAMERA_INFO_TYPE, COMPRESSED_TYPE, IMAGE_TYPE
from gvo.io.calibration.camera_info import make_calibration, make_rgbd_calibration
from gvo.io.poses.tf import TfBuffer, read_tf
from tests.fuzz.mutations import mutate_bytes, mutate_text
from tests.fuzz.target import Target, folder, write
from tests.make import bags as made

_SCANS: dict[str, type[Scan]] = {".bag": Ros1Scan, ".mcap": McapScan}
_MAX_MESSAGES = 200
_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE, CAMERA_INFO_TYPE, TF_TYPE)
_PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8)


def _messages(stamp_ns: int = 5_000_000_006, *, is_ros1: bool) -> list[made.Message]:
    """Return messages of a small stereo camera and of tf."""
    options: dict[str, Any] = {"is_ros1": is_ros1}
    png = cv2.imencode(".png", _PIXELS)[1].ravel()
    header = made.header(stamp_ns=stamp_ns, **options)
    compressed = made.make(COMPRESSED_TYPE, header=header, format="png", data=png, **options)
    found = [
        made.tf("/tf", "base", "camera", np.eye(4), stamp_ns, **options),
        ("/left/image_rect/compressed", COMPRESSED_TYPE, stamp_ns, compressed),
    ]
    for side, shift in (("left", 0.0), ("right", -2.0)):
        P = [8.0, 0, 4, shift, 0, 8, 3, 0, 0, 0, 1, 0]
        numbers: dict[str, Any] = {"width": 8, "height": 6, "R": np.eye(3), "P": P}
        numbers["K"] = np.reshape(P, (3, 4))[:, :3]
        topic = f"/{side}/camera_info"
        found.append(made.camera_info(topic, stamp_ns=stamp_ns, **options, **numbers))
        found.append(made.image(f"/{side}/image_rect", _PIXELS, "mono8", stamp_ns, **options))
    return found


def _bag(suffix: str, compression: str) -> bytes:
    messages = [
        message
        for stamp_ns in (5_000_000_006, 5_100_000_006)
        for message in _messages(stamp_ns, is_ros1=suffix == ".bag")
    ]
    with tempfile.TemporaryDirectory() as name:
        path = made.write(Path(name) / f"made{suffix}", messages, compression=compression)
        return path.read_bytes()


def _bag_seeds(suffix: str, compressions: tuple[str, ...]) -> list[bytes]:
    whole = [_bag(suffix, compression) for compression in compressions]
    return [*whole, whole[0][: len(whole[0]) * 2 // 3]]


def _read(data: bytes, *, suffix: str) -> None:
    """Open a file as a recording, load what it yields; then walk over its records."""
    path = write(f"fuzz{suffix}", data)
    if suffix in _SCANS:
        _walk(path)
    reader = BagReader(path)
    names = [topic.name for topic in reader.topics]
    for message in islice(reader.messages(names), _MAX_MESSAGES):
        _try(message.decode)
    assert "\n" not in reader.damage
    _try(partial(read_tf, reader))
    source = BagSource(path)
    for image in islice(source.images(), _MAX_MESSAGES):
        _try(image.load)
    source.truth()


def _walk(path: Path) -> None:
    """Read without the index; that a file is damaged is said by `DamageError` there."""
    try:
        scan = _SCANS[path.suffix](path)
        for _ in islice(scan.messages({channel.name for channel in scan.counts}), _MAX_MESSAGES):
            pass
        assert "\n" not in scan.damage
    except DamageError:
        return


def _try(read: Callable[[], object]) -> None:
    try:
        read()
    except GvoError:
        return


def _message(data: bytes) -> None:
    """Decode a message; the first byte chooses its type, the second ROS 1 or 2."""
    number, is_ros1 = data.ljust(2, b"\0")[:2]
    topic = Channel("/topic", _TYPES[number % len(_TYPES)], is_ros1 % 2 == 1)
    content = BagMessage(topic, 0, data[2:]).decode()
    if topic.type == TF_TYPE:
        buffer = TfBuffer()
        for transform in content.transforms:
            buffer.add_message(transform)
        found = buffer.lookup("base", "camera", 5_000_000_006)
        assert not isinstance(found, np.ndarray) or np.all(np.isfinite(found))
        assert len(buffer.notes) <= 3
        return
    stamp_of(content.header)
    if topic.type == COMPRESSED_TYPE:
        decode_compressed(content, "/topic")
    elif topic.type == CAMERA_INFO_TYPE:
        for make in (make_calibration, make_rgbd_calibration):
            calibration = make(camera_fields(content, "/topic"), is_rectified=False)
            assert np.all(np.isfinite(calibration.P))
    elif content.encoding in DEPTHS:
        decode_depth(content, 1000.0, "/topic")
    else:
        decode_grey_or_color(content, "/topic")


def _message_seeds() -> list[bytes]:
    seeds = []
    for is_ros1 in (False, True):
        messages = _messages(is_ros1=is_ros1)
        for encoding in {**IMAGES, **DEPTHS}:
            messages.append(made.image("/image", _PIXELS, encoding, is_ros1=is_ros1))
        for _, type_, _, message in messages:
            data = serialize(message, type_, is_ros1=is_ros1)
            seeds.append(bytes([_TYPES.index(type_), is_ros1]) + bytes(data))
    return seeds


def _metadata(data: bytes) -> None:
    write("folder/metadata.yaml", data)
    write("folder/held_0.mcap", b"")
    _try(lambda: BagReader(folder() / "folder"))


_METADATA = b"""rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  relative_file_paths: [held_0.mcap, held_1.mcap]
  files:
    - {path: held_0.mcap, message_count: 4}
    - {path: held_1.mcap, message_count: 5}
"""


def _target(name: str, suffix: str, *compressions: str) -> Target:
    return Target(
        name=name,
        run=partial(_read, suffix=suffix),
        seeds=partial(_bag_seeds, suffix, compressions),
        mutate=mutate_bytes,
        is_slow=True,
    )


TARGETS = (
    _target("ros1_bags", ".bag", "", "BZ2", "LZ4"),
    _target("mcap_bags", ".mcap", "", "STORAGE", "MESSAGE"),
    _target("sqlite_bags", ".db3", "", "MESSAGE"),
    Target(name="messages", run=_message, seeds=_message_seeds),
    Target(name="bag_metadata", run=_metadata, seeds=lambda: [_METADATA, b""], mutate=mutate_text),
)
