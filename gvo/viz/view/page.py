"""The page of a recording that is tracked live."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import cv2
import numpy as np
import viser

from gvo.config import describe_configuration
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.trajectory.alignment import alignment, pair
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, ImageArray
from gvo.viz.scene import GLOBAL, Path
from gvo.viz.view import panels
from gvo.viz.view.controls import ParameterControls
from gvo.viz.view.drawing import Drawing
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.newest import FrameView, Newest
from gvo.viz.view.player import Player
from gvo.viz.view.server import ViewServer, open_server

FILE_NAME = "gvo.yaml"
"""Name under which the browser saves the configuration."""

_JPEG_QUALITY = 80
_START_SIGMAS = 10
# Size of the drawn camera and its height above the ground, as shares of the first median depth.
_CAMERA_SHARE = 0.15
_GROUND_SHARE = 0.15
_DEPTH_PER_BASELINE = 30.0
_VIEW_SHARE = 0.5
_PERIOD_S = 1.0 / 15.0  # shortest time between two drawings
_CLOUD_PERIOD_S = 1.0  # and between two clouds, which are large


def serve_player(
    player: Player | LivePlayer, *, host: str, port: int, truth: Trajectory | None, name: str
) -> ViewServer:
    """Serve a player's page, at its first frame or where it is; see `gvo.viz.view.serve`."""
    view = open_server(host, port, title=f"gvo {name or player.source.info.name}".strip())
    view.on_close(Page(view.viser, player, truth=truth).close)
    if isinstance(player, LivePlayer):
        player.is_watched = lambda: bool(view.viser.get_clients())
    elif player.newest.n_done == 0:
        player.step()
    return view


