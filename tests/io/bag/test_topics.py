"""Which topics hold the camera."""

import re
from itertools import permutations
from typing import Any

import pytest

from gvo.errors import RecordingError
from gvo.io.bag.topics import (
    CAMERA_INFO_TYPE,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    Topic,
    TopicChoice,
    choose_topics,
)


def _topics(*names: str, n_messages: int = 5) -> list[Topic]:
    types = {"compressed": COMPRESSED_TYPE, "compressedDepth": COMPRESSED_TYPE}
    types |= {"camera_info": CAMERA_INFO_TYPE, "tf": "tf2_msgs/msg/TFMessage"}
    return [
        Topic(name=name, type=types.get(name.rpartition("/")[2], IMAGE_TYPE), n_messages=n_messages)
        for name in names
    ]


def _choose(topics: list[Topic], **choice: Any) -> tuple[str, str, str]:
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


# camera -> the topics of its driver, colour and depth that belong together, or left and right
_DRIVERS = {
    "ZED 5.1": (
        [
            f"/zed/zed_node/{eye}/{color}/{state}/image"
            for eye in ("left", "rgb")
            for color in ("color", "gray")
            for state in ("raw", "rect")
        ]
        + ["/zed/zed_node/depth/depth_registered"],
        (
            "rgbd",
            "/zed/zed_node/(left|rgb)/(color|gray)/rect/image",
            "/zed/zed_node/depth/depth_registered",
        ),
    ),
    "ZED 5.1, stereo": (
        [
            f"/zed/zed_node/{eye}/{color}/{state}/image/compressed"
            for eye in ("right", "left")
            for color in ("color", "gray")
            for state in ("raw", "rect")
        ],
        (
            "stereo",
            "/zed/zed_node/left/gray/rect/image/compressed",
            "/zed/zed_node/right/gray/rect/image/compressed",
        ),
    ),
    "ZED 4": (
        [
            "/zed/zed_node/rgb_raw/image_raw_color",
            "/zed/zed_node/rgb/image_rect_color",
            "/zed/zed_node/rgb_gray/image_rect_gray",
            "/zed/zed_node/depth/depth_registered",
            "/zed/zed_node/left_raw/image_raw_color",
            "/zed/zed_node/left/image_rect_color",
            "/zed/zed_node/stereo/image_rect_color",
            "/zed/zed_node/stereo_raw/image_raw_color",
        ],
        (
            "rgbd",
            "/zed/zed_node/(left|rgb)(_gray)?/image_rect_.*",
            "/zed/zed_node/depth/depth_registered",
        ),
    ),
    "ZED 4, stereo": (
        [
            f"/zed/zed_node/{eye}{kind}"
            for eye in ("left", "right")
            for kind in ("_raw/image_raw_color", "/image_rect_color", "_gray/image_rect_gray")
        ],
        (
            "stereo",
            "/zed/zed_node/left_gray/image_rect_gray",
            "/zed/zed_node/right_gray/image_rect_gray",
        ),
    ),
    "ZED 2": (
        ["/zed/rgb/image_raw_color", "/zed/depth/depth_registered"],
        ("rgbd", "/zed/rgb/image_raw_color", "/zed/depth/depth_registered"),
    ),
    "RealSense": (
        [
            "/camera/color/image_raw",
            "/camera/depth/image_rect_raw",
            "/camera/aligned_depth_to_infra1/image_raw",
            "/camera/aligned_depth_to_color/image_raw",
        ],
        ("rgbd", "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"),
    ),
    "RealSense D405": (
        ["/camera/color/image_rect_raw", "/camera/depth/image_rect_raw"],
        ("rgbd", "/camera/color/image_rect_raw", "/camera/depth/image_rect_raw"),
    ),
    "RealSense, stereo": (
        [
            "/camera/infra1/image_rect_raw",
            "/camera/infra2/image_rect_raw",
            "/camera/depth/image_rect_raw",
        ],
        ("stereo", "/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
    ),
    "RealSense, one eye": (
        ["/camera/infra1/image_rect_raw", "/camera/depth/image_rect_raw"],
        ("rgbd", "/camera/infra1/image_rect_raw", "/camera/depth/image_rect_raw"),
    ),
    "Gazebo": (
        ["/camera/image_raw", "/camera/depth/image_raw"],
        ("rgbd", "/camera/image_raw", "/camera/depth/image_raw"),
    ),
    "Azure Kinect": (
        [
            "/rgb/image_raw",
            "/depth/image_raw",
            "/depth_to_rgb/image_raw",
            "/ir/image_raw",
            "/rgb_to_depth/image_raw",
        ],
        ("rgbd", "/rgb/image_raw", "/depth_to_rgb/image_raw"),
    ),
    "OAK-D": (
        ["/oak/rgb/image_raw", "/oak/stereo/image_raw"],
        ("rgbd", "/oak/rgb/image_raw", "/oak/stereo/image_raw"),
    ),
    "OAK-D, rectified": (
        ["/oak/rgb/image_raw", "/oak/rgb/image_rect", "/oak/stereo/image_raw"],
        ("rgbd", "/oak/rgb/image_rect", "/oak/stereo/image_raw"),
    ),
    "OAK-D, stereo": (
        [
            "/oak/left/image_rect",
            "/oak/right/image_rect",
            "/oak/rgb/image_raw",
            "/oak/stereo/image_raw",
        ],
        ("stereo", "/oak/left/image_rect", "/oak/right/image_rect"),
    ),
    "Orbbec": (
        ["/camera/color/image_raw", "/camera/depth/image_raw", "/camera/ir/image_raw"],
        ("rgbd", "/camera/color/image_raw", "/camera/depth/image_raw"),
    ),
    "Kinect, openni": (
        [f"/camera/rgb/image_{kind}" for kind in ("raw", "mono", "color", "rect_color")]
        + ["/camera/depth/image_raw", "/camera/depth_registered/image_raw"],
        ("rgbd", "/camera/rgb/image_(raw|mono|color)", "/camera/depth_registered/image_raw"),
    ),
    "Kinect, in metres": (
        [
            *(f"/camera/rgb/image_{kind}" for kind in ("raw", "rect_color")),
            "/camera/depth_registered/image",
        ],
        ("rgbd", "/camera/rgb/image_rect_color", "/camera/depth_registered/image"),
    ),
    "Kinect, registered by software": (
        [f"/camera/rgb/image_{kind}" for kind in ("raw", "color", "rect_color")]
        + ["/camera/depth/image_rect", "/camera/depth_registered/sw_registered/image_rect_raw"],
        (
            "rgbd",
            "/camera/rgb/image_rect_color",
            "/camera/depth_registered/sw_registered/image_rect_raw",
        ),
    ),
    "Kinect 2": (
        [f"/kinect2/qhd/image_{kind}" for kind in ("color", "color_rect", "depth_rect")],
        ("rgbd", "/kinect2/qhd/image_color_rect", "/kinect2/qhd/image_depth_rect"),
    ),
    "Xtion": (
        ["/xtion/rgb/image_raw", "/xtion/depth_registered/image_raw", "/xtion/depth/image_raw"],
        ("rgbd", "/xtion/rgb/image_raw", "/xtion/depth_registered/image_raw"),
    ),
    "MYNT EYE": (
        [
            "/mynteye/left/image_raw",
            "/mynteye/left_rect/image_rect",
            "/mynteye/depth/image_raw",
            "/mynteye/right_rect/image_rect",
            "/mynteye/right/image_raw",
        ],
        ("stereo", "/mynteye/left_rect/image_rect", "/mynteye/right_rect/image_rect"),
    ),
    "Basler": (
        [
            "/basler/left/image_raw",
            "/basler/right/image_raw",
            "/basler/left/image_rect",
            "/basler/right/image_rect",
        ],
        ("stereo", "/basler/left/image_rect", "/basler/right/image_rect"),
    ),
}


@pytest.mark.parametrize("driver", _DRIVERS)
def test_the_topics_of_a_driver_are_known(driver: str) -> None:
    names, (sensor, first, second) = _DRIVERS[driver]
    for ordered in (names, names[::-1], sorted(names)):
        found = _choose(_topics(*ordered))
        assert found[0] == sensor
        assert re.fullmatch(first, found[1])
        assert found[2] == second


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


def test_depth_goes_with_colour_of_its_own_side() -> None:
    topics = _topics(
        *(f"/{side}/{name}" for side in ("left", "right") for name in ("rgb", "depth"))
    )
    with pytest.raises(RecordingError, match="more than one camera") as caught:
        _choose(topics)
    assert "--color /left/rgb --depth /left/depth" in str(caught.value)
    assert "--color /left/rgb --depth /right/depth" not in str(caught.value)
    assert _choose(topics, color="/right/rgb") == ("rgbd", "/right/rgb", "/right/depth")


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
