"""A rendered IMU measures the motion of the rendered camera, as wrong as asked."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gvo.geometry.imu import ImuSamples
from gvo.io.synthetic import RenderedImu, SyntheticRecording, WorldName, rendered_imu
from gvo.types import FloatArray, IntArray

TINY: Any = dict.fromkeys(
    ("gyro_noise", "gyro_walk", "acceleration_noise", "acceleration_walk"), 1e-9
)
PERFECT = replace(
    rendered_imu(),
    imu=replace(rendered_imu().imu, **TINY),
    gyro_bias=0.0,
    acceleration_bias=0.0,
)


def recorded(
    imu: RenderedImu, *, world: WorldName = "handheld", n_frames: int = 60, seed: int = 0
) -> SyntheticRecording:
    return SyntheticRecording(world, "stereo", n_frames=n_frames, scale=0.1, imu=imu, seed=seed)


def all_of(recording: SyntheticRecording) -> ImuSamples:
    assert recording.info.imu is not None
    parts = [*recording.info.imu.samples(0)]
    assert max(map(len, parts)) <= 200
    return ImuSamples.of(
        np.concatenate([part.stamps_ns for part in parts]),
        np.concatenate([part.gyro for part in parts]),
        np.concatenate([part.acceleration for part in parts]),
    )


def integrated(
    samples: ImuSamples, T_start: FloatArray, stamps_ns: IntArray, T_camera_imu: FloatArray
) -> tuple[FloatArray, Rotation]:
    """Return where specific forces lead the IMU, but for a start velocity and gravity.

    By splines through the samples, and rotations in steps of a quarter of a millisecond.
    """
    times_s = 1e-9 * (samples.stamps_ns - stamps_ns[0])
    fine_s = np.arange(0.0, 1e-9 * (stamps_ns[-1] - stamps_ns[0]) + 1e-9, 2.5e-4)
    steps = CubicSpline(times_s, samples.gyro)(fine_s[:-1] + 1.25e-4) * 2.5e-4
    turns = [Rotation.from_matrix((T_start @ T_camera_imu)[:3, :3])]
    for step in Rotation.from_rotvec(steps):
        turns.append(turns[-1] * step)
    R = Rotation.concatenate(turns)
    forces = R.apply(CubicSpline(times_s, samples.acceleration)(fine_s))
    changes = cumulative_simpson(forces, x=fine_s, axis=0, initial=0.0)
    shifts = cumulative_simpson(changes, x=fine_s, axis=0, initial=0.0)
    at = np.round(1e-9 * (stamps_ns - stamps_ns[0]) / 2.5e-4).astype(int)
    return shifts[at], R[at]


@pytest.mark.parametrize("world", ["handheld", "driving"])
def test_its_samples_integrate_to_the_rendered_motion(world: WorldName) -> None:
    recording = recorded(PERFECT, world=world, n_frames=60)
    truth = recording.ground_truth()
    keep = slice(0, None, 3)
    stamps_ns, T = truth.stamps_ns[keep], truth.T_world_frame[keep]
    shifts, R = integrated(all_of(recording), T[0], stamps_ns, PERFECT.T_camera_imu)
    T_imu = T @ PERFECT.T_camera_imu
    turns = R.inv() * Rotation.from_matrix(T_imu[:, :3, :3])
    assert np.degrees(turns.magnitude()).max() < 0.02
    # What is left is v t - g t^2 / 2.
    times_s = 1e-9 * (stamps_ns - stamps_ns[0])
    left = T_imu[:, :3, 3] - T_imu[0, :3, 3] - shifts
    A = np.stack([times_s, 0.5 * times_s**2], axis=1)
    (_, gravity), *_ = np.linalg.lstsq(A, left, rcond=None)
    np.testing.assert_allclose(A @ np.linalg.lstsq(A, left, rcond=None)[0], left, atol=0.003)
    assert abs(np.linalg.norm(gravity) - 9.81) < 0.03
    assert np.linalg.norm(T_imu[-1, :3, 3] - T_imu[0, :3, 3]) > 0.1


def test_a_camera_that_looks_ahead_feels_gravity_upwards() -> None:
    imu = replace(PERFECT, T_camera_imu=np.eye(4))
    felt = all_of(recorded(imu, world="driving")).acceleration.mean(axis=0)
    assert felt[1] < -9.0  # y points down


def test_samples_begin_before_the_first_image_and_end_after_the_last() -> None:
    recording = recorded(PERFECT)
    samples, stamps_ns = all_of(recording), recording.ground_truth().stamps_ns
    assert 0.09 < 1e-9 * (stamps_ns[0] - samples.stamps_ns[0]) < 0.11
    assert 0.09 < 1e-9 * (samples.stamps_ns[-1] - stamps_ns[-1]) < 0.11
    np.testing.assert_allclose(np.diff(samples.stamps_ns), 5_000_000, atol=2)


@pytest.mark.parametrize("delay_s", [0.03, -0.03])
def test_a_delay_is_what_must_be_added_to_its_stamps(delay_s: float) -> None:
    on_time = all_of(recorded(PERFECT))
    late = all_of(recorded(replace(PERFECT, delay_s=delay_s)))
    n = min(len(on_time), len(late))
    shifts_ns = on_time.stamps_ns[:n] - late.stamps_ns[:n]
    np.testing.assert_allclose(shifts_ns, 1e9 * delay_s, atol=2)
    np.testing.assert_allclose(on_time.gyro[:n], late.gyro[:n], atol=1e-6)


def test_a_late_imu_still_measures_the_last_image() -> None:
    recording = recorded(replace(PERFECT, delay_s=0.15))
    end_ns = int(recording.ground_truth().stamps_ns[-1])
    assert all_of(recording).stamps_ns[-1] + 150_000_000 > end_ns


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_as_many_samples_are_missing_as_asked(share: float) -> None:
    whole = all_of(recorded(PERFECT, n_frames=300))
    part = all_of(recorded(replace(PERFECT, share_missing=share), n_frames=300))
    assert abs(len(part) / len(whole) - (1.0 - share)) < 0.04
    at = np.searchsorted(whole.stamps_ns, part.stamps_ns)
    np.testing.assert_array_equal(whole.stamps_ns[at], part.stamps_ns)
    np.testing.assert_allclose(whole.gyro[at], part.gyro, atol=1e-6)


def as_bytes(samples: ImuSamples) -> bytes:
    return b"".join(
        each.tobytes() for each in (samples.stamps_ns, samples.gyro, samples.acceleration)
    )


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not() -> None:
    imu = replace(rendered_imu("cheap"), share_missing=0.1)
    recording = recorded(imu)
    first = as_bytes(all_of(recording))
    assert as_bytes(all_of(recording)) == first
    assert as_bytes(all_of(recorded(imu))) == first
    assert as_bytes(all_of(recorded(imu, seed=1))) != first


def test_noise_and_walks_are_as_large_as_their_densities() -> None:
    # Of a resting camera at 200 Hz over a minute, 20 seeds.
    loud = replace(PERFECT, imu=replace(PERFECT.imu, gyro_noise=1e-3, acceleration_walk=1e-2))
    whites, ends = [], []
    for seed in range(20):
        parts = [*loud.samples(_resting, 0, 60.0, seed)]
        gyro = np.concatenate([part.gyro for part in parts])
        force = np.concatenate([part.acceleration for part in parts])
        whites.append(gyro.std())
        ends.append(force[-1] - force[0])
    np.testing.assert_allclose(np.mean(whites), 1e-3 * np.sqrt(200.0), rtol=0.02)
    np.testing.assert_allclose(np.std(ends), 1e-2 * np.sqrt(60.0), rtol=0.3)


def _resting(times_s: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(4), (len(times_s), 4, 4))


def test_biases_scales_and_misalignments_spread_as_asked() -> None:
    imu = replace(PERFECT, gyro_bias=0.05, acceleration_bias=0.2)
    biases = np.array([next(imu.samples(_resting, 0, 0.1, seed)).gyro[0] for seed in range(100)])
    np.testing.assert_allclose(biases.std(), 0.05, rtol=0.15)
    bent = replace(PERFECT, scale=0.01)
    forces = [next(bent.samples(_resting, 0, 0.1, seed)).acceleration[0] for seed in range(100)]
    felt = PERFECT.T_camera_imu[:3, :3].T @ [0.0, 0.0, 9.81]
    np.testing.assert_allclose(np.std(forces, axis=0), 0.01 * np.abs(felt), rtol=0.3)
    turned = replace(PERFECT, misalignment=0.02)
    forces = [next(turned.samples(_resting, 0, 0.1, seed)).acceleration[0] for seed in range(100)]
    angles = np.arccos(np.array(forces) @ felt / 9.81**2)
    np.testing.assert_allclose(np.sqrt(np.mean(angles**2)), 0.02 * np.sqrt(2.0), rtol=0.15)
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.81, rtol=1e-6)


def test_a_kind_that_there_is_not_is_refused() -> None:
    kind: Any = "good"
    with pytest.raises(ValueError, match="kind must be one of"):
        rendered_imu(kind)


def test_a_recording_tells_of_its_imu_and_one_without_says_so() -> None:
    told = recorded(rendered_imu()).info.imu
    assert told is not None
    np.testing.assert_array_equal(told.imu.T_camera_imu, rendered_imu().T_camera_imu)
    assert SyntheticRecording("handheld", "stereo", n_frames=3, scale=0.1).info.imu is None
