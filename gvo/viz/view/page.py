"""The page of a recording that is tracked, or of a running camera."""

from __future__ import annotations

import math
import threading
import time
from contextlib import AbstractContextManager
from typing import Any

import cv2
import numpy as np
import viser

from gvo.config import describe_configuration
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.alignment import alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, ImageArray
from gvo.viz.pages import part
from gvo.viz.palette import DRAWN
from gvo.viz.scene import GLOBAL, Path
from gvo.viz.view.controls import ParameterControls
from gvo.viz.view.drawing import LAYERS, Drawing
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.newest import FrameView, Newest
from gvo.viz.view.panels import frame_rows
from gvo.viz.view.player import Player
from gvo.viz.view.server import open_server, silence
from gvo.viz.view.viewpoint import UP, ViewPoint

FILE_NAME = "gvo.yaml"
"""Name under which the browser saves the configuration."""

_MAIN_WIDTH_PX, _FRAME_WIDTH_PX = 330, 430
_SPEEDS: dict[str, float | None] = {f"{speed:g} x": speed for speed in (0.25, 0.5, 1.0, 2.0, 4.0)}
_SPEEDS["fastest"] = None
# Size of the drawn camera and its height above the ground, as shares of the first median depth.
_CAMERA_SHARE = 0.15
_GROUND_SHARE = 0.15
_DEPTH_PER_BASELINE = 30.0
_VIEW_SHARE = 0.5
_PERIOD_S = 1.0 / 15.0  # shortest time between two drawings
_CLOUD_PERIOD_S = 1.0  # and between two clouds, which are large


