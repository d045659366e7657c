"""A run that goes on elsewhere, on the page: the newest frame wins, and nothing waits for it."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gvo.config import Config, Parameters
from gvo.io.synthetic import SyntheticRecording
from gvo.live.odometry import LiveOdometry
from gvo.runs.outputs.options import RunOutputs
from gvo.types import FaultyFrame
from gvo.viz.view import serve
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.newest import FrameView
from gvo.viz.view.player import Player
from tests.make.results import loop_of
from tests.viz.view.fakes import (
    CAMERA,
    PERIOD_NS,
    FakeWindow,
    cells,
    frame_of,
    pose_of,
    result_of,
)


@pytest.fixture
def window() -> FakeWindow:
    return FakeWindow()


@pytest.fixture
def player(window: FakeWindow) -> LivePlayer:
    source = SimpleNamespace(info=SimpleNamespace(camera=CAMERA, name="drive"))
    opened = LivePlayer(cast(Any, source), Parameters(Config()))
    opened.begin(cast(Any, window))
    return opened


def add(player: LivePlayer, window: FakeWindow, index: int, **changes: Any) -> None:
    window.take(PERIOD_NS * index)
    player.add(frame_of(index), result_of(index, **changes))


def shown(player: LivePlayer) -> FrameView:
    view = player.newest.view()
    assert view is not None
    return view


def test_the_newest_frame_is_shown_with_all_paths(player: LivePlayer, window: FakeWindow) -> None:
    assert player.newest.view() is None
    for index in range(5):
        add(player, window, index)
    view = shown(player)
    assert (view.index, player.n_frames) == (4, 5)
    np.testing.assert_array_equal(view.T_world_frame, pose_of(4))
    assert view.scene is not None
    assert [each.stamp_ns for each in view.scene.window] == [PERIOD_NS * k for k in (2, 3, 4)]
    for name, x in (("raw", 0.0), ("causal", 0.0), ("smoothed", 0.5)):
        np.testing.assert_allclose(view.paths[name][1][:, 2], np.arange(5.0))
        np.testing.assert_allclose(view.paths[name][1][:, 0], x)
    assert player.newest.view() is view
    # A faulty frame is shown at the last pose.
    player.add(FaultyFrame(stamp_ns=5 * PERIOD_NS, reason="dropped"), None)
    view = shown(player)
    assert (view.index, view.result, view.reason) == (5, None, "dropped")
    np.testing.assert_array_equal(view.T_world_frame, pose_of(4))
    # Another run begins without former paths.
    player.begin(cast(Any, window))
    add(player, window, 6)
    assert (player.newest.first_index, player.n_frames) == (6, 7)
    assert len(shown(player).paths["causal"][0]) == 1


def test_while_it_is_paused_or_nobody_looks_only_poses_are_noted(
    player: LivePlayer, window: FakeWindow
) -> None:
    add(player, window, 0)
    n_asked = window.n_asked
    player.pause()
    add(player, window, 1)
    player.play()
    player.is_watched = lambda: False
    add(player, window, 2)
    assert window.n_asked == n_asked
    view = shown(player)
    assert view.index == 0
    assert len(view.paths["causal"][0]) == 3


def test_the_page_rests_as_tracking_needs_the_time(
    player: LivePlayer, window: FakeWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = waited_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    player.waited_s = lambda: waited_s
    rests = []
    for idle_s in (10.0, 4.0, 0.4, 0.0):
        now_s, waited_s = now_s + 10.0, waited_s + idle_s
        rests.append(player.rest_s(0.02))
    np.testing.assert_allclose(rests, [0.02, 0.08, 0.98, 0.98])
    now_s += 1.0
    assert player.rest_s(1.0) == 3.0  # it does not look dead
    # While it rests the newest frame wins, and nothing is asked of the window.
    add(player, window, 0)
    player.newest.is_due, n_asked = False, window.n_asked
    add(player, window, 1)
    assert (shown(player).index, window.n_asked) == (1, n_asked)


def test_what_a_page_keeps_of_a_long_run_is_bounded(
    player: LivePlayer, window: FakeWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvo.viz.view.newest.MAX_POINTS", 500)
    monkeypatch.setattr("gvo.viz.view.newest._MAX_KEPT_POSES", 40)
    monkeypatch.setattr("gvo.viz.scene._MAX_LOOPS", 3)
    for index in range(50):
        loops = (loop_of(PERIOD_NS * index, 0),)
        add(player, window, index, keyframes_ns=(PERIOD_NS * index,), loops=loops)
    points, _ = player.newest.keyframe_cloud()
    assert 100 < len(points) <= 500
    history = player.newest.history
    assert len(history.loops) == 3
    assert [len(history.tracks[name]) for name in ("raw", "causal", "smoothed")] == [30] * 3
    assert history.tracks["raw"].path()[0][-1] == 49 * PERIOD_NS


def test_a_page_draws_the_clouds_of_a_bounded_number_of_keyframes(
    player: LivePlayer, window: FakeWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvo.viz.view.newest._MAX_CLOUDS", 8)
    n_points = []
    for index in range(30):
        add(player, window, index, keyframes_ns=(PERIOD_NS * index,))
        n_points.append(len(player.newest.keyframe_cloud()[0]))
    assert max(n_points) == 8 * n_points[0]
    assert n_points[-1] >= 4 * n_points[0] > 0


def test_loops_go_on_being_drawn_where_poses_are_corrected(
    player: LivePlayer, window: FakeWindow
) -> None:
    for index in range(8):
        add(player, window, index)
    add(player, window, 8, loops=(loop_of(8 * PERIOD_NS, 0),))
    np.testing.assert_allclose(shown(player).loops[0, :, 2], [8.0, 0.0])
    add(player, window, 9)
    np.testing.assert_allclose(shown(player).loops[:, :, 0], 0.5)


def test_the_page_shows_the_run_pauses_and_sets_parameters(
    player: LivePlayer, window: FakeWindow
) -> None:
    with serve(player, port=0) as page:
        player.is_watched = lambda: True
        add(player, window, 0)
        add(player, window, 7)
        page.settle()
        numbers = cells(page.numbers.content)
        assert (numbers["frame"], numbers["status"], numbers["inliers"]) == ("1 of 2", "ok", "97")
        page.press("pause")
        assert not player.is_playing
        page.press("play")
        assert player.is_playing

        page.controls.handle("klt", "n_corners").value = 250
        page.controls.flush()
        assert player.config.klt.n_corners == 250
        page.controls.handle("klt", "n_corners").value = 123  # not applied yet
        player.parameters.set({"window.n_links": 1})  # by someone else
        assert page.controls.handle("window", "n_links").value == 1
        assert page.controls.handle("klt", "n_corners").value == 123
        page.controls.handle("klt", "n_corners").value = -1
        page.controls.flush()
        assert "klt.n_corners=-1" in page.state.content
        assert (player.config.klt.n_corners, player.config.window.n_links) == (250, 1)


def test_a_run_is_shown_as_a_recording_is(tmp_path: Path) -> None:
    source = SyntheticRecording("driving", "stereo", n_frames=4, scale=0.3)
    odometry = LiveOdometry(source, max_waiting=100)
    shown = odometry.viewer = LivePlayer(source, odometry.parameters)
    odometry.run(tmp_path, outputs=RunOutputs(report=False))
    view = shown.newest.view()
    assert view is not None
    with Player(lambda config: source, Config()) as player:
        player.set_speed(None)
        player.play()
        assert player.wait(60.0)
        expected = player.newest.view()
        assert expected is not None
        clouds = shown.newest.keyframe_cloud(), player.newest.keyframe_cloud()
    for name in ("raw", "causal"):
        for one, other in zip(view.paths[name], expected.paths[name], strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name)
    np.testing.assert_array_equal(clouds[0][1], clouds[1][1])
    assert view.index == expected.index == 3
    for name in ("image", "T_world_frame"):
        np.testing.assert_array_equal(getattr(view, name), getattr(expected, name))
    assert view.scene is not None
    assert expected.scene is not None
    assert view.scene.counts == expected.scene.counts
    for found, wanted in zip(view.scene.window, expected.scene.window, strict=True):
        np.testing.assert_array_equal(found.T_world_frame, wanted.T_world_frame)
