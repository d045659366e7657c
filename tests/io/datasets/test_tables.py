"""Text tables and stamps."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import RecordingError
from gvo.io.datasets.files import read_rows, read_stamp


@given(stamp_ns=st.integers(0, 2**62))
def test_nine_decimals_of_seconds_are_exact(stamp_ns: int) -> None:
    text = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    assert read_stamp(text, "row", unit_ns=10**9) == stamp_ns
    assert read_stamp(str(stamp_ns), "row", unit_ns=1) == stamp_ns


def test_exponents_are_understood() -> None:
    assert read_stamp("1.037875e-01", "row", unit_ns=10**9) == 103_787_500
    assert read_stamp("0", "row", unit_ns=10**9) == 0


@pytest.mark.parametrize("text", ["", "nan", "inf", "1,5", "stamp", "1e40", "1e999999999999"])
def test_what_is_no_stamp_is_refused_by_its_place(text: str) -> None:
    with pytest.raises(RecordingError, match=r"rgb\.txt, line 3"):
        read_stamp(text, "rgb.txt, line 3", unit_ns=10**9)


def test_comments_and_empty_lines_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes(b"\xef\xbb\xbf# stamp file\r\n\r\n1.0 a b\r\n2.0  c\r\n")
    assert read_rows(path, n_fields=2) == [(3, ["1.0", "a", "b"]), (4, ["2.0", "c"])]


def test_a_short_row_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("#stamp,file\n1,a.png\n2\n")
    with pytest.raises(RecordingError, match="line 3: expected 2 fields, got 1"):
        read_rows(path, n_fields=2, separator=",")


@pytest.mark.parametrize("content", [b"", b"# nothing\n", b"\xff\xfe\x00"])
def test_an_empty_table_or_one_that_is_no_text_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"table\.txt"):
        read_rows(path, n_fields=1)
    with pytest.raises(RecordingError, match="missing"):
        read_rows(tmp_path / "none.txt", n_fields=1)
