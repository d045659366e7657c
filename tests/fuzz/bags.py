"""Whole bag files, read through the package's readers, and walked over without their index."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from gvo.errors import GvoError
from gvo.io.bag.reader import TF_TYPE, BagReader, find_files, typestore
from gvo.io.bag.recovery.inflate import DamageError
from gvo.io.bag.recovery.mcap import McapScan
from gvo.io.bag.recovery.ros1 import Ros1Scan
from gvo.io.bag.recovery.scan import Scan
from gvo.io.bag.source import BagSource
from gvo.io.bag.topics import COMPRESSED_TYPE
from gvo.io.poses.tf import read_tf
from tests.fuzz.messages import make_messages, serialise
from tests.fuzz.mutations import mutate_bytes, mutate_text
from tests.fuzz.target import Folder, Target

_TOPICS = {
    "/left/image_rect": "sensor_msgs/msg/Image",
    "/right/image_rect": "sensor_msgs/msg/Image",
    "/left/camera_info": "sensor_msgs/msg/CameraInfo",
    "/right/camera_info": "sensor_msgs/msg/CameraInfo",
    "/tf": TF_TYPE,
    "/left/image_rect/compressed": COMPRESSED_TYPE,
}
_LEFT_INFO = "/left/camera_info"
_SCANS: dict[str, type[Scan]] = {".bag": Ros1Scan, ".mcap": McapScan}
_MAX_MESSAGES = 200


@cache
def _folder() -> Folder:
    return Folder()


def _read(data: bytes, *, suffix: str) -> None:
    """Open a file as a recording, load what it yields; then walk over its records."""
    path = _folder().write(f"fuzz{suffix}", data)
    if suffix in _SCANS:
        _walk(path)
    reader = BagReader(path)
    names = [topic.name for topic in reader.topics]
    for message in islice(reader.messages(names), _MAX_MESSAGES):
        _try(message.decode)
    _check_line(reader.damage)
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
        _check_line(scan.damage)
    except DamageError:
        return


def _try(read: Callable[[], object]) -> None:
    try:
        read()
    except GvoError:
        return


def _check_line(text: str) -> None:
    if "\n" in text:
        raise AssertionError(f"damage is told in more than one line: {text[:200]!r}")


def _make(suffix: str, compression: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"made{suffix}"
        if suffix == ".bag":
            _write_ros1(path, compression)
            return path.read_bytes()
        plugin = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
        path = path.with_suffix("")
        _write_ros2(path, plugin, compression)
        (found,) = path.glob(f"*{suffix}")
        return found.read_bytes()


def _write_ros1(path: Path, compression: str) -> None:
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        _fill(writer, is_ros1=True)


def _write_ros2(path: Path, plugin: StoragePlugin, compression: str) -> None:
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if compression:
        mode = CompressionMode[compression]
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        _fill(writer, is_ros1=False)


def _fill(writer: Writer1 | Writer2, *, is_ros1: bool) -> None:
    messages = make_messages(is_ros1=is_ros1)
    store = typestore(is_ros1=is_ros1)
    connections = {
        name: writer.add_connection(name, type_, typestore=store) for name, type_ in _TOPICS.items()
    }
    for stamp_ns in (5_000_000_006, 5_100_000_006):
        for name, type_ in _TOPICS.items():
            message = _at_left(messages[type_]) if name == _LEFT_INFO else messages[type_]
            content = serialise(message, type_, is_ros1=is_ros1)
            writer.write(connections[name], stamp_ns, content)


def _at_left(message: Any) -> Any:
    """Return the `CameraInfo` of a camera without an offset to the left one."""
    name = "P" if hasattr(message, "P") else "p"
    P = getattr(message, name).copy()
    P[3] = 0.0
    return replace(message, **{name: P})


def _seeds(suffix: str, compressions: tuple[str, ...]) -> list[bytes]:
    made = [_make(suffix, compression) for compression in compressions]
    return [*made, made[0][: len(made[0]) * 2 // 3]]


def _metadata(data: bytes) -> None:
    folder = _folder().path / "folder"
    folder.mkdir(exist_ok=True)
    (folder / "metadata.yaml").write_bytes(data)
    (folder / "held_0.mcap").write_bytes(b"")
    find_files(folder)


_METADATA = b"""rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  relative_file_paths: [held_0.mcap, held_1.mcap]
  files:
    - {path: held_0.mcap, message_count: 4}
    - {path: held_1.mcap, message_count: 5}
"""


def _target(name: str, suffix: str, compressions: tuple[str, ...]) -> Target:
    return Target(
        name=name,
        run=partial(_read, suffix=suffix),
        seeds=partial(_seeds, suffix, compressions),
        mutate=mutate_bytes,
        max_bytes=32768,
    )


TARGETS = (
    _target("ros1_bags", ".bag", ("", "BZ2", "LZ4")),
    _target("mcap_bags", ".mcap", ("", "STORAGE", "MESSAGE")),
    _target("sqlite_bags", ".db3", ("", "MESSAGE")),
    Target(name="bag_metadata", run=_metadata, seeds=lambda: [_METADATA, b""], mutate=mutate_text),
)
