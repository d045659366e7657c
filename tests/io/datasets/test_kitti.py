"""KITTI odometry folders."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from gvo.errors import CalibrationError, GvoError, RecordingError, TrajectoryError
from gvo.io.datasets.kitti import KittiSource


def test_images_come_by_stamp_and_unchanged(tmp_path: Path, tiny: Any) -> None:
    source = KittiSource(tiny.write_kitti(tmp_path / "00", 12))
    images = list(source.images())
    assert [(image.stream, image.stamp_ns) for image in images] == [
        (stream, n * 100_000_000) for n in range(12) for stream in (0, 1)
    ]
    np.testing.assert_array_equal(images[5].load(), tiny.texture(21))
    assert source.info.sensor == "stereo"
    assert source.info.n_images == 12
    assert source.info.name == "00"


def test_colour_cameras_are_read_where_grey_ones_are_missing(tmp_path: Path, tiny: Any) -> None:
    source = KittiSource(tiny.write_kitti(tmp_path / "00", cameras=(2, 3)))
    np.testing.assert_array_equal(next(source.images()).load(), tiny.texture(2, is_color=True))
    assert getattr(source.info.camera, "baseline", None) == 0.5
    # the truth is that of camera 0: P2 maps the centre of camera 2 to (0, 0, 0)
    truth = source.ground_truth()
    assert truth is not None
    centre = np.append(truth.positions[0], 1.0)
    np.testing.assert_allclose(source.info.calibrations[0].P @ centre, 0.0, atol=1e-12)
    np.testing.assert_allclose(truth.positions[2] - truth.positions[0], [0, 0, 2], atol=1e-12)


def test_poses_are_found_beside_and_in_the_official_layout(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_kitti(tmp_path / "sequences" / "07")
    beside = KittiSource(folder).ground_truth()
    (tmp_path / "poses").mkdir()
    shutil.move(folder / "poses.txt", tmp_path / "poses" / "07.txt")
    official = KittiSource(folder).ground_truth()
    assert beside is not None
    assert official is not None
    np.testing.assert_array_equal(official.T_world_frame, beside.T_world_frame)
    np.testing.assert_array_equal(official.stamps_ns, [0, 100_000_000, 200_000_000])
    (tmp_path / "poses" / "07.txt").unlink()
    assert KittiSource(folder).ground_truth() is None


def test_poses_of_another_length_are_refused(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_kitti(tmp_path / "00", 3)
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    with pytest.raises(RecordingError, match=r"poses\.txt: expected 3 rows .* got 2"):
        KittiSource(folder).ground_truth()
    (folder / "poses.txt").write_text("1 0 0\n")
    with pytest.raises(TrajectoryError, match=r"poses\.txt"):
        KittiSource(folder).ground_truth()


def test_calibration_files_win(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_kitti(tmp_path / "00")
    assert "calibration: calib.txt, rectified" in KittiSource(folder, calibration=()).info.decisions
    (folder / "calib.txt").unlink()
    pair = tiny.ros_pair()
    for name, content in {"pair": pair, "l": pair["left"], "r": pair["right"]}.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    for names in (["pair.yaml"], ["l.yaml", "r.yaml"]):
        info = KittiSource(folder, calibration=[tmp_path / name for name in names]).info
        assert getattr(info.camera, "baseline", None) == 1.0
        assert f"calibration: {' + '.join(names)}, rectified" in info.decisions


def _without(name: str) -> Any:
    return lambda folder: (folder / name).unlink()


def _with(name: str, text: str) -> Any:
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("spoil", "kind", "text"),
    [
        (_without("times.txt"), RecordingError, r"times\.txt: cannot be read: No such file"),
        (_without("calib.txt"), CalibrationError, r"calib\.txt: does not .*--calibration FILE"),
        (_with("times.txt", "0\nx\n0.2\n"), RecordingError, r"times\.txt, line 2: the stamp 'x'"),
        (_with("times.txt", "0\n0.1\n"), RecordingError, r"000002\.png: .* number below 2"),
        (_with("image_0/left.png", ""), RecordingError, r"left\.png: expected an image number"),
        (_with("calib.txt", "P0: 1 2 3\nP1: 1\n"), CalibrationError, "P0: P must hold 12 numbers"),
        (_with("calib.txt", "P0: a b c\nP1: 1\n"), CalibrationError, "P0: P must hold numbers"),
        (_with("calib.txt", f"P0: {'0 ' * 12}\nP1: 1\n"), CalibrationError, "K and P are zero"),
        (
            _with("calib.txt", f"P0: -1{' 0' * 11}\nP1: 1\n"),
            CalibrationError,
            "P0: the third row of K",
        ),
        (_with("calib.txt", f"P0: {'0 ' * 12}\n"), CalibrationError, "holds one camera"),
        (_with("calib.txt", "Tr: 1\n"), CalibrationError, "not a calibration .* or KITTI"),
        (lambda folder: shutil.rmtree(folder / "image_1"), RecordingError, "expected image_0"),
    ],
)
def test_a_malformed_folder_is_refused(
    tmp_path: Path, tiny: Any, spoil: Any, kind: type[GvoError], text: str
) -> None:
    folder = tiny.write_kitti(tmp_path / "00")
    spoil(folder)
    with pytest.raises(kind, match=text) as caught:
        KittiSource(folder)
    assert "\n" not in str(caught.value)


def test_the_first_image_that_can_be_read_says_the_size(tmp_path: Path, tiny: Any) -> None:
    folder = tiny.write_kitti(tmp_path / "00")
    (folder / "image_0" / "000000.png").write_bytes(b"damaged")
    assert KittiSource(folder).info.camera.width == tiny.size[0]
    for path in (folder / "image_0").iterdir():
        path.write_bytes(b"damaged")
    with pytest.raises(RecordingError, match="none of its 3 images can be read"):
        KittiSource(folder)
