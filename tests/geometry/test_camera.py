"""Camera models against OpenCV, and the rectification of raw pairs."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry.camera import (
    Calibration,
    PinholeCamera,
    StereoCamera,
    rectification_maps,
    rectify_stereo,
    stereo_camera,
)
from gvo.types import FloatArray

seeds = st.integers(min_value=0, max_value=2**32 - 1)
lengths = st.floats(min_value=100.0, max_value=2000.0)
CAMERA = StereoCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)


@settings(deadline=None)
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
        ({"cx": np.inf}, "finite"),
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


def ideal(**changes: float) -> Calibration:
    values: dict[str, float] = {"fx": 500.0, "fy": 480.0, "cx": 320.0, "cy": 240.0}
    camera = PinholeCamera(**(values | changes), width=640, height=480)
    return Calibration.from_camera(camera)


def test_two_ideal_calibrations_give_their_camera_back() -> None:
    right = Calibration.from_camera(CAMERA, baseline=0.2)
    camera = stereo_camera(Calibration.from_camera(CAMERA), right)
    assert camera.baseline == pytest.approx(0.2)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 480.0, 320.0, 240.0)
    assert (camera.width, camera.height) == (640, 480)
    assert camera == stereo_camera(ideal(), right)


def test_an_image_of_one_pixel_is_one() -> None:
    camera = PinholeCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=1, height=1)
    np.testing.assert_array_equal(camera.K, [[500.0, 0, 320], [0, 480, 240], [0, 0, 1]])


@pytest.mark.parametrize("baseline", [0.0, 0.2])
def test_the_calibration_of_an_ideal_camera_says_all_that_a_camera_info_says(
    baseline: float,
) -> None:
    if baseline:
        calibration = Calibration.from_camera(CAMERA, baseline=baseline)
    else:
        calibration = Calibration.from_camera(CAMERA)
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
    right = with_other_p(Calibration.from_camera(CAMERA, baseline=0.2), 0, 3, 30.0)
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
def test_rounding_of_a_projection_is_no_other_camera(
    row: int, column: int, value: float, is_one: bool
) -> None:
    right = with_other_p(Calibration.from_camera(CAMERA, baseline=0.2), row, column, value)
    if is_one:
        assert stereo_camera(ideal(), right).baseline == pytest.approx(0.2, rel=1e-5)
    else:
        with pytest.raises(CalibrationError, match="first three"):
            stereo_camera(ideal(), right)


def test_exchanged_cameras_are_refused() -> None:
    with pytest.raises(CalibrationError, match="exchanged"):
        stereo_camera(Calibration.from_camera(CAMERA, baseline=0.2), ideal())


def test_a_pair_without_baseline_is_refused() -> None:
    with pytest.raises(CalibrationError, match="baseline"):
        stereo_camera(ideal(), ideal())


def test_a_pair_of_different_intrinsics_is_refused() -> None:
    with pytest.raises(CalibrationError, match="rectified"):
        stereo_camera(
            ideal(),
            Calibration.from_camera(
                CAMERA.__class__(
                    fx=501.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2
                ),
                baseline=0.2,
            ),
        )


def test_a_pair_of_different_sizes_is_refused_with_both_sizes() -> None:
    small = PinholeCamera(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=320, height=240)
    with pytest.raises(CalibrationError, match=r"640x480.*320x240"):
        stereo_camera(ideal(), Calibration.from_camera(small, baseline=0.2))


def raw(K: FloatArray, D: list[float]) -> Calibration:
    """Return a raw calibration whose R and P are of no use."""
    return Calibration(
        width=752,
        height=480,
        K=K,
        D=np.array(D),
        R=np.full((3, 3), np.nan),
        P=np.full((3, 4), np.nan),
        is_rectified=False,
    )


LEFT = raw(np.array([[458.0, 0, 367], [0, 457, 248], [0, 0, 1]]), [-0.28, 0.07, 2e-4, 2e-5, 0.0])
RIGHT = raw(np.array([[457.0, 0, 379], [0, 456, 255], [0, 0, 1]]), [-0.29, 0.08, -1e-4, 3e-5, 0.0])


def raw_pair_pose(seed: int) -> FloatArray:
    """Return T_left_right of cameras mounted with a few degrees of error."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
    T[:3, 3] = np.array([0.11, 0.0, 0.0]) + 0.003 * rng.normal(size=3)
    return T


