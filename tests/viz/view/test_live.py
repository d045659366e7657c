"""A run that goes on elsewhere, on the page: the newest frame wins, and nothing waits for it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from gvo.config import Config
from gvo.geometry.camera import Calibration, PinholeCamera, StereoCamera
from gvo.io.recording import RecordingInfo, Source, StampedImage
from gvo.live.odometry import LiveOdometry
from gvo.live.transport import Parameters
from gvo.runs.outputs.options import RunOutputs
from gvo.types import Estimate, FaultyFrame, FrameResult, Loop, Status, StereoFrame
from gvo.viz.view import live
from gvo.viz.view.live import LiveHistory, LivePlayer
from gvo.viz.view.page import Page
from gvo.viz.view.player import Player
from gvo.viz.view.server import ViewServer
from tests.recordings import Held
from tests.viz.view.fakes import PERIOD_NS, cells, pose_of, result_of

STEREO = StereoCamera(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0, baseline=0.1)


class FakeWindow:
    """Holds the newest poses, and knows how often it was asked."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.n_asked = 0

    def __contains__(self, stamp_ns: int) -> bool:
        return stamp_ns in self.stamps_ns

    def estimate(self, stamp_ns: int) -> Estimate:
        self.n_asked += 1
        T = pose_of(stamp_ns // PERIOD_NS)
        T[0, 3] = 0.5
        return Estimate(stamp_ns=stamp_ns, T_world_frame=T, covariance=np.eye(6))


@pytest.fixture
def window() -> FakeWindow:
    return FakeWindow()


@pytest.fixture
def player(window: FakeWindow) -> LivePlayer:
    source = SimpleNamespace(info=SimpleNamespace(camera=STEREO, name="drive"))
    opened = LivePlayer(cast(Any, source), Parameters(Config()))
    opened.begin(cast(Any, window))
    return opened


@pytest.fixture
def page(view: ViewServer, player: LivePlayer) -> Iterator[Page]:
    opened = Page(view.viser, player, truth=None)
    yield opened
    opened.close()


def add(player: LivePlayer, window: FakeWindow, index: int) -> None:
    result = result_of(index)
    window.stamps_ns = [*window.stamps_ns[-2:], result.stamp_ns]
    grey = np.full((STEREO.height, STEREO.width), index, dtype=np.uint8)
    player.add(StereoFrame(stamp_ns=result.stamp_ns, left=grey, right=grey), result)


def test_the_newest_frame_is_shown_with_all_paths(player: LivePlayer, window: FakeWindow) -> None:
    assert player.frame_view is None
    for index in range(5):
        add(player, window, index)
    view = player.frame_view
    assert view is not None
    assert (view.index, player.n_frames) == (4, 5)
    np.testing.assert_array_equal(view.T_world_frame, pose_of(4))
    assert {*view.window_poses} == {PERIOD_NS * index for index in (2, 3, 4)}
    for path in (player.history.path("raw"), player.history.path("causal")):
        np.testing.assert_array_equal(path[1][:, 2], np.arange(5.0))
    np.testing.assert_array_equal(player.history.path("smoothed")[1][:, 0], [0.5] * 5)
    assert player.frame_view is view


def test_a_faulty_frame_is_shown_at_the_last_pose(player: LivePlayer, window: FakeWindow) -> None:
    add(player, window, 0)
    add(player, window, 1)
    player.add(FaultyFrame(stamp_ns=2 * PERIOD_NS, reason="dropped"), None)
    view = player.frame_view
    assert view is not None
    assert (view.index, view.result, view.reason) == (2, None, "dropped")
    np.testing.assert_array_equal(view.T_world_frame, pose_of(1))


def test_while_it_is_paused_or_nobody_looks_only_poses_are_noted(
    player: LivePlayer, window: FakeWindow
) -> None:
    told: list[object] = []
    player.subscribe(told.append)
    add(player, window, 0)
    assert len(told) == 1
    n_asked = window.n_asked
    player.pause()
    add(player, window, 1)
    player.play()
    player.is_watched = lambda: False
    add(player, window, 2)
    assert len(told) == 1
    assert window.n_asked == n_asked
    view = player.frame_view
    assert view is not None
    assert view.index == 0
    assert len(player.history.path("causal")[0]) == 3


def test_a_new_run_begins_without_former_paths(player: LivePlayer, window: FakeWindow) -> None:
    add(player, window, 0)
    add(player, window, 1)
    player.begin(cast(Any, window))
    add(player, window, 2)
    assert (player.first_index, player.n_done) == (2, 3)
    assert len(player.history.path("causal")[0]) == 1


def test_a_long_path_keeps_its_shape_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_N_POSES", 64)
    history = LiveHistory()
    for index in range(1000):
        history.add(result_of(index))
    stamps_ns, positions = history.path("causal")
    assert 32 <= len(stamps_ns) <= 64
    np.testing.assert_array_equal(positions[:, 2], stamps_ns / PERIOD_NS)
    assert stamps_ns[0] == 0
    assert {*np.diff(stamps_ns)} == {16 * PERIOD_NS}
    np.testing.assert_array_equal(history.T_world_frame, pose_of(999))


def test_loops_go_on_being_drawn_where_poses_are_corrected() -> None:
    history = LiveHistory()
    for index in range(8):
        history.add(result_of(index))
    loop = Loop(
        reference_ns=0,
        stamp_ns=8 * PERIOD_NS,
        T_reference_frame=np.eye(4),
        covariance=np.eye(6),
        n_matches=60,
        n_inliers=50,
    )
    moved = Estimate(stamp_ns=0, T_world_frame=pose_of(-3), covariance=np.eye(6))
    history.add(replace(result_of(8), loops=(loop,), finished=(moved,)))
    np.testing.assert_array_equal(history.loop_lines()[:, :, 2], [[-3.0, 8.0]])


def test_the_page_shows_the_run_and_pauses(
    page: Page, player: LivePlayer, window: FakeWindow, view: ViewServer
) -> None:
    add(player, window, 0)
    add(player, window, 7)
    page.settle()
    numbers = cells(page.numbers.content)
    assert (numbers["frame"], numbers["status"], numbers["inliers"]) == ("1 of 2", "ok", "97")
    page.playback.toggle()
    assert not player.is_playing
    page.playback.press("play")
    assert player.is_playing


def test_parameters_are_set_refused_and_followed(page: Page, player: LivePlayer) -> None:
    parameters = cast(Parameters, player.parameters)
    corners = page.controls.handle("klt", "n_corners")
    corners.value = 300
    page.flush()
    assert parameters.config.klt.n_corners == 300
    assert page.message.content.count("klt") == 0

    corners.value = 1
    page.flush()
    assert "klt.n_corners=1" in page.message.content
    assert (parameters.config.klt.n_corners, corners.value) == (300, 300)

    page.controls.handle("window", "n_links").value = 1  # not applied yet
    parameters.set({"klt.n_corners": 250})  # by someone else
    assert corners.value == 250
    assert page.controls.handle("window", "n_links").value == 1
    page.flush()
    assert (parameters.config.klt.n_corners, parameters.config.window.n_links) == (250, 1)


def wall(n_frames: int) -> Held:
    """Return what a stereo camera sees that moves along a wall."""
    camera = PinholeCamera(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
    pair = tuple(Calibration.from_camera(camera, baseline=b) for b in (0.0, 0.1))
    info = RecordingInfo(name="wall", sensor="stereo", calibrations=pair, n_images=n_frames)
    noise = np.random.default_rng(0).integers(0, 256, (240, 420)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, None, 2.0), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    items = []
    for index in range(n_frames):
        for stream, start in enumerate((3 * index, 3 * index + 8)):
            load = partial(np.copy, texture[:, start : start + 320].astype(np.uint8))
            items.append(StampedImage(stream=stream, stamp_ns=index * PERIOD_NS, load=load))
    return Held(info=info, items=items)


def test_a_run_is_shown_as_a_recording_is(tmp_path: Path) -> None:
    source: Source = wall(4)
    odometry = LiveOdometry(source, max_waiting=100)
    shown = odometry.viewer = LivePlayer(source, odometry.parameters)
    odometry.run(tmp_path, outputs=RunOutputs(report=False))
    view = shown.frame_view
    assert view is not None
    with Player(lambda config: source, Config()) as player:
        player.seek(3)
        assert player.wait(60.0)
        expected = player.frame_view
        assert expected is not None
        for name in ("raw", "causal", "smoothed", "cloud"):
            found, wanted = (
                each.history.accumulated_cloud() if name == "cloud" else each.history.path(name)
                for each in (shown, player)
            )
            for one, other in zip(found, wanted, strict=True):
                np.testing.assert_array_equal(one, other, err_msg=name)
    assert view.index == expected.index == 3
    assert view.status == Status.OK
    for name in ("image", "T_world_frame"):
        np.testing.assert_array_equal(getattr(view, name), getattr(expected, name))
    for stamp_ns, T in expected.window_poses.items():
        np.testing.assert_array_equal(view.window_poses[stamp_ns], T)
    assert cast(FrameResult, view.result).n_inliers == cast(FrameResult, expected.result).n_inliers
