"""Pictures, numbers and page of an explained frame."""

import json
import re
import shutil
from base64 import b64decode
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gvo._text import html_text
from gvo.config import Config, RegistrationConfig, load_configuration
from gvo.diagnostics.explain import FrameExplanation, explain_frame
from gvo.errors import ConfigurationError
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from gvo.viz.explanation import write_explanation
from gvo.viz.explanation.motion import draw_residuals, position_covariance
from gvo.viz.explanation.sheet import TITLES, Sheet
from tests.viz.browser import Browser

STEREO = [
    *("01_keypoints", "02_stereo", "03_subpixel", "04_disparity_and_depth", "05_matches"),
    *("06_consensus", "07_residuals", "08_pose", "09_links"),
]
RGBD = [STEREO[0], "02_depth", "03_depth_keypoints", *STEREO[3:]]


@cache
def explained(sensor: Sensor, index: int) -> FrameExplanation:
    source = SyntheticRecording("handheld", sensor, n_frames=index + 1, scale=0.4)
    return explain_frame(source, index)


@cache
def explained_descriptors() -> FrameExplanation:
    source = SyntheticRecording("driving", "stereo", n_frames=5, scale=0.4)
    return explain_frame(
        source, 4, config=load_configuration(settings=["frontend.kind=descriptor"])
    )


def decoded(png: bytes) -> np.ndarray[Any, Any]:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def assert_without_words(panels: np.ndarray[Any, Any], image: np.ndarray[Any, Any]) -> None:
    """The page says title and caption as text: its picture is the file's but for these."""
    n_rows = len(panels)
    starts = range(1, len(image) - n_rows)
    [top] = [n for n in starts if np.array_equal(image[n : n + n_rows], panels)]
    assert (image[:top] < 128).any()
    assert (image[top + n_rows :] < 128).any()


@pytest.mark.parametrize(
    ("explain", "names"),
    [
        pytest.param(explained_descriptors, STEREO, marks=pytest.mark.acceptance),
        (partial(explained, "rgbd", 2), RGBD),
    ],
    ids=["descriptors", "tracks"],
)
def test_each_step_has_its_picture_in_order(
    explain: Callable[[], FrameExplanation], names: list[str], tmp_path: Path
) -> None:
    written = write_explanation(explain(), tmp_path / "made" / "here")
    assert [path.stem for path in written] == [*names, "explanation", "explanation"]
    images = [decoded(path.read_bytes()) for path in written[:-2]]
    assert all(image.std() > 5 for image in images)
    page = written[-1].read_text()
    shown = [
        decoded(b64decode(each)) for each in re.findall(r"data:image/png;base64,([^\"]+)", page)
    ]
    for image, panels in zip(images, shown, strict=True):
        assert_without_words(panels, image)
    headings = re.findall(r"<h2>\d\. (.*?)</h2>", page)
    assert headings == [html_text(TITLES[name]) for name in names]
    sections = page.split("<section>")[1:]
    assert [each.count("<p>") for each in sections] == [1] * len(names)  # the caption
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)
    numbers = json.loads(written[-2].read_text())
    assert numbers["matches"]["kept"] == numbers["relative_pose"]["n_matches"]
    assert numbers["refinement"]["n_inliers"][1] == numbers["relative_pose"]["n_inliers"]


def test_a_first_frame_says_in_words_what_was_not_reached(tmp_path: Path) -> None:
    written = write_explanation(explained("stereo", 0), tmp_path)
    assert [path.stem for path in written[:-2]] == [*STEREO[:4], "08_pose"]
    assert "Not reached: this is the first frame" in written[-1].read_text()


def test_no_picture_of_an_earlier_explanation_is_left(tmp_path: Path) -> None:
    for name in ("02_depth.png", "09_links.png", "mine.png"):
        (tmp_path / name).touch()
    written = write_explanation(explained("stereo", 0), tmp_path)
    assert {*tmp_path.iterdir()} == {*written, tmp_path / "mine.png"}


def test_a_folder_that_is_a_file_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvo.viz.explanation.write.draw_pictures", lambda _: [])
    (tmp_path / "out").touch()
    with pytest.raises(ConfigurationError, match="cannot be written") as error:
        write_explanation(explained("stereo", 0), tmp_path / "out")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("word", ["WWMM", "moved", "ill,"])
def test_no_line_of_a_caption_leaves_the_picture(word: str) -> None:
    caption = " ".join([word] * 120)
    picture = Sheet("08_pose", caption, 1.0).picture()
    assert picture.png is not None
    image = decoded(picture.png)
    inked = np.flatnonzero((image < 255).any(axis=0))
    assert inked[-1] < image.shape[1] - inked[0] + 1
    assert inked[-1] > 0.5 * image.shape[1]


def test_the_caption_says_when_the_gate_would_leave_too_few() -> None:
    source = SyntheticRecording("handheld", "stereo", n_frames=3, scale=0.4)
    for gate, words in ((3.0, "chooses the matches again"), (0.05, "less than half")):
        config = Config().model_copy(
            update={"registration": RegistrationConfig(gate=gate, huber=0.3)}
        )
        explanation = explain_frame(source, 2, config=config)
        step = explanation.refinement
        assert step is not None
        n_before, n_after = step.n_inliers
        is_kept = step.n_within_gate < n_before // 2
        assert n_after == (n_before if is_kept else step.n_within_gate)
        assert words in draw_residuals(explanation).caption


def test_the_ellipse_is_turned_into_the_frame_of_the_picture() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    covariance = np.diag([1.0, 1.0, 1.0, 4.0, 9.0, 16.0])
    steps = np.random.default_rng(0).normal(size=(200_000, 3)) * [2.0, 3.0, 4.0]
    spread = np.cov((steps @ T[:3, :3].T).T)
    assert np.allclose(position_covariance(T, covariance), spread, atol=0.2)


_PICTURES = "return [...document.images].map(i => [i.alt, i.naturalWidth, i.clientWidth])"


@pytest.mark.acceptance
@pytest.mark.parametrize("explain", [explained_descriptors, partial(explained, "rgbd", 2)])
def test_an_explained_frame_opens_from_disk_in_a_browser_with_every_picture(
    browser: Browser, tmp_path: Path, explain: Callable[[], FrameExplanation]
) -> None:
    paths = write_explanation(explain(), tmp_path / "out")
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
