"""Depth images that support a motion, and such that contradict it."""

import numpy as np
import pytest

from gvo.config import Config, DepthConfig
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.rgbd import check_depths, compare_depths
from gvo.geometry import se3
from gvo.io.synthetic.recording import SyntheticRecording
from gvo.types import Contradiction, DepthArray, FloatArray, RelativePose

RECORDING = SyntheticRecording("handheld", "rgbd", n_frames=31, scale=1.0)
IMAGES = list(RECORDING.images())
T_WORLD_CAM = RECORDING.ground_truth().T_world_cam
CONFIG = DepthConfig()
CAMERA = as_stereo(RECORDING.info.camera, Config())


def depth(index: int) -> DepthArray:
    return IMAGES[2 * index + 1].load()


def moved(last: int) -> FloatArray:
    return np.asarray(se3.invert(T_WORLD_CAM[0]) @ T_WORLD_CAM[last])


def result_of(T_reference_current: FloatArray) -> RelativePose:
    return RelativePose(
        T_reference_current=T_reference_current,
        covariance=1e-6 * np.eye(6),
        matches=np.zeros((50, 2), dtype=np.int64),
        inliers=np.ones(50, dtype=np.bool_),
    )


@pytest.mark.parametrize("last", [1, 10, 30])
def test_the_true_motion_passes(last: int) -> None:
    depths = depth(0), depth(last)
    result = result_of(moved(last))
    assert check_depths(result, depths, CAMERA, CONFIG) is result
    differences = compare_depths(depths, moved(last), CAMERA, CONFIG)
    assert np.mean(differences < -3.0) < 0.1


@pytest.mark.parametrize("metres", [1.0, 1.3])
def test_a_motion_through_free_space_is_refused_with_its_numbers(metres: float) -> None:
    wrong = moved(1) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, metres]))
    refused = check_depths(result_of(wrong), (depth(0), depth(1)), CAMERA, CONFIG)
    assert isinstance(refused, Contradiction)
    assert "free space" in refused.reason
    assert refused.n_matches == 50


def test_what_is_hidden_now_does_not_count() -> None:
    near = np.full_like(depth(1), 0.5)
    result = result_of(moved(1))
    assert check_depths(result, (depth(0), near), CAMERA, CONFIG) is result


def test_without_depth_nothing_is_refused() -> None:
    unknown = np.full_like(depth(1), np.nan)
    result = result_of(np.eye(4))
    for depths in ((unknown, depth(1)), (depth(0), unknown)):
        assert check_depths(result, depths, CAMERA, CONFIG) is result
