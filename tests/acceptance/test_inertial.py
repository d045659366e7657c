"""What an IMU is for: darkness and blank walls, on a real recording and a rendered one."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.geometry import se3
from gvo.io.recording import Source
from gvo.io.synthetic import rendered_imu
from gvo.runs.loop import ImuFeed
from gvo.testing.faults import Black, FaultySource
from gvo.types import Status
from tests.worlds import rendered

pytestmark = pytest.mark.acceptance

RATE_HZ = 20
CONFIG = gvo.Config.model_validate({"runtime": {"threads": 1}})


def track(source: Source, *, n_frames: int, has_imu: bool = True) -> list[gvo.FrameResult]:
    stream = source.info.imu
    assert stream is not None
    odometry = gvo.Odometry(source.info.camera, CONFIG, imu=stream.imu if has_imu else None)
    feed, results = ImuFeed(stream.samples), []
    for frame in islice(gvo.frames(source, CONFIG), n_frames):
        assert not isinstance(frame, gvo.FaultyFrame)
        for samples in feed.until(frame.stamp_ns):
            odometry.add_imu(samples.stamps_ns, samples.gyro, samples.acceleration)
        results.append(odometry.track(frame))
    return results


@pytest.mark.recorded
@pytest.mark.parametrize("start_s", [1.5, 3.0, 4.0, 5.0])
@pytest.mark.parametrize(("length_s", "most_m"), [(1, 0.03), (2, 0.05)])
def test_a_drone_is_carried_through_the_dark(
    gvo_data: Path, start_s: float, length_s: int, most_m: float
) -> None:
    source = gvo.open_recording(gvo_data / "euroc_mh01_imu")
    first, end = int(start_s * RATE_HZ), int((start_s + length_s) * RATE_HZ)
    results = track(FaultySource(source, Black(first=first, end=end)), n_frames=end)
    assert all(result.is_carried for result in results[first:])
    truth = source.ground_truth()
    assert truth is not None
    ends_ns = np.array([results[first - 1].stamp_ns, results[-1].stamp_ns])
    T_before, T_after = truth.interpolate(ends_ns).T_world_frame
    before, after = results[first - 1].causal, results[-1].causal
    T_true = se3.invert(T_before) @ T_after
    T = se3.invert(before.T_world_frame) @ after.T_world_frame
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < most_m
    assert np.degrees(se3.rotation_angle(se3.invert(T) @ T_true)) < 0.3


@pytest.mark.recorded
def test_an_imu_changes_no_bit_of_a_drone_that_sees_enough(gvo_data: Path) -> None:
    source = gvo.open_recording(gvo_data / "euroc_mh01_imu")
    without, carried = (track(source, n_frames=80, has_imu=has_imu) for has_imu in (False, True))
    assert carried[-1].inertial is not None
    for one, other in zip(without, carried, strict=True):
        for name in ("raw", "causal"):
            first, second = getattr(one, name), getattr(other, name)
            assert first.T_world_frame.tobytes() == second.T_world_frame.tobytes()
            assert first.covariance.tobytes() == second.covariance.tobytes()


def test_a_blank_wall_does_not_lose_a_hand_that_has_an_imu() -> None:
    source = rendered("wall", "stereo", n_frames=230, scale=0.3, imu=rendered_imu())
    results = track(source, n_frames=230)
    assert not any(result.status is Status.LOST for result in results)
    truth = source.ground_truth().T_world_frame
    places = np.array([result.causal.T_world_frame[:3, 3] for result in results])
    assert np.linalg.norm(places - truth[:, :3, 3], axis=1).max() < 0.25
    assert results[-1].status is Status.OK
