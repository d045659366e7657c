"""Bags of ROS 1 and 2 read by topic; folders."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from functools import cache
from heapq import merge
from pathlib import Path, PurePath
from typing import Any, Protocol

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gvo._text import YamlError, load_yaml, read_text
from gvo.errors import RecordingError, named_faults
from gvo.io.bag.file import FAULTS, BagFile
from gvo.io.bag.recovery.inflate import inflate_file
from gvo.io.bag.recovery.scan import FoundMessage
from gvo.io.bag.topics import Topic

STORAGE_SUFFIXES = (".mcap", ".db3")
_COMPRESSED = ".zstd"
_MAX_METADATA = 1 << 20  # bytes; thousands of files
TF_TYPE = "tf2_msgs/msg/TFMessage"
OLD_TF_TYPE = "tf/msg/tfMessage"
"""The type of `/tf` before tf2; it holds the same."""


class BagMessage(FoundMessage):
    """A message, not decoded yet.

    Attributes
    ----------
    topic : Channel
        Name and type, and whether it is serialised the way of ROS 1, not CDR.
    log_time_ns : int
        When it was recorded, nanoseconds.
    data : bytes
        Serialised.
    """

    def decode(self) -> Any:  # noqa: ANN401 - classes made at run time
        """Return the message.

        Raises
        ------
        RecordingError
            When the data are not of the type.
        """
        is_ros1 = self.topic.is_ros1
        store = typestore(is_ros1=is_ros1)
        decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        try:
            return decode(memoryview(self.data), self.topic.type)
        except FAULTS as error:
            raise RecordingError(
                f"{self.topic.name}: a message of {len(self.data)} bytes is not a {self.topic.type}"
            ) from error


class MessageReader(Protocol):
    """Messages by topic: of a bag, or of a network as they came so far.

    Attributes
    ----------
    topics : list of Topic
    notes : list of str
        What was decided, a line each.
    """

    topics: list[Topic]
    notes: list[str]

    @property
    def damage(self) -> str:
        """What cannot be read, in one line."""

    def messages(self, names: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order of recording."""


