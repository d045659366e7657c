"""Bags of ROS 1 and ROS 2, read by topic: one file, a folder, or several that are one recording."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from heapq import merge
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gvo.errors import RecordingError
from gvo.sources.bag_file import FAULTS, BagFile
from gvo.sources.bag_folder import find_files, unpack
from gvo.sources.salvage.scan import FoundMessage
from gvo.sources.topics import Topic

TF_TYPE = "tf2_msgs/msg/TFMessage"
OLD_TF_TYPE = "tf/msg/tfMessage"
"""The type of `/tf` before tf2; it holds the same."""


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
        except FAULTS as error:
            raise RecordingError(
                f"{self.topic.name}: a message of {len(self.data)} bytes is no {self.topic.type}"
            ) from error


class BagReader:
    """Bags that are one recording: split, or recorded side by side.

    Parameters
    ----------
    paths : Path or sequence of Path
        `.bag`, `.mcap` or `.db3` files, or ROS 2 bag folders.

    Raises
    ------
    RecordingError
        When one of them cannot be opened or yields nothing, with what to do.
    """

    def __init__(self, paths: Path | Sequence[Path]) -> None:
        self.notes: list[str] = []
        self._missing: list[str] = []
        self._files: list[BagFile] = []
        self._origins: dict[Path, Path] = {}
        paths = [paths] if isinstance(paths, Path) else list(paths)
        if not paths:
            raise ValueError("expected at least one path of a bag")
        for path in paths:
            self._files += (
                self._open_folder(path) if path.is_dir() else [BagFile(self._unpacked(path))]
            )
        self.notes += [file.note for file in self._files if file.note]
        self.topics = _merge_topics(self._files)

    @property
    def damage(self) -> str:
        """What cannot be read, in one line; complete when all messages were read."""
        found = [*self._missing, *(file.damage for file in self._files)]
        text = "; ".join(text for text in found if text)
        for unpacked, path in self._origins.items():
            text = text.replace(str(unpacked), str(path))
        return text

    def messages(self, names: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order of recording, over all files.

        What is damaged is left out, see `damage`; in a file without an index the order is that
        of its chunks. A file is opened when its first message is due.

        Parameters
        ----------
        names : collection of str
            Topics as listed.
        """
        topics = {(topic.name, topic.type): topic for topic in self.topics}
        wanted = [file for file in self._files if any(c.name in names for c in file.counts)]
        streams = [_begin(file, names) for file in wanted]
        for _, message in merge(*streams, key=lambda item: item[0]):
            if message is None:
                continue
            channel = message.channel
            yield BagMessage(
                topic=topics[channel.name, channel.type],
                log_time_ns=message.log_time_ns,
                data=message.data,
                is_ros1=channel.is_ros1,
            )

    def _open_folder(self, folder: Path) -> list[BagFile]:
        found = find_files(folder)
        self.notes += found.notes
        self._missing += found.damage
        files: list[BagFile] = []
        refusals: list[RecordingError] = []
        for path in found.paths:
            try:
                files.append(BagFile(self._unpacked(path)))
            except RecordingError as error:
                refusals.append(error)
        if not files:
            raise refusals[0]
        self._missing += [str(error) for error in refusals]
        return files

    def _unpacked(self, path: Path) -> Path:
        if path.suffix != ".zstd":
            return path
        folder = Path(tempfile.mkdtemp(prefix="bag-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        unpacked, damage = unpack(path, folder)
        self._origins[unpacked] = path
        self._missing += [damage] if damage else []
        return unpacked


def _begin(file: BagFile, names: Collection[str]) -> Iterator[tuple[int, FoundMessage | None]]:
    # The first item keeps the file closed until its time has come.
    yield file.start_time_ns, None
    for message in file.messages(names):
        yield message.log_time_ns, message


@cache
def typestore(*, is_ros1: bool) -> Typestore:
    """Return the standard message types that recordings are read and written with."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    definition = "geometry_msgs/TransformStamped[] transforms"
    for name in (TF_TYPE, OLD_TF_TYPE):
        if name not in store.fielddefs:
            store.register(get_types_from_msg(definition, name))
    return store


def _merge_topics(files: Sequence[BagFile]) -> list[Topic]:
    counts: dict[tuple[str, str], int] = {}
    for file in files:
        for channel, count in file.counts.items():
            key = (channel.name, channel.type)
            counts[key] = counts.get(key, 0) + count
    return [Topic(name=name, type=type_, n_messages=n) for (name, type_), n in counts.items()]
