"""Films, decoded again, and what stands in for them."""

import re
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvo.errors import ConfigurationError, RecordingError
from gvo.types import ImageArray
from gvo.viz.video import Film, PngFolder, open_sink
from tests.conftest import ENVIRONMENT, python
from tests.viz.browser import Browser

_SUFFIXES = pytest.mark.parametrize("suffix", [".webm", ".mp4"])
_LEVELS = range(30, 240, 16)
_SECOND_NS = 10**9


def _picture(level: int, width: int = 96, height: int = 64) -> ImageArray:
    """Return a picture of two colours, of which one tells the number of the frame."""
    picture = np.empty((height, width, 3), dtype=np.uint8)
    picture[:, : width // 2] = (level, level, level)
    picture[:, width // 2 :] = (0, 159, 230)
    return picture


def _write(path: Path, period_ns: int = _SECOND_NS // 25) -> None:
    sink = open_sink(path)
    for n, level in enumerate(_LEVELS):
        sink.add(_picture(level), 10**18 + n * period_ns)
    sink.close()


def _decoded(path: Path) -> list[ImageArray]:
    capture = cv2.VideoCapture(str(path))
    pictures = []
    while (answer := capture.read())[0]:
        pictures.append(np.asarray(answer[1], dtype=np.uint8))
    return pictures


@_SUFFIXES
def test_a_film_holds_each_picture_once_in_its_order(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"film{suffix}"
    _write(path)
    pictures = _decoded(path)
    assert [picture.shape for picture in pictures] == [(64, 96, 3)] * len(_LEVELS)
    for picture, level in zip(pictures, _LEVELS, strict=True):
        np.testing.assert_allclose(picture[32, 20].astype(int), level, atol=7)
        np.testing.assert_allclose(picture[32, 70].astype(int), (0, 159, 230), atol=14)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@_SUFFIXES
@pytest.mark.parametrize("rate_hz", [0.7, 60.0])
def test_a_film_plays_as_fast_as_it_was_taken(tmp_path: Path, suffix: str, rate_hz: float) -> None:
    path = tmp_path / f"film{suffix}"
    _write(path, round(_SECOND_NS / rate_hz))
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(rate_hz, rel=2e-3)
    stamps_ms = []
    while capture.grab():
        stamps_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    np.testing.assert_allclose(np.diff(stamps_ms), 1e3 / rate_hz, rtol=2e-3, atol=1.0)


@_SUFFIXES
def test_a_single_picture_makes_a_film_and_none_makes_no_file(tmp_path: Path, suffix: str) -> None:
    film = Film(tmp_path / f"one{suffix}")
    film.add(_picture(80), 0)
    film.close()
    Film(tmp_path / f"none{suffix}").close()
    assert [picture.shape for picture in _decoded(film.path)] == [(64, 96, 3)]
    assert [entry.name for entry in tmp_path.iterdir()] == [film.path.name]


_ON_A_FULL_DISK = """
import resource
import sys
from pathlib import Path
import numpy as np
from gvo.errors import RecordingError
from gvo.viz.video import open_sink
limit = 20_000
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
noise = np.random.default_rng(0)
sink = open_sink(Path(sys.argv[1]))
for n in range(40):
    sink.add(noise.integers(0, 256, (96, 96, 3), dtype=np.uint8), n)
try:
    sink.close()
except RecordingError as error:
    print(error)
"""


def test_a_film_too_large_for_the_disk_is_told_and_not_left(tmp_path: Path) -> None:
    name = "film.webm"
    answer = _in_a_process(_ON_A_FULL_DISK, tmp_path, name)
    assert re.fullmatch(
        rf"{re.escape(name)}: was not written whole: \d+ of 40 frames; is its disk full\?\n",
        answer.stdout,
    )
    assert list(tmp_path.iterdir()) == []


def test_existing_files_other_suffixes_and_full_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "there.webm").write_bytes(b"mine")
    with pytest.raises(RecordingError, match="exists already"):
        open_sink(tmp_path / "there.webm")
    with pytest.raises(ConfigurationError, match=r"expected a name ending in \.webm") as caught:
        open_sink(tmp_path / "film.avi")
    assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match="is not empty"):
        open_sink(tmp_path)
    with pytest.raises(RecordingError, match="cannot be written"):
        open_sink(tmp_path / "there.webm" / "film.webm")
    assert [entry.name for entry in tmp_path.iterdir()] == ["there.webm"]


def test_a_name_without_suffix_is_a_folder_of_numbered_pictures(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    _write(folder)
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"{n:06d}.png" for n in range(len(_LEVELS))]
    for file, level in zip(files, _LEVELS, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(file)), _picture(level))
    PngFolder(tmp_path / "empty").close()
    assert not (tmp_path / "empty").exists()


def _in_a_process(
    code: str, folder: Path, *arguments: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    answer = python("-c", code, *arguments, cwd=folder, env=ENVIRONMENT | environment)
    assert answer.returncode == 0, answer.stderr
    return answer


_PROGRAM = """
import sys
from pathlib import Path
import numpy as np
from gvo.errors import ConfigurationError
from gvo.viz.video import open_sink
for name in ("one.webm", "two.mp4"):
    try:
        sink = open_sink(Path(name))
    except ConfigurationError as error:
        print(error)
    else:
        sink.add(np.zeros((64, 64, 3), dtype=np.uint8), 0)
        sink.close()
        print("written")
"""


@pytest.mark.parametrize(("priority", "said"), [("1000", "written"), ("0", "has no encoder for")])
def test_opencv_says_nothing_on_the_error_stream(tmp_path: Path, priority: str, said: str) -> None:
    # a priority of 0 switches FFmpeg off
    answer = _in_a_process(_PROGRAM, tmp_path, OPENCV_VIDEOIO_PRIORITY_FFMPEG=priority)
    assert answer.stderr == ""
    assert answer.stdout.count(said) == answer.stdout.count("\n") == 2


_PLAYER = """<body style="margin: 0"><video muted src="film.webm"></video>"""


@pytest.mark.acceptance
@pytest.mark.browser
def test_a_film_plays_in_a_browser(tmp_path: Path, browser: Browser) -> None:
    _write(tmp_path / "film.webm")
    (tmp_path / "page.html").write_text(_PLAYER)
    browser.open_file(tmp_path / "page.html")
    (player,) = browser.all("video")

    def value(script: str) -> object:
        return browser.run(f"const film = arguments[0]; {script}", player)

    browser.wait(lambda: value("return film.readyState === 4"), message="was not loaded")
    assert value("return [film.videoWidth, film.videoHeight]") == [96, 64]
    assert value("return film.duration") == pytest.approx(len(_LEVELS) / 25, abs=0.05)
    value("film.play()")
    browser.wait(lambda: value("return film.ended"), message="did not play to its end")
    for n in (9, 2):
        value(f"film.currentTime = {(n + 0.5) / 25}")
        browser.wait(lambda: value("return !film.seeking"), message="was not sought")
        shown = browser.picture(player)[32, 20].astype(int)
        np.testing.assert_allclose(shown, _LEVELS[n], atol=7)