class BagReader:
    """Bags that are one recording: split, or recorded side by side.

    Parameters
    ----------
    paths : Path or sequence of Path
        `.bag`, `.mcap` or `.db3` files, or ROS 2 bag folders.

    Attributes
    ----------
    is_found : bool
        The files are what a folder holds of which no metadata say so.

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
        self.is_found = False
        paths = [paths] if isinstance(paths, Path) else list(paths)
        if not paths:
            raise ValueError("expected at least one path of a bag")
        for path in paths:
            with named_faults(RecordingError, path):
                self._files += self._open_folder(path) if path.is_dir() else [self._opened(path)]
        self._are_loose = self.is_found or len(paths) > 1
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

    @property
    def loose_files(self) -> list[BagFile]:
        """The files where no metadata say that they are one recording; none if it is one file."""
        return self._files if self._are_loose and len(self._files) > 1 else []

    def messages(
        self, names: Collection[str], *, files: Sequence[BagFile] | None = None
    ) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order of recording, over all files or some.

        What is damaged is left out, see `damage`; in a file without an index the order is that
        of its chunks. A file is opened when its first message is due.
        """
        streams = [
            _begin(file, names)
            for file in files or self._files
            if any(channel.name in names for channel in file.counts)
        ]
        for _, message in merge(*streams, key=lambda item: item[0]):
            if message is not None:
                yield BagMessage(*message)

    def _open_folder(self, folder: Path) -> list[BagFile]:
        files: list[BagFile] = []
        refusals: list[RecordingError] = []
        for path in self._find_files(folder):
            try:
                files.append(self._opened(path))
            except RecordingError as error:
                refusals.append(error)
        if not files:
            raise refusals[0]
        self._missing += [str(error) for error in refusals]
        return files

    def _find_files(self, folder: Path) -> list[Path]:
        """Find the files of a bag folder; note those left out, missing, and found without metadata.

        The metadata only name them. All else that they say is in the files too, and not always the
        same: readers that compare the two find no messages then.
        """
        held = sorted(path for path in folder.iterdir() if is_storage(path))
        has_metadata = (folder / "metadata.yaml").is_file()
        if not held and not has_metadata:
            raise RecordingError(f"{folder}: holds neither metadata.yaml nor a .mcap or .db3")
        names = _listed_files(folder / "metadata.yaml") if has_metadata else []
        listed = {name: _find(name, held) for name in names}
        found = [path for path in listed.values() if path is not None]
        if found:
            others = [path.name for path in held if path not in found]
            missing = [folder / name for name, path in listed.items() if path is None]
            self.notes += [f"bag: {n} is left out: metadata.yaml does not name it" for n in others]
            self._missing += [f"{path}: is missing; copy it anew" for path in missing]
            return found
        if not held:
            raise RecordingError(
                f"{folder}: holds no .mcap or .db3, only metadata.yaml; copy it anew"
            )
        self.is_found = True
        state = "names other files" if names else "is malformed" if has_metadata else "is missing"
        read = ", ".join(path.name for path in held)
        self.notes.append(f"bag: metadata.yaml {state}: read {read} without it")
        return held

    def _opened(self, path: Path) -> BagFile:
        if path.suffix != _COMPRESSED:
            return BagFile(path)
        folder = Path(tempfile.mkdtemp(prefix="bag-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        unpacked = folder / path.name.removesuffix(_COMPRESSED)
        with named_faults(RecordingError, path, f"cannot be decompressed to {folder}"):
            reason = inflate_file(path, unpacked)
        damage = f"{path}: is cut or damaged ({reason}); copy it anew" if reason else ""
        try:
            file = BagFile(unpacked)
        except RecordingError as error:
            raise RecordingError(damage or str(error).replace(str(unpacked), str(path))) from error
        self._origins[unpacked] = path
        self._missing += [damage] if damage else []
        return file


def _begin(file: BagFile, names: Collection[str]) -> Iterator[tuple[int, FoundMessage | None]]:
    # The first item keeps the file closed until its time has come.
    yield file.start_time_ns, None
    for message in file.messages(names):
        yield message.log_time_ns, message


def _merge_topics(files: Sequence[BagFile]) -> list[Topic]:
    counts: Counter[tuple[str, str]] = Counter()
    for file in files:
        for channel, count in file.counts.items():
            counts[channel.name, channel.type] += count
    return [Topic(name=name, type=type_, n_messages=n) for (name, type_), n in counts.items()]


@cache
def typestore(*, is_ros1: bool) -> Typestore:
    """Return the standard message types that recordings are read and written with."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    definition = "geometry_msgs/TransformStamped[] transforms"
    for name in (TF_TYPE, OLD_TF_TYPE):
        if name not in store.fielddefs:
            store.register(get_types_from_msg(definition, name))
    return store


def serialize(message: object, type_: str, *, is_ros1: bool) -> bytes:
    """Return the bytes of a message of a class of `typestore`, as ROS 1 has them or as CDR."""
    store = typestore(is_ros1=is_ros1)
    return bytes((store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, type_))


def _find(name: str, held: list[Path]) -> Path | None:
    plain = name.removesuffix(_COMPRESSED)
    names = (name, plain, f"{plain}{_COMPRESSED}")
    return next((path for wanted in names for path in held if path.name == wanted), None)


def _listed_files(metadata: Path) -> list[str]:
    try:
        text = read_text(metadata, max_bytes=_MAX_METADATA)
        content = load_yaml(text, max_characters=_MAX_METADATA)["rosbag2_bagfile_information"]
        return [PurePath(name).name for name in content["relative_file_paths"]]
    except (YamlError, OSError, ValueError, TypeError, LookupError, AttributeError):
        return []


def is_storage(path: Path) -> bool:
    """Tell whether a path is a file of ROS 2, by its name, compressed or not."""
    return path.is_file() and path.name.removesuffix(_COMPRESSED).endswith(STORAGE_SUFFIXES)
