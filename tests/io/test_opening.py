"""Recognising recordings."""

from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.errors import CalibrationError, RecordingError
from gvo.io.datasets.kitti import KittiSource
from gvo.io.datasets.tum import TumSource
from gvo.io.opening import is_bag, open_recording


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
