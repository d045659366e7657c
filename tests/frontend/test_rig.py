"""Constant errors of a camera: the filter, a rolling shutter, and rendered planted errors."""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import brentq

import gvo
from gvo.config import Config
from gvo.frontend import klt
from gvo.frontend.factory import make_frontend
from gvo.frontend.offsets import ConstantFilter, RigOffsets, VarianceFactor
from gvo.frontend.rig import FrameMotion, MeasuredVelocity, note_step
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.refinement import Adjustment
from gvo.io.recording import Sensor
from gvo.io.synthetic import SensorNoise
from gvo.kernels import shutter
from gvo.types import (
    ConstantError,
    Failure,
    FaultyFrame,
    FloatArray,
    Frame,
    MotionPrior,
    RelativePose,
    StereoFrame,
)
from tests.geometry.scenes import move, project, unproject
from tests.make.recordings import frames_of

N_FRAMES = 20
CAMERA = StereoCamera(fx=525.0, fy=520.0, cx=319.5, cy=239.5, width=640, height=480, baseline=0.1)
READOUT_S = 0.025


def settle_rows(
    uvd: FloatArray, velocity: FloatArray, readout_s: float, camera: StereoCamera
) -> FloatArray:
    settled = np.empty_like(uvd)
    shutter.settle_rows(uvd, 0.0, velocity, readout_s, camera.parameters, settled)
    return settled


def settling_rates(uvd: FloatArray, velocity: FloatArray, camera: StereoCamera) -> FloatArray:
    rates = np.empty_like(uvd)
    shutter.write_readout_rates(uvd, 0.0, velocity, camera.parameters, rates)
    return rates


def result(*, n_inliers: int = 20, **errors: float) -> RelativePose:
    return RelativePose(
        matches=np.zeros((20, 2), dtype=np.int64),
        inliers=np.arange(20) < n_inliers,
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        calibration_errors={
            name: ConstantError(value=value, sigma=0.1 * abs(value), effect=np.zeros(6))
            for name, value in errors.items()
        },
    )


def config(readout_ms: float | None = None, *, estimate_offset: bool = True) -> Config:
    return Config.model_validate(
        {"camera": {"readout_ms": readout_ms}, "stereo": {"estimate_offset": estimate_offset}}
    )


