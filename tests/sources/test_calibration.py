"""Calibrations from fields and files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gvo.errors import CalibrationError
from gvo.sources.calibration import CameraFields, make_calibration, make_rgbd_calibration
from gvo.sources.calibration_files import read_calibration_file, read_mono_file, read_stereo_file

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


def test_all_numbers_are_taken_over_bit_by_bit() -> None:
    calibration = make_calibration(_fields(), is_rectified=False)
    np.testing.assert_array_equal(calibration.K.ravel(), _K)
    np.testing.assert_array_equal(calibration.D, [0.1, -0.2, 0.001, 0.002, 0.05])
    np.testing.assert_array_equal(calibration.P.ravel(), _P)


def test_what_is_not_set_is_made_up_from_the_other_matrix() -> None:
    calibration = make_calibration(_fields(R=np.zeros(9), P=np.zeros(12)), is_rectified=False)
    np.testing.assert_array_equal(calibration.R, np.eye(3))
    np.testing.assert_array_equal(calibration.P[:, :3], calibration.K)
    rectified = make_calibration(_fields(K=np.zeros(9)), is_rectified=True)
    np.testing.assert_array_equal(rectified.K, rectified.P[:, :3])


@pytest.mark.parametrize("D", [[], [0.1, 0.2, 0.3, 0.4]])
def test_missing_distortion_coefficients_are_zero(D: list[float]) -> None:
    calibration = make_calibration(_fields(D=D), is_rectified=False)
    np.testing.assert_array_equal(calibration.D, [*D, 0, 0, 0, 0, 0][:5])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"K": np.zeros(9), "P": np.zeros(12)}, "not calibrated"),
        ({"K": _K[:8]}, "K must hold 9 numbers, got 8"),
        ({"K": [np.nan, *_K[1:]]}, "not finite"),
        ({"K": ["a"] * 9}, "K must hold numbers"),
        ({"P": [-40.0, *_P[1:]]}, "focal lengths must be positive"),
        ({"R": 2 * np.eye(3)}, "R is no rotation"),
        ({"D": [0.1, 0.2]}, "D must hold 4 or 5 numbers, got 2"),
        ({"model": "equidistant"}, "distortion model 'equidistant'"),
        ({"model": "rational_polynomial", "D": [0.1] * 8}, "'rational_polynomial'"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "R is no rotation"),
        ({"width": 0}, "image size must be positive"),
        ({"width": 2**31}, "at most 32767 px a side .* got 2147483648x32"),
        ({"height": 32768}, "at most 32767 px a side .* got 48x32768"),
        ({"width": 30000, "height": 30000}, "100 megapixels, got 30000x30000"),
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


def test_the_distortion_model_of_rectified_images_does_not_matter() -> None:
    fields = _fields(model="rational_polynomial", D=[0.1] * 8)
    assert not np.any(make_calibration(fields, is_rectified=True).D)


def test_a_model_without_distortion_does_not_matter_either() -> None:
    fields = _fields(model="Brown Conrady", D=np.zeros(5))
    assert not np.any(make_calibration(fields, is_rectified=False).D)


def _write(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("names", ["kdrp", "KDRP"])
def test_both_spellings_of_a_file_say_the_same(tmp_path: Path, tiny: Any, names: str) -> None:
    long = tiny.ros_camera(
        rectification_matrix={"data": np.eye(3).ravel().tolist()},
        projection_matrix={"data": _P},
    )
    k, d, r, p = list(names)
    short = {
        "width": 48,
        "height": 32,
        "distortion_model": "plumb_bob",
        k: tiny.camera.K.ravel().tolist(),
        d: [0.0] * 5,
        r: np.eye(3).ravel().tolist(),
        p: _P,
    }
    made = [
        make_calibration(read_mono_file(_write(tmp_path / "c.yaml", c))[0], is_rectified=False)
        for c in (long, short)
    ]
    for name in "KDRP":
        np.testing.assert_array_equal(getattr(made[0], name), getattr(made[1], name))


def test_a_file_may_carry_the_scale_of_depth(tmp_path: Path, tiny: Any) -> None:
    path = _write(tmp_path / "c.yaml", tiny.ros_camera(depth_scale=1000))
    assert read_calibration_file(path).depth_scale == 1000.0
    path = _write(tmp_path / "c.yaml", tiny.ros_camera(depth_scale="many"))
    with pytest.raises(CalibrationError, match="depth_scale must be a positive number"):
        read_calibration_file(path)


def test_a_stereo_pair_is_two_cameras(tmp_path: Path, tiny: Any) -> None:
    pair = {
        "left": tiny.ros_camera(),
        "right": tiny.ros_camera(projection_matrix={"data": _P}),
    }
    path = _write(tmp_path / "pair.yaml", pair)
    left, right = read_stereo_file(path, is_rectified=True)
    assert left.P[0, 3] == 0
    assert right.P[0, 3] == -20.0
    with pytest.raises(CalibrationError, match="expected one camera"):
        read_mono_file(path)
    with pytest.raises(CalibrationError, match="left and right"):
        read_stereo_file(_write(tmp_path / "mono.yaml", tiny.ros_camera()), is_rectified=True)


@pytest.mark.parametrize("key", ["image_width", "image_height", "camera_matrix"])
def test_a_missing_key_is_named(tmp_path: Path, tiny: Any, key: str) -> None:
    path = _write(tmp_path / "c.yaml", tiny.ros_camera(**{key: None}))
    with pytest.raises(CalibrationError, match=f"lacks {key}"):
        read_mono_file(path)


@pytest.mark.parametrize(
    "text", ["a: [", "", "- 1", "\x00", "a: 2024-99-99", "a: 0b2", "a: " + "[" * 1000]
)
def test_a_file_that_holds_no_keys_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"c\.yaml"):
        read_calibration_file(path)
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_calibration_file(tmp_path / "none.yaml")
