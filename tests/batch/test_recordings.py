"""Every recording that is asked for is found once, under a name of its own."""

import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.batch import find_recordings
from gvo.errors import RecordingError

OWN_FILES = ("batch.json", "report.html", "results.csv")


def make_files(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def test_paths_are_kept_in_their_order_each_once(tmp_path: Path) -> None:
    make_files(tmp_path, "b.bag", "a.mcap")
    asked: list[str | Path] = [tmp_path / "b.bag", tmp_path / "a.mcap", f"{tmp_path}/./b.bag"]
    found = find_recordings(asked)
    assert [*found.items()] == [("b", f"{tmp_path}/b.bag"), ("a", f"{tmp_path}/a.mcap")]


def test_a_folder_is_searched_for_recordings_of_every_kind(tmp_path: Path) -> None:
    bags = ["x.bag", "x.db3", "x.mcap", "x.mcap.zstd", "deep/er/y.bag"]
    folders = {
        "ros2": "metadata.yaml",
        "kitti": "calib.txt",
        "kitti2": "times.txt",
        "euroc": "mav0/cam0/data.csv",
        "asl": "cam0/data.csv",
        "tum": "rgb.txt",
    }
    make_files(tmp_path, *bags, "notes.md", ".hidden/z.bag", "other/image.png")
    for folder, marker in folders.items():
        make_files(tmp_path / folder, marker, "inside.db3")
    found = find_recordings([tmp_path]).values()
    assert sorted(found) == sorted(str(tmp_path / name) for name in [*bags, *folders])


def test_the_files_of_a_bag_folder_are_no_recordings_of_their_own(tmp_path: Path) -> None:
    make_files(tmp_path, "drive/metadata.yaml", "drive/drive_0.db3", "drive/drive_1.db3")
    make_files(tmp_path, "drive-2/metadata.yaml", "drive-2/drive_0.db3")
    assert [*find_recordings([tmp_path])] == ["drive", "drive-2"]


def test_a_list_has_one_recording_a_line(tmp_path: Path) -> None:
    make_files(tmp_path, "in/a.bag", "in/b#1.bag", "more/c.bag", "more/d.mcap")
    (tmp_path / "in" / "list.txt").write_bytes(
        b"\xef\xbb\xbf# recordings\r\na.bag\r\n\r\n  b#1.bag   # a comment\n../more\n/not/here.bag"
    )
    found = find_recordings([tmp_path / "in" / "list.txt"]).values()
    places = ["in/a.bag", "in/b#1.bag", "more/c.bag", "more/d.mcap"]
    assert [*found] == [*(str(tmp_path / place) for place in places), "/not/here.bag"]
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(RecordingError, match=r"list\.txt: is no text file"):
        find_recordings([tmp_path / "list.txt"])


def test_what_of_a_list_leads_to_no_recording_is_named_with_its_line(tmp_path: Path) -> None:
    make_files(tmp_path, "a.bag", "empty/readme.md")
    (tmp_path / "list.txt").write_text("a.bag\nempty\n")
    with pytest.raises(RecordingError, match=r"list\.txt, line 2: empty: no recording there"):
        find_recordings([tmp_path / "list.txt"])
    (tmp_path / "none.txt").write_text("# none\n")
    with pytest.raises(RecordingError, match=r"none\.txt: no recording there"):
        find_recordings([tmp_path / "none.txt"])


def test_an_empty_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=f"{re.escape(str(tmp_path))}: no recording there"):
        find_recordings([tmp_path])


def test_what_has_one_stem_is_told_apart_by_its_ending_or_its_folders() -> None:
    asked = ["/p/a.bag", "/p/a.mcap", "/p/1/drive.bag", "/p/2/drive.bag", "/p/b.bag"]
    expected = ["a.bag", "a.mcap", "1-drive.bag", "2-drive.bag", "b"]
    assert [*find_recordings(asked)] == expected


@pytest.mark.parametrize("name", OWN_FILES)
def test_no_run_folder_stands_where_the_batch_writes(name: str) -> None:
    found = [*find_recordings([f"/x/{name}", f"/x/{name}.new", f"/y/{name}.bag"])]
    assert len(set(found)) == 3
    assert not set(found) & {name, f"{name}.new"}


@given(st.lists(st.text("aé /.*~=-\n", min_size=1), min_size=1, unique=True))
def test_every_name_is_unlike_all_others_and_fit_for_a_folder(texts: list[str]) -> None:
    asked = [f"/nowhere/{text}x.bag" for text in texts]
    found = find_recordings(asked)
    assert len(found) == len({os.path.abspath(each) for each in asked})  # noqa: PTH100
    for name in found:
        assert re.fullmatch(r"[A-Za-z0-9_=,+-][A-Za-z0-9._=,+-]*", name)
        assert len(name) <= 200
