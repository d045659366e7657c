"""Text tables and stamps."""

from pathlib import Path

import pytest

from gvo.errors import RecordingError
from gvo.io.datasets.files import read_rows, read_stamped_rows


def test_stamps_are_read_without_loss(tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    path.write_text("1305031102.175304001 a\n1.037875e-01 b\n0 c\n")
    rows = read_stamped_rows(path, unit_ns=10**9)
    assert rows == [(1305031102175304001, "a"), (103_787_500, "b"), (0, "c")]
    path.write_text("4611686018427387903,a\n")
    assert read_stamped_rows(path, unit_ns=1, separator=",") == [(4611686018427387903, "a")]


@pytest.mark.parametrize("text", ["nan", "inf", "1,5", "stamp", "1e40", "1e999999999999"])
def test_what_is_no_stamp_is_refused_by_its_place(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    path.write_text(f"# comment\n1.0 a\n{text} b\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt, line 3"):
        read_stamped_rows(path, unit_ns=10**9)


def test_comments_and_empty_lines_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes(b"\xef\xbb\xbf# stamp file\r\n\r\n1.0 a b\r\n2.0  c\r\n")
    assert list(read_rows(path, n_fields=2)) == [(3, ["1.0", "a", "b"]), (4, ["2.0", "c"])]


def test_a_short_row_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("#stamp,file\n1,a.png\n2\n")
    with pytest.raises(RecordingError, match="line 3: expected 2 fields, got 1"):
        list(read_rows(path, n_fields=2, separator=","))


@pytest.mark.parametrize("content", [b"", b"# nothing\n", b"\xff\xfe\x00"])
def test_an_empty_table_or_one_that_is_no_text_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"table\.txt"):
        list(read_rows(path, n_fields=1))
    with pytest.raises(RecordingError, match="No such file"):
        list(read_rows(tmp_path / "none.txt", n_fields=1))
