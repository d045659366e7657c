"""Pictures, numbers and page of an explained frame."""

import json
import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvo.errors import ConfigurationError
from gvo.explain import FrameExplanation, explain_frame
from gvo.outputs.explanation import write_explanation
from gvo.outputs.explanation.pose import position_covariance
from gvo.sources.recording import Sensor
from gvo.sources.synthetic import SyntheticRecording

STEREO = [
    "01_keypoints",
    "02_stereo",
    "03_subpixel",
    "04_disparity_and_depth",
    "05_matches",
    "06_consensus",
    "07_residuals",
    "08_pose",
    "09_links",
]
RGBD = [STEREO[0], "02_depth", "03_depth_keypoints", *STEREO[3:]]


@cache
def explained(sensor: Sensor, index: int) -> FrameExplanation:
    source = SyntheticRecording("handheld", sensor, n_frames=index + 1, scale=0.4)
    return explain_frame(source, index)


@pytest.mark.parametrize(("sensor", "names"), [("stereo", STEREO), ("rgbd", RGBD)])
def test_each_step_has_its_picture_in_order(
    sensor: Sensor, names: list[str], tmp_path: Path
) -> None:
    written = write_explanation(explained(sensor, 2), tmp_path / "made" / "here")
    assert [path.stem for path in written] == [*names, "explanation", "explanation"]
    for path in written[:-2]:
        image = cv2.imread(str(path))
        assert image is not None
        assert image.std() > 5
    page = written[-1].read_text()
    assert page.count("data:image/png;base64,") == len(names)
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)
    numbers = json.loads(written[-2].read_text())
    assert numbers["matches"]["kept"] == numbers["relative_pose"]["n_matches"]
    assert numbers["refinement"]["n_inliers"][1] == numbers["relative_pose"]["n_inliers"]


def test_a_first_frame_says_in_words_what_was_not_reached(tmp_path: Path) -> None:
    written = write_explanation(explained("stereo", 0), tmp_path)
    assert [path.stem for path in written[:-2]] == [*STEREO[:4], "08_pose"]
    assert "Not reached: this is the first frame" in written[-1].read_text()


def test_a_folder_that_is_a_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(ConfigurationError, match="cannot be written") as error:
        write_explanation(explained("stereo", 0), tmp_path / "out")
    assert "\n" not in str(error.value)


def test_the_ellipse_is_turned_into_the_frame_of_the_picture() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    covariance = np.diag([1.0, 1.0, 1.0, 4.0, 9.0, 16.0])
    steps = np.random.default_rng(0).normal(size=(200_000, 3)) * [2.0, 3.0, 4.0]
    spread = np.cov((steps @ T[:3, :3].T).T)
    assert np.allclose(position_covariance(T, covariance), spread, atol=0.2)
