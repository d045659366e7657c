"""How an IMU sits and how late it is are found by how camera and gyro turn."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.backend.imu_alignment import Aligned, Alignment, Turns, align
from gvo.backend.imu_buffer import ImuBuffer
from gvo.backend.inertial import InertialEstimator
from gvo.geometry.imu import Imu, ImuSamples
from gvo.types import Edge, FloatArray
from tests.backend.imus import (
    ADIS16448,
    CHEAP,
    FRAMES_HZ,
    HAND,
    STILL,
    Hand,
    Ride,
    Sensor,
    ns,
    transform,
)

PLACE = transform([1.2, -1.1, 1.3], [0.06, -0.06, 0.05])
TURNED = transform([1.2, -1.1, 1.3], [0.0, 0.0, 0.0])
ONE_AXIS = Hand(angles=HAND.angles * [[1.0], [0.0], [0.0]], shifts=HAND.shifts)
BIAS = [0.03, -0.02, 0.01]
Steps = list[tuple[int, Edge]]


def steps_of(
    hand: Hand = HAND, *, n: int = 400, sigma: float = 5e-4, share_wrong: float = 0.0
) -> Steps:
    """Return what the camera measures, with errors of rotations (rad); some are wrong by far."""
    rng, steps = np.random.default_rng(8), []
    T = [hand.imu_pose(k / FRAMES_HZ) @ np.linalg.inv(PLACE) for k in range(n)]
    for k in range(1, n):
        turn = sigma * rng.normal(size=3)
        if rng.random() < share_wrong:
            turn = rng.normal(0.0, 0.3, 3)
        step = np.linalg.inv(T[k - 1]) @ T[k] @ transform(turn, np.zeros(3))
        before_ns, covariance = ns((k - 1) / FRAMES_HZ), 1e-6 * np.eye(6)
        edge = Edge(reference_id=before_ns, T_reference_frame=step, covariance=covariance)
        steps.append((ns(k / FRAMES_HZ), edge))
    return steps


def measured(hand: Hand = HAND, *, n: int = 400, **sensor: Any) -> ImuSamples:
    return Sensor(gyro_bias=BIAS, **sensor).measure(hand, n / FRAMES_HZ + 0.5)


def aligned(steps: Steps, samples: ImuSamples, **known: Any) -> Aligned:
    found = align(Turns.of(steps), samples.stamps_ns, samples.gyro, **known)
    assert found is not None
    return found


def turn_deg(R: FloatArray) -> float:
    return float(np.degrees(Rotation.from_matrix(R.T @ PLACE[:3, :3]).magnitude()))


def learnt(imu: Imu, steps: Steps, samples: ImuSamples) -> list[tuple[int, Imu]]:
    """Return what became known of an IMU, and after how many steps."""
    alignment, buffer, found = Alignment(imu), ImuBuffer(), []
    buffer.add(samples)
    for k, (stamp_ns, step) in enumerate(steps, start=1):
        better = alignment.follow(step, stamp_ns, buffer)
        if better is not None:
            found.append((k, better))
    return found


@pytest.mark.parametrize("delay_s", [0.0, 0.02, -0.013])
@pytest.mark.parametrize("share_wrong", [0.0, 0.05])
def test_rotation_and_delay_are_found(delay_s: float, share_wrong: float) -> None:
    samples = measured(densities=CHEAP, delay_s=delay_s)
    found = aligned(steps_of(share_wrong=share_wrong), samples)
    assert turn_deg(found.R_camera_imu) < 0.5
    assert turn_deg(found.R_camera_imu) < 4.0 * np.degrees(found.sigma_turn)
    assert abs(found.delay_s - delay_s) < min(0.0015, 4.0 * found.sigma_delay_s)
    assert found.is_sound
    assert abs(found.scale - 1.0) < 0.02
    assert np.degrees(found.sigma_turn) < 0.5
    assert found.sigma_delay_s < 0.002


@pytest.mark.parametrize("delay_s", [0.0, 0.02, -0.013])
def test_an_alignment_learns_them_while_frames_come(delay_s: float) -> None:
    samples = measured(densities=ADIS16448, delay_s=delay_s)
    found = learnt(Imu(), steps_of(sigma=3e-4), samples)
    assert found
    for _, imu in found:
        assert imu.T_camera_imu is not None
        assert imu.delay_s is not None
        assert turn_deg(imu.T_camera_imu[:3, :3]) < 0.5
        assert not imu.T_camera_imu[:3, 3].any()
        assert abs(imu.delay_s - delay_s) < 0.0015


@pytest.mark.parametrize("hand", [ONE_AXIS, STILL], ids=["about_one_axis", "not_at_all"])
@pytest.mark.parametrize("densities", [None, CHEAP], ids=["exact", "noisy"])
def test_a_camera_that_hardly_turns_leaves_the_rotation_unknown(hand: Hand, densities: Any) -> None:
    steps = steps_of(hand, sigma=0.0 if densities is None else 5e-4)
    samples = measured(hand, densities=densities)
    found = align(Turns.of(steps), samples.stamps_ns, samples.gyro, delay_s=0.0)
    assert (found is None) == (hand is STILL)
    assert found is None or np.degrees(found.sigma_turn) > 5.0
    assert not learnt(Imu(), steps, samples)


def test_what_is_known_is_kept_exactly() -> None:
    steps, samples = steps_of(), measured(delay_s=0.02)
    placed = learnt(Imu(T_camera_imu=PLACE), steps, samples)[-1][1]
    np.testing.assert_array_equal(placed.T_camera_imu, PLACE)
    assert placed.delay_s is not None
    assert abs(placed.delay_s - 0.02) < 0.0015
    timed = learnt(Imu(delay_s=0.02, gyro_noise=7e-4), steps, samples)[-1][1]
    assert timed.delay_s == 0.02
    assert timed.gyro_noise == 7e-4
    assert timed.T_camera_imu is not None
    assert turn_deg(timed.T_camera_imu[:3, :3]) < 0.5


def test_a_camera_that_turns_about_one_axis_tells_the_delay_where_the_rotation_is_known() -> None:
    found = learnt(Imu(T_camera_imu=PLACE), steps_of(ONE_AXIS), measured(ONE_AXIS, delay_s=-0.03))
    assert found[-1][1].delay_s is not None
    assert abs(found[-1][1].delay_s + 0.03) < 0.0015


@pytest.mark.parametrize("delay_s", [0.12, -0.2])
def test_a_delay_of_more_than_a_tenth_of_a_second_is_not_found(delay_s: float) -> None:
    steps = steps_of(n=700, sigma=1e-4)
    assert not learnt(Imu(), steps, measured(n=700, delay_s=delay_s))


def test_a_gyro_in_degrees_is_not_believed() -> None:
    steps, samples = steps_of(), measured(gyro_unit=180.0 / np.pi)
    found = aligned(steps, samples, delay_s=0.0)
    assert not found.is_sound
    np.testing.assert_allclose(found.scale, 180.0 / np.pi, rtol=0.02)
    assert not learnt(Imu(), steps, samples)


def test_a_few_steps_or_samples_tell_nothing() -> None:
    steps, samples = steps_of(n=25), measured()
    assert align(Turns.of(steps), samples.stamps_ns, samples.gyro) is None
    assert align(Turns.of([]), samples.stamps_ns, samples.gyro) is None
    nothing = np.zeros(0, dtype=np.int64)
    assert align(Turns.of(steps_of()), nothing, np.zeros((0, 3))) is None


def test_turns_are_added_up_over_a_fifth_of_a_second_of_steps_that_follow_each_other() -> None:
    steps = steps_of(n=13, sigma=0.0)
    del steps[5]
    turns = Turns.of(steps)
    spans = np.stack([turns.start_ns, turns.end_ns], axis=1)
    frames = np.round((spans - ns(0.0)) * 1e-9 * FRAMES_HZ).astype(int).tolist()
    assert frames == [[0, 4], [4, 5], [6, 10], [10, 12]]
    whole = np.linalg.inv(HAND.imu_pose(0.0)) @ HAND.imu_pose(4 / FRAMES_HZ)
    seen = PLACE[:3, :3] @ Rotation.from_matrix(whole[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turns.turns[0], seen, atol=1e-3)


def test_the_latest_steps_are_kept_and_frames_without_one_do_not_count() -> None:
    alignment, buffer = Alignment(Imu(T_camera_imu=PLACE)), ImuBuffer()
    n = 1000
    for stamp_ns, step in steps_of(n=n):
        assert alignment.oldest_ns(stamp_ns) < stamp_ns
        alignment.follow(None, stamp_ns, buffer)
        alignment.follow(step, stamp_ns, buffer)
    assert 900 <= len(alignment.steps) < 930
    assert alignment.steps[-1][0] == stamp_ns
    assert alignment.oldest_ns(stamp_ns) < alignment.steps[0][0]


PATIENT = replace(HAND, rest_s=(0.0, 50.5))


def test_a_camera_that_rests_for_long_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    class Counted(ImuBuffer):
        def add(self, samples: ImuSamples) -> None:
            super().add(samples)
            sizes.append(len(self))

    monkeypatch.setattr("gvo.backend.inertial.ImuBuffer", Counted)
    estimator = InertialEstimator(Imu(), max_coast_s=5.0)
    ride = Ride(estimator, PATIENT, length_s=70.0).ride(50.0)
    assert estimator.state is None
    assert "not turned enough" in estimator.reason
    assert ride.ride(64.0).carried(1.0)[0] < 0.01
    assert sizes[-1] < 500
    assert max(sizes) < 20_000


def test_in_the_dark_samples_do_not_pile_up_before_anything_is_learnt() -> None:
    ride = Ride(InertialEstimator(Imu(), max_coast_s=5.0), length_s=60.0)
    ride.ride(50.0, is_seen=False)
    assert len(vars(ride.estimator)["_buffer"]) < 500


def test_a_view_that_is_frozen_tells_nothing() -> None:
    frozen = [
        (stamp_ns, replace(step, T_reference_frame=np.eye(4))) for stamp_ns, step in steps_of()
    ]
    assert not learnt(Imu(), frozen, measured())


def test_an_estimator_learns_what_is_unknown_and_carries_by_it() -> None:
    estimator = InertialEstimator(Imu(), max_coast_s=5.0)
    ride = Ride(estimator, sensor=Sensor(delay_s=0.02), T_camera_imu=TURNED)
    assert ride.ride(1.0).carry(0.5) is None
    assert estimator.state is None
    ride.ride(8.0)
    assert estimator.imu.T_camera_imu is not None
    assert turn_deg(estimator.imu.T_camera_imu[:3, :3]) < 0.1
    assert estimator.imu.delay_s is not None
    assert abs(estimator.imu.delay_s - 0.02) < 0.0005
    shift_m, angle_deg = ride.carried(1.0)
    assert shift_m < 0.01
    assert angle_deg < 0.05
