"""The motion so far, and where it leads, against constant velocities."""

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import expm

from gvo.backend.motion_model import ConstantVelocity
from gvo.geometry import se3
from gvo.types import Estimate, FloatArray
from tests.backend.walks import seeds

STEP_NS = 50_000_000


def estimate(frame: int, stamp_ns: int, T: FloatArray, covariance: FloatArray) -> Estimate:
    return Estimate(frame_id=frame, stamp_ns=stamp_ns, T_world_frame=T, covariance=covariance)


def step_to(motion: ConstantVelocity, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
    edge, last = motion.predict(stamp_ns), motion.last
    assert edge is not None
    assert last is not None
    assert (edge.reference_id, edge.kernel) == (last.frame_id, "none")
    return edge.T_reference_frame, edge.covariance


def generator(twist: FloatArray) -> FloatArray:
    rx, ry, rz, tx, ty, tz = twist
    return np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]])


def moving(
    motion: ConstantVelocity, start: FloatArray, velocity: FloatArray, n: int
) -> list[Estimate]:
    """Let a camera move on with a velocity (rad/s, m/s) and be measured n times."""
    poses = [start @ expm(0.05 * frame * generator(velocity)) for frame in range(n)]
    given = [estimate(k, k * STEP_NS, T, 1e-4 * np.eye(6)) for k, T in enumerate(poses)]
    for before, each in zip([None, *given[:-1]], given, strict=True):
        place = None if before is None else before.T_world_frame
        motion.append(each, is_measured=True, T_world_measured=place)
    return given


@settings(max_examples=8)
@given(seed=seeds)
def test_a_constant_velocity_goes_on(seed: int) -> None:
    rng = np.random.default_rng(seed)
    velocity, start = rng.normal(size=6), se3.exp(rng.normal(size=6))
    motion = ConstantVelocity()
    last = moving(motion, start, velocity, 3)[-1]
    assert motion.last is last
    assert motion.measured is last
    T_last_frame, step_covariance = step_to(motion, last.stamp_ns + 2 * STEP_NS)
    np.testing.assert_allclose(T_last_frame, expm(0.1 * generator(velocity)), atol=1e-9)
    prediction = motion.predict_pose(last.stamp_ns + 2 * STEP_NS)
    assert prediction is not None
    np.testing.assert_allclose(
        prediction.T_world_frame, last.T_world_frame @ T_last_frame, atol=1e-9
    )
    # The uncertainty of the last pose, seen from the new one, and that of the step.
    Ad = np.linalg.inv(se3.adjoint(T_last_frame))
    expected = Ad @ last.covariance @ Ad.T + step_covariance
    np.testing.assert_allclose(prediction.covariance, expected, rtol=1e-9, atol=1e-15)


@settings(max_examples=8)
@given(seed=seeds)
def test_poses_without_a_measurement_follow_the_velocity_before_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    velocity, jump = rng.normal(size=6), se3.exp(rng.normal(size=6))
    motion = ConstantVelocity()
    last = moving(motion, np.eye(4), velocity, 3)[-1]
    total = step_to(motion, last.stamp_ns + 4 * STEP_NS)[1]
    coasted = estimate(3, last.stamp_ns + 3 * STEP_NS, jump, np.eye(6))
    motion.append(coasted, is_measured=False)
    assert motion.last is coasted
    assert motion.measured is last
    T, covariance = step_to(motion, coasted.stamp_ns + STEP_NS)
    np.testing.assert_allclose(T, expm(0.05 * generator(velocity)), atol=1e-9)
    # Two parts of the way add up to the whole, and the sigmas those of a second.
    first = ConstantVelocity()
    moving(first, np.eye(4), velocity, 3)
    before = step_to(first, coasted.stamp_ns)[1]
    np.testing.assert_allclose(covariance + before, total, rtol=1e-9)
    turn, shift = np.radians(30.0), 3.0
    np.testing.assert_allclose(np.diag(total), np.repeat([0.2 * turn, 0.2 * shift], 3) ** 2)


def test_where_nothing_is_known_of_the_motion_the_camera_stands() -> None:
    motion = ConstantVelocity()
    assert motion.last is None
    assert motion.measured is None
    assert motion.predict_pose(0) is None
    assert motion.predict(0) is None
    T = se3.exp(np.ones(6))
    motion.append(estimate(0, 0, T, np.eye(6)), is_measured=True)
    np.testing.assert_array_equal(step_to(motion, STEP_NS)[0], np.eye(4))
    # A measurement that is not tied to the one before tells of no velocity either.
    moving(motion, T, np.ones(6), 2)
    assert step_to(motion, 3 * STEP_NS)[0][0, 3] != pytest.approx(0.0)
    motion.append(estimate(5, 5 * STEP_NS, T, np.eye(6)), is_measured=True)
    np.testing.assert_array_equal(step_to(motion, 6 * STEP_NS)[0], np.eye(4))


def test_two_images_that_arrived_at_once_do_not_throw_the_camera_away() -> None:
    motion = ConstantVelocity()
    last = moving(motion, np.eye(4), np.array([0, 0, 0, 0, 0, 1.0]), 3)[-1]
    T = last.T_world_frame @ se3.exp(np.array([0, 0, 0, 1e-3, 0, 0]))  # noise
    next_ns = last.stamp_ns + 100
    motion.append(
        estimate(3, next_ns, T, 1e-4 * np.eye(6)),
        is_measured=True,
        T_world_measured=last.T_world_frame,
    )
    T_last_frame, covariance = step_to(motion, next_ns + STEP_NS)
    assert np.linalg.norm(T_last_frame[:3, 3]) < np.sqrt(covariance[3, 3])
