"""Whom the window keeps by itself: by distance and turn, as a ruler on the known path tells."""

import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, FloatArray

STEP_NS = 100_000_000


def drive(steps: list[FloatArray], config: WindowConfig) -> list[list[int]]:
    """Return whom the window keeps after each pose of a path of exact steps."""
    window = SlidingWindow(config, keyframes="distance")
    kept = []
    for frame in range(len(steps) + 1):
        edges = []
        if frame:
            T, covariance = steps[frame - 1], 1e-6 * np.eye(6)
            edges = [Edge(reference_id=frame - 1, T_reference_frame=T, covariance=covariance)]
        window.add_pose(frame, frame * STEP_NS, edges)
        # What is in the window besides is recent alone.
        recent = range(max(frame + 1 - (config.size or 0), 0), frame + 1)
        assert set(window.poses()) >= {*recent}
        names = window.kept()
        kept.append([name for name in names if isinstance(name, int)])
    return kept


def forward(length_m: float) -> FloatArray:
    return se3.make_transform(np.eye(3), np.array([0.0, 0.0, length_m]))


def turn(angle_deg: float) -> FloatArray:
    return se3.exp(np.array([0.0, np.radians(angle_deg), 0.0, 0.0, 0.0, 0.0]))


def config_of(**changes: float) -> WindowConfig:
    values = {
        "size": 3,
        "n_keyframes": 4,
        "keyframe_distance_m": 1.0,
        "keyframe_angle_deg": 10.0,
        "keyframe_overlap": 0.9,
        "min_overlap": 0.35,
    }
    return WindowConfig.model_validate(values | changes)


@pytest.mark.parametrize("step", [forward(0.3), turn(3.0)], ids=["distance", "turn"])
def test_the_next_keyframe_is_a_metre_or_ten_degrees_from_the_last(step: FloatArray) -> None:
    # Steps of 0.3 of the distance: each fourth pose is the first beyond it.
    kept = drive([step] * 30, config_of())
    for frame, names in enumerate(kept):
        every = list(range(0, frame + 1, 4))
        # Four at most, and none so far that less than min_overlap is left: 6.5 distances.
        assert names == [name for name in every[-4:] if 0.3 * (frame - name) < 6.5]
    assert kept[-1] == [16, 20, 24, 28]


def test_a_keyframe_leaves_where_too_little_is_left_in_common() -> None:
    kept = drive([forward(0.3)] * 30, config_of(n_keyframes=100, min_overlap=0.75))
    for frame, names in enumerate(kept):
        assert names == [name for name in range(0, frame + 1, 4) if 0.3 * (frame - name) < 2.5]


def test_a_camera_that_comes_back_needs_no_new_keyframe() -> None:
    there, back = [forward(0.6)] * 6, [forward(-0.6)] * 6
    kept = drive([*there, *back], config_of())
    assert kept[6] == [0, 2, 4, 6]
    assert kept[12] == [0, 2, 4, 6]


def test_without_keyframes_nobody_is_kept() -> None:
    assert drive([forward(2.0)] * 5, config_of(n_keyframes=0)) == [[]] * 6
