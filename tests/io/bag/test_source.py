"""Bags as recordings."""

from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import yaml

from gvo.config import Config
from gvo.errors import CalibrationError, RecordingError
from gvo.io.bag.cameras import find_contradiction
from gvo.io.bag.recovery.scan import Channel
from gvo.io.bag.source import BagSource, describe_camera_changes
from gvo.io.bag.topics import IMAGE_TYPE, TopicChoice
from gvo.io.frames import frames
from gvo.types import FaultyFrame, RgbdFrame, StereoFrame
from tests.make.bags import Message, camera_info, image, write

_P_LEFT = [50.0, 0, 23.5, 0, 0, 50.0, 15.5, 0, 0, 0, 1, 0]
_P_RIGHT = [50.0, 0, 23.5, -25.0, 0, 50.0, 15.5, 0, 0, 0, 1, 0]


def _info(topic: str, projection: list[float], **changes: Any) -> Message:
    fields: dict[str, Any] = {"R": np.eye(3), "P": projection} | changes
    return camera_info(topic, **fields)


def _stereo(tiny: Any, name: str = "image_rect", **info: Any) -> list[Message]:
    messages = [
        _info("/s/left/camera_info", _P_LEFT, **info),
        _info("/s/right/camera_info", _P_RIGHT, **info),
    ]
    for n in range(3):
        for k, side in enumerate(("left", "right")):
            messages.append(image(f"/s/{side}/{name}", tiny.texture(2 * n + k), "mono8", n))
    return messages


def _rgbd(tiny: Any, depth: Any, encoding: str) -> list[Message]:
    return [
        _info("/c/rgb/camera_info", _P_LEFT),
        image("/c/rgb/image_color", tiny.texture(1, is_color=True)[:, :, ::-1], "rgb8", 0),
        image("/c/depth/image", depth, encoding),
    ]


def test_a_stereo_pair_is_read_with_its_calibration(tmp_path: Path, tiny: Any) -> None:
    source = BagSource(write(tmp_path / "drive.bag", _stereo(tiny)))
    assert source.info.name == "drive"
    assert source.info.n_images == 3
    assert source.info.decisions == [
        "stereo: /s/left/image_rect + /s/right/image_rect (3 + 3 messages)",
        "calibration: /s/left/camera_info + /s/right/camera_info; the images are rectified",
        "baseline: 0.5000 m from P of /s/right/camera_info",
    ]
    read = list(frames(source, Config()))
    assert [frame.stamp_ns for frame in read] == [0, 1, 2]
    assert isinstance(read[1], StereoFrame)
    np.testing.assert_array_equal(read[1].right, tiny.texture(3))


def _scaled(scale: float | None) -> Config:
    return Config.model_validate({"depth": {"scale": scale}})


def test_each_faulty_image_is_one_faulty_frame(tmp_path: Path, tiny: Any) -> None:
    messages = _stereo(tiny)
    left = "/s/left/image_rect"
    messages += [
        image(left, tiny.texture(1), "mono8", 10, data=np.zeros(3, np.uint8)),
        image(left, tiny.texture(1), "mono8", 11, height=2**31, step=2**30),
        image(left, tiny.texture(1), "unknown", 12),
        image(left, tiny.texture(1)[:9], "mono8", 13),
        (left, IMAGE_TYPE, 14, b"short"),
    ]
    messages += [image("/s/right/image_rect", tiny.texture(1), "mono8", n) for n in range(10, 15)]
    read = list(frames(BagSource(write(tmp_path / "a.bag", messages)), Config()))
    assert [type(item) for item in read] == [StereoFrame] * 3 + [FaultyFrame] * 5
    reasons = [item.reason for item in read if isinstance(item, FaultyFrame)]
    for reason, word in zip(
        reasons, ["got 3", "needs", "'unknown'", "48x9", "5 bytes"], strict=True
    ):
        assert word in reason
        assert reason.startswith("left image: ")


@pytest.mark.parametrize("stamps", ["header", "recording"])
def test_an_image_recorded_at_no_time_is_a_faulty_frame(
    tmp_path: Path, tiny: Any, stamps: Literal["header", "recording"]
) -> None:
    messages = _stereo(tiny, is_ros1=False)
    for n, message in enumerate(messages):
        if message[1] == IMAGE_TYPE and message[2] == 2:
            messages[n] = (*message[:2], 2**63 + 2, message[3])
    source = BagSource(write(tmp_path / "a.mcap", messages))
    config = Config.model_validate({"sync": {"stamps": stamps}})
    read = list(frames(BagSource(tmp_path / "a" / "a.mcap", config=config), config))
    assert [type(item) for item in read] == [StereoFrame] * 2 + [FaultyFrame]
    assert "is no time" in getattr(read[2], "reason", "")
    # as what looks through a recording before a run keeps them
    assert len(array("q", [image.log_time_ns or 0 for image in source.images()])) == 6


