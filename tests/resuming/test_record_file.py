"""A file of records gives back what is whole, and nothing else, however it ends."""

import struct
import subprocess
import sys
import tempfile
import tracemalloc
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import ResumeError, RunBusyError
from gvo.resuming.record_file import MAX_RECORD, RecordFile, refuse_busy

PAYLOADS = [b"first", b"", b"x" * 1000, bytes(range(256))]


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("records") / "file"
    with RecordFile(path, is_new=True) as file:
        for payload in PAYLOADS:
            file.append(payload)
    return path.read_bytes()


def read(path: Path) -> list[bytes]:
    with RecordFile(path, is_new=False) as file:
        return [payload for _, payload in file.records()]


def test_whole_records_are_read_from_a_file_cut_off_anywhere(
    content: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "file"
    n_before = 0
    for length in range(len(content) + 1):
        path.write_bytes(content[:length])
        found = read(path)
        assert found == PAYLOADS[: len(found)]
        assert n_before <= len(found)
        n_before = len(found)
    assert n_before == len(PAYLOADS)


@given(st.data())
def test_nothing_after_a_damaged_byte_is_read(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        with RecordFile(path, is_new=True) as file:
            for payload in PAYLOADS:
                file.append(payload)
        damaged = bytearray(path.read_bytes())
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
        path.write_bytes(damaged)
        found = read(path)
    assert found == PAYLOADS[: len(found)]
    assert len(found) < len(PAYLOADS)


def test_a_record_that_claims_to_be_huge_takes_no_memory(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content + struct.pack("<II", 2**31, 0) + b"y" * 100)
    tracemalloc.start()
    assert read(path) == PAYLOADS
    assert tracemalloc.get_traced_memory()[1] < 4 * MAX_RECORD
    tracemalloc.stop()


def test_what_follows_the_last_good_record_is_cut_off(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(content + b"torn")
    with RecordFile(path, is_new=False) as file:
        end = [end for end, _ in file.records()][-1]
        assert file.cut(end) == 4
        file.append(b"next")
    assert read(path) == [*PAYLOADS, b"next"]


def test_a_record_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with (
        RecordFile(tmp_path / "file", is_new=True) as file,
        pytest.raises(ValueError, match="at most"),
    ):
        file.append(b"x" * (MAX_RECORD + 1))


def test_a_file_is_open_once(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with RecordFile(path, is_new=True), pytest.raises(ResumeError, match="another process"):
        RecordFile(path, is_new=False)
    RecordFile(path, is_new=False).close()


def test_the_check_sum_is_that_of_the_payload(content: bytes) -> None:
    assert struct.pack("<II", 5, zlib.crc32(b"first")) + b"first" in content


# Holds a file of records until its standard input ends.
_HOLDER = """
import sys
from pathlib import Path
from gvo.resuming.record_file import RecordFile
with RecordFile(Path(sys.argv[1]), is_new=True) as file:
    file.append(b"mine")
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_a_file_that_another_process_has_is_busy_until_that_ends(tmp_path: Path) -> None:
    path = tmp_path / "file"
    command = [sys.executable, "-c", _HOLDER, str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as holder:
        assert holder.stdout is not None
        try:
            assert holder.stdout.readline() == "ready\n"
            for _ in range(2):
                with pytest.raises(RunBusyError, match=f"^{tmp_path}: another process is writing"):
                    refuse_busy(path)
                with pytest.raises(RunBusyError):
                    RecordFile(path, is_new=False)
        finally:
            holder.kill()
            holder.communicate()
    refuse_busy(path)
    assert read(path) == [b"mine"]


def test_a_file_that_nobody_has_is_not_busy(content: bytes, tmp_path: Path) -> None:
    refuse_busy(tmp_path / "none")
    refuse_busy(tmp_path)
    path = tmp_path / "file"
    path.write_bytes(content)
    for _ in range(2):
        refuse_busy(path)
    assert path.read_bytes() == content
    with RecordFile(path, is_new=False) as file:
        assert len(list(file.records())) == len(PAYLOADS)
