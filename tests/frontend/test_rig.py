"""Constant errors of a camera: the filter, a rolling shutter, and rendered planted errors."""

import math
from collections.abc import Sequence
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
from gvo.frontend.calibration import CONSIDERED
from gvo.frontend.factory import make_frontend
from gvo.frontend.offsets import ConstantFilter, RigOffsets, VarianceFactor
from gvo.frontend.rig import FrameMotion, MeasuredVelocity, note_step
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.lens import Lens
from gvo.geometry.refinement import Adjustment, Constants
from gvo.geometry.rig import DELAY, READOUT, LearntRig
from gvo.io.recording import Sensor
from gvo.io.synthetic import RigError
from gvo.io.synthetic.world import WORLDS, Motion
from gvo.kernels import shutter
from gvo.types import (
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
    uvd: FloatArray, velocity: FloatArray, exposure: Sequence[float], camera: StereoCamera
) -> FloatArray:
    settled, times = np.empty_like(uvd), np.array(exposure)
    shutter.settle_rows(uvd, np.zeros(11), velocity, times, camera.parameters, settled)
    return settled


def exposure_errors(uvd: FloatArray, velocity: FloatArray, camera: StereoCamera) -> FloatArray:
    errors = np.empty((2, *uvd.shape))
    shutter.write_exposure_errors(uvd, np.zeros(11), velocity, camera.parameters, errors)
    return errors


def told(errors: dict[str, float], sigma: float, names: tuple[str, ...]) -> Constants:
    """Return what a link tells: how much is left of some constants, each with this sigma."""
    information = np.diag([sigma**-2 if name in errors else 0.0 for name in names])
    score = information @ [errors.get(name, 0.0) for name in names]
    return Constants(information=information, score=score)


def config(readout_ms: float | None = None, *, estimate_offset: bool = True) -> Config:
    return Config.model_validate(
        {"camera": {"readout_ms": readout_ms}, "stereo": {"estimate_offset": estimate_offset}}
    )


