"""The loop of a run: which frames reach the outputs, as poses of what, and how it ends."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from gvo.config import Config
from gvo.errors import OutputError, RecordingError
from gvo.geometry import se3
from gvo.geometry.imu import Imu, ImuSamples, ImuStream
from gvo.io.excerpt import Excerpt
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import Sensor
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.runs.loop import RunLoop
from gvo.types import Estimate, FaultyFrame, FloatArray, Frame, FrameResult, Optimum, Progress
from tests.make.recordings import Held, hold
from tests.make.rendered_walk import CAMERA, T_BASE_CAM, moved_by_hand

_N_FRAMES = 7


@dataclass
class Kept:
    frames: list[FrameResult] = field(default_factory=list)
    faulty: list[FaultyFrame] = field(default_factory=list)
    smoothed: list[Estimate] = field(default_factory=list)
    optima: list[Optimum] = field(default_factory=list)

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        assert frame.stamp_ns == result.stamp_ns
        self.frames.append(result)
        self.smoothed += result.finished

    def add_faulty(self, frame: FaultyFrame) -> None:
        self.faulty.append(frame)

    def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
        self.smoothed += estimates

    def add_optimum(self, optimum: Optimum) -> None:
        self.optima.append(optimum)

    def poses(self) -> dict[str, FloatArray]:
        smoothed = sorted(self.smoothed, key=lambda estimate: estimate.stamp_ns)
        return {
            "raw": np.array([result.raw.T_world_frame for result in self.frames]),
            "causal": np.array([result.causal.T_world_frame for result in self.frames]),
            "smoothed": np.array([estimate.T_world_frame for estimate in smoothed]),
        }


def rendered(sensor: Sensor = "stereo") -> Held:
    made = hold(SyntheticRecording("handheld", sensor, n_frames=_N_FRAMES, scale=0.25))
    return Held(info=replace(made.info, frame_id=CAMERA), items=made.items)


@pytest.fixture
def walk() -> Held:
    return rendered()


def loop_over(source: Held, frame: BaseFrame | None = None, **options: Any) -> RunLoop:
    return RunLoop(source, Config(), frame or BaseFrame(CAMERA), **options)


def run(source: Held, frame: BaseFrame | None = None, **options: Any) -> tuple[Kept, RunLoop]:
    kept, loop = Kept(), loop_over(source, frame, **options)
    loop.run([kept], None)
    return kept, loop


def test_all_outputs_are_given_all_frames_and_each_smoothed_pose_once(walk: Held) -> None:
    first, second = Kept(), Kept()
    loop_over(walk).run([first, second], None)
    stamps = [image.stamp_ns for image in walk.items[::2]]
    for kept in (first, second):
        assert [result.stamp_ns for result in kept.frames] == stamps
        assert sorted(estimate.stamp_ns for estimate in kept.smoothed) == stamps
        assert kept.faulty == []
    assert first == second


def test_all_poses_are_of_the_frame_asked_for(walk: Held) -> None:
    camera = run(walk)[0].poses()
    base = run(walk, BaseFrame("base_link", T_BASE_CAM))[0].poses()
    T_initial = se3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]))
    placed = run(walk, BaseFrame("base_link", T_BASE_CAM, T_initial=T_initial))[0].poses()
    for name, poses in camera.items():
        expected = moved_by_hand(poses, T_BASE_CAM)
        np.testing.assert_allclose(base[name], expected, atol=1e-12)
        np.testing.assert_allclose(placed[name], T_initial @ expected, atol=1e-12)


def test_steps_are_of_the_frame_asked_for(walk: Held) -> None:
    camera = run(walk)[0].frames
    base = run(walk, BaseFrame("base_link", T_BASE_CAM))[0].frames
    assert camera[0].T_previous_frame is base[0].T_previous_frame is None
    for ours, theirs in zip(base[1:], camera[1:], strict=True):
        assert theirs.T_previous_frame is not None
        assert ours.T_previous_frame is not None
        expected = T_BASE_CAM @ theirs.T_previous_frame @ np.linalg.inv(T_BASE_CAM)
        np.testing.assert_allclose(ours.T_previous_frame, expected, atol=1e-12)


def test_the_correction_of_the_map_is_one_of_the_world_asked_for(
    walk: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    T_map_world = se3.exp(np.array([0.1, 0.0, 0.2, 1.0, 2.0, 3.0]))
    track = Odometry.track

    def correct(odometry: Odometry, frame: Frame) -> FrameResult:
        return replace(track(odometry, frame), T_map_world=T_map_world)

    monkeypatch.setattr(Odometry, "track", correct)
    camera, base = run(walk)[0].frames[-1], run(walk, BaseFrame("b", T_BASE_CAM))[0].frames[-1]
    np.testing.assert_array_equal(camera.T_map_world, T_map_world)
    moved = T_BASE_CAM @ T_map_world @ camera.causal.T_world_frame @ np.linalg.inv(T_BASE_CAM)
    np.testing.assert_allclose(base.T_map_world @ base.causal.T_world_frame, moved, atol=1e-12)


class Torn(Kept):
    """An output that cannot be written from the second frame on, or at the end."""

    def __init__(self, *, is_at_end: bool) -> None:
        super().__init__()
        self.is_at_end = is_at_end

    def add_frame(self, frame: Frame, result: FrameResult) -> None:
        super().add_frame(frame, result)
        if len(self.frames) == 2 and not self.is_at_end:
            raise RecordingError("torn")

    def add_optimum(self, optimum: Optimum) -> None:
        super().add_optimum(optimum)
        raise RecordingError("torn at the end")


def test_all_outputs_but_those_that_cannot_write_are_given_the_optimum(walk: Held) -> None:
    first, early, late, last = Kept(), Torn(is_at_end=False), Torn(is_at_end=True), Kept()
    loop = loop_over(walk, BaseFrame("base_link", T_BASE_CAM))
    loop.run([first, early, late, last], None)
    optimum = loop.optimize()
    assert optimum is not None
    assert first.optima == last.optima == late.optima == [optimum]
    assert early.optima == []
    assert loop.output_faults == ["torn", "torn at the end"]
    poses = np.array([estimate.T_world_frame for estimate in optimum.estimates])
    np.testing.assert_allclose(poses, last.poses()["smoothed"], atol=0.05)


def test_the_first_pose_is_asked_for_once_with_the_first_stamp_that_is_read(walk: Held) -> None:
    asked: list[int] = []
    T_first = se3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]))

    def first_pose(stamp_ns: int) -> FloatArray:
        asked.append(stamp_ns)
        return T_first

    kept, _ = run(walk, excerpt=Excerpt(start_s=0.05), first_pose=first_pose)
    assert asked == [kept.frames[0].stamp_ns]
    assert asked[0] == walk.items[4].stamp_ns
    np.testing.assert_allclose(kept.frames[0].raw.T_world_frame, T_first, atol=1e-12)


def test_only_the_excerpt_is_tracked_and_announced(walk: Held) -> None:
    told: list[Progress] = []
    kept, loop = Kept(), loop_over(walk, excerpt=Excerpt(every=3))
    loop.run([kept], told.append)
    stamps = [image.stamp_ns for image in walk.items[::2]]
    assert [result.stamp_ns for result in kept.frames] == stamps[::3]
    assert [(progress.n_done, progress.n_total) for progress in told] == [(1, 3), (2, 3), (3, 3)]


def test_a_break_in_the_recording_is_noted_and_ends_the_run_with_all_poses(walk: Held) -> None:
    walk.items, walk.damage = walk.items[:8], "the last 3 frames are missing"
    kept, loop = run(walk)
    assert len(kept.frames) == len(kept.smoothed) == 4
    assert loop.statistics.broken_off == "the last 3 frames are missing"
    assert not loop.statistics.is_complete


@pytest.mark.parametrize(("sensor", "n_lost"), [("stereo", 1), ("rgbd", 0)])
def test_an_image_without_partner_is_a_loss_of_stereo_alone(sensor: Sensor, n_lost: int) -> None:
    source = rendered(sensor)
    del source.items[7]
    kept, loop = run(source)
    assert len(kept.frames) == _N_FRAMES - 1
    assert [frame.stamp_ns for frame in kept.faulty] == [source.items[6].stamp_ns] * n_lost
    assert loop.statistics.n_faulty == n_lost
    assert loop.statistics.is_complete == (n_lost == 0)


def test_frames_are_counted_also_where_the_last_poses_cannot_be_written(walk: Held) -> None:
    class Full(Kept):
        def add_smoothed(self, estimates: Iterable[Estimate]) -> None:
            raise OutputError("no space")

    loop = loop_over(walk)
    with pytest.raises(OutputError, match="no space"):
        loop.run([Full()], None)
    assert loop.statistics.window.n_poses == _N_FRAMES


def _with_imu(walk: Held, samples: Callable[[int], Iterator[ImuSamples]]) -> Held:
    stream = ImuStream(name="imu", imu=Imu(), samples=samples)
    return replace(walk, info=replace(walk.info, imu=stream))


def test_an_imu_that_cannot_be_read_on_is_told_of_and_the_run_goes_on(walk: Held) -> None:
    def samples(_: int) -> Iterator[ImuSamples]:
        yield ImuSamples.of([walk.items[0].stamp_ns], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 9.81]])
        raise RecordingError("row 2 is none")

    kept, loop = run(_with_imu(walk, samples))
    assert len(kept.frames) == _N_FRAMES
    assert loop.statistics.broken_off == "row 2 is none"
    assert not loop.statistics.is_complete


def test_samples_are_asked_for_from_before_the_first_frame_of_an_excerpt(walk: Held) -> None:
    asked_ns: list[int] = []

    def samples(start_ns: int) -> Iterator[ImuSamples]:
        asked_ns.append(start_ns)
        yield from ()

    start_ns = walk.items[4].stamp_ns
    start_s = 1e-9 * (start_ns - walk.items[0].stamp_ns)
    kept, _ = run(_with_imu(walk, samples), excerpt=Excerpt(start_s=start_s))
    assert kept.frames[0].stamp_ns == start_ns
    (first_ns,) = asked_ns
    assert start_ns - 3 * 10**9 < first_ns < start_ns
