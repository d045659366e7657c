"""The script that draws the pictures of the documentation."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.acceptance.conftest import SCRIPTS
from tests.conftest import python

pytestmark = pytest.mark.acceptance

ROOT = Path(__file__).parents[2]
MAX_BYTES = 250_000
NAMES = {"explain", "report", "overlay", "corners", "view"}


@pytest.fixture(scope="module")
def pictures(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the pictures that take little time, of a short drive."""
    out = tmp_path_factory.mktemp("pictures") / "docs"
    options = ["--recording", drive_bag, "--frame", 5, "--only", "explain", "--only", "overlay"]
    answer = python(SCRIPTS / "make_pictures.py", "--out", out, *options)
    assert answer.returncode == 0, answer.stderr
    return out


def test_what_is_asked_for_is_drawn_and_small(pictures: Path) -> None:
    found = sorted(path.name for path in pictures.iterdir())
    assert found == ["explain.png", "overlay.png"]
    assert all((pictures / name).stat().st_size < MAX_BYTES for name in found)


def test_fewer_colours_keep_their_meaning(pictures: Path) -> None:
    # the text on top is written in sky blue and orange, and nothing else there has a colour
    seen = cv2.imread(str(pictures / "overlay.png"))
    assert seen is not None
    header = seen[:44].reshape(-1, 3).astype(int)
    for bgr in ((0xE9, 0xB4, 0x56), (0x00, 0x9F, 0xE6)):
        assert np.abs(header - bgr).max(axis=1).min() <= 32


def test_a_frame_beyond_the_end_is_told_with_no_traceback(drive_bag: Path, tmp_path: Path) -> None:
    options = ["--recording", drive_bag, "--frame", 20, "--only", "overlay"]
    answer = python(SCRIPTS / "make_pictures.py", "--out", tmp_path, *options)
    assert answer.returncode == 2
    assert "no usable frame from 20 on" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_the_pictures_of_the_documentation_are_small_and_used() -> None:
    pages = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    for name in NAMES:
        assert (ROOT / "docs" / f"{name}.png").stat().st_size < MAX_BYTES
        assert f"({name}.png)" in pages
