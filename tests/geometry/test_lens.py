"""Lenses against OpenCV's projections of the same points, and the rectification of pairs."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.geometry import lens as lens_module
from gvo.geometry import se3
from gvo.geometry.camera import Calibration, rectification_maps, rectify_stereo, stereo_camera
from gvo.geometry.lens import N_COEFFICIENTS, DistortionModel, Lens, bouguet_wide
from gvo.types import FloatArray
from tests.geometry.scenes import random_motion, seeds

# As calibrated for real cameras: a wide lens, one with eight coefficients, a fisheye.
_RADTAN = [-0.283, 0.0740, 1.9e-4, 1.8e-5, 0.0]
_RATIONAL = [0.62, -2.71, 4e-4, -2e-4, 1.55, 0.49, -2.53, 1.47]
_FISHEYE = [0.0034, 0.0007, -0.0020, 0.0002]
_LENSES: list[tuple[DistortionModel, list[float]]] = [
    ("plumb_bob", _RADTAN),
    ("rational_polynomial", _RATIONAL),
    ("rational_polynomial", [*_RATIONAL, 1e-3, -2e-3, 5e-4, 1e-3]),
    ("rational_polynomial", [*_RATIONAL, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.01]),
    ("equidistant", _FISHEYE),
]
_IDS = ["5", "8", "12", "14", "fisheye"]


def raw(
    model: DistortionModel, D: list[float], *, focal: float = 250.0, shift: float = 0.0
) -> Calibration:
    """Return a raw camera whose R and P are of no use."""
    K = np.array([[focal, 0, 260.0 + shift], [0, focal * 1.01, 250.0 - shift], [0, 0, 1]])
    return Calibration(
        width=512,
        height=480,
        K=K,
        D=np.array(D),
        R=np.full((3, 3), np.nan),
        P=np.full((3, 4), np.nan),
        is_rectified=False,
        model=model,
    )


def see(
    points: FloatArray, camera: Calibration, T_cam_points: FloatArray | None = None
) -> FloatArray:
    """Return the raw pixels (n, 2) of points (n, 3) by OpenCV's projection."""
    T = np.eye(4) if T_cam_points is None else T_cam_points
    rotation, _ = cv2.Rodrigues(T[:3, :3])
    project: Any = cv2.fisheye.projectPoints if len(camera.D) == 4 else cv2.projectPoints
    pixels, _ = project(points[:, None], rotation, T[:3, 3].copy(), camera.K, camera.D)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def maps_of(calibration: Calibration) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    maps = rectification_maps(calibration)
    assert maps is not None
    return maps


_SPLINE_PX = 3e-3  # between the pixels of a map a spline errs by 1.2e-3 near the corners


def read_maps(calibration: Calibration, pixels: FloatArray) -> FloatArray:
    """Return where the maps say that rectified pixels (n, 2) come from."""
    maps = maps_of(calibration)
    at = pixels[:, ::-1].T
    return np.stack([map_coordinates(m.astype(float), at, order=3) for m in maps], axis=1)


def visible(calibration: Calibration, rng: np.random.Generator, n: int = 60) -> FloatArray:
    """Return points (n, 3) of the rectified camera that lie in its image, 1 to 20 m away."""
    pixels = rng.uniform([5, 5], [calibration.width - 6, calibration.height - 6], (n, 2))
    return calibration.pinhole().unproject(pixels) * rng.uniform(1, 20, (n, 1))


@pytest.mark.parametrize(("model", "D"), _LENSES, ids=_IDS)
def test_the_maps_send_pixels_to_their_raw_pixels(model: DistortionModel, D: list[float]) -> None:
    rng = np.random.default_rng(0)
    camera = raw(model, D)
    R = np.asarray(Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix())
    P = np.array([[240.0, 0, 255, 0], [0, 245.0, 238, 0], [0, 0, 1, 0]])
    calibration = replace(camera, R=R, P=P)
    points_cam = visible(calibration, rng)
    found = read_maps(calibration, calibration.pinhole().project(points_cam))
    np.testing.assert_allclose(found, see(points_cam @ R, camera), atol=_SPLINE_PX)
    np.testing.assert_allclose(camera.lens.project(points_cam), see(points_cam, camera))


def test_each_model_says_how_many_numbers_it_has() -> None:
    assert {(model, len(D)) for model, D in _LENSES} == {
        (model, n) for model, counts in N_COEFFICIENTS.items() for n in counts
    }


