"""What is asked of a front-end's results."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gvo.config import Config
from gvo.frontend.descriptor import as_stereo
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.protocol import CheckedFrontend, count_points, find_fault
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.types import Failure, FloatArray, MotionPrior, RelativePose

CAMERA = PinholeCamera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
COVARIANCE = np.diag([1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0])


def pose(**changes: Any) -> RelativePose:
    values: dict[str, Any] = {
        "T_reference_current": se3.exp(np.array([0.5, -0.2, 0.1, 3.0, 2.0, 1.0])),
        "covariance": COVARIANCE,
    }
    return RelativePose(**(values | changes))


def correlated(value: float) -> FloatArray:
    covariance = np.eye(6)
    covariance[0, 1] = covariance[1, 0] = value
    return covariance


def test_pose_and_covariance_are_all_that_is_needed() -> None:
    assert find_fault(pose()) == ""
    assert (pose().n_matches, pose().n_inliers, pose().flow_px) == (0, 0, None)


@pytest.mark.parametrize("value", [0.0, 0.9, 0.999999])
def test_covariances_of_any_correlation_will_do(value: float) -> None:
    assert find_fault(pose(covariance=correlated(value))) == ""


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"T_reference_current": np.eye(3)}, "shape (4, 4)"),
        ({"T_reference_current": np.eye(4, dtype=np.float32)}, "float64"),
        ({"T_reference_current": [[1.0]]}, "no array"),
        ({"T_reference_current": np.diag([1.0, 1.0, np.nan, 1.0])}, "not finite"),
        ({"T_reference_current": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rotation"),
        ({"T_reference_current": np.diag([1.01, 1.0, 1.0, 1.0])}, "no rotation"),
        ({"T_reference_current": np.diag([1.0, 1.0, 1.0, 2.0])}, "last row"),
        ({"covariance": np.eye(3)}, "shape (6, 6)"),
        ({"covariance": np.full((6, 6), np.inf)}, "the covariance is not finite"),
        ({"covariance": -COVARIANCE}, "not positive definite"),
        ({"covariance": np.zeros((6, 6))}, "not positive definite"),
        ({"covariance": correlated(1.0)}, "not positive definite"),
        ({"covariance": correlated(2.0)}, "not positive definite"),
        ({"covariance": np.triu(correlated(0.5))}, "not symmetric"),
        ({"passing_covariance": np.eye(3)}, "the passing covariance is no array"),
        ({"passing_covariance": COVARIANCE}, "without what passes is not positive definite"),
    ],
)
def test_a_fault_is_named(changes: dict[str, Any], fault: str) -> None:
    assert fault in find_fault(pose(**changes))


@dataclass
class Answering:
    """A front-end that always gives the same answer."""

    answer: Any

    def extract(self, frame: Any) -> Any:
        return frame

    def register(self, reference: Any, current: Any, prior: MotionPrior | None) -> Any:
        return self.answer


def ask(answer: object) -> RelativePose | Failure:
    return CheckedFrontend(Answering(answer)).register(None, None, None)


class Capable(Answering):
    """The same with all that a front-end may offer."""

    def __init__(self, answer: object) -> None:
        super().__init__(answer)
        self.camera = CAMERA
        self.rig_offsets = RigOffsets(as_stereo(CAMERA), Config())
        self.configs: list[Config] = []

    def align_depth(self, reference: Any, current: Any, T_reference_current: Any) -> Any:
        return (reference, current) if self.answer == "pair" else self.answer

    def recognize(self, reference: Any, current: Any, observations: Any) -> Any:
        return self.answer

    def reconfigure(self, config: Config) -> None:
        self.configs.append(config)


def test_a_front_end_of_two_methods_is_asked_for_no_more() -> None:
    frontend = CheckedFrontend(Answering(pose()))
    assert frontend.camera is None
    assert frontend.rig_offsets is None
    frontend.reconfigure(Config())
    assert frontend.extract(5) == 5
    assert not frontend.align_depth(1, 2, np.eye(4))
    assert frontend.recognizer is None


def test_what_a_front_end_offers_is_used() -> None:
    inner = Capable(Failure(reason="never seen"))
    frontend = CheckedFrontend(inner)
    assert frontend.camera is CAMERA
    assert frontend.rig_offsets is inner.rig_offsets
    config = Config()
    frontend.reconfigure(config)
    assert inner.configs == [config]
    assert frontend.align_depth(1, 2, np.eye(4)) is inner.answer
    recognizer: object = frontend.recognizer
    assert recognizer is inner


def test_what_is_offered_must_be_what_its_name_says() -> None:
    inner = Capable("pair")
    inner.camera, inner.rig_offsets = "a camera", 0.3  # type: ignore[assignment]
    frontend = CheckedFrontend(inner)
    assert frontend.camera is None
    assert frontend.rig_offsets is None
    with pytest.raises(ValueError, match=r"align_depth of Capable must return .* got tuple"):
        frontend.align_depth(1, 2, np.eye(4))


def test_points_are_counted_where_the_observations_tell() -> None:
    assert count_points(object()) == (0, 0)
    assert count_points([1, 2]) == (2, 2)
    assert count_points(Observed(7)) == (7, 2)


@dataclass
class Observed:
    n_keypoints: int

    def __len__(self) -> int:
        return 2


def test_sound_answers_are_handed_through() -> None:
    for answer in (pose(), Failure(reason="dark")):
        assert ask(answer) is answer


def test_a_faulty_pose_becomes_a_failure() -> None:
    result = ask(pose(covariance=-COVARIANCE))
    assert isinstance(result, Failure)
    assert "not positive definite" in result.reason


@pytest.mark.parametrize("answer", [None, np.eye(4), (np.eye(4), COVARIANCE)])
def test_any_other_answer_is_misuse(answer: object) -> None:
    with pytest.raises(ValueError, match="register of Answering must return RelativePose"):
        ask(answer)
