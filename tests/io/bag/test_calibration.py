"""Calibrations of bags: from `CameraInfo`, from transforms, and of depth seen from elsewhere."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry import se3
from gvo.geometry.camera import rectification_maps
from gvo.io.bag.calibration import BagCalibration, calibrations_of_messages
from gvo.io.bag.reader import BagReader
from gvo.io.bag.topics import COMPRESSED_TYPE, TopicChoice, choose_topics
from gvo.io.calibration.camera_info import stereo_baseline
from gvo.types import FloatArray
from tests.make.bags import Message, camera_info, header, image, make, tf, write

_P = [50.0, 0, 23.5, 0, 0, 50.0, 15.5, 0, 0, 0, 1, 0]
_D = [-0.2, 0.05, 0.001, -0.002, 0.0]


def _image(topic: str, size: tuple[int, int] = (48, 32), frame_id: str = "camera") -> Message:
    return image(topic, np.zeros(size[::-1], np.uint8), header=header(frame_id))


def _found(path: Path, messages: Sequence[Message], **choice: Any) -> BagCalibration:
    reader = BagReader(write(path, messages))
    topics = choose_topics(reader.topics, TopicChoice(**choice), "the bag")
    return calibrations_of_messages(reader, topics, "the bag")


def _pose(rotation: Sequence[float], t: Sequence[float]) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = t
    return T


_T_BODY_LEFT = _pose([0.2, -1.1, 0.7], [0.3, 0.1, 0.9])
_T_LEFT_RIGHT = _pose([0.01, -0.02, 0.015], [0.12, 0.001, -0.002])


def _pair(name: str = "image_raw", **changes: Any) -> list[Message]:
    return [
        *(_image(f"/s/{side}/{name}") for side in ("left", "right")),
        *(
            camera_info(f"/s/{side}/camera_info", f"{side}_optical", **changes)
            for side in ("left", "right")
        ),
    ]


def _mounts(topic: str = "/tf_static", stamp_ns: int = 0) -> list[Message]:
    return [
        tf(topic, "body", "left_optical", _T_BODY_LEFT, stamp_ns),
        tf(topic, "body", "right_optical", _T_BODY_LEFT @ _T_LEFT_RIGHT, stamp_ns),
    ]


@pytest.mark.parametrize(
    ("model", "D"), [("plumb_bob", _D), ("equidistant", [0.01, -0.002, 0.001, 0.0])]
)
@pytest.mark.parametrize(("topic", "stamp_ns"), [("/tf_static", 0), ("/tf", 7_000_000_000)])
def test_raw_cameras_without_baseline_are_rectified_bytf(
    tmp_path: Path, model: str, D: list[float], topic: str, stamp_ns: int
) -> None:
    messages = [*_pair(distortion_model=model, D=D), *_mounts(topic, stamp_ns)]
    found = _found(tmp_path / "a.bag", messages)
    assert found.frame_id == "left_optical"
    assert "baseline: 0.1200 m from tf left_optical -> right_optical" in found.decisions
    left, right = found.calibrations
    assert left.model == model
    # a point seen by the raw cameras, through OpenCV's projection of each
    point_left = np.array([0.3, -0.1, 3.0])
    uv = {}
    for camera, T in ((left, np.eye(4)), (right, np.linalg.inv(_T_LEFT_RIGHT))):
        point = T[:3, :3] @ point_left + T[:3, 3]
        u, v, w = camera.P[:, :3] @ camera.R @ point
        maps = rectification_maps(camera)
        assert maps is not None
        column, row = round(u / w), round(v / w)
        ray = camera.R.T @ np.linalg.solve(camera.P[:, :3], [column, row, 1.0])
        project: Any = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
        pixel, _ = project(ray[None, None], np.zeros(3), np.zeros(3), camera.K, camera.D)
        np.testing.assert_allclose(
            [m[row, column] for m in maps], np.asarray(pixel).ravel(), atol=1e-3
        )
        uv[camera is left] = np.array([u / w, v / w])
    assert uv[True][1] == pytest.approx(uv[False][1], abs=1e-9)
    depth = (left.R @ point_left)[2]
    baseline = stereo_baseline((left, right), "")
    assert uv[True][0] - uv[False][0] == pytest.approx(left.P[0, 0] * baseline / depth)


def test_rectified_images_without_baseline_take_it_fromtf(tmp_path: Path) -> None:
    T = _pose([0, 0, 0], [0.25, 0, 0])
    messages = [*_pair("image_rect", P=_P), tf("/tf_static", "left_optical", "right_optical", T)]
    left, right = _found(tmp_path / "a.bag", messages).calibrations
    assert left.is_rectified
    assert right.P[0, 3] == pytest.approx(-50 * 0.25)
    T = _pose([0, 0.05, 0], [0.25, 0, 0])
    messages[-1] = tf("/tf_static", "left_optical", "right_optical", T)
    with pytest.raises(CalibrationError, match=r"turned by 2\.86 deg .* --calibration FILE"):
        _found(tmp_path / "b.bag", messages)


@pytest.mark.parametrize("name", ["image_rect", "image_raw"])
def test_tf_decides_where_the_sign_of_p_is_wrong(tmp_path: Path, name: str) -> None:
    messages = _pair(name, P=_P)
    P_right = [50.0, 0, 23.5, 12.5, *_P[4:]]
    messages[3] = camera_info("/s/right/camera_info", "right_optical", P=P_right)
    T = _pose([0, 0, 0], [0.25, 0, 0])
    mount = tf("/tf_static", "left_optical", "right_optical", T)
    found = _found(tmp_path / "a.bag", [*messages, mount])
    assert found.calibrations[1].P[0, 3] == pytest.approx(-50 * 0.25)
    assert found.decisions[-1] == (
        "baseline: 0.2500 m from tf left_optical -> right_optical, which the sign of P of "
        "/s/right/camera_info contradicts"
    )
    exchanged = tf("/tf_static", "left_optical", "right_optical", _pose([0, 0, 0], [-0.25, 0, 0]))
    for number, more in enumerate(([], [exchanged])):
        text = r"got -0.25 m from P.3. of .*none from tf: .* exchange --left .*--calibration FILE"
        with pytest.raises(CalibrationError, match=text):
            _found(tmp_path / f"{number}.bag", [*messages, *more])


@pytest.mark.parametrize("is_compressed", [False, True])
def test_a_size_of_zero_is_that_of_the_image(tmp_path: Path, is_compressed: bool) -> None:
    messages = _pair(width=0, height=0)
    messages[:2] = [_image(f"/s/{side}/image_raw", (64, 40)) for side in ("left", "right")]
    if is_compressed:
        data = np.asarray(cv2.imencode(".png", np.zeros((40, 64), np.uint8))[1]).ravel()
        fields = {"header": header("camera"), "format": "png", "data": data}
        messages[:2] = [
            (f"{m[0]}/compressed", COMPRESSED_TYPE, 0, make(COMPRESSED_TYPE, **fields))
            for m in messages[:2]
        ]
    found = _found(tmp_path / "a.bag", [*messages, *_mounts()])
    assert (found.calibrations[0].width, found.calibrations[0].height) == (64, 40)
    assert any("left/camera_info leaves the size 0: 64x40 px" in line for line in found.decisions)


def _rgbd(depth_name: str = "/c/depth/image_raw", **depth: Any) -> list[Message]:
    frame_id = depth.pop("frame_id", "depth_optical")
    return [
        _image("/c/rgb/image_raw"),
        _image(depth_name),
        camera_info("/c/rgb/camera_info", "color_optical"),
        camera_info(f"{depth_name.rpartition('/')[0]}/camera_info", frame_id, **depth),
    ]


_DEPTH_K = [40.0, 0, 25.0, 0, 40.0, 14.0, 0, 0, 1]
_T_COLOR_DEPTH = _pose([0.01, 0.02, -0.01], [0.015, 0.001, -0.002])


def test_depth_of_another_camera_comes_with_its_calibration_and_place(tmp_path: Path) -> None:
    # The tf tree is up to the other side: the depth camera is the parent of the colour camera.
    mount = tf("/tf_static", "depth_optical", "color_optical", se3.invert(_T_COLOR_DEPTH))
    found = _found(tmp_path / "a.bag", [*_rgbd(K=_DEPTH_K, width=64, D=_D), mount])
    view = found.depth_view
    assert view is not None
    np.testing.assert_allclose(view.T_color_depth, _T_COLOR_DEPTH, atol=1e-9)
    assert (view.calibration.width, view.calibration.K[0, 0]) == (64, 40.0)
    np.testing.assert_array_equal(view.calibration.D, _D)
    assert found.frame_id == "color_optical"
    (line,) = [line for line in found.decisions if line.startswith("depth: ")]
    assert "0.0152 m from colour by tf color_optical -> depth_optical" in line


@pytest.mark.parametrize(
    ("name", "depth"),
    [
        ("/c/depth/image_raw", {"frame_id": "color_optical"}),
        ("/c/depth/image_raw", {"frame_id": "/color_optical"}),
        ("/c/depth/image_raw", {"frame_id": "coincident"}),
        # a driver that leaves the frame of the depth camera
        ("/c/aligned_depth_to_color/image_raw", {}),
        ("/c/depth_registered/image_raw", {}),
        ("/c/depth_to_rgb/image_raw", {}),
    ],
)
def test_registered_depth_is_left_alone(tmp_path: Path, name: str, depth: dict[str, Any]) -> None:
    mounts = [
        tf("/tf_static", "color_optical", "depth_optical", _T_COLOR_DEPTH),
        tf("/tf_static", "color_optical", "coincident", np.eye(4)),
    ]
    found = _found(tmp_path / "a.bag", [*_rgbd(name, **depth), *mounts])
    assert found.depth_view is None
    assert not any(line.startswith("depth: ") for line in found.decisions)


_HALF = {"width": 24, "height": 16, "K": [25.0, 0, 11.5, 0, 25.0, 7.5, 0, 0, 1]}


@pytest.mark.parametrize(
    ("name", "depth", "place"),
    [
        ("/c/depth_registered/image_raw", {"K": _DEPTH_K}, _T_COLOR_DEPTH),
        ("/c/aligned_depth_to_color/image_raw", {"K": _DEPTH_K}, _T_COLOR_DEPTH),
        ("/c/aligned_depth_to_infra1/image_raw", {}, _T_COLOR_DEPTH),
        ("/c/depth/image_raw", {}, _T_COLOR_DEPTH),
        ("/c/depth/image_raw", _HALF, _T_COLOR_DEPTH),
        ("/c/depth_registered/image_raw", _HALF, np.eye(4)),
        ("/c/depth_registered/image_raw", {"frame_id": "color_optical", **_HALF}, np.eye(4)),
        ("/c/depth/image_raw", {"frame_id": "color_optical", **_HALF}, np.eye(4)),
        ("/c/depth/depth_registered", {"frame_id": "color_optical", "K": _DEPTH_K}, np.eye(4)),
    ],
)
def test_depth_is_registered_by_frame_and_intrinsics_not_by_a_word(
    tmp_path: Path, name: str, depth: dict[str, Any], place: FloatArray
) -> None:
    mount = tf("/tf_static", "color_optical", "depth_optical", _T_COLOR_DEPTH)
    view = _found(tmp_path / "a.bag", [*_rgbd(name, **depth), mount]).depth_view
    assert view is not None
    np.testing.assert_allclose(view.T_color_depth, place, atol=1e-9)
    assert view.calibration.width == depth.get("width", 48)


@pytest.mark.parametrize(("size", "width"), [((48, 32), None), ((24, 16), 24), ((16, 10), 16)])
def test_depth_without_camera_info_has_larger_pixels_than_colour(
    tmp_path: Path, size: tuple[int, int], width: int | None
) -> None:
    color, _, info, _ = _rgbd()
    found = _found(tmp_path / "a.bag", [color, _image("/c/depth/image_raw", size), info])
    assert found.info_names == ("/c/rgb/camera_info",)
    view = found.depth_view
    assert (None if view is None else view.calibration.width) == width
    if view is not None:
        assert view.calibration.height == size[1]
        assert view.calibration.K[0, 0] == pytest.approx(50.0 * size[0] / 48)
        np.testing.assert_array_equal(view.T_color_depth, np.eye(4))


@pytest.mark.parametrize(("fx", "is_registered"), [(50.0, True), (49.6, False)])
def test_depth_of_the_rectified_image_is_not_that_of_a_raw_one(
    tmp_path: Path, fx: float, is_registered: bool
) -> None:
    """As a ZED's: one frame, one size, a lens of colour alone, and nearly its focal length."""
    messages = _rgbd("/c/depth/depth_registered", K=[fx, 0, 23.5, 0, fx, 15.5, 0, 0, 1])
    infos = [camera_info("/c/rgb/camera_info", "depth_optical", D=_D), messages[3]]
    found = _found(tmp_path / "a.bag", [*messages[:2], *infos])
    assert (found.depth_view is None) == is_registered


