"""Matches that continue the recent mean motion, where the prediction was drawn away from it."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.config import Config
from gvo.frontend import registration, rig
from gvo.frontend.factory import make_frontend
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.odometry.chain import RawChain
from gvo.types import Failure, FloatArray, MotionPrior, RelativePose
from tests.frontend import two_motions

CAMERA = StereoCamera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480, baseline=0.2)
STATED_PX = 0.7
STILL = np.zeros(6)
# A bus at 5 m: what it moves by from frame to frame, 1.5 px, is well within the stated noise.
BUS = np.array([0.0, 0.0, 0.0, 0.015, 0.0, 0.0])


matches_of = partial(
    two_motions.matches_of, camera=CAMERA, disparities=(18, 24), stated_px=STATED_PX, seed=7
)


def register(
    matches: Correspondences, T_predicted: FloatArray, T_recent: FloatArray | None = None
) -> FloatArray:
    """Return the translation that is found, metres."""
    prior = MotionPrior(T_predicted=T_predicted, T_recent=T_recent)
    result = two_motions.register(matches, CAMERA, prior)
    assert isinstance(result, RelativePose), result
    return np.asarray(result.T_reference_current[:3, 3])


@pytest.mark.parametrize("n_bus", [100, 140, 300])
def test_a_bus_that_has_drawn_the_prediction_along_is_not_followed(n_bus: int) -> None:
    matches = matches_of((STILL, 60), (BUS, n_bus), noise_px=0.05)
    assert np.linalg.norm(register(matches, se3.exp(BUS), se3.exp(STILL))) < 0.003
    # By the prediction alone it is.
    assert np.linalg.norm(register(matches, se3.exp(BUS))) > 0.005


@pytest.mark.parametrize(
    ("others", "bus", "noise_px"),
    [
        pytest.param((STILL, 60), 6.0 * BUS, STATED_PX, id="noise as stated"),
        pytest.param((STILL, 14), BUS, 0.05, id="few continue it"),
        pytest.param((STILL, 0), BUS, 0.05, id="none continues it"),
        pytest.param((-BUS, 60), BUS, 0.05, id="the others are no nearer to it"),
    ],
)
def test_a_result_stays_bit_by_bit_where_the_recent_motion_says_nothing(
    others: tuple[FloatArray, int], bus: FloatArray, noise_px: float
) -> None:
    matches = matches_of(others, (bus, 200), noise_px=noise_px)
    np.testing.assert_array_equal(
        register(matches, se3.exp(bus), se3.exp(STILL)), register(matches, se3.exp(bus))
    )


@pytest.mark.parametrize(
    ("kind", "heeding", "n_rounds"),
    [("klt", [True, False, False], 1), ("descriptor", [True, True, False], 3)],
)
def test_the_recent_motion_counts_where_the_prediction_is_and_not_in_the_round_after_it(
    kind: str, heeding: list[bool], n_rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = gvo.SyntheticRecording("handheld", "rgbd", n_frames=2, scale=0.25)
    sections = {"frontend": {"kind": kind}, "camera": {"readout_ms": 0.0}}
    frontend: Any = make_frontend(recording.info.camera, Config.model_validate(sections))
    pair = [frontend.extract(frame) for frame in gvo.frames(recording, Config())]
    still, recent = np.eye(4), se3.exp(BUS)
    handed: list[bool] = []

    def spy(*arguments: Any, **options: Any) -> RelativePose | Failure:
        prior = options.get("prior")
        handed.append(prior is not None and prior.T_recent is not None)
        # The first round leads to nothing, so that all that follow are made.
        return Failure(reason="") if len(handed) == 1 else real(*arguments, **options)

    real = registration.register_correspondences
    monkeypatch.setattr(rig, "register_correspondences", spy)
    prior = MotionPrior(T_predicted=still, T_recent=recent)
    assert isinstance(frontend.register(*pair, prior), RelativePose)
    assert handed == heeding
    handed.clear()
    # Where nothing but a prior is known, that of a keyframe, tracks are not searched again.
    prior = MotionPrior(T_predicted=still)
    assert isinstance(frontend.register(*pair, prior), RelativePose) == (n_rounds > 1)
    assert handed == [False] * n_rounds


@dataclass
class Seen:
    stamp_ns: int


class Scripted:
    """Registers neighbours by given steps, and keeps what was expected of them."""

    def __init__(self, steps_m: list[float]) -> None:
        self.steps_m = steps_m
        self.recent_m: list[float] = []

    def extract(self, frame: Seen) -> Seen:
        return frame

    def register(self, reference: Seen, current: Seen, prior: MotionPrior | None) -> RelativePose:
        if prior is not None:
            assert prior.T_recent is not None
            self.recent_m.append(float(prior.T_recent[0, 3]))
        T = np.eye(4)
        T[0, 3] = self.steps_m.pop(0)
        return RelativePose(T_reference_current=T, covariance=1e-6 * np.eye(6))


def test_the_recent_velocity_is_the_median_of_the_last_second() -> None:
    # Uneven, so that every other number of steps, and their mean, would be seen.
    steps_m = [0.01 * n**2 for n in range(30)]
    frontend = Scripted(list(steps_m))
    chain: RawChain[Seen] = RawChain(frontend)
    for n in range(len(steps_m) + 1):
        chain.advance(Seen(100_000_000 * n), Seen(100_000_000 * n))
    # At 10 Hz: those that ended a second ago or later, and the last one.
    expected = [np.median(steps_m[max(n - 11, 0) : n]) for n in range(1, len(steps_m))]
    np.testing.assert_allclose(frontend.recent_m, expected, atol=1e-12)
