"""Bags of all kinds, good and broken, read by topic."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from gvo.errors import RecordingError
from gvo.sources.bag_reader import BagMessage, BagReader, typestore
from gvo.sources.topics import IMAGE_TYPE, Topic

_N = 5
_KINDS = pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
_FOREIGN = "this is no definition ("


def _image(n: int, *, is_ros1: bool) -> Any:
    types: dict[str, Any] = typestore(is_ros1=is_ros1).types
    sequence = {"seq": 0} if is_ros1 else {}
    return types[IMAGE_TYPE](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=n, nanosec=7), frame_id="f", **sequence
        ),
        height=2,
        width=3,
        encoding="mono8",
        is_bigendian=0,
        step=3,
        data=np.full(6, n, np.uint8),
    )


def _write(path: Path) -> Path:
    """Write images on two topics, and a message of a type whose definition is no definition."""
    is_ros1 = path.suffix == ".bag"
    store = typestore(is_ros1=is_ros1)
    writer: Any
    if is_ros1:
        writer, foreign = Writer1(path), {"msgdef": _FOREIGN, "md5sum": "0" * 32}
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path.with_suffix(""), version=8, storage_plugin=plugin)
        foreign = {"msgdef": _FOREIGN, "rihs01": "RIHS01_" + "0" * 64}
    with writer:
        foreign_connection = writer.add_connection("/foreign", "a/msg/B", **foreign)
        connections = [
            writer.add_connection(name, IMAGE_TYPE, typestore=store) for name in ("/a", "/b")
        ]
        for n in range(_N):
            writer.write(foreign_connection, n, b"\x00\x01\x00\x00\x05\x06\x07\x08")
            for connection in connections:
                message = _image(n, is_ros1=is_ros1)
                serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
                writer.write(connection, n, serialize(message, IMAGE_TYPE))
    return path if is_ros1 or not path.suffix else path.with_suffix("") / path.name


@_KINDS
def test_messages_of_wanted_topics_come_whatever_else_the_bag_holds(
    tmp_path: Path, name: str
) -> None:
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


@_KINDS
def test_a_bag_can_be_read_again_and_again(tmp_path: Path, name: str) -> None:
    reader = BagReader(_write(tmp_path / name))
    assert next(reader.messages(["/b"])).log_time_ns == 0
    assert len(list(reader.messages(["/a", "/b"]))) == 2 * _N
    assert list(reader.messages(["/none"])) == []


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        # as where the reader announces messages and yields none
        (lambda text: text.replace(IMAGE_TYPE, "sensor_msgs/Image"), "does not fit the files"),
        (lambda text: text.replace("profiles: ''", "profiles: '- depth: 7'"), "malformed"),
        (lambda text: text[: len(text) // 2], "malformed"),
        (lambda text: "", "malformed"),
        (None, "missing"),
    ],
)
def test_a_folder_whose_metadata_are_of_no_use_is_read_without_them(
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
    (note,) = reader.notes
    assert reason in note
    assert note.endswith("read folder.db3 without it")


def test_a_message_that_is_not_of_its_type_is_refused() -> None:
    topic = Topic(name="/a", type=IMAGE_TYPE, n_messages=1)
    for is_ros1 in (False, True):
        for data in (b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00" + b"\xff" * 40):
            message = BagMessage(topic=topic, log_time_ns=0, data=data, is_ros1=is_ros1)
            with pytest.raises(RecordingError, match=f"/a: a message of {len(data)} bytes"):
                message.decode()


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_bag_is_refused_in_one_line(tmp_path: Path, name: str, share: float) -> None:
    path = _write(tmp_path / name)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError) as caught:
        list(BagReader(path).messages(["/a", "/b"]))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder/metadata.yaml"])
def test_flipped_bytes_are_refused_in_one_line_or_do_not_matter(tmp_path: Path, name: str) -> None:
    whole = _write(tmp_path / name.partition("/")[0])
    path = whole / "metadata.yaml" if whole.is_dir() else whole
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    faults = []
    for _ in range(60):
        spoilt = bytearray(data)
        for position in rng.integers(0, len(data), 8):
            spoilt[position] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(spoilt))
        faults.append(_read_all(whole))
    # the files inside say all that the metadata do
    assert any(faults) is not name.startswith("folder")
    assert not any("\n" in fault for fault in faults if fault)


def _read_all(path: Path) -> str | None:
    try:
        for message in BagReader(path).messages(["/a", "/b"]):
            message.decode()
    except RecordingError as error:
        return str(error)
    return None


def test_a_database_without_tables_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE other (id INTEGER)")
    connection.close()
    with pytest.raises(RecordingError, match=r"a\.db3"):
        BagReader(path)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"metadata\.yaml"):
        BagReader(tmp_path)
