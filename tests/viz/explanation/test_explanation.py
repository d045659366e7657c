"""Pictures and page of an explained frame."""

import re
import shutil
from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvo.errors import ConfigurationError
from gvo.io.recording import Sensor
from gvo.viz.explanation import write_explanation
from tests.make.explained import explained
from tests.viz.browser import Browser

TRACKS = ["1_measured", "2_flow", "3_corner", "4_consensus", "5_links", "6_times"]
DESCRIPTORS = [*TRACKS[:2], "3_candidates", *TRACKS[3:]]
KINDS = {"klt": TRACKS, "descriptor": DESCRIPTORS}


@pytest.mark.parametrize(("kind", "sensor"), [("klt", "stereo"), ("descriptor", "rgbd")])
def test_each_step_has_its_picture_in_order(kind: str, sensor: Sensor, tmp_path: Path) -> None:
    written = write_explanation(explained(kind, sensor), tmp_path / "made" / "here")
    assert [path.stem for path in written] == [*KINDS[kind], "explanation"]
    for path in written[:-1]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert np.std(image) > 5
        # Nothing is cut: the border is white.
        for edge in (image[:2], image[-2:], image[:, :2], image[:, -2:]):
            assert np.mean(edge < 200) < 0.01, path
    page = written[-1].read_text()
    shown = re.findall(r"data:image/png;base64,([^\"]+)", page)
    assert [b64decode(each) for each in shown] == [path.read_bytes() for path in written[:-1]]
    assert len(re.findall(r"<h2>[1-6]\. ", page)) == 6
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)


def test_a_first_frame_says_in_words_what_was_not_reached(tmp_path: Path) -> None:
    for name in ("3_candidates.png", "5_links.png", "mine.png"):  # of an earlier explanation
        (tmp_path / name).touch()
    written = write_explanation(explained("klt", "stereo", 0), tmp_path)
    assert [path.stem for path in written[:-1]] == ["1_measured", "3_corner", "6_times"]
    page = written[-1].read_text()
    assert page.count("Not reached: this is the first frame") == 2
    assert "None: there is no earlier frame to link to." in page
    assert {*tmp_path.iterdir()} == {*written, tmp_path / "mine.png"}


def test_a_folder_that_is_a_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(ConfigurationError, match="cannot be written") as error:
        write_explanation(explained("klt", "stereo", 0), tmp_path / "out")
    assert "\n" not in str(error.value)


_PICTURES = "return [...document.images].map(i => [i.alt, i.naturalWidth, i.clientWidth])"


@pytest.mark.acceptance
@pytest.mark.browser
def test_an_explained_frame_opens_from_disk_in_a_browser_with_every_picture(
    browser: Browser, tmp_path: Path
) -> None:
    paths = write_explanation(explained("klt", "rgbd"), tmp_path / "out")
    n_pictures = sum(path.suffix == ".png" for path in paths)
    # alone: moved away from the pictures beside it
    page = Path(shutil.move(tmp_path / "out" / "explanation.html", tmp_path / "alone.html"))
    browser.open_file(page)
    pictures = browser.run(_PICTURES)
    assert isinstance(pictures, list)
    assert len(pictures) == n_pictures == 6
    assert [name for name, width, shown in pictures if not (name and width and shown)] == []
    others = [url for url in browser.requests() if not url.startswith("data:")]
    assert others == [page.as_uri()]
    assert browser.requests_leaving() == []
    assert browser.console_errors() == []
