"""What a run writes beside its folder: names of frames, and what does not go together."""

from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.errors import ConfigurationError
from gvo.io.poses.base_frame import BaseFrame
from gvo.runs.outputs.options import name_frames
from tests.make.rendered_walk import CAMERA, T_BASE_CAM


def test_the_bag_of_a_run_names_the_frames_of_the_recording(walk_bag: Path) -> None:
    walk = gvo.open_recording(walk_bag)
    camera = name_frames(walk, BaseFrame(CAMERA), is_placed=False, world="odom")
    assert (camera.world, camera.base, camera.is_world_optical) == ("odom", CAMERA, True)
    placed = name_frames(walk, BaseFrame(CAMERA), is_placed=True, world="odom")
    assert not placed.is_world_optical
    base = name_frames(walk, BaseFrame("base_link", T_BASE_CAM), is_placed=False, world="odom")
    assert (base.base, base.camera, base.is_world_optical) == ("base_link", CAMERA, False)
    np.testing.assert_allclose(base.mount(0), T_BASE_CAM, atol=1e-12)
    moving = name_frames(
        walk, BaseFrame("base_link", lambda _: (T_BASE_CAM, False)), is_placed=False, world="odom"
    )
    np.testing.assert_allclose(moving.mount(0), T_BASE_CAM, atol=1e-12)
    with pytest.raises(ConfigurationError, match=r"^--world : "):
        name_frames(walk, BaseFrame(CAMERA), is_placed=False, world="")


def test_plots_without_a_report_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="--plots are those of the report, which is not"):
        gvo.RunOutputs(report=False, plots=Path("plots"))
