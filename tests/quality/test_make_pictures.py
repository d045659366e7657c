"""The script that draws the pictures of the documentation."""

from pathlib import Path

import pytest

from tests.acceptance.conftest import SCRIPTS
from tests.conftest import python


@pytest.mark.acceptance
def test_what_is_asked_for_is_drawn_and_small(drive_bag: Path, tmp_path: Path) -> None:
    options = ["--recording", drive_bag, "--frame", 5, "--only", "explain", "--only", "overlay"]
    answer = python(SCRIPTS / "make_pictures.py", "--out", tmp_path / "docs", *options)
    assert answer.returncode == 0, answer.stderr
    found = sorted((tmp_path / "docs").iterdir())
    assert [path.name for path in found] == ["explain.png", "overlay.png"]
    assert all(path.stat().st_size < 250_000 for path in found)
