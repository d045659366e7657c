"""Calibrations from fields."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.io.calibration.camera_info import (
    CameraFields,
    RegionOfInterest,
    make_calibration,
    make_rgbd_calibration,
)

_K = [50.0, 0, 23.5, 0, 51.0, 15.5, 0, 0, 1]
_P = [40.0, 0, 20.5, -20.0, 0, 41.0, 10.5, 0, 0, 0, 1, 0]


def _fields(**changes: Any) -> CameraFields:
    values: dict[str, Any] = {
        "where": "/info",
        "width": 48,
        "height": 32,
        "model": "plumb_bob",
        "K": _K,
        "D": [0.1, -0.2, 0.001, 0.002, 0.05],
        "R": np.eye(3),
        "P": _P,
    }
    return CameraFields(**(values | changes))


def test_what_is_not_set_is_made_up_from_the_other_matrix() -> None:
    calibration = make_calibration(_fields(R=np.zeros(9), P=np.zeros(12)), is_rectified=False)
    np.testing.assert_array_equal(calibration.R, np.eye(3))
    np.testing.assert_array_equal(calibration.P[:, :3], calibration.K)
    rectified = make_calibration(_fields(K=np.zeros(9)), is_rectified=True)
    np.testing.assert_array_equal(rectified.K, rectified.P[:, :3])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"K": np.zeros(9), "P": np.zeros(12)}, "not calibrated"),
        ({"K": _K[:8]}, "K must hold 9 numbers, got 8"),
        ({"K": [np.nan, *_K[1:]]}, "not finite"),
        ({"K": ["a"] * 9}, "K must hold numbers"),
        ({"P": [-40.0, *_P[1:]]}, "focal lengths must be positive"),
        ({"P": [0.0, *_P[1:]]}, "focal lengths must be positive"),
        ({"R": 2 * np.eye(3)}, "R is not a rotation"),
        ({"K": [1e300, *_K[1:]]}, "K holds 1e.300"),
        ({"K": [10**400, *_K[1:]]}, "K must hold numbers"),
        ({"K": [0.0, *_K[1:]]}, "focal lengths must be positive, got K with fx=0 fy=51"),
        ({"K": [*_K[:8], 0.0]}, "third row of K must begin with 0 0 1, got 0 0 0"),
        ({"P": [*_P[:8], 1, 0, 1, 0]}, "third row of P must begin with 0 0 1, got 1 0 1"),
        ({"D": [0.1, 0.2]}, "D of plumb_bob must hold 4 or 5 numbers, got 2"),
        ({"D": [0.1] * 7}, "D of plumb_bob must hold 4 or 5 or 8 or 12 or 14 numbers, got 7"),
        ({"model": "equidistant"}, "D of equidistant must hold 4 numbers, got 5"),
        ({"model": "rational_polynomial", "D": [0.1] * 15}, "8 or 12 or 14 numbers, got 15"),
        ({"model": "thin_prism"}, "model 'thin_prism' .* expected plumb_bob"),
        ({"model": "Inverse Brown Conrady"}, "model 'Inverse Brown Conrady'"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "R is not a rotation"),
        ({"width": 0}, "image size must be positive"),
        ({"width": 2**31}, "at most 32767 px a side .* got 2147483648x32"),
        ({"height": 32768}, "at most 32767 px a side .* got 48x32768"),
        ({"width": 30000, "height": 30000}, "100 megapixels, got 30000x30000"),
        ({"roi": RegionOfInterest(x_offset=1, width=48)}, "the region .* image of 48x32 px"),
        ({"roi": RegionOfInterest(y_offset=33)}, "the region .* full image of 48x32 px"),
    ],
)
def test_a_camera_that_cannot_be_used_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(CalibrationError, match=f"/info.*{text}"):
        make_calibration(_fields(**changes), is_rectified=False)


def test_depth_is_not_rectified_by_a_camera_that_turns() -> None:
    R = np.asarray(Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix())
    with pytest.raises(CalibrationError, match=r"/info.*R turns the camera.*identity"):
        make_rgbd_calibration(_fields(R=R), is_rectified=False)
    # rectified images and their depth are turned already
    assert make_rgbd_calibration(_fields(R=R), is_rectified=True).is_rectified
    for unturned in (np.eye(3), np.zeros(9)):
        calibration = make_rgbd_calibration(_fields(R=unturned), is_rectified=False)
        np.testing.assert_array_equal(calibration.R, np.eye(3))


@pytest.mark.parametrize(
    ("name", "n", "model", "n_kept"),
    [
        ("plumb_bob", 4, "plumb_bob", 5),
        ("radtan", 4, "plumb_bob", 5),
        ("radial-tangential", 4, "plumb_bob", 5),
        ("Brown Conrady", 5, "plumb_bob", 5),
        ("plumb_bob", 8, "rational_polynomial", 8),
        ("rational_polynomial", 5, "rational_polynomial", 8),
        ("rational_polynomial", 8, "rational_polynomial", 8),
        ("rational_polynomial", 12, "rational_polynomial", 12),
        ("rational_polynomial", 14, "rational_polynomial", 14),
        ("equidistant", 4, "equidistant", 4),
        ("fisheye", 4, "equidistant", 4),
        ("kannala_brandt", 4, "equidistant", 4),
    ],
)
def test_the_model_goes_by_name_and_count(name: str, n: int, model: str, n_kept: int) -> None:
    D = np.linspace(0.01, 0.02, n)
    calibration = make_calibration(_fields(model=name, D=D), is_rectified=False)
    assert calibration.model == model
    np.testing.assert_array_equal(calibration.D, [*D, *[0.0] * (n_kept - n)])


def test_zeros_of_a_fisheye_mean_no_distortion_unless_they_are_meant() -> None:
    unset = make_calibration(_fields(model="equidistant", D=[0.0] * 4), is_rectified=False)
    assert unset.model == "plumb_bob"
    fields = _fields(model="equidistant", D=[0.0] * 4, is_distorted_by_zeros=True)
    assert make_calibration(fields, is_rectified=False).model == "equidistant"


@given(
    binning=st.sampled_from([0, 1, 2, 4]),
    offset=st.integers(0, 200),
    point=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_a_binned_region_sees_a_point_where_the_full_image_has_it(
    binning: int, offset: int, point: tuple[float, float]
) -> None:
    wide: dict[str, Any] = {
        "width": 1280,
        "height": 960,
        "K": [800.0, 0, 640, 0, 800, 480, 0, 0, 1],
    }
    roi = RegionOfInterest(x_offset=offset, y_offset=offset // 2, width=1000, height=800)
    fields = _fields(**wide, P=np.zeros(12), binning=(binning, binning), roi=roi)
    full = make_calibration(_fields(**wide, P=np.zeros(12)), is_rectified=False)
    part = make_calibration(fields, is_rectified=False)
    scale = max(binning, 1)
    points = np.array([[*point, 1.0]])
    np.testing.assert_allclose(
        part.lens.project(points) * scale + [offset, offset // 2],
        full.lens.project(points),
        atol=1e-9,
    )
    assert (part.width, part.height) == (1000 // scale, 800 // scale)


_QUARTER = RegionOfInterest(x_offset=320, y_offset=240, width=320, height=240)


@pytest.mark.parametrize(
    ("size", "focal", "centre", "changes", "doubt"),
    [
        ((320, 240), 525, (319.5, 239.5), {}, "of 640x480, the image is 320x240: factor 0.5"),
        ((320, 240), 525, (325.1, 249.7), {}, "of 640x480, the image is 320x240: factor 0.5"),
        ((640, 480), 262, (160.0, 120.0), {}, "of 320x240, the image is 640x480: factor 2"),
        ((640, 480), 262, (160, 120), {"binning": (2, 2)}, "before binning is 640x480: factor 2"),
        ((640, 360), 650, (480.2, 268.1), {}, "of 960x540, the image is 640x360: factor 0.667"),
        ((640, 480), 900, (639.5, 359.5), {}, "of 1280x720, the image is 640x480"),
        # cameras as they are: KITTI, EuRoC, freiburg1, KAIST, rectified TUM-VI; with a region
        ((1241, 376), 718, (607.19, 185.22), {}, ""),
        ((752, 480), 457, (379.999, 255.238), {}, ""),
        ((640, 480), 517, (318.643, 255.314), {}, ""),
        ((1280, 560), 813, (613.864, 249.41), {}, ""),
        ((512, 512), 62, (240.229, 255.732), {}, ""),
        ((640, 480), 525, (319.5, 239.5), {"roi": _QUARTER}, ""),
        ((640, 480), 525, (319.5, 239.5), {"roi": _QUARTER, "binning": (2, 2)}, ""),
        # cut: a third on the left; a quarter on the right and below; 40 % on the left and above
        ((427, 480), 525, (106.5, 239.5), {}, ""),
        ((480, 360), 525, (319.5, 239.5), {}, ""),
        ((384, 288), 525, (63.5, 47.5), {}, ""),
        ((640, 120), 525, (319.5, 239.5), {}, ""),
        ((640, 480), 525, (0.0, 0.0), {}, ""),
    ],
)
def test_a_principal_point_far_from_the_centre_tells_of_another_size(
    size: tuple[int, int],
    focal: float,
    centre: tuple[float, float],
    changes: dict[str, Any],
    doubt: str,
) -> None:
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    P = np.hstack([K, np.zeros((3, 1))])
    for is_rectified in (False, True):
        fields = _fields(width=size[0], height=size[1], K=K, P=P, **changes)
        found = make_calibration(fields, is_rectified=is_rectified).doubt
        assert doubt in found
        assert bool(doubt) == bool(found)
        assert found[:1] in ("", "K")
    ideal = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    fields = _fields(width=size[0], height=size[1], K=ideal, P=P, **changes)
    if not changes:  # P alone
        assert make_calibration(fields, is_rectified=False).doubt[:1] == ("P" if doubt else "")
        assert make_calibration(fields, is_rectified=True).doubt[:1] == ("P" if doubt else "")
