"""Whatever is cut from a bag or changed in it: the rest is read, and what is lost is said."""

import struct
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import RecordingError
from gvo.io.bag.file import BagFile
from gvo.io.bag.recovery.mcap import McapScan
from gvo.io.bag.recovery.ros1 import Ros1Scan
from gvo.io.bag.recovery.scan import Scan
from tests.io.bag.recovery.bags import (
    TOPICS,
    Message,
    contents,
    damaged,
    open_mcap,
    write,
)

_MESSAGES = contents(20)
_ALL = list(range(len(_MESSAGES)))
_CLOSED = ("none.bag", "bz2.bag", "lz4.bag", "plain.mcap", "storage.mcap")
_OPEN_AS = {"flat.mcap": None, "none.mcap": "", "lz4.mcap": "lz4", "zstd.mcap": "zstd"}
_OPEN = tuple(_OPEN_AS)
_KINDS = (*_CLOSED, *_OPEN)
_DATABASE = "base.db3"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a whole bag of each kind."""
    folder = tmp_path_factory.mktemp("bags")
    found = {}
    for name in (*_CLOSED, _DATABASE):
        compression = name.partition(".")[0].upper()
        compression = "" if compression in ("NONE", "PLAIN", "BASE") else compression
        found[name] = write(folder / name, _MESSAGES, compression)
    for name, packed in _OPEN_AS.items():
        found[name] = folder / name
        found[name].write_bytes(open_mcap(_MESSAGES, packed))
    return found


def _scan(path: Path) -> Scan:
    return Ros1Scan(path) if path.suffix == ".bag" else McapScan(path)


_FOREIGN = -1


def _read(bag: BagFile | Scan, written: Sequence[Message] = _MESSAGES) -> list[int]:
    """Return which of the messages come, by number."""
    numbers = {message: n for n, message in enumerate(written)}
    found = [(m.topic.name, m.log_time_ns, m.data) for m in bag.messages(TOPICS)]
    return [numbers.get(message, _FOREIGN) for message in found]


def _try(path: Path, written: Sequence[Message] = _MESSAGES) -> tuple[list[int], str] | None:
    """Return the messages and what is lost; nothing where the file is refused in one line."""
    try:
        bag = BagFile(path)
    except RecordingError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert refusal.startswith(str(path))
        assert "\n" not in refusal
        return None
    messages = _read(bag, written)
    assert "\n" not in bag.damage
    return messages, bag.damage


def _records_of_mcap(data: bytes) -> Iterator[int]:
    position = 8
    while position + 9 <= len(data):
        yield position
        position += 9 + struct.unpack_from("<Q", data, position + 1)[0]


def _records_of_ros1(data: bytes) -> Iterator[int]:
    position = 13
    while position + 4 <= len(data):
        yield position
        position += 4 + struct.unpack_from("<I", data, position)[0]
        position += 4 + struct.unpack_from("<I", data, position)[0]


@pytest.mark.parametrize("name", _KINDS)
def test_the_walk_finds_all_messages_in_their_order(bags: dict[str, Path], name: str) -> None:
    scan = _scan(bags[name])
    assert _read(scan) == _ALL
    assert scan.damage == ""
    assert {channel.name: n for channel, n in scan.counts.items()} == {"/a": 10, "/b": 10}
    assert scan.start_time_ns == 0


@pytest.mark.parametrize("name", _KINDS)
def test_of_a_bag_cut_at_a_record_the_start_is_read(bags: dict[str, Path], name: str) -> None:
    data = bags[name].read_bytes()
    walk = _records_of_ros1 if name.endswith(".bag") else _records_of_mcap
    for position in walk(data):
        for n_bytes in (position - 1, position, position + 5):
            _check_cut(bags[name], min(n_bytes, len(data) - 1))


def _check_cut(path: Path, n_bytes: int) -> None:
    found = _try(damaged(path, lambda data: data[:n_bytes]))
    if found is None:
        return
    messages, damage = found
    assert messages == _ALL[: len(messages)]
    ends_with_a_record = path.suffix == ".mcap" and n_bytes in {
        *_records_of_mcap(path.read_bytes())
    }
    if len(messages) < len(_MESSAGES) and not ends_with_a_record:
        # Where no record is cut, nothing tells an MCAP file from one that was never longer.
        assert damage


@pytest.mark.parametrize("name", ["none.mcap", "lz4.mcap", "zstd.mcap"])
def test_a_chunk_that_its_checksum_contradicts_is_left_out(
    bags: dict[str, Path], name: str
) -> None:
    chunks = [p for p in _records_of_mcap(bags[name].read_bytes()) if _op(bags[name], p) == 6]
    found = _try(damaged(bags[name], _flipper({chunks[2] - 60: 1})))
    assert found is not None
    messages, damage = found
    assert messages == [n for n in _ALL if n not in (3, 4, 5)]
    assert "cannot be read" in damage


def _op(path: Path, position: int) -> int:
    return path.read_bytes()[position]


def _flipper(changes: dict[int, int]) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        return bytes(value ^ changes.get(n, 0) for n, value in enumerate(data))

    return change


@pytest.mark.parametrize("name", ["none.bag", "bz2.bag", "lz4.bag", "plain.mcap", "storage.mcap"])
def test_a_chunk_that_is_lost_costs_no_other(bags: dict[str, Path], name: str) -> None:
    whole = bags[name].read_bytes()
    walk = _records_of_ros1 if name.endswith(".bag") else _records_of_mcap
    mark = b"op=\x05" if name.endswith(".bag") else b"\x06"
    chunks = [p for p in walk(whole) if mark in whole[p : p + 40 if mark[0] == 111 else p + 1]]
    all_lost: list[int] = []
    for start in chunks[1:-1]:
        # the start of it, with all that is said of it, and of what is in it
        found = _try(damaged(bags[name], partial(_zeros, start=start, n_bytes=90)))
        assert found is not None
        messages, damage = found
        lost = sorted(set(_ALL) - set(messages))
        assert lost == list(range(lost[0], lost[0] + len(lost)))
        assert 1 <= len(lost) <= 4
        assert messages == sorted(set(messages) & set(_ALL))
        assert "cannot be read" in damage
        all_lost += lost
    assert sorted(set(all_lost)) == sorted(all_lost)


def _zeros(data: bytes, start: int, n_bytes: int) -> bytes:
    return data[:start] + bytes(n_bytes) + data[start + n_bytes :]


def test_an_index_without_use_costs_no_message(bags: dict[str, Path]) -> None:
    for name in ("none.bag", "bz2.bag", "plain.mcap"):
        whole = bags[name].read_bytes()
        start = (
            struct.unpack_from("<Q", whole, whole.index(b"index_pos=") + 10)[0]
            if (name.endswith(".bag"))
            else len(whole) - 300
        )
        bag = BagFile(damaged(bags[name], partial(_zeros, start=start, n_bytes=200)))
        assert _read(bag) == _ALL
        assert bag.damage == ""
        assert "is read without its index" in bag.note


def _without_index(data: bytes, tail: bytes = b"") -> bytes:
    """Return a ROS 1 bag as a recorder leaves it that was killed."""
    place = data.index(b"index_pos=") + len("index_pos=")
    end = struct.unpack_from("<Q", data, place)[0]
    head = data[:4096]
    for name in (b"conn_count=", b"chunk_count="):
        at = head.index(name) + len(name)
        head = head[:at] + bytes(4) + head[at + 4 :]
    head = head[:place] + bytes(8) + head[place + 8 :]
    return head + data[len(head) : end] + tail


@pytest.mark.parametrize("name", _CLOSED[:3])
def test_a_chunk_that_was_never_closed_is_read(bags: dict[str, Path], name: str) -> None:
    whole = _without_index(bags[name].read_bytes())
    start = [p for p in _records_of_ros1(whole) if b"op=\x05" in whole[p : p + 40]][-1]
    n_header = struct.unpack_from("<I", whole, start)[0]
    n_data = struct.unpack_from("<I", whole, start + 4 + n_header)[0]
    at = start + 4 + n_header
    size = whole.index(b"size=", start) + 5
    file = (
        whole[:size] + bytes(4) + whole[size + 4 : at] + bytes(4) + whole[at + 4 : at + 4 + n_data]
    )
    assert _read(BagFile(damaged(bags[name], lambda _: file))) == _ALL


def test_messages_that_the_index_gave_are_not_given_again(tmp_path: Path) -> None:
    # The reader stops at the fourth: it sees that they are not sorted.
    shuffled = [n for n in (0, 1, 5, 3, 2, 6, 4) for _ in range(2)]
    twice = [_MESSAGES[n] for n in shuffled]
    path = tmp_path / "flat.mcap"
    path.write_bytes(open_mcap(twice, None) + b"\x0f" + struct.pack("<QI", 4, 0))
    path.write_bytes(path.read_bytes() + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0))
    path.write_bytes(path.read_bytes() + b"\x89MCAP0\r\n")
    bag = BagFile(path)
    assert bag.note == ""
    assert _read(bag) == shuffled
    assert bag.damage == ""


def test_mcap_holds_messages_of_ros1_too(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(open_mcap(_MESSAGES, "lz4", encoding="ros1"))
    assert all(message.topic.is_ros1 for message in BagFile(path).messages(TOPICS))


def test_a_log_that_is_not_part_of_a_database_is_told(bags: dict[str, Path]) -> None:
    path = damaged(bags[_DATABASE], bytes)
    path.with_name(f"{path.name}-wal").write_bytes(b"0123456789")
    bag = BagFile(path)
    assert _read(bag) == _ALL
    assert "the 10 bytes of" in bag.damage
    path.with_name(f"{path.name}-wal").unlink()


@given(data=st.data())
def test_a_database_cut_anywhere_is_refused(bags: dict[str, Path], data: st.DataObject) -> None:
    n_bytes = data.draw(st.integers(16, bags[_DATABASE].stat().st_size - 1))
    with pytest.raises(RecordingError, match=r"sqlite3 FILE \.recover"):
        BagFile(damaged(bags[_DATABASE], lambda whole: whole[:n_bytes]))


def test_pages_of_a_database_that_are_lost_are_told(tmp_path: Path) -> None:
    written = contents(200)
    path = write(tmp_path / "a.db3", written)
    n_pages = path.stat().st_size // 4096
    for page in range(1, n_pages):
        found = _try(damaged(path, partial(_fill_page, start=4096 * page)), written)
        if found is None:
            continue
        messages, damage = found
        assert messages == sorted(set(messages))
        assert len(messages) == len(written) or "`sqlite3 FILE .recover`" in damage


def _fill_page(data: bytes, start: int) -> bytes:
    return data[:start] + b"\xff" * 4096 + data[start + 4096 :]


def _check_memory(path: Path) -> None:
    tracemalloc.start()
    messages = _read(_scan(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert messages[: len(_ALL)] == _ALL
    assert peak < 4_000_000


@pytest.mark.parametrize("op", range(1, 16))
def test_a_claimed_size_is_not_allocated_in_mcap(tmp_path: Path, op: int) -> None:
    path = tmp_path / "a.mcap"
    good, huge = open_mcap(_MESSAGES, "lz4"), struct.pack("<Q", 2**64 - 1)
    # the record itself; a string, a list, the data of a chunk, all longer than their record
    contents = [bytes(n_bytes) + huge + b"\xff" * 100 for n_bytes in range(0, 60, 12)]
    records = [struct.pack("<Q", len(content)) + content for content in contents]
    for record in (huge + bytes(200), *records):
        path.write_bytes(good + bytes([op]) + record)
        _check_memory(path)


@pytest.mark.parametrize("op", range(2, 8))
@pytest.mark.parametrize("compression", [b"none", b"lz4"])
def test_a_claimed_size_is_not_allocated_in_ros1(
    bags: dict[str, Path], op: int, compression: bytes
) -> None:
    number = struct.pack("<I", 2**32 - 1)
    names = (b"conn=", b"count=", b"size=", b"index_pos=", b"chunk_count=")
    fields = [b"op=" + bytes([op]), b"compression=" + compression, b"time=" + 2 * number]
    fields += [name + number for name in names]
    header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    head = struct.pack("<I", len(header)) + header
    for record in (head + number, head + struct.pack("<I", 100), number + header):
        tail = record + b"\xff" * 200
        _check_memory(damaged(bags["lz4.bag"], partial(_without_index, tail=tail)))


def test_a_chunk_that_inflates_without_end_is_stopped(tmp_path: Path) -> None:
    bomb = [("/a", n, bytes(1_000_000)) for n in range(3)]
    good = open_mcap(_MESSAGES, "zstd", has_crc=False)
    file = open_mcap(bomb, "zstd", has_crc=False)
    chunk = next(p for p in _records_of_mcap(file) if file[p] == 6)
    end = chunk + 9 + struct.unpack_from("<Q", file, chunk + 1)[0]
    record = bytearray(file[chunk:end])
    record[9 + 16 : 9 + 24] = struct.pack("<Q", 5000)
    path = tmp_path / "a.mcap"
    path.write_bytes(good + bytes(record))
    _check_memory(path)
    assert "more than 5000 bytes" in McapScan(path).damage
