"""Which topics hold the camera."""

from itertools import permutations

import pytest

from gvo.errors import RecordingError
from gvo.io.bag.topics import (
    CAMERA_INFO_TYPE,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    Topic,
    TopicChoice,
    choose_topics,
    find_camera_info,
)


def _topics(*names: str, n_messages: int = 5) -> list[Topic]:
    types = {"compressed": COMPRESSED_TYPE, "compressedDepth": COMPRESSED_TYPE}
    types |= {"camera_info": CAMERA_INFO_TYPE, "tf": "tf2_msgs/msg/TFMessage"}
    return [
        Topic(name=name, type=types.get(name.rpartition("/")[2], IMAGE_TYPE), n_messages=n_messages)
        for name in names
    ]


def _choose(topics: list[Topic], **choice: str) -> tuple[str, str, str]:
    camera = choose_topics(topics, TopicChoice(**choice), "a.bag")
    return camera.sensor, camera.first.name, camera.second.name


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("/kitti/left/image_rect", "/kitti/right/image_rect"),
        ("kitty_stereo/left/image_rect", "kitty_stereo/right/image_rect"),
        ("/stereo/left/image_raw/compressed", "/stereo/right/image_raw/compressed"),
        ("/kitti/camera_gray_left/image_raw", "/kitti/camera_gray_right/image_raw"),
        ("/zed/zed_node/Left/image", "/zed/zed_node/Right/image"),
        ("/image_0", "/image_1"),
        ("/sync/image_00/data", "/sync/image_01/data"),
        ("/cam0/image_raw", "/cam1/image_raw"),
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/left/left/image", "/right/right/image"),
    ],
)
def test_a_stereo_pair_is_found_by_name(left: str, right: str) -> None:
    for names in permutations([left, right, "/imu", "/tf"]):
        assert _choose(_topics(*names)) == ("stereo", left, right)


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("/camera/rgb/image_color", "/camera/depth/image"),
        ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"),
        ("/colour", "/depth"),
        ("/device_0/sensor_1/Color_0/image/data", "/device_0/sensor_0/Depth_0/image/data"),
        ("/k/rgb/image_raw/compressed", "/k/depth_to_rgb/image_raw/compressedDepth"),
    ],
)
def test_an_rgbd_camera_is_found_by_name(color: str, depth: str) -> None:
    for names in permutations([color, depth, "/tf"]):
        assert _choose(_topics(*names)) == ("rgbd", color, depth)


def test_rectified_topics_are_taken_before_raw_ones_and_these_before_compressed_ones() -> None:
    names = [
        f"/stereo/{side}/{name}"
        for side in ("left", "right")
        for name in ("image_raw/compressed", "image_raw", "image_rect")
    ]
    taken = _choose(_topics(*names))
    assert taken == ("stereo", "/stereo/left/image_rect", "/stereo/right/image_rect")
    taken = _choose(_topics(*(name for name in names if "rect" not in name)))
    assert taken == ("stereo", "/stereo/left/image_raw", "/stereo/right/image_raw")


@pytest.mark.parametrize("own", ["/camera/depth/image_rect_raw", "/camera/depth/image_raw"])
@pytest.mark.parametrize(
    "registered", ["/camera/aligned_depth_to_color/image_raw", "/camera/depth_registered/image_raw"]
)
def test_registered_depth_is_taken_before_the_depth_camera_s_own(own: str, registered: str) -> None:
    for names in permutations(["/camera/color/image_raw", own, registered]):
        assert _choose(_topics(*names))[2] == registered


def test_two_cameras_are_refused_with_what_to_type() -> None:
    topics = _topics("/a/left/image", "/a/right/image", "/b/left/image", "/b/right/image")
    with pytest.raises(RecordingError, match="more than one camera") as caught:
        _choose(topics)
    for flags in ("--left /a/left/image --right /a/right/image", "--left /b/left/image"):
        assert flags in str(caught.value)
    assert _choose(topics, left="/b/left/image") == ("stereo", "/b/left/image", "/b/right/image")
    assert _choose(topics, right="a/right/image")[1] == "/a/left/image"


def test_any_two_topics_can_be_named() -> None:
    topics = _topics("/a", "/b")
    assert _choose(topics, left="/b", right="/a") == ("stereo", "/b", "/a")
    assert _choose(topics, color="a", depth="b") == ("rgbd", "/a", "/b")
    with pytest.raises(RecordingError, match="has no image topic /c; it has /a"):
        _choose(topics, left="/c", right="/a")
    with pytest.raises(RecordingError, match="not some of both"):
        _choose(topics, left="/a", depth="/b")


def test_no_camera_is_refused_with_what_there_is() -> None:
    with pytest.raises(RecordingError, match=r"/front/image .*--left TOPIC --right TOPIC"):
        _choose(_topics("/front/image", "/rear/image", "/tf"))
    with pytest.raises(RecordingError, match=r"no image topics; it holds /tf \(tf2_msgs"):
        _choose(_topics("/tf"))
    with pytest.raises(RecordingError, match="no messages"):
        _choose([])


@pytest.mark.parametrize(
    ("name", "is_rectified"),
    [
        ("/left/image_rect", True),
        ("/left/image_rect_color/compressed", True),
        ("left/rectified", True),
        ("/left/image_raw", False),
        ("/left/image_unrectified", False),
        ("/direct/left/image", False),
    ],
)
def test_the_name_says_whether_images_are_rectified(name: str, is_rectified: bool) -> None:
    assert _topics(name)[0].is_rectified is is_rectified


@pytest.mark.parametrize(
    ("image", "info"),
    [
        ("/left/image_rect", "/left/camera_info"),
        ("left/image_rect", "left/camera_info"),
        ("/left/image_raw/compressed", "/left/camera_info"),
        ("/cam0", "/cam0/camera_info"),
        ("/cam0/image/data", "/cam0/camera_info"),
        ("/Color_0/image/data", "/Color_0/info/camera_info"),
        ("/image", "/camera_info"),
    ],
)
def test_camera_info_is_found_in_the_namespace(image: str, info: str) -> None:
    topics = _topics("/elsewhere/camera_info", image, info)
    assert find_camera_info(topics[1], topics) == info
    assert find_camera_info(topics[1], topics[:2]) is None
