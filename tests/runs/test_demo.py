"""The demonstration leaves a drive and its robot, and replaces its own folder only."""

from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.errors import RecordingError
from gvo.io.poses.base_frame import find_base_frame
from gvo.io.poses.inputs import read_truth
from gvo.runs.demo import BAG_NAME, ROBOT_NAME, run_demo, write_robot_bag


def test_the_robot_of_the_drive_goes_ahead_on_the_ground(drive_bag: Path, tmp_path: Path) -> None:
    truth = gvo.open_recording(drive_bag).ground_truth()
    assert truth is not None
    write_robot_bag(truth, tmp_path / ROBOT_NAME)
    assert [path.name for path in tmp_path.iterdir()] == [ROBOT_NAME]
    source = gvo.open_recording([drive_bag, tmp_path / ROBOT_NAME])
    base_frame = find_base_frame(source, "base_link", T_initial=None)
    found = read_truth(source, "tf:map:base_link", base_frame=base_frame).trajectory
    np.testing.assert_allclose(found.T_world_frame[0], np.eye(4), atol=1e-9)
    x, y, z = found.positions[-1]
    assert x > 10.0
    assert abs(y) < 1.0
    assert abs(z) < 0.1


@pytest.mark.parametrize("name", [BAG_NAME, "raw.txt"])
def test_the_demonstration_replaces_nothing_but_its_own(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(RecordingError, match=f"{name}.*; give another .*--force"):
        run_demo(tmp_path)
    assert (tmp_path / name).read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [name]
