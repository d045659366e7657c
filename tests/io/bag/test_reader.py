"""Bags of all kinds, good and broken, read by topic."""

from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import IndexType, Writer

from gvo.errors import RecordingError
from gvo.io.bag.reader import BagReader, serialize
from gvo.io.bag.topics import IMAGE_TYPE
from tests.make.bags import Message, image, write

_N = 5
_KINDS = pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])


def _images(topic: str, log_times_ns: Iterable[int], *, is_ros1: bool) -> list[Message]:
    """Return images whose pixels and seconds are their numbers."""
    made = []
    for n, log_time_ns in enumerate(log_times_ns):
        pixels = np.full((2, 3), n, np.uint8)
        message = image(topic, pixels, stamp_ns=n * 10**9 + 7, is_ros1=is_ros1)[3]
        made.append((topic, IMAGE_TYPE, log_time_ns, message))
    return made


def _write(path: Path) -> Path:
    """Write images on two topics, and a message of a type whose definition is none."""
    messages: list[Message] = [("/foreign", "a/msg/B", n, bytes(8)) for n in range(_N)]
    for topic in ("/a", "/b"):
        messages += _images(topic, range(_N), is_ros1=path.suffix == ".bag")
    return write(path, sorted(messages, key=lambda message: message[2]))


@_KINDS
def test_messages_of_wanted_topics_come_whatever_else_is_held(tmp_path: Path, name: str) -> None:
    reader = BagReader(_write(tmp_path / name))
    assert {(topic.name, topic.n_messages) for topic in reader.topics} == {
        ("/foreign", _N),
        ("/a", _N),
        ("/b", _N),
    }
    messages = list(reader.messages(["/a"]))
    assert [message.log_time_ns for message in messages] == list(range(_N))
    for n, message in enumerate(messages):
        assert message.topic.name == "/a"
        image = message.decode()
        assert (image.header.stamp.sec, image.header.stamp.nanosec) == (n, 7)
        assert bytes(image.data) == bytes([n] * 6)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        # readers that compare the metadata with the files find no messages then
        (lambda text: text.replace(IMAGE_TYPE, "sensor_msgs/Image"), ""),
        (lambda text: text.replace("profiles: ''", "profiles: '- depth: 7'"), ""),
        (lambda text: text[: len(text) // 2], "is malformed"),
        (lambda text: "", "is malformed"),
        (lambda text: text.replace("folder.db3", "other.db3"), "names other files"),
        (None, "is missing"),
    ],
)
def test_a_folder_is_read_whatever_its_metadata_say(
    tmp_path: Path, spoil: Callable[[str], str] | None, reason: str
) -> None:
    folder = _write(tmp_path / "folder")
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    if spoil is None:
        metadata.unlink()
    else:
        assert spoil(text) != text
        metadata.write_text(spoil(text))
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == _N
    expected = [f"bag: metadata.yaml {reason}: read folder.db3 without it"] if reason else []
    assert reader.notes == expected
    assert reader.damage == ""


def _split(folder: Path, suffix: str, mode: str = "") -> Path:
    """Write a folder of three files, each with messages of its own second."""
    folder.mkdir()
    names = []
    for n in range(3):
        times = range(10 * n, 10 * n + _N)
        messages = _images("/a", times, is_ros1=False)
        file = write(folder / f"part_{n}{suffix}", messages, compression=mode)
        names.append(file.name)
        file.rename(folder / file.name)
    files = [{"path": name, "message_count": _N} for name in names]
    information = {"relative_file_paths": names, "files": files}
    (folder / "metadata.yaml").write_text(
        yaml.safe_dump({"rosbag2_bagfile_information": information})
    )
    return folder


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
@pytest.mark.parametrize("mode", ["", "FILE", "MESSAGE"])
def test_a_split_folder_is_read_compressed_or_not(tmp_path: Path, suffix: str, mode: str) -> None:
    reader = BagReader(_split(tmp_path / "bag", suffix, mode))
    messages = list(reader.messages(["/a"]))
    assert [m.log_time_ns for m in messages] == [10 * n + k for n in range(3) for k in range(_N)]
    assert [m.decode().header.stamp.sec for m in messages] == [*range(_N)] * 3
    assert reader.damage == ""
    assert reader.notes == []


