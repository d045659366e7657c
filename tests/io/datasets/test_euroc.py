"""EuRoC folders."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gvo.errors import RecordingError
from gvo.io.datasets.euroc import EurocSource

_STAMPS = (1403636584763555584, 1403636584813555456)


def _poses() -> tuple[Any, Any]:
    """Return T_body_left and T_body_right: turned, the right one 0.5 m along the left x axis."""
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix()
    T_body_left[:3, 3] = 0.1, 0.2, -0.3
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.015]).as_matrix()
    T_left_right[0, 3] = 0.5
    return T_body_left, T_body_left @ T_left_right


def _write(folder: Path, tiny: Any, **changes: Any) -> Path:
    sensors = [tiny.euroc_camera(T_body_cam, **changes) for T_body_cam in _poses()]
    return Path(tiny.write_euroc(folder, _STAMPS, sensors))


def test_the_folder_and_its_mav0_are_the_same_recording(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "MH_01", tiny)
    for source in (EurocSource(folder), EurocSource(folder / "mav0")):
        assert source.info.name == "MH_01"
        images = list(source.images())
        assert [image.stamp_ns for image in images] == [s for s in _STAMPS for _ in range(2)]
        np.testing.assert_array_equal(images[3].load(), tiny.texture(11))


def test_the_truth_is_that_of_the_rectified_left_camera(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    assert EurocSource(folder).ground_truth() is None
    states = folder / "mav0" / "state_groundtruth_estimate0"
    states.mkdir()
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y []"
    row = f"{_STAMPS[0]},1,2,3,0.8,0,0.6,0"
    (states / "data.csv").write_text(f"{header}, q_RS_z []\n{row}\n")
    source = EurocSource(folder)
    truth = source.ground_truth()
    assert truth is not None
    # a point of the rectified camera, by hand through raw camera and body to the world
    point_rectified = np.array([0.3, -0.2, 2.0])
    point_raw = source.info.calibrations[0].R.T @ point_rectified
    T_body_left, _ = _poses()
    point_body = T_body_left[:3, :3] @ point_raw + T_body_left[:3, 3]
    expected = Rotation.from_quat([0, 0.6, 0, 0.8]).apply(point_body) + np.array([1, 2, 3])
    found = truth.T_world_frame[0] @ np.append(point_rectified, 1.0)
    np.testing.assert_allclose(found[:3], expected, atol=1e-12)
    assert truth.stamps_ns.tolist() == [_STAMPS[0]]


def test_a_missing_table_is_refused_and_a_missing_image_is_not(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    (folder / "mav0/cam1/data" / f"{_STAMPS[1]}.png").unlink()
    image = list(EurocSource(folder).images())[3]
    with pytest.raises(RecordingError, match="missing"):
        image.load()
    (folder / "mav0/cam1/data.csv").unlink()
    with pytest.raises(RecordingError, match=r"data\.csv: cannot be read: No such file"):
        EurocSource(folder)


def test_the_pose_on_the_body_is_that_of_the_rectified_camera(tmp_path: Path, tiny: Any) -> None:
    folder = _write(tmp_path / "m", tiny)
    T_body_left, _ = _poses()
    sensors = [folder / "mav0" / f"cam{n}" / "sensor.yaml" for n in range(2)]
    (tmp_path / "pair.yaml").write_text(yaml.safe_dump(tiny.ros_pair()))
    for calibration in (None, sensors, folder, folder / "mav0", tmp_path / "pair.yaml"):
        info = EurocSource(folder, calibration=calibration).info
        assert info.T_body_cam is not None
        R = info.calibrations[0].R
        np.testing.assert_allclose(info.T_body_cam[:3, :3], T_body_left[:3, :3] @ R.T, atol=1e-12)
        np.testing.assert_allclose(info.T_body_cam[:3, 3], T_body_left[:3, 3], atol=1e-12)
