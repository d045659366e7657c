"""Where a camera comes back after the dark, the global poses are those of the unbroken run."""

from pathlib import Path

import numpy as np
import pytest

import gvo
from gvo.io.recording import Source
from gvo.testing import Black, FaultySource
from gvo.types import FaultyFrame, FrameResult, Status
from tests.worlds import rendered

pytestmark = pytest.mark.acceptance


def follow(recording: Source) -> tuple[gvo.Odometry, list[FrameResult]]:
    odometry = gvo.Odometry(recording.info.camera, gvo.Config())
    frames = gvo.frames(recording, gvo.Config())
    return odometry, [
        odometry.track(frame) for frame in frames if not isinstance(frame, FaultyFrame)
    ]


def global_error(recording: Source, odometry: gvo.Odometry, stamps_ns: set[int]) -> float:
    estimates = [each for each in odometry.optimize().estimates if each.stamp_ns in stamps_ns]
    truth = recording.ground_truth()
    assert truth is not None
    return gvo.evaluate(truth, gvo.Trajectory.of(estimates), name="global").ate_m


def check(recording: Source, black: Black) -> None:
    unbroken, _ = follow(recording)
    dark, results = follow(FaultySource(recording, black))
    tracked = {each.stamp_ns for each in results if each.status in (Status.OK, Status.RESUMED)}
    assert len(tracked) < len(results) - 20
    expected, found = (global_error(recording, each, tracked) for each in (unbroken, dark))
    assert found < 1.5 * expected


# Too short to be lost, and the camera turns: the frame before is not seen again.
@pytest.mark.recorded
def test_a_second_in_the_dark_costs_the_global_poses_nothing(gvo_data: Path) -> None:
    recording = gvo.open_recording(gvo_data / "rgbd_dataset_freiburg1_rpy_part")
    check(recording, Black(first=42, end=72))


def test_a_camera_that_was_lost_in_a_room_finds_its_place() -> None:
    check(
        gvo.SyntheticRecording("handheld", "rgbd", n_frames=180, seed=4, scale=0.4),
        Black(first=60, end=120),
    )


def test_windows_that_repeat_connect_nothing_across_the_dark() -> None:
    facade = rendered("facade", n_frames=75, seed=0, scale=0.5)
    odometry, results = follow(FaultySource(facade, Black(first=30, end=50)))
    assert not any(result.joins for result in results)
    loops = odometry.optimize().loops
    assert len(loops) > 3
    assert all(loop.reason for loop in loops)


def test_equal_rooms_are_not_taken_for_each_other() -> None:
    rooms = rendered("rooms", "rgbd", n_frames=450, seed=1, scale=0.5)
    odometry, _ = follow(rooms)
    loops = odometry.optimize().loops
    assert len(loops) > 3
    assert all(loop.reason for loop in loops)
    truth = rooms.ground_truth()
    assert global_error(rooms, odometry, set(np.asarray(truth.stamps_ns).tolist())) < 0.1
