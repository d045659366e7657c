"""Two motions in one pair of frames: which one is the camera's."""

from functools import partial

import numpy as np
import pytest

from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.types import Contradiction, Failure, FloatArray, MotionPrior, RelativePose
from tests.frontend import two_motions

CAMERA = StereoCamera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.3)
SIGMA_PX = 0.2
STILL = np.zeros(6)
DRIVING = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.8])
BUS = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])


matches_of = partial(
    two_motions.matches_of,
    camera=CAMERA,
    disparities=(8, 40),
    noise_px=SIGMA_PX,
    stated_px=SIGMA_PX,
    seed=4,
)


def register(matches: Correspondences, prior: FloatArray | None) -> RelativePose | Failure:
    expected = None if prior is None else MotionPrior(T_predicted=se3.exp(prior))
    return two_motions.register(matches, CAMERA, expected)


def assert_is(result: RelativePose | Failure, twist: FloatArray) -> None:
    assert isinstance(result, RelativePose), result
    error = se3.log(se3.invert(se3.exp(twist)) @ result.T_reference_current)
    assert np.sqrt(error @ np.linalg.solve(result.covariance, error)) < 5.0
    assert np.linalg.norm(error[3:]) < 0.01


@pytest.mark.parametrize("n_bus", [90, 150, 300])
@pytest.mark.parametrize("camera", [STILL, DRIVING])
def test_a_majority_that_moves_unpredictably_does_not_win(camera: FloatArray, n_bus: int) -> None:
    matches = matches_of((camera, 60), (camera + BUS, n_bus), n_wrong=20)
    assert_is(register(matches, camera + np.array([0.001, -0.001, 0.0, 0.02, 0.0, 0.02])), camera)


@pytest.mark.parametrize("speed", [0.02, 0.04, 0.06, 0.1, 0.2])
def test_a_bus_that_hardly_moves_yet_is_told_from_the_world(speed: float) -> None:
    result = register(matches_of((STILL, 70), (speed * BUS / 0.4, 140)), STILL)
    assert isinstance(result, RelativePose)
    # Where the two differ by less than the noise of a pixel, the error is less than that as well.
    assert np.linalg.norm(result.T_reference_current[:3, 3]) < 0.012


def test_the_world_wins_as_the_majority_even_where_something_moves_as_predicted() -> None:
    assert_is(register(matches_of((DRIVING, 150), (STILL, 14)), STILL), DRIVING)


@pytest.mark.parametrize("prior", [None, BUS / 2])
def test_two_motions_that_nothing_tells_apart_are_no_answer(prior: FloatArray | None) -> None:
    result = register(matches_of((STILL, 100), (BUS, 100)), prior)
    assert isinstance(result, Contradiction)
    assert "two motions: 9" in result.reason
    assert result.n_matches == 200


@pytest.mark.parametrize("prior", [STILL, DRIVING, DRIVING * 0.9, None])
def test_wrong_matches_are_no_second_motion(prior: FloatArray | None) -> None:
    assert_is(register(matches_of((DRIVING, 120), n_wrong=120), prior), DRIVING)


def test_a_sudden_motion_of_the_whole_view_is_believed() -> None:
    jump = np.array([0.1, -0.2, 0.05, 0.5, 0.2, -0.6])
    assert_is(register(matches_of((jump, 100), n_wrong=40), STILL), jump)