class Page:
    """Shows what a player does, and controls it."""

    def __init__(
        self, server: viser.ViserServer, player: Player | LivePlayer, *, truth: Trajectory | None
    ) -> None:
        self._server, self._player = server, player
        self._truth = truth if truth is not None and len(truth) > 0 else None
        self._absent = {"truth"} if truth is None else set()
        self._cloud_of: tuple[int, int] | None = None
        self._cloud_s = -math.inf  # when it was drawn
        self._placed_for: int | None = None
        self._refusal = ""
        self.drawing = Drawing(server.scene)
        self._add_frame_panel()
        self._add_main_panel()
        self._drawn: tuple[object, ...] = ()
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="gvo view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the threads of the page."""
        self._is_closed.set()
        self._thread.join()
        self.controls.close()

    def settle(self) -> None:
        """Wait until the last frame that the player showed is drawn."""
        while self._thread.is_alive() and self._drawn != self._shown():
            time.sleep(0.01)

    def _shown(self) -> tuple[object, ...]:
        """Return what the drawing depends on."""
        newest = self._player.newest
        return newest, newest.n_changes, self._sigmas.value

    def _work(self) -> None:
        """Draw the newest frame, at a limited rate; those between are left out."""
        while not self._is_closed.wait(_PERIOD_S):
            shown, newest = self._shown(), self._player.newest
            frame = newest.view()
            if shown != self._drawn and frame is not None:
                with self._server.atomic():
                    self._draw(frame, newest)
            elif frame is not None:
                self._draw_cloud(newest)
            self._show_state()
            self.controls.tick()
            self._drawn = shown

    def _draw(self, frame: FrameView, newest: Newest) -> None:
        self._place(frame, newest.first_index)
        self.numbers.content = panels.numbers_html(panels.frame_rows(frame, self._player.n_frames))
        self._overlay.image = _rgb(frame.overlay)
        self.drawing.show_camera(frame.T_world_frame, _rgb(frame.image))
        self.drawing.show_points(frame.cloud)
        self._draw_paths(frame)
        self.drawing.show_loops(frame.loops)
        if frame.scene is not None:
            self.drawing.show_scene(frame.scene, float(self._sigmas.value))
            self._draw_cloud(newest, every_s=_CLOUD_PERIOD_S)
        self._view.show_pose(frame.T_world_frame)

    def _add_frame_panel(self) -> None:
        gui = self._server.gui
        with panels.add_frame_panel(self._server):
            empty = np.full((90, 160, 3), 230, dtype=np.uint8)
            self._overlay = gui.add_image(empty, format="jpeg", jpeg_quality=_JPEG_QUALITY)
            self.message = gui.add_html(panels.message_html(""))  # in sight, whatever is unfolded
            self.numbers = gui.add_html(panels.numbers_html({"frame": "the first is coming"}))
            gui.add_html(panels.legend_html(self._absent))

    def _add_main_panel(self) -> None:
        gui = self._server.gui
        player = self._player
        self.playback = panels.Playback(gui, player, before=self.flush)
        self._view = panels.ViewPoint(self._server)
        gui.add_button(
            "save as YAML", hint="For gvo run --config; the browser saves the file"
        ).on_click(self._on_save)
        self._state = gui.add_html(panels.state_html(player_state(player)))
        self._sigmas = panels.add_scene_controls(gui, self.drawing, self._absent, _START_SIGMAS)
        with gui.add_folder("Parameters", expand_by_default=False):
            self.controls = ParameterControls(
                gui, player.config, apply=player.reconfigure, say=self._say
            )
        if isinstance(player, LivePlayer):
            player.parameters.follow(self.controls.follow)

    def flush(self) -> None:
        """Apply the parameters as they are shown."""
        self.controls.flush()

    def _say(self, refusal: str) -> None:
        self._refusal = refusal
        self._show_state()

    def _show_state(self) -> None:
        """Show what the player is doing, and what went wrong."""
        problems = [problem for problem in (self._refusal, self._player.fault) if problem]
        state = panels.state_html(player_state(self._player))
        message = panels.message_html("; ".join(problems))
        for shown, content in ((self._state, state), (self.message, message)):
            if shown.content != content:
                shown.content = content

    def _on_save(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self.save(event.client)

    def save(self, client: viser.ClientHandle) -> None:
        """Send the configuration to a browser as a file."""
        self.flush()
        content = describe_configuration(self.controls.config).encode()
        client.send_file_download(FILE_NAME, content, save_immediately=True)

    def _place(self, frame: FrameView, first_index: int) -> None:
        """Choose sizes and view by what the first frame sees."""
        if self._placed_for == first_index:
            return
        self._placed_for = first_index
        camera = self._player.source.info.camera
        depth = _depth_of(frame, camera)
        self.drawing.set_camera(camera, _CAMERA_SHARE * depth)
        ground = frame.T_world_frame[:3, 3] - _GROUND_SHARE * depth * panels.UP
        self.drawing.show_ground(ground, panels.grid_cell(0.1 * depth))
        self._view.look_along(frame.T_world_frame, _VIEW_SHARE * depth)

    def _draw_paths(self, frame: FrameView) -> None:
        for name, (_, poses) in frame.paths.items():
            if name != GLOBAL:  # it comes at the end of a run
                self.drawing.show_path(name, poses[:, :3])
        if self._truth is not None and "causal" in frame.paths:
            positions = truth_positions(self._truth, frame.paths["causal"])
            self.drawing.show_path("truth", positions)

    def _draw_cloud(self, newest: Newest, *, every_s: float = 0.0) -> None:
        """Draw the points of the keyframes where there are others than before."""
        keyframes = newest.history.keyframes
        cloud_of = newest.first_index, max(keyframes, default=0)
        now_s = time.monotonic()
        if cloud_of != self._cloud_of and now_s - self._cloud_s >= every_s:
            self._cloud_of, self._cloud_s = cloud_of, now_s
            self.drawing.show_cloud(newest.keyframe_cloud())


def player_state(player: Player | LivePlayer) -> str:
    """Return what a player is doing, in a word."""
    if player.is_playing:
        return "playing"
    if player.is_busy:
        return "working"
    return "at the end" if player.is_finished else "paused"


def _depth_of(frame: FrameView, camera: StereoCamera | PinholeCamera) -> float:
    """Return the median depth of what is seen, metres; a guess where nothing is."""
    points_cam, _ = frame.cloud
    if len(points_cam) > 0:
        return float(np.median(points_cam[:, 2]))
    return _DEPTH_PER_BASELINE * getattr(camera, "baseline", 0.05)


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
