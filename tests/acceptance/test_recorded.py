"""Recorded data: the same bytes from every container, and published errors."""

from pathlib import Path

import numpy as np
import pytest

import gvo
from tests.io.conftest import Tiny

KITTI = "kitti_06_start"
XYZ = "rgbd_dataset_freiburg1_xyz_start"
EUROC = "euroc_mh01_start"

pytestmark = [pytest.mark.recorded, pytest.mark.acceptance]


@pytest.mark.parametrize(("name", "suffix"), [(KITTI, ".bag"), (XYZ, ".mcap"), (EUROC, "")])
def test_folder_and_bag_give_the_same_frames_and_cameras(
    gvo_data: Path, tmp_path: Path, name: str, suffix: str
) -> None:
    folder, path = gvo.open_recording(gvo_data / name), tmp_path / f"recording{suffix}"
    gvo.convert(folder, path)
    bag = gvo.open_recording(path)
    for one, other in zip(gvo.frames(folder), gvo.frames(bag), strict=True):
        assert Tiny().fingerprint(one) == Tiny().fingerprint(other)
    for camera, copy in zip(folder.info.calibrations, bag.info.calibrations, strict=True):
        for matrix in "KDRP":
            np.testing.assert_array_equal(getattr(camera, matrix), getattr(copy, matrix))