@settings(max_examples=30)
@given(true=st.floats(-0.2, 0.2), seed=st.integers(0, 999))
def test_the_filter_finds_a_constant_within_its_sigma(true: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = ConstantFilter(0.3, 5e-4)
    for _ in range(200):
        found.update(true + 0.1 * rng.normal() - found.value, 0.1)
    assert abs(found.value - true) < 4.5 * found.sigma
    assert found.sigma < 0.012


def test_what_is_not_measured_stays_at_the_prior() -> None:
    for prior in (0.0, 0.3):
        found = ConstantFilter(0.1, 5e-4, prior)
        for _ in range(100):
            found.advance()
            found.update(0.5, 50.0)
        assert abs(found.value - prior) < 0.02
        assert found.sigma == pytest.approx(0.1, rel=0.05)


def test_what_is_given_is_not_learnt() -> None:
    found = ConstantFilter(0.0, 0.0, 0.02)
    found.advance()
    found.update(0.01, 1e-6)
    assert (found.value, found.sigma) == (0.02, 0.0)


def test_one_wild_measurement_moves_it_no_farther_than_three_sigmas() -> None:
    tame, wild = ConstantFilter(0.1, 5e-4), ConstantFilter(0.1, 5e-4)
    tame.update(3.0 * np.hypot(0.1, 0.02), 0.02)
    wild.update(50.0, 0.02)
    assert wild.value == pytest.approx(tame.value)


@pytest.mark.parametrize(
    ("misfit", "sigma_factor", "expected"),
    [
        (0.2, 2.4, 0.4),
        (1.0, 2.4, 1.0),
        (50.0, 2.4, 1.0),  # never wider than assumed
        (0.2, 1.2, 1.2**-2),  # never surer than residuals are
        (0.2, 0.9, 1.0),
    ],
)
def test_an_inflation_is_taken_back_as_far_as_registrations_agree_better(
    misfit: float, sigma_factor: float, expected: float
) -> None:
    factor = VarianceFactor(sigma_factor)
    for _ in range(300):
        factor.note(misfit)
        factor.note(math.nan)
    assert factor.value == pytest.approx(expected, abs=1e-3)


def test_one_misfit_far_off_does_not_undo_what_many_showed() -> None:
    factor = VarianceFactor(2.4)
    for _ in range(300):
        factor.note(0.2)
    factor.note(1e9)
    assert factor.value < 0.5


def test_what_is_noted_counts_from_the_next_frame_and_once() -> None:
    offsets = RigOffsets(config())
    offsets.note_disparity(result(disparity_px=0.1).calibration_errors["disparity_px"])
    offsets.note_rows(0.2)
    assert offsets.disparity.value == offsets.row.value == 0.0
    offsets.advance()
    disparity_px, row_px = offsets.disparity.value, offsets.row.value
    assert 0.0 < disparity_px <= 0.1
    assert 0.0 < row_px <= 0.2
    for _ in range(87):
        offsets.note_rows(0.2)  # measured while less of it was known
        offsets.advance()
        assert row_px <= offsets.row.value <= 0.2
    assert offsets.row.value == pytest.approx(0.2, abs=0.01)
    row_px = offsets.row.value
    offsets.advance()
    assert (offsets.disparity.value, offsets.row.value) == (disparity_px, row_px)


@pytest.mark.parametrize("true_px", [-0.3, -0.04, 0.0, 0.03, 0.2])
def test_an_offset_is_taken_off_but_for_what_lenses_and_edges_feign(true_px: float) -> None:
    offsets = RigOffsets(config())
    for _ in range(200):
        # What is left of it after the present value was subtracted.
        left_px = true_px - offsets.disparity_px
        error = ConstantError(value=left_px, sigma=0.01, effect=np.zeros(6))
        offsets.note_disparity(error)
        offsets.advance()
    assert offsets.disparity.value == pytest.approx(true_px, abs=0.01)
    expected_px = np.sign(true_px) * max(abs(true_px) - 0.05, 0.0)
    assert offsets.disparity_px == pytest.approx(expected_px, abs=0.01)


def note_link(offsets: RigOffsets, readout_s: float, *, n_inliers: int = 20) -> None:
    link = result(n_inliers=n_inliers, readout_s=readout_s)
    offsets.note_readout(link.calibration_errors["readout_s"], link)


def test_each_link_of_a_frame_tells_the_readout_that_was_not_known_when_it_was_made() -> None:
    offsets = RigOffsets(config())
    for _ in range(2):
        note_link(offsets, 0.02)
    assert offsets.readout.value == 0.0
    offsets.advance()
    # Both are of the value that was used, not of what the first one made of it.
    assert 0.01 < offsets.readout.value <= 0.02
    assert offsets.readout.sigma < 0.014


def test_a_registration_with_many_outliers_tells_less_of_the_readout() -> None:
    sure, doubtful = RigOffsets(config()), RigOffsets(config())
    note_link(sure, 0.02)
    note_link(doubtful, 0.02, n_inliers=10)
    for offsets in (sure, doubtful):
        offsets.advance()
    # Half of the matches: four times the sigma.
    information = [each.readout.sigma**-2 - 0.03**-2 for each in (sure, doubtful)]
    assert information[0] == pytest.approx(16.0 * information[1], rel=1e-3)


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
def test_a_frame_tells_the_readout_once_the_next_step_is_known(kind: str) -> None:
    recording = gvo.SyntheticRecording("turning", "rgbd", n_frames=12, seed=3, readout_ms=25.0)
    settings = Config.model_validate({"frontend": {"kind": kind}})
    frontend: Any = make_frontend(recording.info.camera, settings)
    readout, poses = frontend.rig_offsets.readout, recording.ground_truth().T_world_frame
    frames, values = [frontend.extract(frame) for frame in frames_of(recording)], []
    for k, (reference, current) in enumerate(pairwise(frames), start=1):
        T = se3.invert(poses[k - 1]) @ poses[k]
        frontend.register(reference, current, MotionPrior(T_predicted=T, T_recent=T))
        frontend.rig_offsets.advance()
        values.append(readout.value)
        if k == 8:
            T = se3.invert(poses[0]) @ poses[k]
            link = frontend.register(frames[0], current, MotionPrior(T_predicted=T))
            assert isinstance(link, RelativePose)
            frontend.rig_offsets.advance()
            assert readout.value == values[-1]
    # Of the first step no velocity is known.
    assert values[0] == 0.0
    error_s = np.abs(np.array(values) - READOUT_S)
    assert error_s[8] != error_s[7]
    assert error_s[-1] < (0.0015 if kind == "klt" else 0.01)


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_what_is_refused_and_loops_tell_nothing_of_the_camera(
    sensor: Sensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = gvo.SyntheticRecording("turning", sensor, n_frames=9, seed=3, readout_ms=25.0)
    poses = recording.ground_truth().T_world_frame

    def refuse(result: RelativePose, *_: object) -> Failure:
        assert isinstance(result, RelativePose)
        return Failure(reason="refused")

    def learnt(also: str) -> list[float]:
        frontend: Any = make_frontend(recording.info.camera, Config())
        frames = [frontend.extract(frame) for frame in frames_of(recording)]
        for k, (reference, current) in enumerate(pairwise(frames), start=1):
            T = se3.invert(poses[k - 1]) @ poses[k]
            frontend.register(reference, current, MotionPrior(T_predicted=T, T_recent=T))
            T = se3.invert(poses[0]) @ poses[k]
            if also == "loops":
                places = frontend.describe(frames[0]), frontend.describe(current)
                assert isinstance(frontend.recognize(*places, current), RelativePose)
            elif also:
                with monkeypatch.context() as patch:
                    if also == "refused":
                        patch.setattr(klt, "check_view", refuse)
                        patch.setattr(frontend, "_check_depth", refuse)
                    found = frontend.register(frames[0], current, MotionPrior(T_predicted=T))
                assert isinstance(found, Failure) == (also == "refused")
            frontend.rig_offsets.advance()
        return [frontend.rig_offsets.readout.value, frontend.rig_offsets.disparity.value]

    assert learnt("loops") == learnt("refused") == learnt("") != learnt("links")


def test_nothing_is_learnt_where_it_is_switched_off() -> None:
    offsets = RigOffsets(config(12.5, estimate_offset=False))
    offsets.note_rows(0.2)
    offsets.advance()
    assert not offsets.learnt
    assert offsets.as_json() == {
        "disparity_px": 0.0,
        "disparity_sigma_px": 0.1,
        "row_px": 0.0,
        "readout_ms": 12.5,
        "readout_sigma_ms": 0.0,
    }


@dataclass(frozen=True, eq=False)
class Seen:
    stamp_ns: int
    motion: FrameMotion = field(default_factory=FrameMotion)


STEPS = np.array([[0.01, -0.02, 0.005, 0.03, 0.01, 0.04], [0, 0.02, 0, 0.01, 0, 0.06]])


def assert_velocity(frame: Seen, expected: FloatArray) -> None:
    velocity = frame.motion.velocity
    assert velocity is not None
    np.testing.assert_allclose(velocity, expected, atol=1e-12)


def test_a_frame_moves_with_the_mean_of_the_steps_around_it() -> None:
    first, second, third = (Seen(stamp) for stamp in (0, 100_000_000, 150_000_000))
    assert second.motion.velocity is None
    note_step(first, second, se3.exp(STEPS[0]))
    assert_velocity(first, 10.0 * STEPS[0])
    assert_velocity(second, 10.0 * STEPS[0])
    for _ in range(2):  # once more changes nothing
        note_step(second, third, se3.exp(STEPS[1]))
        mean = 0.5 * (10.0 * STEPS[0] + 20.0 * STEPS[1])
        assert_velocity(second, mean)
        # A step and half of its change, before the first and after the last.
        assert_velocity(first, 15.0 * STEPS[0] - 10.0 * STEPS[1])
        assert_velocity(third, 30.0 * STEPS[1] - 5.0 * STEPS[0])
    # Neither a frame itself nor one a nanosecond later tells a velocity.
    for later in (third, Seen(third.stamp_ns + 1)):
        note_step(third, later, se3.exp(STEPS[1]))
        assert_velocity(third, 30.0 * STEPS[1] - 5.0 * STEPS[0])


def test_of_an_unknown_step_only_the_one_before_is_known() -> None:
    first, second, third = (Seen(stamp) for stamp in (0, 100_000_000, 200_000_000))
    note_step(first, second, se3.exp(STEPS[0]))
    note_step(second, third, se3.exp(STEPS[1]))
    note_step(second, third, None)
    assert_velocity(second, 10.0 * STEPS[0])
    assert third.motion.velocity is None
    note_step(first, third, None)
    assert first.motion.velocity is None


def test_the_velocity_of_a_frame_is_in_doubt_until_the_next_step_is_known() -> None:
    first, second, third = (Seen(stamp) for stamp in (0, 100_000_000, 200_000_000))
    assert first.motion.sigmas is None
    note_step(first, second, se3.exp(STEPS[0]))
    # It may change along any axis, by a fifth; later by as much as it just did, and shift by less.
    of_step, change = 10.0 * STEPS[0], 10.0 * (STEPS[1] - STEPS[0])
    for frame, vector in ((second, 0.2 * of_step), (third, change / np.sqrt(3.0))):
        if frame is third:
            note_step(second, third, se3.exp(STEPS[1]))
            assert second.motion.sigmas is None
        turn, shift = np.linalg.norm(vector[:3]), 0.3 * np.linalg.norm(vector[3:])
        sigmas = frame.motion.sigmas
        assert sigmas is not None
        np.testing.assert_allclose(sigmas, np.repeat([turn, shift], 3))


def test_a_pose_is_off_by_what_is_learnt_of_its_velocity_later() -> None:
    first, second, third, fourth = (Seen(stamp) for stamp in range(0, 400_000_000, 100_000_000))
    note_step(first, second, se3.exp(STEPS[0]))
    note_step(second, third, se3.exp(STEPS[1]))
    extrapolated, sigmas = third.motion.velocity, third.motion.sigmas
    assert extrapolated is not None
    assert sigmas is not None
    rng = np.random.default_rng(2)
    measured = MeasuredVelocity(
        extrapolated=extrapolated,
        sigmas=sigmas,
        found=Adjustment(
            values=np.arange(6.0),
            covariance=np.eye(6),
            effects=rng.normal(size=(6, 6)),
            T_reference_current=np.eye(4),
        ),
    )
    np.testing.assert_array_equal(measured.velocity, extrapolated + sigmas * np.arange(6))
    third.motion.measure(measured)
    assert third.motion.measured is measured
    assert_velocity(third, measured.velocity)
    error = third.motion.error()
    np.testing.assert_array_equal(error, 0.0)
    assert not second.motion.error().any()
    note_step(third, fourth, se3.exp(STEPS[0]))
    mean = 5.0 * (STEPS[1] + STEPS[0])
    assert_velocity(third, mean)
    assert third.motion.measured is None
    change = (mean - measured.velocity) / sigmas
    np.testing.assert_allclose(third.motion.error(), change @ measured.found.effects)
    # Where the next step fails, what was measured is the best that is known.
    note_step(third, fourth, None)
    assert_velocity(third, measured.velocity)
    # Registered anew it is measured anew.
    note_step(second, third, se3.exp(STEPS[1]))
    assert third.motion.measured is None
    assert not third.motion.error().any()


def velocity_errors(seed: int) -> list[list[float]]:
    """Return by how much velocities of frames in the hand are off, measured and extrapolated."""
    # Each second frame: between two of them a camera in the hand changes its velocity.
    recording = gvo.SyntheticRecording("turning", "rgbd", n_frames=27, seed=seed, readout_ms=25.0)
    poses = recording.ground_truth().T_world_frame
    given = Config.model_validate({"camera": {"readout_ms": 25.0}})
    frontend: Any = make_frontend(recording.info.camera, given)
    frames = frames_of(recording)
    seen = [frontend.extract(frame) for frame in frames[::2]]
    errors, prior = [], None
    for n, (reference, current) in enumerate(pairwise(seen[:-1]), start=1):
        found = frontend.register(reference, current, prior)
        T = found.T_reference_current
        prior = MotionPrior(T_predicted=T, T_recent=T)
        measured = current.motion.measured
        assert measured is not None
        if n > 1:  # of a first step nothing is extrapolated
            k = 2 * n
            seconds = 1e-9 * (frames[k + 1].stamp_ns - frames[k - 1].stamp_ns)
            turn = se3.log(se3.invert(poses[k - 1]) @ poses[k + 1])[:3] / seconds
            compared = measured.velocity, measured.extrapolated
            errors.append([float(np.linalg.norm(each[:3] - turn)) for each in compared])
    return errors


@pytest.mark.acceptance
def test_rows_tell_the_velocity_of_the_newest_frame() -> None:
    # Of one recording it is chance: by seed the ratio is 0.7 to 1.1, over many 0.9.
    errors = {seed: velocity_errors(seed) for seed in range(1, 5)}
    by_rows, extrapolated = np.mean(np.concatenate([*errors.values()]), axis=0)
    assert by_rows < 0.95 * extrapolated
    # Where three quarters of what was extrapolated from steps of narrower thresholds are 0.0297.
    assert np.mean(errors[3], axis=0)[0] < 0.0297


def screw(velocity: FloatArray, elapsed_s: float) -> FloatArray:
    """Return the pose after some time, by the series of the exponential."""
    (a, b, c), t = velocity[:3], velocity[3:]
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]], t
    return np.asarray(expm(elapsed_s * twist), dtype=np.float64)