@pytest.mark.parametrize("mode", ["", "FILE"])
def test_a_file_of_a_folder_that_is_missing_is_told(tmp_path: Path, mode: str) -> None:
    folder = _split(tmp_path / "bag", ".mcap", mode)
    (lost,) = folder.glob("part_1.mcap*")
    lost.unlink()
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == 2 * _N
    assert reader.damage == f"{lost}: is missing; copy it anew"


def test_a_file_of_a_folder_that_is_empty_is_told(tmp_path: Path) -> None:
    folder = _split(tmp_path / "bag", ".db3")
    (folder / "part_0.db3").write_bytes(b"")
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == 2 * _N
    assert reader.damage == f"{folder / 'part_0.db3'}: the file is empty"
    for n in (1, 2):
        (folder / f"part_{n}.db3").write_bytes(b"")
    with pytest.raises(RecordingError, match="the file is empty"):
        BagReader(folder)


@pytest.mark.parametrize("name", ["a.db3", "a.mcap"])
def test_a_compressed_file_that_ends_early_is_told_by_its_own_name(
    tmp_path: Path, name: str
) -> None:
    file = write(tmp_path / name, _images("/a", range(_N), is_ros1=False), compression="FILE")
    data = file.read_bytes()
    for cut in (data[: len(data) // 2], b""):
        file.write_bytes(cut)
        with pytest.raises(RecordingError) as caught:
            BagReader(file)
        assert str(caught.value).startswith(f"{file}: is cut or damaged (its zstd stream ends")


_OPTIONS = ("use_chunking", "repeat_channels", "repeat_schemas", "use_statistics")


@pytest.mark.parametrize("kinds", [IndexType.NONE, IndexType.CHUNK, IndexType.ALL])
def test_a_summary_of_mcap_may_lack_anything(tmp_path: Path, kinds: IndexType) -> None:
    for values in product([False, True], repeat=len(_OPTIONS)):
        path = tmp_path / "a.mcap"
        with path.open("wb") as file:
            options: Any = dict(zip(_OPTIONS, values, strict=True))
            writer: Any = Writer(file, index_types=kinds, **options)
            writer.start(profile="ros2")
            schema = writer.register_schema(IMAGE_TYPE, "ros2msg", b"")
            channel = writer.register_channel("/a", "cdr", schema)
            for n, (_, _, _, message) in enumerate(_images("/a", range(_N), is_ros1=False)):
                data = serialize(message, IMAGE_TYPE, is_ros1=False)
                writer.add_message(channel, n, data, publish_time=n)
            writer.finish()
        reader = BagReader(path)
        assert [(t.name, t.type, t.n_messages) for t in reader.topics] == [("/a", IMAGE_TYPE, _N)]
        assert len([message.decode() for message in reader.messages(["/a"])]) == _N
        assert reader.damage == ""


def test_a_file_that_the_metadata_do_not_name_is_left_out(tmp_path: Path) -> None:
    folder = _split(tmp_path / "bag", ".mcap")
    (folder / "stray.mcap").write_bytes((folder / "part_0.mcap").read_bytes())
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == 3 * _N
    assert reader.notes == ["bag: stray.mcap is left out: metadata.yaml does not name it"]


_WRITTEN = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 2)), max_size=20).map(
    lambda written: [(0, 0), (1, 1), (2, 2), *written]
)


@settings(max_examples=10)
@given(written=_WRITTEN)
def test_several_bags_are_merged_by_the_time_of_recording(
    tmp_path_factory: pytest.TempPathFactory, written: list[tuple[int, int]]
) -> None:
    folder = tmp_path_factory.mktemp("bags")
    names = ("a.bag", "b.mcap", "c.db3")
    paths = [
        _write_times(folder / name, sorted(t for t, file in written if file == n))
        for n, name in enumerate(names)
    ]
    reader = BagReader(paths)
    (topic,) = reader.topics
    assert topic.n_messages == len(written)
    found = list(reader.messages(["/a"]))
    assert [m.log_time_ns for m in found] == sorted(t for t, _ in written)
    alone = [m for path in paths for m in BagReader(path).messages(["/a"])]
    # sorting is stable: files in the order given, messages of a file in theirs
    expected = sorted(alone, key=lambda m: m.log_time_ns)
    assert [m.data for m in expected] == [m.data for m in found]


def _write_times(path: Path, log_times_ns: list[int]) -> Path:
    return write(path, _images("/a", log_times_ns, is_ros1=path.suffix == ".bag"))