class Page(AbstractContextManager["Page"]):
    """A page that is served until it is closed: shows what a player does, and controls it.

    Attributes
    ----------
    note : str
        One line where another port than the one asked for is used, else empty.
    server : viser.ViserServer
    """

    def __init__(
        self,
        player: Player | LivePlayer,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        truth: Trajectory | None = None,
    ) -> None:
        self._player = player
        self._truth = truth if truth is not None and len(truth) > 0 else None
        self._absent = {"truth"} if truth is None else set()
        self._refusal = ""
        title = f"gvo {player.source.info.name}"
        self.server = server = open_server(host, port, title=title)
        free = server.get_port()
        self.note = ""
        if port not in (0, free):
            self.note = f"port {port} of {host} is taken: serving on {free}"
        self.drawing = Drawing(server.scene)
        self._add_frame_panel()
        self._add_main_panel()
        self._placed_for: int | None = None
        self._drawn: tuple[object, ...] = ()
        self._cloud_of: tuple[int, int] | None = None
        self._cloud_s = -math.inf  # when it was drawn
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="gvo view", daemon=True)
        self._thread.start()
        if isinstance(player, LivePlayer):
            player.is_watched = lambda: bool(server.get_clients())
            player.parameters.follow(self.controls.follow)
        elif player.newest.n_done == 0:
            player.step()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        shown = "localhost" if host in ("0.0.0.0", "::") else host  # noqa: S104 - only shown
        return f"http://{shown}:{self.server.get_port()}"

    def play_when_opened(self) -> None:
        """Have the recording play as soon as the first browser opens the page."""

        def play(_: viser.ClientHandle) -> None:
            if not self._player.is_playing and self._player.newest.n_done <= 1:
                self._player.play()

        self.server.on_client_connect(play)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the page is closed; return whether it is."""
        return self._is_closed.wait(timeout_s)

    def close(self) -> None:
        """Stop serving; again: nothing."""
        if self._is_closed.is_set():
            return
        self._is_closed.set()
        self._thread.join()
        self.controls.close()
        with silence():
            self.server.stop()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def settle(self) -> None:
        """Wait until the last frame that the player showed is drawn."""
        while self._thread.is_alive() and self._drawn != self._shown():
            time.sleep(0.01)

    # Panels

    def _add_frame_panel(self) -> None:
        gui = self.server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_MAIN_WIDTH_PX)
        panel = gui.add_panel()
        tab = panel.add_tab("frame")
        panel.dock_left()
        panel.set_width(_FRAME_WIDTH_PX)
        with tab:
            empty = np.full((90, 160, 3), 230, dtype=np.uint8)
            self._overlay = gui.add_image(empty, format="jpeg", jpeg_quality=80)
            self.state = gui.add_html(part("state", "", "", DRAWN))
            self.numbers = gui.add_html(part("numbers", {"frame": "the first is coming"}))
            gui.add_html(part("legend", DRAWN, self._absent))

    def _add_main_panel(self) -> None:
        gui = self.server.gui
        self._add_playback(gui)
        self._view = ViewPoint(self.server, self.drawing.world)
        save = gui.add_button("save as YAML", hint="For gvo run --config; the browser saves it")
        save.on_click(self._on_save)
        self._sigmas = gui.add_slider(
            "ellipsoid sigmas", 1, 100, 1, 10, hint="Half axes of the ellipsoids"
        )
        with gui.add_folder("Show", expand_by_default=False):
            for layer in LAYERS:
                if layer not in self._absent:
                    gui.add_checkbox(layer, True).on_update(self._show_or_hide)
        with gui.add_folder("Parameters", expand_by_default=False):
            player = self._player
            self.controls = ParameterControls(
                gui, player.config, apply=player.reconfigure, say=self._say
            )

    def _add_playback(self, gui: viser.GuiApi) -> None:
        """Add buttons, keys and speed; of a running camera only whether its frames are shown."""
        player = self._player
        is_live = isinstance(player, LivePlayer)
        names = ("play", "pause") if is_live else ("play", "pause", "step")
        buttons = gui.add_button_group("picture" if is_live else "recording", names)
        buttons.on_click(lambda event: self.press(event.target.value))
        gui.add_command("play or pause", hotkey="P").on_trigger(
            lambda _: self.press("pause" if player.is_playing else "play")
        )
        if isinstance(player, LivePlayer):
            return
        gui.add_command("step", hotkey="N").on_trigger(lambda _: self.press("step"))
        self.speed: Any = gui.add_dropdown(
            "speed", tuple(_SPEEDS), initial_value="1 x", hint="1 x: as fast as it was recorded"
        )
        self.speed.on_update(lambda _: player.set_speed(_SPEEDS[self.speed.value]))
        last = max(1, player.n_frames - 1)
        self.start: Any = gui.add_slider("first frame", 0, last, 1, 0, hint="Where to restart")
        restart = gui.add_button(
            "restart", hint="Begin anew at the first frame, with the parameters as they are"
        )
        restart.on_click(lambda _: self.press("restart", int(self.start.value)))

    def press(self, name: str, *arguments: int) -> None:
        """Have the player play, pause, step or restart, with the parameters as they are shown."""
        self.controls.flush()
        getattr(self._player, name)(*arguments)

    def _on_save(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self.save(event.client)

    def save(self, client: viser.ClientHandle) -> None:
        """Send the configuration to a browser as a file."""
        self.controls.flush()
        content = describe_configuration(self.controls.config).encode()
        client.send_file_download(FILE_NAME, content, save_immediately=True)

    def _show_or_hide(self, event: viser.GuiEvent[Any]) -> None:
        self.drawing.set_visible(event.target.label, event.target.value)

    def _say(self, refusal: str) -> None:
        self._refusal = refusal
        self._show_state()

    def _show_state(self) -> None:
        """Show what the player is doing, and what went wrong."""
        problems = [problem for problem in (self._refusal, self._player.fault) if problem]
        content = part("state", _state_of(self._player), "; ".join(problems), DRAWN)
        if self.state.content != content:
            self.state.content = content

    # On the thread of the page

    def _shown(self) -> tuple[object, ...]:
        """Return what the drawing depends on."""
        newest = self._player.newest
        return newest, newest.n_changes, self._sigmas.value

    def _work(self) -> None:
        """Draw the newest frame, at a limited rate; those between are left out."""
        due_s = 0.0
        while not self._is_closed.wait(_PERIOD_S):
            start_s, newest = time.monotonic(), self._player.newest
            if newest.is_due:
                self._draw_newest(newest)
                end_s = time.monotonic()
                rest_s = self._player.rest_s(end_s - start_s)
                newest.is_due, due_s = rest_s == 0.0, end_s + rest_s
            elif start_s >= due_s:
                newest.is_due = True  # the next frame comes with the poses of the window
            self._show_state()
            self.controls.tick()

    def _draw_newest(self, newest: Newest) -> None:
        shown = self._shown()
        if shown != self._drawn and (frame := newest.view()) is not None:
            with self.server.atomic():
                self._draw(frame, newest)
        self._draw_cloud(newest)
        self._drawn = shown

    def _draw(self, frame: FrameView, newest: Newest) -> None:
        if self._placed_for != newest.first_index:
            self._placed_for = newest.first_index
            self._place(frame)
        self.numbers.content = part("numbers", frame_rows(frame, self._player.n_frames))
        self._overlay.image = _rgb(frame.overlay)
        self.drawing.show_camera(frame.T_world_frame, _rgb(frame.image))
        self.drawing.show_points(frame.cloud)
        self._draw_paths(frame)
        self.drawing.show_loops(frame.loops)
        if frame.scene is not None:
            self.drawing.show_scene(frame.scene, float(self._sigmas.value))
        self._view.show_pose(frame.T_world_frame)

    def _place(self, frame: FrameView) -> None:
        """Choose sizes and view by what the first frame sees."""
        camera = self._player.source.info.camera
        points_cam, _ = frame.cloud
        if len(points_cam) > 0:
            depth = float(np.median(points_cam[:, 2]))
        else:
            depth = _DEPTH_PER_BASELINE * getattr(camera, "baseline", 0.05)
        self.drawing.set_camera(camera, _CAMERA_SHARE * depth)
        ground = frame.T_world_frame[:3, 3] - _GROUND_SHARE * depth * UP
        self.drawing.show_ground(ground, cell_m=10.0 ** math.floor(math.log10(0.1 * depth)))
        self._view.look_along(_VIEW_SHARE * depth)

    def _draw_paths(self, frame: FrameView) -> None:
        for name, (_, poses) in frame.paths.items():
            if name != GLOBAL:  # it comes at the end of a run
                self.drawing.show_path(name, poses[:, :3])
        if self._truth is not None and "causal" in frame.paths:
            positions = truth_positions(self._truth, frame.paths["causal"])
            self.drawing.show_path("truth", positions)

    def _draw_cloud(self, newest: Newest) -> None:
        """Draw the points of the keyframes, where there are others than before."""
        cloud_of = newest.first_index, max(newest.history.keyframes, default=0)
        now_s = time.monotonic()
        if cloud_of != self._cloud_of and now_s - self._cloud_s >= _CLOUD_PERIOD_S:
            self._cloud_of, self._cloud_s = cloud_of, now_s
            self.drawing.show_cloud(newest.keyframe_cloud())


def _state_of(player: Player | LivePlayer) -> str:
    """Return what a player is doing, in a word."""
    if player.is_playing:
        return "playing"
    if player.is_busy:
        return "working"
    return "at the end" if player.is_finished else "paused"


def _rgb(image: ImageArray) -> ImageArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def truth_positions(truth: Trajectory, path: Path) -> FloatArray:
    """Return the truth (m, 3) along a path that starts at the origin of its world, metres.

    With a rotation at the first frame it starts there too, so that drift shows; else all positions
    are fitted by a rigid motion.
    """
    stamps_ns, poses = path
    if truth.has_rotations and truth.stamps_ns[0] <= stamps_ns[0] <= truth.stamps_ns[-1]:
        T_truth_first = truth.interpolate(stamps_ns[:1]).T_world_frame[0]
        moved = truth.moved(se3.invert(T_truth_first))
    else:
        try:
            true, paired = pair(truth, Trajectory.of_positions(stamps_ns, poses[:, :3]))
        except TrajectoryError:
            return np.zeros((0, 3))
        moved = alignment(paired, true, "se3").apply(truth)
    is_in = (moved.stamps_ns >= stamps_ns[0]) & (moved.stamps_ns <= stamps_ns[-1])
    return np.asarray(moved.positions[is_in])