def rectified_pixels(calibration: Calibration, pixels_raw: FloatArray) -> FloatArray:
    """Find where raw pixels (n, 2) come to lie, by searching the maps for them."""
    maps = rectification_maps(calibration)
    assert maps is not None
    found = np.full((len(pixels_raw), 2), 300.0)
    for _ in range(60):  # fixed point: the maps are close to a shift
        at = found[:, ::-1].T
        values = np.stack([map_coordinates(m, at, order=1, mode="nearest") for m in maps], axis=1)
        found += 0.8 * (pixels_raw - values)
    return found


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_points_seen_by_raw_cameras_land_on_one_row_at_the_disparity_of_their_depth(
    seed: int,
) -> None:
    T_left_right = raw_pair_pose(seed)
    left, right = rectify_stereo(LEFT, RIGHT, T_left_right)
    camera = stereo_camera(left, right)
    assert camera.baseline == pytest.approx(np.linalg.norm(T_left_right[:3, 3]))
    rng = np.random.default_rng(seed)
    points_left = rng.uniform([-0.6, -0.4, 2.0], [0.8, 0.4, 8.0], size=(40, 3))
    T_right_left = np.linalg.inv(T_left_right)
    rotation, _ = cv2.Rodrigues(T_right_left[:3, :3])
    zero = np.zeros(3)
    seen_left, _ = cv2.projectPoints(points_left, zero, zero, LEFT.K, LEFT.D)
    seen_right, _ = cv2.projectPoints(points_left, rotation, T_right_left[:3, 3], RIGHT.K, RIGHT.D)
    pixels_left = rectified_pixels(left, np.asarray(seen_left, dtype=np.float64)[:, 0])
    pixels_right = rectified_pixels(right, np.asarray(seen_right, dtype=np.float64)[:, 0])
    np.testing.assert_allclose(pixels_left[:, 1], pixels_right[:, 1], atol=0.02)
    points_cam = points_left @ left.R.T
    expected = camera.project_stereo(points_cam)
    np.testing.assert_allclose(pixels_left, expected[:, :2], atol=0.02)
    np.testing.assert_allclose(pixels_left[:, 0] - pixels_right[:, 0], expected[:, 2], atol=0.03)


def test_rectification_keeps_the_raw_calibrations() -> None:
    left, right = rectify_stereo(LEFT, RIGHT, raw_pair_pose(0))
    for before, after in ((LEFT, left), (RIGHT, right)):
        assert after.K is before.K
        assert after.D is before.D
        assert (after.width, after.height) == (752, 480)
        assert not after.is_rectified
        np.testing.assert_allclose(after.R @ after.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(left.P[:, :3], right.P[:, :3])


def test_what_is_rectified_here_is_not_called_rectified_already() -> None:
    said = [replace(lens, is_rectified=True) for lens in (LEFT, RIGHT)]
    for rectified in rectify_stereo(said[0], said[1], raw_pair_pose(0)):
        assert not rectified.is_rectified
        assert rectification_maps(rectified) is not None


def test_a_pair_at_which_opencv_gives_up_is_refused_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise cv2.error("no projection")

    monkeypatch.setattr(cv2, "stereoRectify", give_up)
    with pytest.raises(CalibrationError, match=r"cannot be rectified.*calibrate the pair again"):
        rectify_stereo(LEFT, RIGHT, raw_pair_pose(0))


def test_nothing_is_to_be_done_for_rectified_images() -> None:
    assert rectification_maps(ideal()) is None
    as_raw = Calibration(
        width=640,
        height=480,
        K=CAMERA.K,
        D=np.zeros(5),
        R=np.eye(3),
        P=np.hstack([CAMERA.K, np.zeros((3, 1))]),
        is_rectified=False,
    )
    assert rectification_maps(as_raw) is None


@pytest.mark.parametrize("what", ["D", "R", "P"])
def test_each_difference_between_raw_and_rectified_is_mapped(what: str) -> None:
    values: dict[str, Any] = {
        "K": CAMERA.K,
        "D": np.zeros(5),
        "R": np.eye(3),
        "P": np.hstack([CAMERA.K, np.zeros((3, 1))]),
    }
    values[what] = values[what].copy()
    if what == "D":
        values["D"][0] = -0.1
    elif what == "R":
        values["R"] = Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix()
    else:
        values["P"][0, 2] += 5.0
    maps = rectification_maps(Calibration(width=640, height=480, is_rectified=False, **values))
    assert maps is not None
    # Where a rectified pixel comes from, by OpenCV's projection of its ray.
    row, column = 100, 500
    ray = values["R"].T @ np.linalg.solve(values["P"][:, :3], [column, row, 1.0])
    pixel, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), CAMERA.K, values["D"])
    u, v = (float(m[row, column]) for m in maps)
    np.testing.assert_allclose([u, v], np.asarray(pixel).ravel(), atol=1e-3)
    assert [m.dtype for m in maps] == [np.float32, np.float32]
    assert [m.shape for m in maps] == [(480, 640)] * 2
