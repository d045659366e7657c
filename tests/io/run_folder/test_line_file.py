"""Files of whole lines: a group of lines is there or not, and what is there stays."""

import io
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import ResumeError
from gvo.io.run_folder.line_file import (
    LineFile,
    RewrittenFile,
    append_whole,
    cut_torn_line,
    replace_text,
)

HEADER = "stamp,x\n"
LINES = [f"{n},{n * n}\n" for n in range(8)]


class SmallDisk(io.FileIO):
    """A file that takes a few bytes at a time, and no more than there is room for."""

    room = 100

    def write(self, data: Any) -> int:
        n = min(7, len(data), self.room - self.seek(0, io.SEEK_END))
        if n <= 0:
            raise OSError(28, "No space left on device")
        return super().write(bytes(data)[:n]) or 0


def test_what_fits_is_written_whole_and_what_does_not_not_at_all(tmp_path: Path) -> None:
    with SmallDisk(tmp_path / "file", "ab") as file:
        append_whole(file, b"a" * 60)
        with pytest.raises(OSError, match="No space"):
            append_whole(file, b"b" * 60)
        assert (tmp_path / "file").read_bytes() == b"a" * 60
        append_whole(file, b"c" * 40)
    assert (tmp_path / "file").read_bytes() == b"a" * 60 + b"c" * 40


@given(content=st.binary(max_size=50), n_long=st.sampled_from([0, 70_000, 200_000]))
def test_what_follows_the_last_line_feed_is_cut_off(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, n_long: int
) -> None:
    path = tmp_path_factory.mktemp("cut") / "file"
    content += b"y" * n_long
    path.write_bytes(content)
    cut_torn_line(path)
    assert path.read_bytes() == content[: content.rfind(b"\n") + 1]


@pytest.mark.parametrize("n_bytes", [0, 3, 8, 12, 20, 33, 1000])
def test_lines_that_are_there_are_not_written_again(tmp_path: Path, n_bytes: int) -> None:
    path = tmp_path / "file"
    whole = (HEADER + "".join(LINES)).encode()
    there = whole.replace(b",4", b",5")  # as another machine would have written it
    path.write_bytes(there[:n_bytes])
    file = LineFile(path, HEADER, goes_on=True)
    file.write("".join(LINES[:3]))
    for line in LINES[3:]:
        file.write(line)
    file.close()
    n_kept = there[:n_bytes].rfind(b"\n") + 1
    assert path.read_bytes() == there[:n_kept] + whole[n_kept:]


def test_a_file_that_does_not_go_on_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old\n")
    file = LineFile(path, HEADER)
    file.write(LINES[0])
    file.close()
    assert path.read_text() == HEADER + LINES[0]


def test_lines_of_other_stamps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text(HEADER + LINES[0] + LINES[2])
    file = LineFile(path, HEADER, goes_on=True)
    with pytest.raises(ResumeError, match="holds '2' where 1 was written"):
        file.write("".join(LINES))
    file.close()
    assert path.read_text() == HEADER + LINES[0] + LINES[2]
    with pytest.raises(ResumeError, match="does not begin as expected"):
        LineFile(path, "other\n", goes_on=True)


def test_a_rewritten_file_holds_what_was_written_as_it_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    before = HEADER + "2,two\n" + "0,zero\n" + "5,provisional\n" + "6,to"
    path.write_text(before)
    file = RewrittenFile(path, HEADER)
    file.write(LINES[0])
    file.write(LINES[1])
    file.write(LINES[2])
    assert path.read_text() == before
    file.settle()
    file.write(LINES[5])
    file.close()
    assert path.read_text() == HEADER + "0,zero\n" + LINES[1] + "2,two\n" + LINES[5]
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_rewritten_file_that_does_not_settle_is_as_before(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text(HEADER + LINES[0])
    file = RewrittenFile(path, HEADER)
    file.write(LINES[3])
    file.close()
    assert path.read_text() == HEADER + LINES[0]
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_text_is_replaced_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "summary.json"
    replace_text(path, "first")
    with monkeypatch.context() as patch:
        patch.setattr("gvo.io.run_folder.line_file.io.FileIO", SmallDisk)
        with pytest.raises(OSError, match="No space"):
            replace_text(path, "x" * 1000)
    assert path.read_text() == "first"
    assert [each.name for each in tmp_path.iterdir()] == ["summary.json"]
