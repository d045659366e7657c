"""The script that draws the pictures of the documentation."""

from pathlib import Path

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


def test_the_pictures_of_the_documentation_are_small_and_used() -> None:
    pages = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    for name in NAMES:
        assert (ROOT / "docs" / f"{name}.png").stat().st_size < MAX_BYTES
        assert f"({name}.png)" in pages
