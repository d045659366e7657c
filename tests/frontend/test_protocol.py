"""What is asked of a front-end's results."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gvo.frontend.protocol import Frontend, find_fault, register_checked
from gvo.geometry import se3
from gvo.types import Failure, FloatArray, RelativePose

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

    def register(self, reference: Any, current: Any, prior: FloatArray | None) -> Any:
        return self.answer


def ask(answer: object) -> RelativePose | Failure:
    frontend: Frontend[Any] = Answering(answer)
    return register_checked(frontend, None, None, None)


class Expecting(Answering):
    """Says nothing but where the usual motion is known, and what it was handed."""

    handed: tuple[Any, ...] = ()

    def register_expecting(self, *handed: Any) -> Any:
        self.handed = handed
        return pose()


def test_a_front_end_is_asked_with_the_usual_motion_where_it_can_be() -> None:
    frontend, failure = Expecting(Failure(reason="dark")), Failure(reason="dark")
    prior, T_usual = np.eye(4), se3.exp(np.ones(6))
    assert register_checked(frontend, 1, 2, prior, T_usual=T_usual)
    assert frontend.handed[:2] == (1, 2)
    assert frontend.handed[2] is prior
    assert frontend.handed[3] is T_usual
    assert not register_checked(frontend, 1, 2, prior)
    assert register_checked(Answering(failure), 1, 2, prior, T_usual=T_usual) is failure


def test_answers_with_the_usual_motion_are_checked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    frontend = Expecting(None)
    monkeypatch.setattr(frontend, "register_expecting", lambda *handed: None)
    with pytest.raises(ValueError, match="register_expecting of Expecting must return"):
        register_checked(frontend, 1, 2, None, T_usual=np.eye(4))


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
