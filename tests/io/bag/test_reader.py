"""Bags of all kinds, good and broken, read by topic."""

import sqlite3
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from gvo.errors import RecordingError
from gvo.io.bag.file import BagFile
from gvo.io.bag.reader import BagMessage, BagReader, typestore
from gvo.io.bag.recovery.scan import FoundMessage
from gvo.io.bag.topics import IMAGE_TYPE, Topic

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


@_KINDS
def test_a_bag_can_be_read_again_and_again(tmp_path: Path, name: str) -> None:
    reader = BagReader(_write(tmp_path / name))
    assert next(reader.messages(["/b"])).log_time_ns == 0
    assert len(list(reader.messages(["/a", "/b"]))) == 2 * _N
    assert list(reader.messages(["/none"])) == []


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


def _split(folder: Path, suffix: str, mode: CompressionMode = CompressionMode.NONE) -> Path:
    """Write a folder of three files, each with messages of its own second."""
    folder.mkdir()
    names = []
    for n in range(3):
        plugin = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(folder / f"part_{n}", version=9, storage_plugin=plugin)
        if mode is not CompressionMode.NONE:
            writer.set_compression(mode, CompressionFormat.ZSTD)
        store = typestore(is_ros1=False)
        with writer:
            connection = writer.add_connection("/a", IMAGE_TYPE, typestore=store)
            for k in range(_N):
                message = store.serialize_cdr(_image(k, is_ros1=False), IMAGE_TYPE)
                writer.write(connection, 10 * n + k, message)
        for file in (folder / f"part_{n}").glob(f"part_*{suffix}*"):
            names.append(file.name)
            file.rename(folder / file.name)
    files = [{"path": name, "message_count": _N} for name in names]
    information = {"relative_file_paths": names, "files": files}
    (folder / "metadata.yaml").write_text(
        yaml.safe_dump({"rosbag2_bagfile_information": information})
    )
    return folder


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
@pytest.mark.parametrize("mode", ["NONE", "FILE", "MESSAGE"])
def test_a_split_folder_is_read_compressed_or_not(tmp_path: Path, suffix: str, mode: str) -> None:
    reader = BagReader(_split(tmp_path / "bag", suffix, CompressionMode[mode]))
    messages = list(reader.messages(["/a"]))
    assert [m.log_time_ns for m in messages] == [10 * n + k for n in range(3) for k in range(_N)]
    assert [m.decode().header.stamp.sec for m in messages] == [*range(_N)] * 3
    assert reader.damage == ""
    assert reader.notes == []


@pytest.mark.parametrize("mode", ["NONE", "FILE"])
def test_a_file_of_a_folder_that_is_missing_is_told(tmp_path: Path, mode: str) -> None:
    folder = _split(tmp_path / "bag", ".mcap", CompressionMode[mode])
    (lost,) = folder.glob("part_1.mcap*")
    lost.unlink()
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == 2 * _N
    assert reader.damage == f"{lost}: is missing ({_N} messages); copy it anew"


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


def test_a_compressed_file_that_is_cut_is_told_by_its_own_name(tmp_path: Path) -> None:
    folder = _split(tmp_path / "bag", ".mcap", CompressionMode.FILE)
    path = folder / "part_2.mcap.zstd"
    path.write_bytes(path.read_bytes()[:-20])
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) >= 2 * _N
    assert reader.damage.startswith(f"{path}: is cut or damaged (its end is missing)")


def test_a_file_that_the_metadata_do_not_name_is_left_out(tmp_path: Path) -> None:
    folder = _split(tmp_path / "bag", ".mcap")
    (folder / "stray.mcap").write_bytes((folder / "part_0.mcap").read_bytes())
    reader = BagReader(folder)
    assert len(list(reader.messages(["/a"]))) == 3 * _N
    assert reader.notes == ["bag: stray.mcap is left out: metadata.yaml does not name it"]


_WRITTEN = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 2)), min_size=3, max_size=20)


@settings(max_examples=10)
@given(written=_WRITTEN)
def test_several_bags_are_merged_by_the_time_of_recording(
    tmp_path_factory: pytest.TempPathFactory, written: list[tuple[int, int]]
) -> None:
    folder = tmp_path_factory.mktemp("bags")
    names = ("a.bag", "b.mcap", "c.db3")
    paths = [
        _write_counted(folder / name, sorted(t for t, file in written if file == n))
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


def _write_counted(path: Path, log_times_ns: list[int]) -> Path:
    is_ros1 = path.suffix == ".bag"
    store = typestore(is_ros1=is_ros1)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    writer: Any = Writer1(path) if is_ros1 else Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        connection = writer.add_connection("/a", IMAGE_TYPE, typestore=store)
        for n, log_time_ns in enumerate(log_times_ns):
            message = _image(n, is_ros1=is_ros1)
            serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(connection, log_time_ns, serialize(message, IMAGE_TYPE))
    return path if is_ros1 else folder / path.name


def test_one_bag_per_camera_gives_the_topics_of_both(tmp_path: Path) -> None:
    paths = [_write(tmp_path / name) for name in ("a.bag", "b.bag")]
    reader = BagReader(paths)
    assert {topic.name: topic.n_messages for topic in reader.topics} == {
        "/foreign": 2 * _N,
        "/a": 2 * _N,
        "/b": 2 * _N,
    }
    times = [message.log_time_ns for message in reader.messages(["/a"])]
    assert times == [n for n in range(_N) for _ in paths]


def test_a_file_is_opened_when_it_is_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = BagReader(_split(tmp_path / "bag", ".mcap"))
    opened: list[str] = []
    original = BagFile.messages

    def messages(file: BagFile, names: Collection[str]) -> Iterator[FoundMessage]:
        opened.append(file.path.name)
        yield from original(file, names)

    monkeypatch.setattr(BagFile, "messages", messages)
    n_opened = [len(opened) for _ in reader.messages(["/a"])]
    assert n_opened == [1] * _N + [2] * _N + [3] * _N


def test_no_path_is_misuse() -> None:
    with pytest.raises(ValueError, match="at least one"):
        BagReader([])


def test_a_message_that_is_not_of_its_type_is_refused() -> None:
    topic = Topic(name="/a", type=IMAGE_TYPE, n_messages=1)
    for is_ros1 in (False, True):
        for data in (b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00" + b"\xff" * 40):
            message = BagMessage(topic=topic, log_time_ns=0, data=data, is_ros1=is_ros1)
            with pytest.raises(RecordingError, match=f"/a: a message of {len(data)} bytes"):
                message.decode()


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_bag_is_read_or_a_line(tmp_path: Path, name: str, share: float) -> None:
    path = _write(tmp_path / name)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    said = _read_all(path)
    if said is None:
        (said,) = BagReader(path).notes
    assert path.name in said
    assert "\n" not in said


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
    # the files inside say all that the metadata do, but for what their names are
    assert any(fault and "is missing" not in fault for fault in faults) is (
        not name.startswith("folder")
    )
    assert not any("\n" in fault for fault in faults if fault)


def _read_all(path: Path) -> str | None:
    try:
        reader = BagReader(path)
        for message in reader.messages(["/a", "/b"]):
            message.decode()
    except RecordingError as error:
        return str(error)
    return reader.damage or None


def test_the_name_of_a_database_may_hold_any_character(tmp_path: Path) -> None:
    path = tmp_path / "a#b?c%20 ü.db3"
    path.write_bytes(_write(tmp_path / "a.db3").read_bytes())
    assert _read_all(path) is None


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
