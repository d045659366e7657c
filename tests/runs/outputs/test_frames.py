"""Names of a run's frames."""

import pytest

from gvo.runs.outputs.frames import RunFrames


def test_without_names_the_trajectory_is_that_of_the_camera() -> None:
    names = RunFrames(camera="", base="")
    assert (names.camera, names.base) == ("camera_optical", "camera_optical")
    assert RunFrames(camera="left").base_by("raw") == "gvo/raw/left"
    assert list(names.fixed(5)) == []


def test_tf_refuses_leading_slashes_so_they_are_taken_away() -> None:
    names = RunFrames(world="/map", camera="/left", base="/base_link")
    assert (names.world, names.camera, names.base) == ("map", "left", "base_link")


def test_a_world_without_a_name_is_refused() -> None:
    with pytest.raises(ValueError, match="the world needs a name"):
        RunFrames(world="/")