def test_a_calibration_file_replaces_camera_info(tmp_path: Path, tiny: Any) -> None:
    messages = [m for m in _rgbd(tiny, tiny.counts(1), "16UC1") if m[1] == IMAGE_TYPE]
    bag = write(tmp_path / "a.bag", messages)
    with pytest.raises(CalibrationError, match=r"/c/rgb/image_color, it holds none; give --calib"):
        BagSource(bag)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(tiny.ros_camera(depth_scale=2500)))
    (frame,) = frames(BagSource(bag, calibration=path), Config())
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_allclose(frame.depth, 2 * tiny.depth(1), rtol=1e-6)
    (frame,) = frames(BagSource(bag, calibration=path, config=_scaled(5000.0)), Config())
    assert isinstance(frame, RgbdFrame)
    np.testing.assert_allclose(frame.depth, tiny.depth(1), rtol=1e-6)


def test_bags_of_two_cameras_are_not_one_recording(tmp_path: Path, tiny: Any) -> None:
    wide = [2.0 * number for number in _P_LEFT]
    messages = _stereo(tiny)
    other = [(name, type_, ns + 10, message) for name, type_, ns, message in messages]
    other[0] = (*other[0][:3], _info("/s/left/camera_info", wide)[3])
    paths = [write(tmp_path / "a.bag", messages), write(tmp_path / "b.bag", other)]
    with pytest.raises(
        RecordingError, match=r"/s/left/camera_info of b.bag is not that of those before"
    ):
        BagSource(paths)
    other[0] = (*other[0][:3], messages[0][3])
    assert BagSource([paths[0], write(tmp_path / "c.bag", other)]).info.n_images == 6


def test_camera_info_is_chosen_or_replaced(tmp_path: Path, tiny: Any) -> None:
    bag = write(tmp_path / "a.bag", [*_stereo(tiny), _info("/other", _P_RIGHT)])
    source = BagSource(bag, topics=TopicChoice(camera_info=("/s/left/camera_info", "/other")))
    assert "calibration: /s/left/camera_info + /other" in source.info.decisions[1]
    for names, calibration in ((("/other",) * 3, None), (("/other",), tmp_path / "mine.yaml")):
        with pytest.raises(RecordingError, match="at most two --camera-info, or --calibration"):
            BagSource(bag, topics=TopicChoice(camera_info=names), calibration=calibration)


@pytest.mark.parametrize(("gap_s", "is_one"), [(-2, False), (0, True), (4, True), (6, False)])
def test_files_of_a_folder_follow_each_other(gap_s: int, is_one: bool) -> None:
    files = [
        SimpleNamespace(
            path=Path(f"{n}.mcap"),
            counts={Channel("/image", IMAGE_TYPE, False): 9},
            start_time_ns=start_s * 10**9,
            end_time_ns=(start_s + 10) * 10**9,
        )
        for n, start_s in enumerate((0, 10 + gap_s))
    ]
    reader: Any = SimpleNamespace(loose_files=files, is_found=True)
    assert (find_contradiction(reader, by_camera_info=False) == "") == is_one
    reader.is_found = False
    assert (find_contradiction(reader, by_camera_info=False) == "") == (gap_s >= 0)


def test_camera_info_that_changes_on_the_way_is_told(tmp_path: Path, tiny: Any) -> None:
    messages = _stereo(tiny)
    wide = _info("/s/left/camera_info", [2.0 * number for number in _P_LEFT])
    source = BagSource(write(tmp_path / "a.bag", [*messages, (*wide[:2], 2, wide[3])]))
    assert describe_camera_changes(source) == ""
    assert len(list(source.images())) == 6
    assert describe_camera_changes(source) == "1 of /s/left/camera_info"
    assert len(list(source.images())) == 6
    assert describe_camera_changes(source) == "1 of /s/left/camera_info"


def test_images_without_stamps_take_those_of_the_recording(tmp_path: Path, tiny: Any) -> None:
    plain: list[tuple[str, str, int, Any]] = list(_stereo(tiny))
    for _, _, _, message in plain:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    path = write(tmp_path / "a.bag", plain)
    read = list(frames(BagSource(path), Config()))
    faulty = [item for item in read if isinstance(item, FaultyFrame)]
    assert all("--set sync.stamps=recording" in item.reason for item in faulty)
    assert len(faulty) == len(read) - 1 > 0
    settings = {"sync": {"stamps": "recording", "stereo_tolerance_ms": 1.0}}
    config = Config.model_validate(settings)
    stamped = list(frames(BagSource(path, config=config), config))
    assert [type(item) for item in stamped] == [StereoFrame] * len(read)
    left = [stamp for name, _, stamp, _ in plain if name == "/s/left/image_rect"]
    assert [item.stamp_ns for item in stamped] == left