def mount(seed: int) -> FloatArray:
    """Return T_left_right of cameras mounted with a few degrees of error."""
    T = random_motion(np.random.default_rng(seed), 0.03, 0.004)
    T[0, 3] += 0.11
    return T


_PAIRS = [
    *[(lens, lens) for lens in _LENSES],
    (_LENSES[0], _LENSES[1]),
    (_LENSES[4], _LENSES[0]),
    (_LENSES[0], _LENSES[4]),
]


@settings(max_examples=5)
@given(seed=seeds)
@pytest.mark.parametrize(("first", "second"), _PAIRS, ids=lambda lens: f"{lens[0]}{len(lens[1])}")
def test_a_point_lies_on_one_row_of_the_pair_at_the_disparity_of_its_depth(
    first: tuple[DistortionModel, list[float]],
    second: tuple[DistortionModel, list[float]],
    seed: int,
) -> None:
    T_left_right = mount(seed)
    raw_left, raw_right = raw(*first), raw(*second, focal=255.0, shift=8.0)
    left, right = rectify_stereo(raw_left, raw_right, T_left_right)
    camera = stereo_camera(left, right)
    assert camera.baseline == pytest.approx(np.linalg.norm(T_left_right[:3, 3]))
    points_cam = visible(left, np.random.default_rng(seed))
    points_left = points_cam @ left.R
    uvd = camera.project_stereo(points_cam)
    np.testing.assert_allclose(
        read_maps(left, uvd[:, :2]), see(points_left, raw_left), atol=_SPLINE_PX
    )
    pixels_right = uvd[:, :2] - np.stack([uvd[:, 2], np.zeros(len(uvd))], axis=1)
    is_seen = np.all((pixels_right > 4) & (pixels_right < [507, 475]), axis=1)
    assert is_seen.sum() > 20
    seen_right = see(points_left, raw_right, se3.invert(T_left_right))
    found = read_maps(right, pixels_right[is_seen])
    np.testing.assert_allclose(found, seen_right[is_seen], atol=_SPLINE_PX)


