"""An IMU carries the camera through the dark, and changes nothing where it sees."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from gvo.config import Config
from gvo.geometry.imu import Imu, ImuSamples
from gvo.io.recording import Sensor, StampedImage
from gvo.io.synthetic import SyntheticRecording, rendered_imu
from gvo.odometry.odometry import Odometry
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate, FloatArray, Frame, FrameResult, Status
from tests.backend.imus import errors_of
from tests.make.recordings import Held, frames_of, hold

N_FRAMES = 80
DARK = range(40, 70)
SEEN = DARK[0] - 1
RATE_HZ = 30


@cache
def lit(sensor: Sensor = "stereo", n_frames: int = N_FRAMES) -> Held:
    recording = SyntheticRecording(
        "handheld", sensor, n_frames=n_frames, scale=0.35, imu=rendered_imu()
    )
    return hold(recording)


def darkened(source: Held, dark: range) -> list[Frame]:
    """Return frames of which some are black."""

    def change(image: StampedImage, number: int) -> StampedImage:
        if number not in dark or (image.stream == 1 and source.info.sensor == "rgbd"):
            return image
        return replace(image, load=lambda: np.zeros_like(image.load()))

    return frames_of(source.mapped(change))


@dataclass(frozen=True)
class Run:
    """What odometry gave for each frame, and at the end."""

    results: list[FrameResult]
    trajectories: dict[str, Trajectory]
    last: tuple[Estimate, ...]

    def finished(self) -> list[Estimate]:
        return [each for result in self.results for each in result.finished] + [*self.last]

    def errors(self, truth: Trajectory, start: int, end: int) -> tuple[float, float]:
        """Return how far the causal pose of a frame is off in that of another: m, degrees."""
        T, T_true = (
            np.linalg.inv(poses[start]) @ poses[end]
            for poses in (self.poses(), truth.T_world_frame)
        )
        return errors_of(T, T_true)

    def error_m(self, truth: Trajectory, start: int, end: int) -> float:
        return self.errors(truth, start, end)[0]

    def poses(self) -> FloatArray:
        return np.array([result.causal.T_world_frame for result in self.results])

    def carried(self) -> list[int]:
        return [k for k, result in enumerate(self.results) if result.is_carried]


def samples_of(source: Held) -> Iterator[ImuSamples]:
    assert source.info.imu is not None
    return source.info.imu.samples(0)


def run(
    source: Held,
    dark: range = range(0),
    *,
    config: Config | None = None,
    has_imu: bool = True,
    changes: dict[int, Config] | None = None,
    late_s: float = 0.0,
) -> Run:
    """Track a recording; the configuration may change before some frames."""
    assert source.info.imu is not None
    imu: Imu | None = source.info.imu.imu if has_imu else None
    odometry = Odometry(source.info.camera, config or Config(), imu=imu)
    for samples in samples_of(source):
        stamps_ns = samples.stamps_ns - round(1e9 * late_s)
        odometry.add_imu(stamps_ns, samples.gyro, samples.acceleration)
    results = []
    for k, frame in enumerate(darkened(source, dark)):
        if changes and k in changes:
            odometry.reconfigure(changes[k])
        results.append(odometry.track(frame))
    trajectories = odometry.trajectories()
    return Run(results=results, trajectories=trajectories, last=odometry.finish())


@cache
def dark_run(sensor: Sensor, has_imu: bool) -> Run:
    return run(lit(sensor), DARK, has_imu=has_imu)


def with_imu(**changes: Any) -> Config:
    return Config.model_validate({"imu": changes})


def parts(result: FrameResult) -> list[Any]:
    """Return what a frame gave but times and what is told of the IMU, as plain values."""
    links = [(link.reference_ns, link.kind, link.chi2) for link in result.links]
    loops = [(loop.stamp_ns, loop.reference_ns, loop.covariance.tolist()) for loop in result.loops]
    estimates = [
        (each.T_world_frame.tolist(), each.covariance.tolist(), each.status)
        for each in (result.raw, result.causal, *result.finished)
    ]
    return [links, loops, estimates, result.keyframes_ns, result.segment, result.reason]


def assert_same(one: Run, other: Run) -> None:
    assert list(map(parts, one.results)) == list(map(parts, other.results))
    for name, trajectory in one.trajectories.items():
        found = other.trajectories[name].T_world_frame
        np.testing.assert_array_equal(trajectory.T_world_frame, found)
    for before, after in zip(one.last, other.last, strict=True):
        np.testing.assert_array_equal(before.covariance, after.covariance)


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_where_the_camera_sees_an_imu_changes_no_bit(sensor: Sensor) -> None:
    source = lit(sensor).cut(40)
    with_one, without = run(source), run(source, has_imu=False)
    assert_same(with_one, without)
    assert with_one.results[-1].inertial is not None
    assert without.results[-1].inertial is None
    assert sum(len(result.links) for result in with_one.results) > 50


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_a_second_of_darkness_is_carried_within_centimetres(sensor: Sensor) -> None:
    truth, last = lit(sensor).ground_truth(), DARK[-1]
    assert truth is not None
    carried, guessed = dark_run(sensor, True), dark_run(sensor, False)
    error_m = carried.error_m(truth, SEEN, last)
    assert error_m < 0.04
    assert guessed.error_m(truth, SEEN, last) > 2.5 * error_m
    sigmas = np.sqrt(carried.results[last].causal.covariance.diagonal())
    assert sigmas[3:].max() < 0.1 * np.sqrt(guessed.results[last].causal.covariance[3, 3])
    assert error_m < 4.0 * np.linalg.norm(sigmas[3:])
    assert carried.error_m(truth, SEEN, N_FRAMES - 1) < 0.02


def test_carried_frames_are_coasting_flagged_and_of_the_same_segment() -> None:
    found = dark_run("stereo", True)
    assert found.carried() == [*DARK]
    assert {found.results[k].status for k in DARK} == {Status.COASTING}
    assert found.results[DARK.stop].status is Status.RESUMED
    assert {result.segment for result in found.results} == {0}
    assert {each.status for each in found.finished()} >= {Status.COASTING}
    assert not dark_run("stereo", False).carried()


def test_the_first_frame_that_sees_again_is_linked_by_the_imu_too() -> None:
    found = dark_run("stereo", True)
    links = {k: [link.kind for link in found.results[k].links] for k in range(N_FRAMES)}
    assert links[DARK.stop].count("imu") == 1
    assert "step" in links[DARK.stop]
    link = found.results[DARK.stop].links[-1]
    assert link.kind == "imu"
    assert link.reference_ns == found.results[DARK[-1]].stamp_ns
    assert not [k for k in links if k != DARK.stop and "imu" in links[k]]


def test_smoothed_poses_of_the_dark_lie_between_what_was_seen_before_and_after() -> None:
    truth, found = lit().ground_truth(), dark_run("stereo", True)
    assert truth is not None
    for name in ("smoothed", "global"):
        T = found.trajectories[name].T_world_frame
        for k in (DARK.start + 10, DARK[-1]):
            step = np.linalg.inv(T[SEEN]) @ T[k]
            true = np.linalg.inv(truth.T_world_frame[SEEN]) @ truth.T_world_frame[k]
            assert np.linalg.norm(step[:3, 3] - true[:3, 3]) < 0.02


@pytest.mark.parametrize("changes", [{"enabled": False}, {"max_coast_s": 0.0}])
def test_an_imu_that_may_not_carry_changes_no_bit(changes: dict[str, Any]) -> None:
    found = run(lit(), DARK, config=with_imu(**changes))
    assert_same(found, dark_run("stereo", False))
    assert not found.carried()
    is_told = found.results[SEEN].inertial is not None
    assert is_told == ("max_coast_s" in changes)


def test_two_seconds_after_it_may_carry_no_more_the_camera_is_lost() -> None:
    source, dark = lit(n_frames=120), range(25, 120)
    found = run(source, dark, config=with_imu(max_coast_s=0.5))
    n_carried = int(0.5 * RATE_HZ)
    assert found.carried() == [*range(25, 24 + n_carried + 1)]
    first_lost = next(k for k, each in enumerate(found.results) if each.status is Status.LOST)
    assert abs(first_lost - (24 + n_carried + 2 * RATE_HZ)) <= 2
    assert {each.status for each in found.results[25:first_lost]} == {Status.COASTING}
    assert {each.status for each in found.results[first_lost:]} == {Status.LOST}


@pytest.mark.parametrize("off", [{"enabled": False}, {"max_coast_s": 0.0}])
def test_while_it_runs_it_is_let_carry_or_not(off: dict[str, Any]) -> None:
    changes = {50: with_imu(**off), 60: Config()}
    found = run(lit(), DARK, changes=changes)
    assert found.carried() == [*range(40, 50), *range(60, 70)]
    assert {found.results[k].status for k in DARK} == {Status.COASTING}


def test_a_gap_that_it_did_not_carry_through_is_not_linked_by_it() -> None:
    changes = {DARK[0]: with_imu(max_coast_s=0.0), DARK.stop: Config()}
    found = run(lit().cut(DARK.stop + 1), DARK, changes=changes)
    assert not found.carried()
    assert [link.kind for link in found.results[-1].links].count("imu") == 0
    assert found.results[-1].status is Status.RESUMED


def test_an_imu_that_was_not_enabled_at_the_start_is_not_used_in_this_run() -> None:
    found = run(lit(), DARK, config=with_imu(enabled=False), changes={10: Config()})
    assert not found.carried()


def test_an_imu_that_is_enabled_later_is_the_one_that_was_given() -> None:
    given = Imu(T_camera_imu=np.diag([1.0, -1.0, -1.0, 1.0]), delay_s=0.01)
    odometry, frame = Odometry(lit().info.camera, with_imu(enabled=False), imu=given), lit()
    odometry.reconfigure(Config())
    odometry.track(next(iter(frames_of(frame))))
    assert odometry.inertial is None
    odometry.add_imu([0], np.zeros((1, 3)), np.zeros((1, 3)))
    assert odometry.inertial is not None
    assert odometry.inertial.imu is not given
    assert odometry.inertial.imu.delay_s == 0.01
    np.testing.assert_array_equal(odometry.inertial.imu.T_camera_imu, given.T_camera_imu)


def test_a_delay_that_is_configured_stands_above_that_of_the_recording() -> None:
    late_s = 0.05  # which the recording does not know of
    truth = lit().ground_truth()
    assert truth is not None
    told = run(lit(), DARK, config=with_imu(delay_ms=1e3 * late_s), late_s=late_s)
    untold = run(lit(), DARK, late_s=late_s)
    right, wrong = (each.errors(truth, SEEN, DARK[-1]) for each in (told, untold))
    assert right[0] < 0.03
    assert right[1] < 0.3
    assert wrong[1] > 1.0


def test_densities_that_are_configured_stand_above_those_of_the_recording() -> None:
    noisy = with_imu(acceleration_noise=0.1, gyro_noise=0.01)
    found, known = run(lit().cut(45), DARK, config=noisy), dark_run("stereo", True)
    for entry in (0, 3):
        sigmas = [
            np.sqrt(each.results[44].causal.covariance[entry, entry]) for each in (found, known)
        ]
        assert sigmas[0] > 2.0 * sigmas[1]


def test_samples_whose_shapes_do_not_fit_are_refused() -> None:
    odometry = Odometry(lit().info.camera, imu=Imu())
    with pytest.raises(ValueError, match="gyro must have shape"):
        odometry.add_imu([1, 2], np.zeros((1, 3)), np.zeros((2, 3)))