def rolling(points: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return (u, v, disparity) of points of the middle of the exposure, each in its own row."""

    def seen(point: FloatArray, row: float) -> FloatArray:
        pose = screw(velocity, READOUT_S * (row / CAMERA.height - 0.5))
        return np.asarray(project(move(se3.invert(pose), point[np.newaxis]), CAMERA)[0])

    rows = [
        brentq(lambda v, point=point: seen(point, v)[1] - v, -200.0, 700.0, xtol=1e-10)
        for point in points
    ]
    return np.array([seen(point, row) for point, row in zip(points, rows, strict=True)])


def points_in_view(n: int) -> FloatArray:
    rng = np.random.default_rng(5)
    low, high = [30.0, 30.0, 8.0], [610.0, 450.0, 50.0]
    return unproject(rng.uniform(low, high, size=(n, 3)), CAMERA)


VELOCITY = np.array([0.8, -1.1, 0.6, 0.4, -0.3, 0.7])


def test_settled_rows_are_those_of_a_camera_that_opens_all_at_once() -> None:
    points = points_in_view(60)
    measured, truth = rolling(points, VELOCITY), project(points, CAMERA)
    assert np.median(np.abs(measured - truth)[:, :2].max(axis=1)) > 2.0
    settled = settle_rows(measured, VELOCITY, READOUT_S, CAMERA)
    np.testing.assert_allclose(settled, truth, atol=2e-3)
    # The way back is that of the middle row's time, right to first order.
    back = settle_rows(truth, VELOCITY, -READOUT_S, CAMERA)
    assert np.abs(back - measured).max() < 0.05 * np.abs(measured - truth).max()


def test_what_is_not_known_or_does_not_move_is_left_as_it_is() -> None:
    uvd = project(points_in_view(5), CAMERA)
    np.testing.assert_array_equal(settle_rows(uvd, VELOCITY, 0.0, CAMERA), uvd)
    np.testing.assert_allclose(settle_rows(uvd, 0.0 * VELOCITY, READOUT_S, CAMERA), uvd)
    np.testing.assert_array_equal(settling_rates(uvd, 0.0 * VELOCITY, CAMERA), 0.0)
    assert settle_rows(np.zeros((0, 3)), VELOCITY, READOUT_S, CAMERA).shape == (0, 3)
    # Points that would be behind the camera stay where they were seen.
    backwards = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1e3])
    lower = uvd[:, 1] > 245
    assert lower.any()
    np.testing.assert_array_equal(settle_rows(uvd, backwards, 1.0, CAMERA)[lower], uvd[lower])


def test_the_rates_are_the_derivatives_by_the_readout() -> None:
    uvd = project(points_in_view(40), CAMERA)
    ends = [settle_rows(uvd, VELOCITY, sign * 1e-6, CAMERA) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(
        settling_rates(uvd, VELOCITY, CAMERA), (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-3
    )


@cache
def rolling_frames(sensor: Sensor) -> tuple[gvo.SyntheticRecording, list[Frame]]:
    recording = gvo.SyntheticRecording(
        "handheld", sensor, n_frames=6, scale=0.5, seed=2, readout_ms=25.0
    )
    return recording, frames_of(recording)


def motions(kind: str, sensor: Sensor, readout_ms: float) -> list[RelativePose]:
    """Return the steps of a camera with rolling shutter, each from the one before, and a link."""
    recording, frames = rolling_frames(sensor)
    given = Config.model_validate(
        {"camera": {"readout_ms": readout_ms}, "frontend": {"kind": kind}}
    )
    frontend: Any = make_frontend(recording.info.camera, given)
    seen = [frontend.extract(frame) for frame in frames]
    found: list[RelativePose] = []
    prior = None
    for pair in pairwise(seen):
        result, again = (frontend.register(*pair, prior) for _ in range(2))
        assert isinstance(result, RelativePose)
        np.testing.assert_array_equal(result.T_reference_current, again.T_reference_current)
        np.testing.assert_array_equal(result.covariance, again.covariance)
        found.append(result)
        T = result.T_reference_current
        prior = MotionPrior(T_predicted=T, T_recent=T)
    T = np.linalg.multi_dot([each.T_reference_current for each in found])
    link = frontend.register(seen[0], seen[-1], MotionPrior(T_predicted=T))
    assert isinstance(link, RelativePose)
    return [*found, link]


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("kind", ["klt", "descriptor"])
def test_motions_are_those_between_the_middles_of_the_exposures(kind: str, sensor: Sensor) -> None:
    recording, frames = rolling_frames(sensor)
    poses = recording.ground_truth().T_world_frame
    pairs = [*pairwise(range(len(frames))), (0, len(frames) - 1)]
    truths = [se3.invert(poses[i]) @ poses[j] for i, j in pairs]
    errors = [
        [
            np.linalg.norm(se3.log(se3.invert(T) @ each.T_reference_current))
            for T, each in zip(truths, motions(kind, sensor, readout_ms), strict=True)
        ]
        for readout_ms in (25.0, 0.0)
    ]
    known, ignored = np.array(errors)
    # Descriptors find pixels less exactly, whatever the shutter.
    assert np.mean(known[1:]) < (0.7 if kind == "klt" else 0.95) * np.mean(ignored[1:])


@cache
def shaken(sensor: Sensor, readout_ms: float) -> gvo.Odometry:
    """Return the odometry of a camera in the hand, after a second and a half."""
    recording = gvo.SyntheticRecording(
        "handheld", sensor, n_frames=36, seed=2, readout_ms=readout_ms
    )
    odometry = gvo.Odometry(recording.info.camera)
    for frame in frames_of(recording):
        odometry.track(frame)
    return odometry


@pytest.mark.parametrize("seed", [0, 2])
def test_first_steps_claim_no_more_than_is_known_of_the_readout(seed: int) -> None:
    recording = gvo.SyntheticRecording(
        "turning", "rgbd", n_frames=9, scale=0.5, seed=seed, readout_ms=25.0
    )
    odometry = gvo.Odometry(recording.info.camera)
    results = [odometry.track(frame) for frame in frames_of(recording)]
    poses = recording.ground_truth().T_world_frame
    nees = []
    for (i, T_world_reference), T_world_current in zip(enumerate(poses), poses[1:], strict=False):
        step = results[i + 1].registration
        assert isinstance(step, RelativePose)
        T_error = se3.invert(step.T_reference_current) @ se3.invert(T_world_reference)
        error = se3.log(T_error @ T_world_current)
        nees.append(error @ np.linalg.solve(step.covariance, error) / 6.0)
    assert max(nees) < 1.5
    assert np.mean(nees) > 0.1
    offsets = odometry.rig_offsets
    assert offsets is not None
    assert offsets.readout.sigma < offsets.readout.value < READOUT_S + 2.0 * offsets.readout.sigma


@pytest.mark.parametrize("readout_ms", [0.0, 0.5, None])
def test_a_readout_is_possible_until_it_is_known_to_take_no_time(readout_ms: float | None) -> None:
    offsets = RigOffsets(config(readout_ms))
    assert (offsets.possible_readout_s > 0.0) == (readout_ms != 0.0)
    for _ in range(100):
        offsets.readout.update(-offsets.readout.value, 1e-3)
    offsets.advance()
    if readout_ms is None:
        assert offsets.possible_readout_s == 0.0


@pytest.mark.acceptance
@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("planted_ms", [0.0, 10.0, 25.0])
def test_a_planted_readout_is_found(sensor: Sensor, planted_ms: float) -> None:
    offsets = shaken(sensor, planted_ms).rig_offsets
    assert offsets is not None
    found_ms, sigma_ms = 1e3 * offsets.readout.value, 1e3 * offsets.readout.sigma
    assert abs(found_ms - planted_ms) < 1.5
    assert abs(found_ms - planted_ms) < 2.5 * sigma_ms
    assert sigma_ms < 1.5


@cache
def frames(offset_px: float, row_px: int = 0) -> list[StereoFrame]:
    """Return a rendered drive with an error of its disparities, and of its rows."""
    noise = SensorNoise(max_depth_m=80.0, disparity_offset_px=offset_px)
    recording = gvo.SyntheticRecording("driving", n_frames=N_FRAMES, seed=3, noise=noise)
    found = []
    for frame in gvo.frames(recording, Config()):
        assert not isinstance(frame, FaultyFrame)
        assert isinstance(frame, StereoFrame)
        found.append(replace(frame, right=np.roll(frame.right, row_px, axis=0)))
    return found


def learn(frames: list[StereoFrame], kind: str, *, is_on: bool = True) -> gvo.Odometry:
    camera = gvo.SyntheticRecording("driving", n_frames=1).info.camera
    sections = {"frontend": {"kind": kind}, "stereo": {"estimate_offset": is_on}}
    odometry = gvo.Odometry(camera, Config.model_validate(sections))
    for frame in frames:
        odometry.track(frame)
    return odometry


Kind = Literal["klt", "descriptor"]


@pytest.mark.acceptance
@pytest.mark.parametrize("kind", ["klt", "descriptor"])
@pytest.mark.parametrize("planted_px", [-0.15, 0.0, 0.15])
def test_a_planted_offset_is_found_within_twenty_frames(kind: Kind, planted_px: float) -> None:
    offsets = learn(frames(planted_px), kind).rig_offsets
    assert offsets is not None
    assert offsets.disparity.sigma < 0.06
    # The prior of zero holds back a share of it, the more as rows might be read one by one.
    assert abs(offsets.disparity.value - planted_px) < 0.03 + 0.4 * abs(planted_px)


@pytest.mark.acceptance
def test_rows_that_differ_are_found() -> None:
    offsets = learn(frames(0.0, row_px=1), "klt").rig_offsets
    assert offsets is not None
    assert offsets.row.value == pytest.approx(1.0, abs=0.15)
    straight = learn(frames(0.0), "klt").rig_offsets
    assert straight is not None
    assert abs(straight.row.value) < 0.03


@pytest.mark.acceptance
def test_the_length_of_the_path_is_right_with_it_and_wrong_without() -> None:
    truth = gvo.SyntheticRecording("driving", n_frames=N_FRAMES, seed=3).ground_truth()
    lengths = []
    for is_on in (True, False):
        odometry = learn(frames(0.15), "klt", is_on=is_on)
        smoothed = gvo.Trajectory.of(
            [odometry.window.estimate(stamp) for stamp in odometry.window.poses()]
        )
        lengths.append(float(np.linalg.norm(smoothed.T_world_frame[-1, :3, 3])))
    T = np.linalg.inv(truth.T_world_frame[0]) @ truth.T_world_frame[N_FRAMES - 1]
    errors = np.abs(np.array(lengths) - np.linalg.norm(T[:3, 3]))
    assert errors[0] < 0.5 * errors[1]
