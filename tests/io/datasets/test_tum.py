"""TUM RGB-D folders."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from gvo.config import Config, DepthConfig
from gvo.io.datasets.tum import TumSource
from gvo.io.frames import frames
from gvo.types import RgbdFrame

_COLOR = ("1305031102.175304", "1305031102.211214")
_DEPTH = ("1305031102.160407", "1305031102.194330")


def test_images_come_by_stamp_in_metres_and_exact_nanoseconds(tmp_path: Path, tiny: Any) -> None:
    source = TumSource(tiny.write_tum(tmp_path / "f", _COLOR, _DEPTH))
    images = list(source.images())
    assert [(image.stream, image.stamp_ns) for image in images] == [
        (1, 1305031102160407000),
        (0, 1305031102175304000),
        (1, 1305031102194330000),
        (0, 1305031102211214000),
    ]
    np.testing.assert_array_equal(images[0].load(), tiny.depth(0))
    np.testing.assert_array_equal(images[1].load(), tiny.texture(0, is_color=True))
    assert source.info.n_images == 2


@pytest.mark.parametrize(
    ("name", "fx", "k1"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.306408, 0.262383),
        ("fr2_desk", 520.908620, 0.231222),
        ("Freiburg3_office", 535.433105, 0.0),
    ],
)
def test_the_name_of_the_folder_tells_the_camera(
    tmp_path: Path, tiny: Any, name: str, fx: float, k1: float
) -> None:
    folder = tiny.write_tum(tmp_path / name, _COLOR, _DEPTH)
    (folder / "calibration.yaml").unlink()
    (calibration,) = TumSource(folder).info.calibrations
    assert (calibration.K[0, 0], calibration.D[0]) == (fx, k1)
    np.testing.assert_array_equal(calibration.P[:, :3], calibration.K)
    np.testing.assert_array_equal(calibration.R, np.eye(3))
    assert (calibration.width, calibration.height) == (640, 480)


def test_the_file_given_wins_then_the_file_beside_then_the_name(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_tum(tmp_path / "freiburg1", _COLOR, _DEPTH)
    assert TumSource(folder).info.camera.fx == tiny.camera.fx
    (folder / "calibration.yaml").unlink()
    info = TumSource(folder).info
    assert info.camera.fx == 517.306408
    (line,) = [line for line in info.decisions if line.startswith("calibration:")]
    assert "freiburg1, by the name of the folder" in line
    K = [99.0, 0, 23.5, 0, 99.0, 15.5, 0, 0, 1]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(tiny.ros_camera(camera_matrix={"data": K})))
    info = TumSource(folder, calibration=path).info
    assert info.camera.fx == 99.0
    assert "calibration: mine.yaml" in info.decisions


def test_the_scale_is_the_users_then_the_files_then_5000(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_tum(tmp_path / "f", _COLOR, _DEPTH)

    def largest(**options: Any) -> float:
        return float(np.nanmax(next(TumSource(folder, **options).images()).load()))

    at_5000 = largest()
    (folder / "calibration.yaml").write_text(yaml.safe_dump(tiny.ros_camera(depth_scale=2500)))
    assert largest() == pytest.approx(2 * at_5000)
    assert largest(config=Config(depth=DepthConfig(scale=10000.0))) == pytest.approx(0.5 * at_5000)


def _depth_decision(source: TumSource) -> str:
    (line,) = [line for line in source.info.decisions if line.startswith("depth: ")]
    return line


def test_depth_that_only_makes_sense_in_millimetres_is_read_so(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_tum(tmp_path / "f", _COLOR, _DEPTH)
    assert _depth_decision(TumSource(folder)).startswith(
        "depth: 5000 counts per metre, the default"
    )
    expected = next(TumSource(folder).images()).load()
    for stamp in _DEPTH:
        tiny.write_image(folder / "depth" / f"{stamp}.png", tiny.counts(0) // 5)
    assert _depth_decision(TumSource(folder)).startswith("depth: 1000 counts per metre, because")
    found = next(TumSource(folder).images()).load()
    is_known = np.isfinite(expected)
    np.testing.assert_allclose(found[is_known], expected[is_known], atol=2e-3)
    insisted = TumSource(folder, config=Config(depth=DepthConfig(scale=5000.0)))
    assert _depth_decision(insisted) == "depth: 5000 counts per metre, by depth.scale"


def test_depth_and_colour_are_undistorted_with_the_same_camera(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_tum(tmp_path / "f", ["1.0"], ["1.0"])
    D = [0.3, -0.1, 0.001, -0.002, 0.0]
    (folder / "calibration.yaml").write_text(
        yaml.safe_dump(tiny.ros_camera(distortion_coefficients={"data": D}))
    )
    (frame,) = frames(TumSource(folder), Config())
    assert isinstance(frame, RgbdFrame)
    K = tiny.camera.K
    grey = cv2.cvtColor(tiny.texture(0, is_color=True), cv2.COLOR_BGR2GRAY)
    expected = np.asarray(cv2.undistort(grey, K, np.array(D)), dtype=np.int64)
    assert np.abs(frame.image.astype(np.int64) - expected).max() <= 1
    # each depth is one of the raw depths, at the pixel that the distortion model says
    u, v = 30, 8
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    raw, _ = cv2.projectPoints(np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), K, np.array(D))
    column, row = np.rint(np.ravel(raw)).astype(int)
    assert frame.depth[v, u] == tiny.depth(0)[row, column]
