"""The player: what it shows, in what order, and what it makes of trouble."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import islice

import numpy as np
import pytest

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt
from gvo.io.frames import frames
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.io.synthetic import SyntheticRecording
from gvo.odometry.odometry import Odometry
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Estimate, FrameResult, RgbdFrame
from gvo.viz.view.history import FrameView
from gvo.viz.view.player import Player

N_FRAMES = 12
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
        return self._change(iter(rendered()))

    def ground_truth(self) -> Trajectory | None:
        return None


@cache
def rendered() -> tuple[StampedImage, ...]:
    """Return the images of the walk, rendered once."""
    loaded = [(image, image.load()) for image in walk().images()]
    return tuple(replace(image, load=partial(np.copy, pixels)) for image, pixels in loaded)


@cache
def walk() -> SyntheticRecording:
    return SyntheticRecording("handheld", "rgbd", n_frames=N_FRAMES, scale=0.3)


def stamps_ns() -> list[int]:
    return [int(stamp_ns) for stamp_ns in walk().ground_truth().stamps_ns]


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
    player.seek(index)
    assert player.wait(LIMIT_S)


def follow(player: Player) -> list[FrameView]:
    """Return a list that each view shown is added to."""
    views: list[FrameView] = []
    player.subscribe(views.append)
    return views


def test_playing_shows_each_frame_once_with_the_poses_of_a_run(player: Player) -> None:
    views = follow(player)
    assert player.index == -1
    assert player.frame_view is None
    player.set_speed(None)
    player.play()
    assert player.wait(LIMIT_S)
    assert not player.is_playing
    assert player.is_finished
    assert player.fault == ""
    # Once more at the end, with the smoothed poses of all.
    assert [view.index for view in views] == [*range(N_FRAMES), N_FRAMES - 1]
    assert [view.stamp_ns for view in views[:-1]] == stamps_ns()
    results, smoothed = computed()
    for view, result in zip(views, results, strict=False):
        np.testing.assert_array_equal(view.T_world_frame, result.causal.T_world_frame)
        assert view.keyframes == result.keyframes_ns
        assert set(view.keyframes) <= set(view.window_poses)
        assert set(view.window_poses) == set(view.window_covariances)
    paths = player.history.path("raw"), player.history.path("causal")
    for (stamps, path), kind in zip(paths, ("raw", "causal"), strict=True):
        assert stamps.tolist() == stamps_ns()
        assert path.tolist() == positions([getattr(result, kind) for result in results])
    stamps, path = player.history.path("smoothed")
    assert stamps.tolist() == stamps_ns()
    assert path.tolist() == positions(list(smoothed))


def test_a_frame_that_is_done_is_shown_as_it_was(player: Player) -> None:
    views = follow(player)
    go(player, 7)
    go(player, 3)
    then, now = views[3], views[-1]
    assert (now.index, player.n_done) == (3, 8)
    assert now.status == then.status
    np.testing.assert_array_equal(now.T_world_frame, then.T_world_frame)
    np.testing.assert_array_equal(now.cloud[0], then.cloud[0])
    assert now.image.shape == then.image.shape
    assert np.abs(now.overlay.astype(int) - then.overlay).mean() < 6  # JPEG
    assert len(player.history.path("raw")[0]) == 4
    assert player.history.path("smoothed")[0].tolist() == stamps_ns()[:4]


def test_steps_go_through_what_is_done_and_on(player: Player) -> None:
    go(player, 2)
    go(player, 0)
    views = follow(player)
    for _ in range(4):
        player.step()
    assert player.wait(LIMIT_S)
    assert [view.index for view in views][-2:] == [3, 4]
    assert player.n_done == 5
    assert not player.is_playing


@pytest.mark.parametrize("tell", ["pause", "seek"])
def test_the_way_to_a_frame_can_be_interrupted(player: Player, tell: str) -> None:
    def interrupt(view: FrameView) -> None:
        if (view.index, player.n_done) == (4, 5):
            player.pause() if tell == "pause" else player.seek(1)

    player.subscribe(interrupt)
    go(player, N_FRAMES - 1)
    assert (player.index, player.n_done) == (4 if tell == "pause" else 1, 5)


def test_a_seek_beyond_an_end_shows_the_frame_there(player: Player) -> None:
    go(player, 10_000)
    assert (player.index, player.n_frames, player.is_finished) == (N_FRAMES - 1, N_FRAMES, True)
    go(player, -5)
    assert player.index == 0
    go(player, 10_000)
    assert player.index == N_FRAMES - 1


def test_pause_ends_a_wait_for_the_next_frame(player: Player) -> None:
    player.set_speed(1e-6)  # hours from frame to frame
    go(player, 0)
    player.play()
    assert not player.wait(0.05)
    player.pause()
    assert player.wait(LIMIT_S)
    assert player.index < 2


def test_a_jump_of_the_stamps_is_not_waited_for() -> None:
    def jump(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        for image in images:
            is_late = image.stamp_ns > stamps_ns()[5]
            yield replace(image, stamp_ns=image.stamp_ns + is_late * 10**15)

    with Player(Recording(jump).open, Config()) as player:
        player.set_speed(200.0)  # the jump alone: more than an hour
        player.play()
        assert player.wait(LIMIT_S)
        assert player.index == N_FRAMES - 1


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_refused(factor: float) -> None:
    with (
        Player(Recording().open, Config()) as player,
        pytest.raises(ValueError, match="positive or None"),
    ):
        player.set_speed(factor)


def test_after_a_restart_the_world_begins_at_the_frame_shown(player: Player) -> None:
    go(player, 8)
    go(player, 5)
    player.restart()
    assert player.wait(LIMIT_S)
    assert (player.index, player.first_index, player.n_done) == (5, 5, 6)
    go(player, N_FRAMES - 1)
    results, smoothed = computed(5)
    stamps, path = player.history.path("smoothed")
    assert stamps.tolist() == stamps_ns()[5:]
    assert path.tolist() == positions(list(smoothed))
    go(player, 0)
    assert player.index == 5
    assert player.frame_view is not None
    np.testing.assert_array_equal(player.frame_view.T_world_frame, results[0].causal.T_world_frame)
    player.restart(0)
    assert player.wait(LIMIT_S)
    assert (player.index, player.first_index, player.n_done) == (0, 0, 1)
    with pytest.raises(ValueError, match="frame 4 is not known"):
        player.restart(4)


def test_another_configuration_counts_from_the_next_frame_on() -> None:
    recording = Recording()
    with Player(recording.open, Config()) as player:
        views = follow(player)
        go(player, 3)
        player.reconfigure(change(klt={"n_corners": 50}))
        player.step()
        assert player.wait(LIMIT_S)
        before, after = views[-2].result, views[-1].result
        assert before is not None
        assert after is not None
        assert after.n_matches <= 50 < before.n_matches
        assert player.config.klt.n_corners == 50
        assert recording.n_opened == 1
        with pytest.raises(ValueError, match=r"gvo\.Config, got dict"):
            player.reconfigure({})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "other", [change(sync={"max_difference_ms": 5.0}), change(runtime={"threads": 1})]
)
def test_what_matters_when_reading_opens_the_recording_again_without_a_gap(other: Config) -> None:
    recording = Recording()
    with Player(recording.open, Config()) as player:
        views = follow(player)
        go(player, 3)
        player.reconfigure(other)
        go(player, N_FRAMES - 1)
        assert recording.n_opened == 2
        assert [view.stamp_ns for view in views[:-1]] == stamps_ns()
        expected = positions([result.raw for result in computed()[0]])
        assert player.history.path("raw")[1].tolist() == expected


def test_a_configuration_that_cannot_be_read_with_leaves_the_former_one() -> None:
    recording = Recording()

    def open_source(config: Config) -> Source:
        if config.images.black > 0:
            raise RecordingError("black is not black; take 0")
        return recording.open(config)

    with Player(open_source, Config()) as player:
        views = follow(player)
        go(player, 3)
        player.reconfigure(change(images={"black": 7}, klt={"n_corners": 50}))
        player.step()
        assert player.wait(LIMIT_S)
        assert player.fault == "black is not black; take 0"
        assert player.config == Config()
        go(player, N_FRAMES - 1)
        assert [view.stamp_ns for view in views[:-1]] == stamps_ns()


def test_a_faulty_frame_is_shown_without_result() -> None:
    def fail() -> np.ndarray:
        raise RecordingError("cut off")

    def spoil(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        for image in images:
            is_bad = image.stamp_ns == stamps_ns()[4]
            yield replace(image, load=fail) if is_bad else image

    with Player(Recording(spoil).open, Config()) as player:
        views = follow(player)
        go(player, N_FRAMES - 1)
        view = views[4]
        assert view.result is None
        assert view.status is None
        assert "cut off" in view.reason
        np.testing.assert_array_equal(view.T_world_frame, views[3].T_world_frame)
        assert player.history.path("smoothed")[0].tolist() == stamps_ns()[:4] + stamps_ns()[5:]
        player.restart(4)
        go(player, 6)
        assert player.history.path("raw")[0].tolist() == stamps_ns()[5:7]


def test_images_without_partner_are_no_frames() -> None:
    def drop(images: Iterator[StampedImage]) -> Iterator[StampedImage]:
        return (i for i in images if (i.stamp_ns, i.stream) != (stamps_ns()[4], 1))

    with Player(Recording(drop).open, Config()) as player:
        go(player, N_FRAMES)
        assert player.n_frames == N_FRAMES - 1
        assert player.history.path("raw")[0].tolist() == stamps_ns()[:4] + stamps_ns()[5:]


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
        assert player.fault == "the file ends here"
        assert player.is_finished
        assert not player.is_playing
        assert player.history.path("smoothed")[0].tolist() == stamps_ns()[:6]
        go(player, 1)
        assert player.index == 1


def test_a_recording_without_a_frame_is_told() -> None:
    recording = Recording(lambda images: islice(images, 0))
    with Player(recording.open, Config()) as player:
        player.step()
        assert player.wait(LIMIT_S)
        assert player.is_finished
        assert player.frame_view is None


def test_a_fault_of_the_program_is_told_and_a_restart_goes_on() -> None:
    broken = [Recording(break_off(ZeroDivisionError("an odd image"))), Recording()]
    with Player(lambda config: broken.pop(0), Config()) as player:
        go(player, N_FRAMES - 1)
        assert player.fault == "ZeroDivisionError: an odd image"
        player.restart(0)
        go(player, N_FRAMES - 1)
        assert player.fault == ""
        assert player.index == N_FRAMES - 1


def test_a_subscriber_that_fails_stops_nobody(player: Player) -> None:
    page: dict[str, FrameView] = {}
    player.subscribe(lambda view: page["page"])  # type: ignore[arg-type]
    views = follow(player)
    go(player, 2)
    assert player.fault == "KeyError: 'page'"
    assert [view.index for view in views] == [0, 1, 2]


def test_who_unsubscribes_is_not_called(player: Player) -> None:
    views: list[FrameView] = []
    end = player.subscribe(views.append)
    player.step()
    player.wait(LIMIT_S)
    end()
    end()
    player.step()
    player.wait(LIMIT_S)
    assert [view.index for view in views] == [0]


def test_an_excerpt_is_played_and_restarted_within() -> None:
    excerpt = Excerpt(start_s=0.1, duration_s=0.25, every=2)
    expected = [ns for ns in stamps_ns() if 0.1 <= 1e-9 * (ns - stamps_ns()[0]) < 0.35][::2]
    with Player(Recording().open, Config(), excerpt=excerpt) as player:
        go(player, 100)
        assert player.history.path("raw")[0].tolist() == expected
        player.restart(2)
        go(player, 100)
        assert player.history.path("raw")[0].tolist() == expected[2:]


def test_what_was_done_can_be_read_after_the_end() -> None:
    player = Player(Recording().open, Config())
    go(player, 4)
    player.close()
    player.close()
    assert player.history.frame_view(1).index == 1
    with pytest.raises(ValueError, match="frame 5 is not among those done: 0 to 4"):
        player.history.frame_view(5)


def test_closing_while_it_plays_ends_it() -> None:
    player = Player(Recording().open, Config())
    player.set_speed(1e-6)
    player.play()
    player.close()
    assert not player.is_busy
