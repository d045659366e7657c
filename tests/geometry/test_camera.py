"""Camera models against OpenCV."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry.camera import (
    Calibration,
    PinholeCamera,
    StereoCamera,
    rectification_maps,
    stereo_camera,
)
from tests.geometry.scenes import CAMERA, seeds

lengths = st.floats(min_value=100.0, max_value=2000.0)


@given(fx=lengths, fy=lengths, baseline=st.floats(0.01, 2.0), seed=seeds)
def test_unprojecting_undoes_projecting(fx: float, fy: float, baseline: float, seed: int) -> None:
    camera = StereoCamera(
        fx=fx, fy=fy, cx=310.0, cy=250.0, width=640, height=480, baseline=baseline
    )
    points = np.random.default_rng(seed).uniform([-5, -5, 0.5], [5, 5, 90], size=(4, 5, 3))
    uvd = camera.project_stereo(points)
    assert uvd.shape == (4, 5, 3)
    np.testing.assert_array_equal(uvd[..., :2], camera.project(points))
    np.testing.assert_allclose(
        camera.unproject_stereo(uvd[..., :2], uvd[..., 2]), points, rtol=1e-9, atol=1e-9
    )
    rays = camera.unproject(uvd[..., :2])
    np.testing.assert_allclose(rays * points[..., 2:], points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(camera.disparity_to_depth(uvd[..., 2]), points[..., 2])
    np.testing.assert_allclose(camera.depth_to_disparity(points[..., 2]), uvd[..., 2])


def test_projection_is_that_of_opencv_and_disparity_that_of_a_second_camera() -> None:
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 20], size=(50, 3))
    zero = np.zeros(3)
    left, _ = cv2.projectPoints(points, zero, zero, CAMERA.K, np.zeros(5))
    right, _ = cv2.projectPoints(points, zero, np.array([-0.2, 0, 0]), CAMERA.K, np.zeros(5))
    uvd = CAMERA.project_stereo(points)
    np.testing.assert_allclose(uvd[:, :2], np.asarray(left)[:, 0], atol=1e-9)
    np.testing.assert_allclose(uvd[:, 2], (left - right)[:, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"fx": 0.0}, "focal"),
        ({"fy": 0.0}, "focal"),
        ({"fy": -1.0}, "focal"),
        ({"fx": np.nan}, "focal"),
        ({"cx": np.inf}, "finite, got .* cx=inf"),
        ({"width": 0}, "size"),
        ({"height": 0}, "size"),
        ({"height": -3}, "size"),
        ({"baseline": 0.0}, "baseline"),
        ({"baseline": -0.5}, "exchanged"),
        ({"baseline": np.nan}, "baseline"),
    ],
)
def test_what_is_no_camera_is_refused(changes: dict[str, float], match: str) -> None:
    values = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 4, "height": 3, "baseline": 1.0}
    with pytest.raises(CalibrationError, match=match):
        StereoCamera(**(values | changes))  # type: ignore[arg-type]


def ideal() -> Calibration:
    return Calibration.from_camera(
        PinholeCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480)
    )


RIGHT = Calibration.from_camera(CAMERA, baseline=0.2)


def test_two_ideal_calibrations_give_their_camera_back() -> None:
    camera = stereo_camera(Calibration.from_camera(CAMERA), RIGHT)
    assert camera.baseline == pytest.approx(0.2)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 480.0, 320.0, 240.0)
    assert (camera.width, camera.height) == (640, 480)
    assert camera == stereo_camera(ideal(), RIGHT)


def test_an_image_of_one_pixel_is_one() -> None:
    camera = PinholeCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=1, height=1)
    np.testing.assert_array_equal(camera.K, [[500.0, 0, 320], [0, 480, 240], [0, 0, 1]])


@pytest.mark.parametrize("baseline", [0.0, 0.2])
def test_the_calibration_of_an_ideal_camera_says_all_a_camera_info_says(baseline: float) -> None:
    calibration = Calibration.from_camera(CAMERA, **({"baseline": baseline} if baseline else {}))
    assert (calibration.width, calibration.height) == (640, 480)
    assert calibration.is_rectified
    assert calibration.model == "plumb_bob"
    np.testing.assert_array_equal(calibration.K, [[500.0, 0, 320], [0, 480, 240], [0, 0, 1]])
    np.testing.assert_array_equal(calibration.D, [0.0] * 5)
    np.testing.assert_array_equal(calibration.R, np.eye(3))
    P = [[500.0, 0, 320, -500 * baseline], [0, 480, 240, 0], [0, 0, 1, 0]]
    np.testing.assert_array_equal(calibration.P, P)
    np.testing.assert_array_equal(calibration.lens.K, calibration.K)


def with_other_p(calibration: Calibration, row: int, column: int, value: float) -> Calibration:
    P = calibration.P.copy()
    P[row, column] += value
    return replace(calibration, P=P)


def test_only_what_lies_between_the_two_cameras_is_their_baseline() -> None:
    # Projections of a pair may be given about a third origin.
    left = with_other_p(ideal(), 0, 3, 50.0)
    right = with_other_p(RIGHT, 0, 3, 30.0)
    assert stereo_camera(left, right).baseline == pytest.approx((50.0 + 100.0 - 30.0) / 500.0)
    # The other rows are of no account.
    left, right = with_other_p(left, 1, 3, 7.0), with_other_p(right, 1, 3, 9.0)
    assert stereo_camera(left, right).baseline == pytest.approx(0.24)


@pytest.mark.parametrize(
    ("row", "column", "value", "is_one"),
    [
        (0, 0, 4.9e-4, True),  # a millionth of the focal length
        (0, 0, 5.1e-4, False),
        (0, 1, 0.9e-6, True),  # and a millionth where there should be nothing
        (0, 1, 1.1e-6, False),
        (2, 2, -1.9e-6, True),
        (2, 2, -2.1e-6, False),
    ],
)
def test_a_rounded_camera_is_the_same(row: int, column: int, value: float, is_one: bool) -> None:
    right = with_other_p(RIGHT, row, column, value)
    if is_one:
        assert stereo_camera(ideal(), right).baseline == pytest.approx(0.2, rel=1e-5)
    else:
        with pytest.raises(CalibrationError, match="first three"):
            stereo_camera(ideal(), right)


@pytest.mark.parametrize(
    ("left", "right", "match"),
    [
        (RIGHT, ideal(), "exchanged"),
        (ideal(), ideal(), "baseline"),
        (ideal(), Calibration.from_camera(replace(CAMERA, fx=501.0), baseline=0.2), "rectified"),
        (ideal(), replace(RIGHT, width=320, height=240), "640x480.*320x240"),
    ],
)
def test_what_is_no_pair_is_refused(left: Calibration, right: Calibration, match: str) -> None:
    with pytest.raises(CalibrationError, match=match):
        stereo_camera(left, right)


AS_RAW = replace(ideal(), is_rectified=False)


def test_nothing_is_to_be_done_for_rectified_images() -> None:
    assert rectification_maps(ideal()) is None
    assert rectification_maps(AS_RAW) is None


@pytest.mark.parametrize("what", ["D", "R", "P"])
def test_each_difference_between_raw_and_rectified_is_mapped(what: str) -> None:
    other: dict[str, Any] = {
        "D": np.array([-0.1, 0.0, 0.0, 0.0, 0.0]),
        "R": Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix(),
        "P": AS_RAW.P + np.outer([5.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]),
    }
    calibration = replace(AS_RAW, **{what: other[what]})
    maps = rectification_maps(calibration)
    assert maps is not None
    # Where a rectified pixel comes from, by OpenCV's projection of its ray.
    row, column = 100, 500
    ray = calibration.R.T @ np.linalg.solve(calibration.P[:, :3], [column, row, 1.0])
    pixel, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), CAMERA.K, calibration.D)
    u, v = (float(m[row, column]) for m in maps)
    np.testing.assert_allclose([u, v], np.asarray(pixel).ravel(), atol=1e-3)
    assert [m.dtype for m in maps] == [np.float32, np.float32]
    assert [m.shape for m in maps] == [(480, 640)] * 2


def test_the_view_ends_at_the_centres_of_the_outer_pixels() -> None:
    right, bottom = CAMERA.width - 1.0, CAMERA.height - 1.0
    inside = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    assert CAMERA.is_in_view(inside).all()
    for step in ([-0.1, 0.0], [0.0, -0.1]):
        assert not CAMERA.is_in_view(inside[:1] + step).any()
        assert not CAMERA.is_in_view(inside[3:] - step).any()