_SEEN = ("eye", (48, 32))


@pytest.mark.parametrize(
    ("image_name", "infos", "expected"),
    [
        ("/left/image_rect", {"/left/camera_info": _SEEN}, "/left/camera_info"),
        ("left/image_rect", {"left/camera_info": _SEEN}, "left/camera_info"),
        ("/cam0", {"/cam0/camera_info": _SEEN}, "/cam0/camera_info"),
        ("/cam0/image/data", {"/cam0/camera_info": _SEEN}, "/cam0/camera_info"),
        ("/C_0/image/data", {"/C_0/info/camera_info": _SEEN}, "/C_0/info/camera_info"),
        ("/image", {"/camera_info": _SEEN}, "/camera_info"),
        # a driver that calls one camera by two frames
        ("/left/image_rect", {"/left/camera_info": ("other", (48, 32))}, "/left/camera_info"),
        ("/left/image_rect", {"/left/camera_info": ("", (0, 0))}, "/left/camera_info"),
        # raw and rectified
        (
            "/zed/rgb/image_raw_color",
            {"/zed/rgb/camera_info": _SEEN, "/zed/rgb/camera_info_raw": _SEEN},
            "/zed/rgb/camera_info_raw",
        ),
        (
            "/zed/rgb/image_rect_color",
            {"/zed/rgb/camera_info_raw": _SEEN, "/zed/rgb/camera_info": _SEEN},
            "/zed/rgb/camera_info",
        ),
        ("/zed/rgb/image_rect_color", {"/zed/rgb/camera_info_raw": _SEEN}, None),
        (
            "/left/color/rect/image",
            {"/left/color/raw/camera_info": _SEEN, "/left/color/rect/camera_info": _SEEN},
            "/left/color/rect/camera_info",
        ),
        ("/left/color/rect/image", {"/left/color/raw/camera_info": _SEEN}, None),
        (
            "/rgb/image_rect_color",
            {"/rgb/image_rect_color/camera_info": _SEEN},
            "/rgb/image_rect_color/camera_info",
        ),
        ("/infra1/image_rect_raw", {"/infra1/camera_info": _SEEN}, "/infra1/camera_info"),
        # numbers and sides
        (
            "/cam/image_0",
            {"/cam/camera_info_1": _SEEN, "/cam/camera_info_0": _SEEN},
            "/cam/camera_info_0",
        ),
        (
            "/cam/image_1",
            {"/cam/camera_info_0": _SEEN, "/cam/camera_info_1": _SEEN},
            "/cam/camera_info_1",
        ),
        (
            "/s/left_image",
            {"/s/right_camera_info": _SEEN, "/s/left_camera_info": _SEEN},
            "/s/left_camera_info",
        ),
        ("/s/left/image", {"/s/right/camera_info": _SEEN}, None),
        ("/cam1/image", {"/cam0/camera_info": _SEEN}, None),
        ("/s/left/image", {"/infos/right": _SEEN, "/infos/left": _SEEN}, "/infos/left"),
        # elsewhere, with the size and the frame of the images
        ("/cam/image_raw", {"/cam/camera_info_0": _SEEN}, "/cam/camera_info_0"),
        ("/cam/image_raw", {"/cam/camera_info_0": ("other", (48, 32))}, None),
        ("/cam/image_raw", {"/cam/camera_info_0": _SEEN, "/cam/camera_info_1": _SEEN}, None),
        (
            "/cam/image_raw",
            {"/x/camera_info": _SEEN, "/cam/b/camera_info": _SEEN},
            "/cam/b/camera_info",
        ),
        ("/cam/image_raw", {"/cam/camera_info_0": ("eye", (96, 64))}, None),
        (
            "/cam/image_raw",
            {"/cam/camera_info": ("eye", (96, 64)), "/cam/half/camera_info": _SEEN},
            "/cam/half/camera_info",
        ),
        (
            "/cam/image_raw",
            {"/cam/camera_info": ("other", (48, 32)), "/driver/camera_info": _SEEN},
            "/driver/camera_info",
        ),
        ("/cam/image_raw", {"/cam/camera_info": ("eye", (96, 64))}, "/cam/camera_info"),
    ],
)
def test_a_camera_info_is_that_of_the_image_s_name_size_and_frame(
    tmp_path: Path,
    image_name: str,
    infos: dict[str, tuple[str, tuple[int, int]]],
    expected: str | None,
) -> None:
    messages = [_image(image_name, frame_id="eye"), _image("/other")]
    for name, (frame_id, (width, height)) in infos.items():
        messages.append(camera_info(name, frame_id, width=width, height=height))
    choice = {"color": image_name, "depth": "/other"}
    if expected is None:
        with pytest.raises(
            CalibrationError, match=f"no CameraInfo for {image_name}, it holds /.*-i"
        ):
            _found(tmp_path / "a.bag", messages, **choice)
        return
    assert _found(tmp_path / "a.bag", messages, **choice).info_names[0] == expected


def test_camera_info_is_what_the_user_names_in_the_order_of_the_images(tmp_path: Path) -> None:
    P_right = [*_P[:3], -25.0, *_P[4:]]
    infos = [camera_info("/s/a", P=_P), camera_info("/s/b", P=P_right), *_pair("image_rect", P=_P)]
    reader = BagReader(write(tmp_path / "a.bag", infos))
    topics = choose_topics(reader.topics, TopicChoice(), "the bag")
    found = calibrations_of_messages(reader, topics, "the bag", ["/s/a", "s/b"])
    assert found.info_names == ("/s/a", "/s/b")
    assert found.calibrations[1].P[0, 3] == -25.0
    with pytest.raises(
        CalibrationError, match=r"right/image_rect on /s/c, it holds .*--camera-info"
    ):
        calibrations_of_messages(reader, topics, "the bag", ["/s/a", "/s/c"])
