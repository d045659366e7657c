"""How large errors of a calibration are, by what images tell of its constants."""

import numpy as np
import pytest

from gvo.frontend.calibration import CONSIDERED, CalibrationErrors
from gvo.geometry.camera import StereoCamera
from gvo.geometry.rig import LENS
from gvo.kernels.lens import write_considered, write_lens_fields
from gvo.types import FloatArray

CAMERA = StereoCamera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.1)
NAMES = CONSIDERED[:-1]


def judged(values: FloatArray, sigma: float, *, is_corrected: bool = False) -> CalibrationErrors:
    """Return what is judged of constants that images told with this sigma, again and again."""
    errors = CalibrationErrors(CAMERA, NAMES, in_pixels=True)
    information, prior = np.eye(len(NAMES)) / sigma**2, np.ones(len(NAMES))
    for _ in range(200):
        errors.judge(information, information @ values, prior, is_corrected=is_corrected)
    return errors


@pytest.mark.parametrize("size_px", [0.1, 0.25, 1.0])
def test_the_size_is_that_of_the_bends_and_of_k1(size_px: float) -> None:
    rng = np.random.default_rng(7)
    sizes = []
    for _ in range(50):
        values = size_px * rng.normal(size=len(NAMES))
        values[[0, 7]] = 30.0 * size_px  # offset and focal length do not count
        sizes.append(judged(values, 0.01 * size_px).size_px)
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(size_px, rel=0.15)


def test_what_images_hardly_tell_is_as_presumed() -> None:
    assert judged(np.zeros(8), 100.0).size_px == pytest.approx(0.3, rel=0.01)


def test_what_is_corrected_stays_uncertain_and_what_is_not_counts_with_its_value() -> None:
    values = np.array([0.0, 0.3, -0.2, 0.1, 0.3, -0.4, 0.2, 0.0])
    corrected = judged(values, 0.04, is_corrected=True)
    left = corrected.size_px**2 * corrected.root @ corrected.root.T
    # Its sigma, and what patches feign.
    assert np.sqrt(left[6, 6]) == pytest.approx(np.hypot(0.04, 0.03), rel=0.05)
    assert corrected.left_px == pytest.approx(np.hypot(0.04, 0.03), rel=0.05)
    assert left[7, 7] == left[8, 8] == pytest.approx(corrected.size_px**2)
    found = judged(values, 0.04)
    whole = found.size_px**2 * found.root @ found.root.T
    assert whole[5, 5] == pytest.approx(found.size_px**2 + 0.4**2, rel=0.1)
    assert whole[1, 5] == pytest.approx(-0.3 * 0.4, rel=0.15)


def test_fields_are_those_of_the_lens_in_pixels_at_the_border() -> None:
    rng = np.random.default_rng(3)
    uvd = rng.uniform([0.0, 0.0, 1.0], [640.0, 480.0, 60.0], (20, 3))
    found, own = np.empty((9, 20, 3)), np.empty((11, 20, 3))
    write_considered(uvd, CAMERA.parameters, found)
    write_lens_fields(uvd, CAMERA.parameters, own)
    X, Y = 320.0 / 500.0, 240.0 / 500.0
    units = [1.0, *(1.0 / (500.0 * power) for power in (X, Y, X * X, X * Y, Y * Y, 0.5 * X**3))]
    for k, unit in enumerate(units):
        name = CONSIDERED[k]
        np.testing.assert_allclose(found[k], unit * own[LENS.index(name)], atol=1e-12)
    # Another focal length scales the image about its middle, another baseline the disparity.
    rays = np.column_stack([uvd[:, 0] - 320.0, uvd[:, 1] - 240.0, uvd[:, 2]])
    np.testing.assert_allclose(found[7], 3.0 * rays / 320.0, atol=1e-12)
    np.testing.assert_allclose(found[8], 0.01 * np.column_stack([0.0 * rays[:, :2], uvd[:, 2]]))
