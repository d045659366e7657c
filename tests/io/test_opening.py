"""Recognising recordings."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import gvo
from gvo.config import Config
from gvo.errors import CalibrationError, RecordingError
from gvo.io.datasets.kitti import KittiSource
from gvo.io.datasets.tum import TumSource
from gvo.io.opening import RecordingOptions, is_bag, open_recording


def test_a_missing_path_is_refused_with_what_a_recording_may_be(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"does not exist; a recording is a \.bag"):
        open_recording(tmp_path / "none")


def test_other_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"not a recording; .*KITTI.*EuRoC.*TUM"):
        open_recording(tmp_path)
    path = tmp_path / "drive.mp4"
    path.write_bytes(b"video")
    with pytest.raises(RecordingError, match="not a recording"):
        open_recording(path)


def test_what_a_recording_lacks_is_said(tmp_path: Path) -> None:
    (tmp_path / "associations.txt").write_text("1.0 rgb/1.png 1.0 depth/1.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt and depth\.txt are .* associations\.txt;"):
        open_recording(tmp_path)
    (tmp_path / "associations.txt").unlink()
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    with pytest.raises(RecordingError, match=r"rgb\.txt and depth\.txt are missing"):
        open_recording(tmp_path)
    packed = tmp_path / "drive.bag.gz"
    packed.write_bytes(b"packed")
    with pytest.raises(RecordingError, match="unpack it first"):
        open_recording(packed)


def test_folders_are_recognised_by_what_they_hold(tmp_path: Path, tiny: Any) -> None:
    assert isinstance(open_recording(tiny.write_kitti(tmp_path / "a")), KittiSource)
    (tmp_path / "a" / "calib.txt").unlink()
    with pytest.raises(CalibrationError, match=r"calib\.txt: .* --calibration FILE"):
        open_recording(str(tmp_path / "a"))
    assert isinstance(open_recording(tiny.write_tum(tmp_path / "b", ["1"], ["1"])), TumSource)
    (tmp_path / "mav0").mkdir()
    with pytest.raises(RecordingError, match=r"cam0.data\.csv"):
        open_recording(tmp_path)
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).touch()
        with pytest.raises(RecordingError, match="empty"):
            open_recording(tmp_path / name)


def test_compressed_files_of_ros2_are_bags_with_and_without_metadata(tmp_path: Path) -> None:
    assert not is_bag(tmp_path)
    file = tmp_path / "drive.mcap.zstd"
    file.touch()
    assert is_bag(file)
    assert is_bag(tmp_path)


def test_a_source_is_shown_in_a_line() -> None:
    source = gvo.SyntheticRecording("driving", "stereo", n_frames=3, scale=0.25)
    images = "(driving-stereo: stereo, 3 images of 306x92)"
    assert [repr(each) for each in (source, source.info)] == [
        f"{name}{images}" for name in ("SyntheticRecording", "RecordingInfo")
    ]


def _masked(folder: Path, config: Config | None = None, **pictures: Any) -> Any:
    """Open a KITTI folder with masks of these names."""
    paths = []
    for name, pixels in pictures.items():
        paths.append(folder / f"{name}.png")
        assert cv2.imwrite(str(paths[-1]), pixels)
    options = RecordingOptions(mask=tuple(paths))
    return open_recording(folder, config=config, options=options).info.masks


def test_masks_are_of_both_cameras_or_of_left_and_right(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_kitti(tmp_path / "drive")
    assert _masked(folder) == ()
    half = np.zeros((32, 48), np.uint8)
    half[16:] = 255
    for given, expected in (
        ({"a": half}, (half, half)),
        ({"a": half, "b": 255 - half}, (half, 255 - half)),
        ({"a": np.dstack([half] * 3)}, (half, half)),
    ):
        np.testing.assert_array_equal(_masked(folder, **given), expected)
    config = Config.model_validate({"images": {"mask": [str(folder / "a.png")]}})
    np.testing.assert_array_equal(_masked(folder, config), (half, half))
    other = _masked(folder, config, b=255 - half)  # the option wins
    np.testing.assert_array_equal(other, (255 - half, 255 - half))


@pytest.mark.parametrize(
    ("masks", "reason"),
    [
        ([np.zeros((32, 47), np.uint8)], r"a\.png: the mask has 47x32 pixels, the images 48x32"),
        ([np.zeros((32, 48), np.uint16)], "a mask of 8 bits grey, 0 = not used, got 16 bits"),
        ([np.eye(32, 48 * 3, dtype=np.uint8).reshape(32, 48, 3)], "8 bits grey.*, got colours"),
        ([np.zeros((32, 48), np.uint8)] * 3, "c.png: a stereo recording takes 2 --mask, got 3"),
    ],
)
def test_other_masks_are_refused(tmp_path: Path, tiny: Any, masks: list[Any], reason: str) -> None:
    folder = tiny.write_kitti(tmp_path / "drive")
    with pytest.raises(RecordingError, match=reason):
        _masked(folder, **dict(zip("abc", masks, strict=False)))
