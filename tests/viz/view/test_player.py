"""The player: what it shows, in what order, and what it makes of trouble."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.frames import frames
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate, FrameResult, RgbdFrame
from gvo.viz.view.player import Player
from tests.make.recordings import Held, hold

N_FRAMES = 8
LIMIT_S = 60.0  # ends a test that hangs; none waits for it

Change = Callable[[Iterator[StampedImage]], Iterator[StampedImage]]


class Recording:
    """A short walk with an RGB-D camera; a test may change its images."""

    def __init__(self, change: Change | None = None) -> None:
        self._walk = walk()
        self._change = change or (lambda images: images)
        self.n_opened = 0

    def open(self, config: Config) -> Source:
        self.n_opened += 1
        return self

    @property
    def info(self) -> RecordingInfo:
        return self._walk.info

    def images(self) -> Iterator[StampedImage]:
        return self._change(iter(walk().items))

    def ground_truth(self) -> Trajectory | None:
        return None


@cache
def walk() -> Held:
    return hold(SyntheticRecording("handheld", "rgbd", n_frames=N_FRAMES, scale=0.3))


def stamps_ns() -> list[int]:
    return [image.stamp_ns for image in walk().stream(0)]


@cache
def computed(first: int = 0) -> tuple[tuple[FrameResult, ...], tuple[Estimate, ...]]:
    """Return what odometry gives without a player: results, and all smoothed poses."""
    items = [item for item in frames(Recording(), Config()) if isinstance(item, RgbdFrame)]
    odometry = Odometry(walk().info.camera, Config())
    results = tuple(odometry.track(frame) for frame in items[first:])
    smoothed = [estimate for result in results for estimate in result.finished]
    smoothed += odometry.finish()
    return results, tuple(sorted(smoothed, key=lambda estimate: estimate.stamp_ns))


def positions(estimates: list[Estimate]) -> list[list[float]]:
    return [estimate.T_world_frame[:3, 3].tolist() for estimate in estimates]


def change(**sections: dict[str, object]) -> Config:
    return Config.model_validate(sections)


@pytest.fixture
def player() -> Iterator[Player]:
    with Player(Recording().open, Config()) as opened:
        yield opened


def go(player: Player, index: int) -> None:
    """Track all frames up to one; beyond the end: all."""
    for _ in range(min(index, N_FRAMES) - player.newest.n_done + 1):
        player.step()
    assert player.wait(LIMIT_S)


def path(player: Player, name: str) -> tuple[list[int], list[list[float]]]:
    view = player.newest.view()
    assert view is not None
    stamps, poses = view.paths[name]
    return stamps.tolist(), poses[:, :3].tolist()


def test_steps_give_the_poses_of_a_run(player: Player) -> None:
    assert (player.newest.view(), player.n_frames) == (None, N_FRAMES)
    results, smoothed = computed()
    for index, result in enumerate(results):
        go(player, index)
        view = player.newest.view()
        assert view is not None
        assert (view.index, view.stamp_ns) == (index, stamps_ns()[index])
        np.testing.assert_array_equal(view.T_world_frame, result.causal.T_world_frame)
    assert (player.fault, player.is_finished) == ("", True)
    assert path(player, "smoothed") == (stamps_ns(), positions(list(smoothed)))
    go(player, N_FRAMES)  # there is none
    assert player.newest.n_done == player.n_frames == N_FRAMES


def test_play_goes_to_the_end_and_a_jump_of_the_stamps_is_not_waited_for() -> None:
    def jump(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        for image in images:
            is_late = image.stamp_ns > stamps_ns()[5]
            yield replace(image, stamp_ns=image.stamp_ns + is_late * 10**15)

    with Player(Recording(jump).open, Config()) as player:
        player.set_speed(200.0)  # the jump alone: more than an hour
        player.play()
        assert player.wait(LIMIT_S)
        assert (player.is_playing, player.is_finished, player.fault) == (False, True, "")
        assert player.newest.n_done == N_FRAMES


def test_pause_ends_a_wait_for_the_next_frame_and_closing_a_run_that_plays() -> None:
    player = Player(Recording().open, Config())
    for factor in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="positive or None"):
            player.set_speed(factor)
    player.set_speed(1e-6)  # hours from frame to frame
    go(player, 0)
    player.play()
    assert not player.wait(0.05)
    player.pause()
    assert player.wait(LIMIT_S)
    assert player.newest.n_done <= 2
    player.play()
    player.close()
    assert not player.is_busy


def test_after_a_restart_the_world_begins_at_the_frame(player: Player) -> None:
    go(player, 6)
    player.restart(5)
    assert player.wait(LIMIT_S)
    assert (player.newest.first_index, player.newest.n_done) == (5, 6)
    go(player, N_FRAMES - 1)
    assert path(player, "smoothed") == (stamps_ns()[5:], positions(list(computed(5)[1])))
    player.restart(400)  # is not there: nothing changes
    assert player.wait(LIMIT_S)
    assert f"there is no frame 400, only 0 to {N_FRAMES - 1}" in player.fault
    assert player.newest.n_done == N_FRAMES
    player.restart(0)
    assert player.wait(LIMIT_S)
    assert (player.newest.first_index, player.newest.n_done, player.fault) == (0, 1, "")


def test_another_configuration_counts_from_the_next_frame_on() -> None:
    recording = Recording()
    with Player(recording.open, Config()) as player:
        go(player, 2)
        before = matches(player)
        player.reconfigure(change(klt={"n_corners": 50}))
        go(player, 3)
        assert matches(player) <= 50 < before
        assert recording.n_opened == 1


def matches(player: Player) -> int:
    view = player.newest.view()
    assert view is not None
    assert view.result is not None
    return view.result.n_matches


@pytest.mark.parametrize(
    "other", [change(sync={"max_difference_ms": 5.0}), change(runtime={"threads": 1})]
)
def test_what_matters_when_reading_opens_the_recording_again_without_a_gap(other: Config) -> None:
    recording = Recording()
    with Player(recording.open, Config()) as player:
        go(player, 3)
        player.reconfigure(other)
        go(player, N_FRAMES - 1)
        assert recording.n_opened == 2
        expected = positions([result.raw for result in computed()[0]])
        assert path(player, "raw") == (stamps_ns(), expected)


def test_a_configuration_that_cannot_be_read_with_leaves_the_former_one() -> None:
    recording = Recording()

    def open_source(config: Config) -> Source:
        if config.images.black > 0:
            raise RecordingError("black is not black; take 0")
        return recording.open(config)

    with Player(open_source, Config()) as player:
        go(player, 3)
        player.reconfigure(change(images={"black": 7}, klt={"n_corners": 50}))
        go(player, 4)
        assert player.fault == "black is not black; take 0"
        assert player.config == Config()
        assert path(player, "raw")[0] == stamps_ns()[:5]


def test_a_faulty_frame_is_shown_without_result_and_one_without_partner_is_none() -> None:
    def fail() -> np.ndarray:
        raise RecordingError("cut off")

    def spoil(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        for image in images:
            if (image.stamp_ns, image.stream) == (stamps_ns()[2], 1):
                continue
            is_bad = image.stamp_ns == stamps_ns()[4]
            yield replace(image, load=fail) if is_bad else image

    with Player(Recording(spoil).open, Config()) as player:
        go(player, 3)
        view = player.newest.view()
        assert view is not None
        assert view.result is None
        assert "cut off" in view.reason
        player.restart(3)
        assert player.wait(LIMIT_S)
        go(player, 5)
        assert path(player, "raw")[0] == stamps_ns()[5:7]


def break_off(error: Exception) -> Change:
    def change_images(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        yield from islice(images, 12)
        raise error

    return change_images


def test_a_recording_that_breaks_off_is_told_and_its_poses_are_there() -> None:
    recording = Recording(break_off(RecordingError("the file ends here")))
    with Player(recording.open, Config()) as player:
        player.set_speed(None)
        player.play()
        assert player.wait(LIMIT_S)
        assert (player.fault, player.is_finished) == ("the file ends here", True)
        assert not player.is_playing
        assert path(player, "smoothed")[0] == stamps_ns()[:6]