def test_the_rotations_of_wide_pairs_are_those_that_opencv_chooses() -> None:
    # Without distortion a fisheye's rotations and those of a pinhole are one.
    for seed in range(5):
        T_left_right = mount(seed)
        pinhole = raw("plumb_bob", [0.0] * 5)
        wide = rectify_stereo(raw("equidistant", _FISHEYE), pinhole, T_left_right)
        expected = rectify_stereo(pinhole, pinhole, T_left_right)
        for found, of_opencv in zip(wide, expected, strict=True):
            np.testing.assert_allclose(found.R, of_opencv.R, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_fisheye_pair_keeps_the_resolution_of_its_centre_without_a_border(seed: int) -> None:
    lenses = raw("equidistant", _FISHEYE, focal=190.0), raw("equidistant", _FISHEYE, focal=192.0)
    pair = rectify_stereo(*lenses, mount(seed))
    for rectified in pair:
        assert rectified.P[0, 0] == rectified.P[1, 1]
        assert 190.0 <= rectified.P[0, 0] < 1.1 * 192.0
        maps = maps_of(rectified)
        for values, size in zip(maps, (512, 480), strict=True):
            assert values.min() >= -0.01
            assert values.max() <= size - 1 + 0.01


def test_a_lens_narrower_than_a_plane_is_enlarged_until_no_border_is_empty() -> None:
    # pincushion: the rim of the raw image is nearer to the axis than that of a pinhole
    lens = raw("equidistant", [0.75, 0.1, 0.0, 0.0])
    left, _ = rectify_stereo(lens, lens, mount(1))
    maps = maps_of(left)
    assert left.P[0, 0] > 1.02 * lens.K[0, 0]
    assert maps[0].min() >= -0.01
    assert maps[1].max() <= 479.01


def test_a_pair_of_barrels_is_shrunk_to_show_all_that_leaves_no_border_empty() -> None:
    lens = raw("plumb_bob", _RADTAN)
    for rectified in rectify_stereo(lens, lens, mount(1)):
        assert 0.7 < rectified.P[0, 0] / lens.K[0, 0] < 0.95
        maps = maps_of(rectified)
        columns, rows = maps[0][240, [0, -1]], maps[1][[0, -1], 256]
        for values, size in ((columns, 512), (rows, 480)):
            assert values.min() >= -1.0
            assert values.max() <= size


def test_lenses_that_see_behind_the_plane_of_the_pair_are_still_rectified() -> None:
    # Half a field of 77 degrees, turned by another 17: the border lies behind the raw camera.
    T_left_right = mount(0)
    T_left_right[:3, :3] = Rotation.from_rotvec([0.0, 0.6, 0.0]).as_matrix()
    lens = raw("equidistant", [0.0] * 4, focal=60.0)
    for rectified in rectify_stereo(lens, lens, T_left_right):
        # No enlargement up to twice leaves the border full: the resolution of the centre stays.
        assert rectified.P[0, 0] == 60.0
        assert 0.0 < maps_of(rectified)[0][240, 256] < 511.0


@pytest.mark.parametrize("seed", range(3))
def test_the_middle_of_a_wide_pair_is_between_the_middles_of_its_lenses(seed: int) -> None:
    # Cameras that look far away from the baseline's square: turned by a quarter of a radian.
    T_left_right = mount(seed)
    T_left_right[:3, 3] = [0.1, 0.02, 0.025]
    left, right = rectify_stereo(
        raw("equidistant", _FISHEYE, focal=190.0),
        raw("equidistant", _FISHEYE, focal=192.0, shift=15.0),
        T_left_right,
    )
    seen = []
    for camera in (left, right):
        middle = np.array([[[(512 - 1) / 2, (480 - 1) / 2]]])
        pixel = cv2.fisheye.undistortPoints(middle, camera.K, camera.D, R=camera.R, P=left.P[:, :3])
        seen.append(np.asarray(pixel).ravel())
    np.testing.assert_allclose(np.mean(seen, axis=0), [511 / 2, 479 / 2], atol=1e-6)
    np.testing.assert_array_equal(left.P[:, :3], right.P[:, :3])


def test_a_fisheye_without_coefficients_is_still_no_pinhole() -> None:
    camera = raw("equidistant", [0.0] * 4)
    as_raw = replace(camera, R=np.eye(3), P=np.hstack([camera.K, np.zeros((3, 1))]))
    # 45 degrees off the axis: f * theta in the raw image, f * tan(theta) in the rectified one
    found = read_maps(as_raw, np.array([[260.0 + 200.0, 250.0]]))
    np.testing.assert_allclose(found, [[260.0 + 250.0 * np.arctan(0.8), 250.0]], atol=1e-3)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_exchanged_cameras_give_no_positive_baseline(model: DistortionModel) -> None:
    lens = raw(model, _RADTAN if model == "plumb_bob" else _FISHEYE)
    pair = rectify_stereo(lens, lens, se3.invert(mount(2)))
    with pytest.raises(CalibrationError, match="exchanged"):
        stereo_camera(*pair)


@pytest.mark.parametrize(
    "t",
    [[0.0, 0.1, 0.0], [0.05, 0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.0, 0.1], [0, 0, 0], [0, 0, 0.2]],
)
def test_cameras_that_do_not_stand_side_by_side_are_refused(t: list[float]) -> None:
    T_left_right = np.eye(4)
    T_left_right[:3, 3] = t
    lens = raw("plumb_bob", _RADTAN)
    with pytest.raises(CalibrationError, match=f"side by side, .* x={t[0]:g} y={t[1]:g}"):
        rectify_stereo(lens, lens, T_left_right)


def test_cameras_of_two_sizes_are_refused_with_both() -> None:
    lens = raw("plumb_bob", _RADTAN)
    small = replace(lens, width=256, height=240)
    with pytest.raises(CalibrationError, match=r"512x480 and 256x240") as caught:
        rectify_stereo(lens, small, mount(0))
    assert "\n" not in str(caught.value)


def test_rectification_keeps_the_raw_calibrations_but_for_what_they_say_of_it() -> None:
    pair = raw("plumb_bob", _RADTAN), raw("rational_polynomial", _RATIONAL, shift=8.0)
    said = [replace(lens, is_rectified=True) for lens in pair]
    left, right = rectify_stereo(said[0], said[1], mount(0))
    for before, after in zip(said, (left, right), strict=True):
        assert after.K is before.K
        assert after.D is before.D
        assert (after.width, after.height) == (512, 480)
        assert not after.is_rectified
        assert rectification_maps(after) is not None
        np.testing.assert_allclose(after.R @ after.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(left.P[:, :3], right.P[:, :3])


def test_a_pair_at_which_opencv_gives_up_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise cv2.error("no projection")

    monkeypatch.setattr(cv2, "stereoRectify", give_up)
    lens = raw("plumb_bob", _RADTAN)
    with pytest.raises(CalibrationError, match=r"cannot be rectified.*calibrate the pair again"):
        rectify_stereo(lens, lens, mount(0))


# Pinholes side by side: a wide pair of them is known to the last digit.

_SIZE = {"width": 401, "height": 301}


def pinhole(cx: float, cy: float, focal: float = 256.0) -> Lens:
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Lens(K=K, D=np.zeros(5), model="plumb_bob", **_SIZE)


def side_by_side(x: float) -> FloatArray:
    T_right_left = np.eye(4)
    T_right_left[0, 3] = x
    return T_right_left


@pytest.mark.parametrize("x", [-0.2, 0.2])
@pytest.mark.parametrize(
    ("offset", "zoom"), [(0.0, 1.0), (1.5, 1.01), (2.5, 1.02), (-4.5, 1.03), (99.0, 1.99)]
)
def test_lenses_that_are_off_their_middle_are_enlarged_as_little_as_fills_the_border(
    offset: float, zoom: float, x: float
) -> None:
    # Half of the width over the zoom, and the offset, must lie within half of the width.
    left, right = pinhole(200.0 + offset, 150.0), pinhole(200.0 - offset, 150.0)
    found = bouguet_wide(left, right, side_by_side(x))
    np.testing.assert_allclose(found.R_left, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.R_right, np.eye(3), atol=1e-12)
    if offset == 0.0:  # rounding may ask for one step more
        zoom = float(found.P_left[0, 0]) / 256.0
        assert zoom in (1.0, 1.01)
    K = np.array([[256.0 * zoom, 0, 200], [0, 256.0 * zoom, 150], [0, 0, 1]])
    np.testing.assert_allclose(found.P_left, np.hstack([K, np.zeros((3, 1))]), atol=1e-9)
    shift = [[256.0 * zoom * x], [0.0], [0.0]]
    np.testing.assert_allclose(found.P_right, np.hstack([K, shift]), atol=1e-9)


@pytest.mark.parametrize("axis", [(0, 0), (1, 1)])
def test_the_shortest_focal_length_of_all_is_kept(axis: tuple[int, int]) -> None:
    short = pinhole(200.0, 150.0)
    short.K[axis] = 250.0
    wide = pinhole(200.0, 150.0, focal=300.0)
    for pair in ((short, wide), (wide, short)):
        found = bouguet_wide(*pair, side_by_side(-0.1))
        assert 250.0 <= found.P_left[0, 0] == found.P_left[1, 1] < 1.5 * 250.0


@pytest.mark.parametrize(
    ("edges", "is_full"),
    [
        ((0.0, 400.0, 0.0, 300.0), True),  # on the border is inside
        ((0.5, 399.5, 0.5, 299.5), True),
        ((-0.5, 399.5, 0.5, 299.5), False),
        ((0.5, 400.5, 0.5, 299.5), False),
        ((0.5, 399.5, -0.5, 299.5), False),
        ((0.5, 399.5, 0.5, 300.5), False),
    ],
)
def test_a_border_is_full_where_all_of_its_four_sides_lie_in_the_raw_image(
    edges: tuple[float, float, float, float], is_full: bool
) -> None:
    # Lenses whose raw image lies so in the rectified one; powers of two leave no rounding.
    left, right, top, bottom = edges
    fx, fy = 256.0 * (right - left) / 400.0, 256.0 * (bottom - top) / 300.0
    K = np.array([[fx, 0.0, left], [0.0, fy, top], [0.0, 0.0, 1.0]])
    camera = Lens(K=K, D=np.zeros(5), model="plumb_bob", **_SIZE)
    K_rectified = np.array([[256.0, 0.0, 0.0], [0.0, 256.0, 0.0], [0.0, 0.0, 1.0]])
    assert lens_module._is_full(camera, np.eye(3), K_rectified) == is_full


def test_a_border_that_is_partly_behind_the_camera_is_not_full() -> None:
    # Half of it is seen, and mirrored points of the other half would lie in the image as well.
    turned = np.asarray(Rotation.from_rotvec([0.0, np.pi / 2, 0.0]).as_matrix())
    camera = pinhole(200.0, 150.0, focal=1e-3)
    assert lens_module._is_full(camera, np.eye(3), pinhole(200.0, 150.0).K)
    assert not lens_module._is_full(camera, turned, pinhole(200.0, 150.0).K)


def test_what_a_lens_is_asked_stays_as_it_is() -> None:
    points = np.array([[0.3, -0.2, 2.0], [0.1, 0.4, 3.0]])
    points.setflags(write=False)
    found = pinhole(200.0, 150.0).project(points)
    np.testing.assert_allclose(found, 256.0 * points[:, :2] / points[:, 2:] + [200.0, 150.0])