@settings(max_examples=30)
@given(true=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3), seed=st.integers(0, 999))
def test_the_filter_finds_constants_within_their_sigmas(true: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = ConstantFilter(dict.fromkeys("abc", (0.0, 0.3)))
    for _ in range(200):
        J, used = rng.normal(size=(20, 3)), rng.normal(size=3)
        # Errors of registrations are correlated: sigmas are three times larger.
        left = J @ (true - used) + 3.0 * rng.normal(size=20)
        found.note((*"abc",), J.T @ J, J.T @ left, used)
        found.advance()
    error = found.mean - true
    assert error @ np.linalg.solve(found.covariance, error) < 4.5**2 * 3
    assert np.diag(found.covariance).max() < 0.06**2


def test_what_is_not_told_stays_at_the_prior() -> None:
    found = ConstantFilter({"a": (0.0, 0.1), "b": (0.3, 0.2)})
    for _ in range(100):
        found.note(("a",), np.array([[1000.0]]), np.zeros(1), np.zeros(1))
        found.advance()
    assert found.mean[1] == pytest.approx(0.3)
    assert found.covariance[1, 1] == pytest.approx(0.2**2)
    assert found.covariance[0, 0] < 0.01**2


@pytest.mark.parametrize(
    ("misfit", "sigma_factor", "expected"),
    [
        (0.2, 2.4, 0.4),
        (1.0, 2.4, 1.0),
        (50.0, 2.4, 0.25 + 0.75 * 50.0),
        (0.2, 1.2, 1.2**-2),  # never surer than residuals are
        (0.2, 0.9, 1.0),
    ],
)
def test_covariances_are_wrong_by_as_much_as_registrations_agree_better_or_worse(
    misfit: float, sigma_factor: float, expected: float
) -> None:
    factor = VarianceFactor(sigma_factor)
    for _ in range(300):
        factor.note(misfit)
        factor.note(math.nan)
    assert factor.value == pytest.approx(expected, rel=1e-2)


def test_one_misfit_far_off_does_not_undo_what_many_showed() -> None:
    factor = VarianceFactor(2.4)
    for _ in range(300):
        factor.note(0.2)
    factor.note(1e9)
    assert factor.value < 0.7


def test_what_is_noted_counts_from_the_next_frame_and_once() -> None:
    offsets, pixels = RigOffsets(CAMERA, config()), points_in_view(200)[:, :2] * 5.0
    offsets.note(told({"d0": 0.3}, 0.005, offsets.names))
    offsets.note_rows(pixels, np.full(200, 0.2))
    assert not offsets.lens.any()
    assert not offsets.rows.any()
    offsets.advance()
    lens, rows = offsets.lens, offsets.rows
    assert 0.1 < lens[0] < 0.3
    assert 0.0 < rows[0] < 0.2
    offsets.advance()
    np.testing.assert_allclose(offsets.lens, lens, rtol=1e-2)
    np.testing.assert_allclose(offsets.rows, rows, rtol=1e-2)


def test_rows_are_found_that_change_over_the_image() -> None:
    rng, offsets = np.random.default_rng(3), RigOffsets(CAMERA, config())
    for _ in range(60):
        pixels = rng.uniform([20, 20], [620, 460], (150, 2))
        shifts = 0.2 + 0.4 * ((pixels[:, 1] - CAMERA.cy) / CAMERA.height) ** 2
        shifts[::5], shifts[1::5] = np.nan, 1.4  # not told, and of another corner
        offsets.note_rows(pixels, shifts + 0.05 * rng.normal(size=150))
        offsets.advance()
    places = np.array([[320.0, 240.0], [320.0, 430.0]])
    expected = 0.2 + 0.4 * ((places[:, 1] - CAMERA.cy) / CAMERA.height) ** 2
    np.testing.assert_allclose(offsets.row_errors(places), expected, atol=0.03)
    rows = offsets.rows
    offsets.note_rows(places, np.array([0.9, 0.9]))  # too few
    offsets.advance()
    np.testing.assert_allclose(offsets.rows, rows, rtol=1e-2)


@pytest.mark.parametrize(("true_px", "is_told"), [(-0.3, True), (-0.04, False), (0.2, True)])
def test_an_error_is_taken_off_but_for_what_edges_feign(true_px: float, is_told: bool) -> None:
    offsets = RigOffsets(CAMERA, config())
    for _ in range(200):
        # What is left of it after the present value was subtracted.
        offsets.note(told({"d0": true_px - offsets.lens[0]}, 0.01, offsets.names))
        offsets.advance()
    assert learnt_by(offsets).constants["d0"][0] == pytest.approx(true_px, abs=0.01)
    expected_px = np.sign(true_px) * (abs(true_px) - 0.05) * is_told
    assert offsets.lens[0] == pytest.approx(expected_px, abs=0.01)


@pytest.mark.parametrize(("sigma", "is_told"), [(0.022, True), (0.028, False)])
def test_what_is_not_significant_is_not_taken_off(sigma: float, is_told: bool) -> None:
    offsets = RigOffsets(CAMERA, config())
    offsets.note(told({"d0": 0.3}, sigma, offsets.names))
    offsets.advance()
    assert offsets.lens.any() == is_told


def learnt_by(offsets: RigOffsets) -> LearntRig:
    assert offsets.learnt is not None
    return offsets.learnt


def taught(camera: StereoCamera = CAMERA, n: int = 50) -> RigOffsets:
    """Return offsets that n frames told a lens, rows, a readout of 8 ms, and a delay of 12 ms."""
    offsets, pixels = RigOffsets(camera, config()), points_in_view(200)[:, :2] * 5.0
    for _ in range(n):
        left = {"d0": -0.3 - offsets.lens[0], READOUT: 8e-3 - offsets.readout_s}
        left[DELAY] = 12e-3 - offsets.delay_s
        offsets.note(told(left, 0.002, offsets.names))
        offsets.note_rows(pixels, np.full(200, 0.2))
        offsets.advance()
    return offsets


def test_what_was_learnt_is_used_at_once_and_counts_less() -> None:
    first = taught()
    known = learnt_by(first)
    assert known.n_frames == 50
    again = RigOffsets(replace(CAMERA, rig=known), config())
    np.testing.assert_allclose(again.lens, first.lens, atol=1e-3)
    assert 0.4 < again.rows[0] / first.rows[0] < 1.0  # they were hardly told
    assert again.readout_s == pytest.approx(first.readout_s, abs=5e-4)
    assert again.delay_s == pytest.approx(first.delay_s, abs=5e-4)
    sigmas = [learnt_by(each).constants["d0"][1] for each in (first, again)]
    assert sigmas[1] / sigmas[0] == pytest.approx(2.0, rel=0.05)
    twice = taught(replace(CAMERA, rig=known))
    assert learnt_by(twice).n_frames == 100
    # The same images hardly make it surer.
    assert learnt_by(twice).constants["d0"][1] > 0.8 * sigmas[0]


def test_what_was_learnt_is_held_where_nothing_is_to_be_learnt() -> None:
    known = learnt_by(taught())
    offsets = RigOffsets(replace(CAMERA, rig=known), config(estimate_offset=False))
    assert offsets.lens[0] == known.constants["d0"][0]
    assert offsets.rows[0] == known.constants["r0"][0]
    value, sigma = offsets.readout
    assert offsets.delay_s == known.constants[DELAY][0] > 0.01
    assert offsets.names == CONSIDERED[:-1]  # which are judged alone
    offsets.note_rows(points_in_view(200)[:, :2], np.full(200, 0.9))
    offsets.advance()
    assert offsets.rows[0] == known.constants["r0"][0]
    assert offsets.readout == (value, sigma)
    assert offsets.learnt is known
    given = RigOffsets(replace(CAMERA, rig=known), config(3.0, estimate_offset=False))
    assert given.readout == (0.003, 0.0)


LEARNT = {"d0": -0.3, "dyy": 0.004, "tx": -4e-3, "ty": 3e-3, "k1": 5e-3, "p1": 4e-4, "p2": -8e-4}


def test_errors_of_a_lens_are_those_of_both_images() -> None:
    """By the model of OpenCV for each image; the tilt is what a small turn makes of a plane."""
    rng = np.random.default_rng(6)
    uvd = rng.uniform([50, 50, 2.0], [600, 400, 60.0], (50, 3))
    K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
    camera = replace(CAMERA, fy=525.0)
    D = np.array([LEARNT["k1"], 0.0, LEARNT["p1"], LEARNT["p2"], 0.0])

    def shown(u: FloatArray, v: FloatArray) -> FloatArray:
        rays = np.column_stack([(u - 319.5) / 525.0, (v - 239.5) / 525.0, np.ones(len(u))])
        turned = rays / (1.0 - rays[:, :2] @ [LEARNT["tx"], LEARNT["ty"]])[:, np.newaxis]
        flat = np.column_stack([turned[:, :2], np.ones(len(u))])
        return Lens(width=640, height=480, K=K, D=D, model="plumb_bob").project(flat)

    left, right = shown(uvd[:, 0], uvd[:, 1]), shown(uvd[:, 0] - uvd[:, 2], uvd[:, 1])
    own = LEARNT["d0"] + 525.0 * LEARNT["dyy"] * ((uvd[:, 1] - 239.5) / 525.0) ** 2
    measured = np.column_stack([left, left[:, 0] - right[:, 0] + own])
    offsets = RigOffsets(camera, config())
    for _ in range(2):
        sigmas = 1e-3 * np.abs([LEARNT.get(name, 0.01) for name in offsets.names])
        information = np.diag(sigmas**-2)
        left_over = np.array([LEARNT.get(name, 0.0) for name in offsets.names])
        left_over[: len(offsets.lens)] -= offsets.lens
        score = information @ left_over
        offsets.note(Constants(information=information, score=score))
        offsets.advance()
    # To second order of the errors; a twentieth of a pixel of them stays.
    assert np.abs(measured - uvd).max() > 1.0
    np.testing.assert_allclose(offsets.take_off(measured), uvd, atol=0.1)


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
def test_a_frame_tells_the_readout_once_the_next_step_is_known(kind: str) -> None:
    recording = gvo.SyntheticRecording("turning", "rgbd", n_frames=12, seed=5, readout_ms=25.0)
    settings = Config.model_validate({"frontend": {"kind": kind}})
    frontend: Any = make_frontend(recording.info.camera, settings)
    offsets, poses = frontend.rig_offsets, recording.ground_truth().T_world_frame
    frames, values = [frontend.extract(frame) for frame in frames_of(recording)], []
    for k, (reference, current) in enumerate(pairwise(frames), start=1):
        T = se3.invert(poses[k - 1]) @ poses[k]
        frontend.register(reference, current, MotionPrior(T_predicted=T, T_recent=T))
        offsets.advance()
        values.append(offsets.readout[0])
        if k == 8:
            T = se3.invert(poses[0]) @ poses[k]
            link = frontend.register(frames[0], current, MotionPrior(T_predicted=T))
            assert isinstance(link, RelativePose)
            offsets.advance()
            assert offsets.readout[0] == values[-1]
    # Steps tell nothing.
    assert values[:8] == [0.02] * 8
    assert 0.0205 < values[8] < READOUT_S + 0.003


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
def test_what_is_refused_and_loops_tell_nothing_of_the_camera(
    sensor: Sensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = gvo.SyntheticRecording(
        "turning", sensor, n_frames=9, scale=0.5, seed=3, readout_ms=25.0
    )
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
        return [value for value, _ in frontend.rig_offsets.learnt.constants.values()]

    assert learnt("loops") == learnt("refused") == learnt("") != learnt("links")


def test_nothing_is_learnt_where_it_is_switched_off() -> None:
    offsets = RigOffsets(CAMERA, config(12.5, estimate_offset=False))
    offsets.note_rows(points_in_view(200)[:, :2], np.full(200, 0.2))
    offsets.advance()
    assert offsets.learnt is None
    assert offsets.as_json() == {
        "disparity_px": 0.0,
        "pixel_px": 0.0,
        "row_px": 0.0,
        "delay_ms": 0.0,
        "calibration_px": 0.3,
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
    errors = {seed: velocity_errors(seed) for seed in (1, 3)}
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
    settled = settle_rows(measured, VELOCITY, [READOUT_S, 0.0], CAMERA)
    np.testing.assert_allclose(settled, truth, atol=2e-3)
    # The way back is that of the middle row's time, right to first order.
    back = settle_rows(truth, VELOCITY, [-READOUT_S, 0.0], CAMERA)
    assert np.abs(back - measured).max() < 0.05 * np.abs(measured - truth).max()


def test_what_is_not_known_or_does_not_move_is_left_as_it_is() -> None:
    uvd, both = project(points_in_view(5), CAMERA), [READOUT_S, 0.01]
    np.testing.assert_array_equal(settle_rows(uvd, VELOCITY, [0.0, 0.0], CAMERA), uvd)
    np.testing.assert_allclose(settle_rows(uvd, 0.0 * VELOCITY, both, CAMERA), uvd)
    np.testing.assert_array_equal(exposure_errors(uvd, 0.0 * VELOCITY, CAMERA), 0.0)
    assert settle_rows(np.zeros((0, 3)), VELOCITY, both, CAMERA).shape == (0, 3)
    # Points that would be behind the camera stay where they were seen.
    backwards = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1e3])
    lower = uvd[:, 1] > 245
    assert lower.any()
    np.testing.assert_array_equal(
        settle_rows(uvd, backwards, [1.0, 0.0], CAMERA)[lower], uvd[lower]
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
    value, sigma = offsets.readout
    assert sigma < value < READOUT_S + 2.0 * sigma


@pytest.mark.parametrize("readout_ms", [0.0, 0.5, None])
def test_a_readout_is_possible_until_it_is_known_to_take_no_time(readout_ms: float | None) -> None:
    offsets = RigOffsets(CAMERA, config(readout_ms), is_stereo=False)
    assert (offsets.possible_readout_s > 0.0) == (readout_ms != 0.0)
    for _ in range(100):
        if offsets.names:
            offsets.note(told({"readout_s": -offsets.readout_s}, 1e-3, offsets.names))
        offsets.advance()
    if readout_ms is None:
        assert offsets.possible_readout_s == 0.0


@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("sensor", "planted_ms"), [("stereo", 0.0), ("stereo", 25.0), ("rgbd", 10.0)]
)
def test_a_planted_readout_is_found(sensor: Sensor, planted_ms: float) -> None:
    offsets = shaken(sensor, planted_ms).rig_offsets
    assert offsets is not None
    found_ms, sigma_ms = 1e3 * np.array(offsets.readout)
    assert abs(found_ms - planted_ms) < 1.5
    assert abs(found_ms - planted_ms) < 2.5 * sigma_ms
    assert sigma_ms < 1.5


@cache
def frames(offset_px: float, row_px: int = 0) -> list[StereoFrame]:
    """Return a rendered drive with an error of its disparities, and of its rows."""
    error = RigError(constants={"d0": offset_px})
    recording = gvo.SyntheticRecording("driving", n_frames=N_FRAMES, seed=3, rig_error=error)
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
@pytest.mark.parametrize(
    ("kind", "planted_px"), [("klt", 0.0), ("klt", -0.15), ("descriptor", 0.15)]
)
def test_a_planted_offset_is_found_within_twenty_frames(kind: Kind, planted_px: float) -> None:
    offsets = learn(frames(planted_px), kind).rig_offsets
    assert offsets is not None
    found_px, sigma_px = learnt_by(offsets).constants["d0"]
    assert sigma_px < 0.12
    assert abs(found_px - planted_px) < 0.03 + 0.4 * abs(planted_px)


@pytest.mark.acceptance
def test_rows_that_differ_are_found() -> None:
    offsets = learn(frames(0.0, row_px=1), "klt").rig_offsets
    assert offsets is not None
    assert offsets.rows[0] == pytest.approx(1.0, abs=0.15)
    straight = learn(frames(0.0), "klt").rig_offsets
    assert straight is not None
    assert abs(straight.rows[0]) < 0.03


@pytest.mark.parametrize("late_ms", [0.0, 10.0])
def test_a_right_image_that_is_exposed_later_is_found(late_ms: float) -> None:
    """Without it drives err by a tenth, and nobody is told."""
    world = WORLDS["handheld"]

    def later(seed: int) -> Motion:
        motion = world.motion(seed)
        return lambda elapsed_s: motion(elapsed_s + 1e-3 * late_ms)

    how: dict[str, Any] = {"n_frames": 30, "seed": 1, "scale": 0.5}
    recording = gvo.SyntheticRecording(world, **how)
    late = frames_of(gvo.SyntheticRecording(replace(world, motion=later), **how))
    odometry = gvo.Odometry(recording.info.camera)
    for frame, other in zip(frames_of(recording), late, strict=True):
        assert isinstance(frame, StereoFrame)
        assert isinstance(other, StereoFrame)
        odometry.track(replace(frame, right=other.right))
    offsets = odometry.rig_offsets
    assert offsets is not None
    assert 1e3 * offsets.delay_s == pytest.approx(late_ms, rel=0.3)


@pytest.mark.acceptance
def test_the_length_of_the_path_is_right_with_it_and_wrong_without() -> None:
    truth = gvo.SyntheticRecording("driving", n_frames=N_FRAMES, seed=3).ground_truth()
    lengths = []
    for is_on in (True, False):
        odometry = learn(frames(0.3), "klt", is_on=is_on)
        smoothed = gvo.Trajectory.of(
            [odometry.window.estimate(stamp) for stamp in odometry.window.poses()]
        )
        lengths.append(float(np.linalg.norm(smoothed.T_world_frame[-1, :3, 3])))
    T = np.linalg.inv(truth.T_world_frame[0]) @ truth.T_world_frame[N_FRAMES - 1]
    errors = np.abs(np.array(lengths) - np.linalg.norm(T[:3, 3]))
    assert errors[0] < 0.5 * errors[1]
