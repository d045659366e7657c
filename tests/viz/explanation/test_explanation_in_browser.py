"""The page of an explained frame in a real browser: it stands alone, no picture is missing."""

import shutil
from pathlib import Path

import pytest

from gvo.diagnostics.explain import explain_frame
from gvo.io.recording import Sensor
from gvo.io.synthetic.recording import SyntheticRecording, WorldName
from gvo.viz.explanation import write_explanation
from tests.viz.browser import Browser

pytestmark = pytest.mark.acceptance

_PICTURES = "return [...document.images].map(i => [i.alt, i.naturalWidth, i.clientWidth])"


@pytest.mark.parametrize(("world", "sensor"), [("driving", "stereo"), ("handheld", "rgbd")])
def test_an_explained_frame_opens_from_disk_with_every_picture(
    browser: Browser, tmp_path: Path, world: WorldName, sensor: Sensor
) -> None:
    source = SyntheticRecording(world, sensor, n_frames=3, scale=0.5)
    paths = write_explanation(explain_frame(source, 2), tmp_path / "out")
    n_pictures = sum(path.suffix == ".png" for path in paths)
    # alone: moved away from the pictures beside it
    page = Path(shutil.move(tmp_path / "out" / "explanation.html", tmp_path / "alone.html"))
    browser.open_file(page)
    pictures = browser.run(_PICTURES)
    assert isinstance(pictures, list)
    assert len(pictures) == n_pictures > 5
    assert [name for name, width, shown in pictures if not (name and width and shown)] == []
    others = [url for url in browser.requests() if not url.startswith("data:")]
    assert others == [page.as_uri()]
    assert browser.requests_leaving() == []
    assert browser.console_errors() == []
