"""Constant errors of a rig: the filter, and rendered rigs with a planted error."""

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gvo
from gvo.config import Config, StereoConfig
from gvo.frontend.stereo.offsets import OffsetFilter, RigOffsets
from gvo.io.synthetic.recording import SensorNoise
from gvo.types import FaultyFrame, RelativePose, StereoFrame

N_FRAMES = 20


def result(offset_px: float | None, sigma_px: float | None = 0.02) -> RelativePose:
    return RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        offset_px=offset_px,
        offset_sigma_px=sigma_px,
    )


@settings(max_examples=30)
@given(true=st.floats(-0.2, 0.2), seed=st.integers(0, 999))
def test_the_filter_finds_a_constant_within_its_sigma(true: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = OffsetFilter(0.3)
    for _ in range(200):
        found.update(true + 0.1 * rng.normal() - found.value_px, 0.1)
    assert abs(found.value_px - true) < 4.5 * found.sigma_px
    assert found.sigma_px < 0.012


def test_what_is_not_measured_stays_at_zero() -> None:
    found = OffsetFilter(0.1)
    for _ in range(100):
        found.update(0.5, 50.0)
    assert abs(found.value_px) < 0.02
    assert found.sigma_px == pytest.approx(0.1, rel=0.05)


def test_one_wild_measurement_moves_it_no_farther_than_three_sigmas() -> None:
    tame, wild = OffsetFilter(0.1), OffsetFilter(0.1)
    tame.update(3.0 * np.hypot(0.1, 0.02), 0.02)
    wild.update(50.0, 0.02)
    assert wild.value_px == pytest.approx(tame.value_px)


def test_what_is_noted_counts_from_the_next_frame_and_once() -> None:
    offsets = RigOffsets(StereoConfig())
    offsets.note(result(0.1), 10)
    offsets.note(result(-5.0), 10)  # a link of the same frame
    offsets.note(result(-5.0), 9)
    offsets.note(result(None, None), 11)
    offsets.note_rows(0.2, 10)
    offsets.note_rows(-5.0, 10)
    offsets.note_rows(None, 11)
    assert offsets.disparity.value_px == offsets.row.value_px == 0.0
    offsets.advance()
    disparity_px, row_px = offsets.disparity.value_px, offsets.row.value_px
    assert 0.0 < disparity_px <= 0.1
    assert 0.0 < row_px <= 0.2
    offsets.advance()
    assert (offsets.disparity.value_px, offsets.row.value_px) == (disparity_px, row_px)


def test_nothing_is_learnt_where_it_is_switched_off() -> None:
    offsets = RigOffsets(StereoConfig(estimate_offset=False))
    offsets.note(result(0.1), 10)
    offsets.note_rows(0.2, 10)
    offsets.advance()
    assert offsets.as_json() == {"disparity_px": 0.0, "disparity_sigma_px": 0.1, "row_px": 0.0}


@cache
def frames(offset_px: float, row_px: int = 0) -> list[StereoFrame]:
    """Return a rendered drive with an error of its disparities, and of its rows."""
    noise = SensorNoise(max_depth_m=80.0, disparity_offset_px=offset_px)
    recording = gvo.SyntheticRecording("driving", n_frames=N_FRAMES, seed=3, noise=noise)
    found = []
    for frame in gvo.frames(recording, Config()):
        assert not isinstance(frame, FaultyFrame)
        assert isinstance(frame, StereoFrame)
        right = np.roll(frame.right, row_px, axis=0)
        found.append(replace(frame, right=right))
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
    assert offsets.disparity.sigma_px < 0.06
    # The prior of zero holds back a share of it.
    assert abs(offsets.disparity.value_px - planted_px) < 0.03 + 0.3 * abs(planted_px)


@pytest.mark.acceptance
def test_rows_that_differ_are_found() -> None:
    offsets = learn(frames(0.0, row_px=1), "klt").rig_offsets
    assert offsets is not None
    assert offsets.row.value_px == pytest.approx(1.0, abs=0.15)
    straight = learn(frames(0.0), "klt").rig_offsets
    assert straight is not None
    assert abs(straight.row.value_px) < 0.03


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
