"""Which keyframes a frame is registered against, and when more of them are."""

from typing import Any

import numpy as np
import pytest

from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.odometry.chain import RawStep
from gvo.odometry.keyframes import link_keyframes
from gvo.types import Edge, Estimate, Failure, FloatArray, RelativePose, Status

CONFIG = WindowConfig(n_links=3, gate=10.0)
# The first is chosen, the other is spare: two steps ago.
SCORES = {10: 0.4, 80: 0.5}
N_UNASKED = {10: 9, 80: 2}
RECENTLY = {10: 4, 80: 2}
SIGMA = 0.01


def forward(distance_m: float) -> FloatArray:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, distance_m]))


def step_of(*, is_registered: bool = True, is_steady: bool = True) -> RawStep:
    covariance = SIGMA**2 * np.eye(6)
    registration = RelativePose(
        T_reference_current=forward(1.0),
        covariance=covariance,
        matches=np.zeros((0, 2), dtype=np.int64),
        inliers=np.zeros(0, dtype=np.bool_),
    )
    return RawStep(
        estimate=Estimate(
            stamp_ns=100, T_world_frame=np.eye(4), covariance=covariance, status=Status.OK
        ),
        covariance=covariance,
        edge=Edge(reference_id=90, T_reference_frame=forward(1.0), covariance=covariance),
        registration=registration if is_registered else None,
        failure=None if is_registered else Failure(reason="blank"),
        is_steady=is_steady,
    )


class Registrations:
    """Finds keyframes so far from where they are predicted, in sigmas of the difference."""

    def __init__(self, **off_by: float | None) -> None:
        self._off_by = off_by
        self.asked: list[int] = []

    def __call__(self, stamp_ns: int, prior: FloatArray) -> Edge | None:
        self.asked.append(stamp_ns)
        sigmas = self._off_by.get(f"of_{stamp_ns}", 0.0)
        if sigmas is None:
            return None
        return Edge(
            reference_id=stamp_ns,
            T_reference_frame=prior @ forward(sigmas * SIGMA * np.sqrt(2.0)),
            covariance=SIGMA**2 * np.eye(6),
        )


def linked(
    measure: Registrations, step: RawStep, n_unasked: dict[int, int] = N_UNASKED, **changes: Any
) -> list[Any]:
    poses = {ns: forward(-0.1 * (100 - ns)) for ns in SCORES}
    config = CONFIG.model_copy(update=changes)
    links = link_keyframes(measure, SCORES, poses, step, config, n_unasked=n_unasked)
    return [link.reference_id for link in links]


@pytest.mark.parametrize(
    ("sigmas", "changes", "asked", "found"),
    [
        (9.9, {}, [10], [10]),  # it bears out the step
        *((sigmas, {}, [10, 80], [10, 80]) for sigmas in (10.1, -10.1, 1e6)),  # it contradicts it
        (None, {}, [10, 80], [80]),  # it fails
        (1e6, {"gate": None}, [10], [10]),  # nothing contradicts without a gate
        (0.0, {"n_unasked": RECENTLY}, [], []),  # steady steps tell as much
    ],
)
def test_links_are_asked_for_until_one_bears_out_the_step(
    sigmas: float | None, changes: dict[str, Any], asked: list[int], found: list[int]
) -> None:
    measure = Registrations(of_10=sigmas)
    assert linked(measure, step_of(), **changes) == found
    assert measure.asked == asked


def test_a_step_without_registration_wants_all_links_there_are() -> None:
    measure = Registrations()
    assert linked(measure, step_of(is_registered=False)) == measure.asked == [10, 80]


def test_the_prediction_is_the_motion_from_the_keyframe() -> None:
    priors: dict[int, FloatArray] = {}

    def measure(stamp_ns: int, prior: FloatArray) -> None:
        priors[stamp_ns] = prior

    link_keyframes(measure, {10: 0.4}, {10: forward(-9.0)}, step_of(), CONFIG, n_unasked={10: 9})
    np.testing.assert_allclose(priors[10], forward(9.0), atol=1e-12)


def test_an_unsteady_step_is_checked_until_a_keyframe_bears_it_out() -> None:
    unsteady = step_of(is_steady=False)
    assert linked(Registrations(), unsteady, RECENTLY) == [80]
    assert linked(Registrations(of_80=1e6), unsteady, RECENTLY) == [80, 10]
    assert linked(Registrations(of_80=None), unsteady, RECENTLY) == [10]
    unregistered = step_of(is_registered=False)
    assert linked(Registrations(), unregistered, RECENTLY) == [80, 10]
