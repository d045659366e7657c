"""Files of whole lines: a group of lines is there or not, and what is there stays."""

import io
from pathlib import Path
from typing import Any

import pytest

from gvo.errors import RecordingError, RunBusyError
from gvo.io.run_folder.line_file import PartFile, append_whole, replace_text


class SmallDisk(io.FileIO):
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


def test_a_file_is_written_by_one_run_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    first, other = PartFile(path), PartFile(tmp_path / "other.mcap")
    with pytest.raises(RunBusyError, match=r"run\.mcap: another process is writing it"):
        PartFile(path)
    for file in (first, other):
        file.part.write_bytes(b"whole")
    with other.discarded():
        assert other.part.read_bytes() == b""
    with first.completed(is_kept=True):
        pass
    assert [each.name for each in tmp_path.iterdir()] == ["run.mcap"]
    with pytest.raises(RecordingError, match="exists already"):
        PartFile(path)


def test_a_text_is_replaced_whole_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "summary.json"
    replace_text(path, "first")
    with monkeypatch.context() as patch:
        patch.setattr("gvo.io.run_folder.line_file.io.FileIO", SmallDisk)
        with pytest.raises(OSError, match="No space"):
            replace_text(path, "x" * 1000)
    assert path.read_text() == "first"
    assert [each.name for each in tmp_path.iterdir()] == ["summary.json"]
