"""Bags of ROS 1 and ROS 2, read by topic.

rosbags' readers are used without its `AnyReader`, which parses the definitions of all message
types: one foreign type that it cannot parse would block the camera's topics.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gvo.errors import RecordingError
from gvo.sources.topics import CAMERA_INFO_TYPE, COMPRESSED_TYPE, IMAGE_TYPE, Topic

TF_TYPE = "tf2_msgs/msg/TFMessage"
_READ_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE, CAMERA_INFO_TYPE, TF_TYPE)

_STORAGE_SUFFIXES = (".mcap", ".db3")
_Reader: TypeAlias = Reader1 | Reader2


def _storage_faults() -> Iterator[type[Exception]]:
    """Yield the errors of the libraries that rosbags reads SQLite and Zstandard with.

    It lets them through. The libraries are its own affair, another release may bring others.
    """
    for module, name in (
        ("apsw", "Error"),
        ("compression.zstd", "ZstdError"),
        ("backports.zstd", "ZstdError"),
    ):
        with suppress(ImportError):
            yield getattr(import_module(module), name)


# The readers check the structure of a file by assertions and by what happens to fail.
_FAULTS: tuple[type[Exception], ...] = (
    ReaderError1,
    ReaderError2,
    SerdeError,
    AssertionError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    OverflowError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,  # a damaged size
    struct.error,
    *_storage_faults(),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagMessage:
    """A message, not decoded yet.

    Parameters
    ----------
    topic : Topic
        As listed by the reader.
    log_time_ns : int
        When it was recorded, nanoseconds.
    data : bytes
        Serialised.
    is_ros1 : bool
        Serialised the way of ROS 1, not CDR.
    """

    topic: Topic
    log_time_ns: int
    data: bytes
    is_ros1: bool

    def decode(self) -> Any:  # noqa: ANN401 - classes made at run time
        """Return the message.

        Raises
        ------
        RecordingError
            When the data are not of the type.
        """
        store = typestore(is_ros1=self.is_ros1)
        decode = store.deserialize_ros1 if self.is_ros1 else store.deserialize_cdr
        try:
            return decode(memoryview(self.data), self.topic.type)
        except _FAULTS as error:
            raise RecordingError(
                f"{self.topic.name}: a message of {len(self.data)} bytes is no {self.topic.type}"
            ) from error


class BagReader:
    """A `.bag`, `.mcap` or `.db3` file, or a ROS 2 bag folder.

    Parameters
    ----------
    path : Path
        File or folder.

    Raises
    ------
    RecordingError
        When it cannot be opened, with what to do.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._is_ros1 = path.is_file() and path.suffix == ".bag"
        self._files = [path]
        self.notes: list[str] = []
        if path.is_dir():
            self._check_folder()
        with self._opened() as readers:
            self.topics = _merge_topics(readers)

    def messages(self, names: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order of recording.

        Parameters
        ----------
        names : collection of str
            Topics as listed.

        Raises
        ------
        RecordingError
            When the file cannot be read on.
        """
        topics = {(topic.name, topic.type): topic for topic in self.topics}
        with self._opened() as readers:
            for reader in readers:
                connections = [c for c in reader.connections if c.topic in names]
                if not connections:
                    continue
                for connection, log_time_ns, data in reader.messages(connections=connections):
                    yield BagMessage(
                        topic=topics[connection.topic, _type_of(connection)],
                        log_time_ns=log_time_ns,
                        data=data,
                        is_ros1=self._is_ros1,
                    )

    def _check_folder(self) -> None:
        """Read the files inside directly where the folder's metadata are of no use."""
        files = sorted(p for p in self._path.iterdir() if p.suffix in _STORAGE_SUFFIXES)
        if not files and not (self._path / "metadata.yaml").is_file():
            raise RecordingError(f"{self._path}: holds neither metadata.yaml nor a .mcap or .db3")
        try:
            with self._opened() as readers:
                if not any(_is_silent(reader) for reader in readers):
                    return
            reason = "does not fit the files"
        except RecordingError:
            if not files:
                raise
            reason = "is missing or malformed"
        names = ", ".join(file.name for file in files)
        self._files = files
        self.notes.append(f"bag: metadata.yaml {reason}: read {names} without it")

    @contextmanager
    def _opened(self) -> Iterator[list[_Reader]]:
        """Open all files, in the order of their first message; translate what goes wrong."""
        with ExitStack() as stack:
            try:
                readers: list[_Reader] = []
                for file in self._files:
                    readers.append(Reader1(file) if self._is_ros1 else Reader2(file))
                    stack.enter_context(readers[-1])
                yield sorted(readers, key=lambda reader: reader.start_time)
            except _FAULTS as error:
                raise RecordingError(_explain(self._path, error)) from error


@cache
def typestore(*, is_ros1: bool) -> Typestore:
    """Return the standard message types that recordings are read and written with."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if TF_TYPE not in store.fielddefs:
        definition = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(definition, TF_TYPE))
    return store


def _is_silent(reader: _Reader) -> bool:
    """Tell whether a topic of a camera announces messages of which none comes."""
    return any(
        next(iter(reader.messages(connections=[connection])), None) is None
        for connection in reader.connections
        if connection.msgcount > 0 and _type_of(connection) in _READ_TYPES
    )


def _merge_topics(readers: list[_Reader]) -> list[Topic]:
    counts: dict[tuple[str, str], int] = {}
    for reader in readers:
        for connection in reader.connections:
            key = (connection.topic, _type_of(connection))
            counts[key] = counts.get(key, 0) + connection.msgcount
    return [Topic(name=name, type=type_, n_messages=n) for (name, type_), n in counts.items()]


def _type_of(connection: Connection) -> str:
    """Return the type as `package/msg/Name`: early ROS 2 bags leave out the middle."""
    package, _, name = connection.msgtype.partition("/")
    return f"{package}/msg/{name}" if "/" not in name else connection.msgtype


def _explain(path: Path, error: Exception) -> str:
    text = " ".join(str(error).split())
    if path.is_file() and path.stat().st_size == 0:
        return f"{path}: the file is empty"
    if "not indexed" in text:
        return f"{path}: the bag was not closed and has no index; run `rosbag reindex` on a copy"
    if path.suffix == ".bag" and not _has_magic(path, b"#ROSBAG V2.0"):
        if _has_magic(path, b"#ROS"):
            return f"{path}: the bag is of an older format than 2.0; run `rosbag fix` on a copy"
        return f"{path}: is no ROS 1 bag"
    if path.suffix == ".mcap" and not _has_magic(path, b"\x89MCAP0\r\n"):
        return f"{path}: is no MCAP file"
    tools = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "sqlite3 FILE .recover"}
    tool = tools.get(path.suffix, "ros2 bag reindex")
    detail = text or type(error).__name__
    return (
        f"{path}: cannot be read ({detail}); where it is truncated or damaged, try `{tool}` on a "
        "copy"
    )


def _has_magic(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic
