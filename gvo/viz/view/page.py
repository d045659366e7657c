"""The page of a recording that is tracked live."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import viser

from gvo.config import describe_configuration
from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.trajectory.alignment import alignment, associate
from gvo.trajectory.trajectory import Trajectory
from gvo.types import FloatArray, ImageArray, IntArray
from gvo.viz.view import panels
from gvo.viz.view.controls import ParameterControls
from gvo.viz.view.history import FrameView
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.player import Player
from gvo.viz.view.scene import COLOURS, Scene
from gvo.viz.view.server import ViewServer, open_server

FILE_NAME = "gvo.yaml"
"""Name under which the browser saves the configuration."""

_JPEG_QUALITY = 80
_START_SIGMAS = 10
# Size of the drawn camera and its height above the ground, by the median depth at first.
_CAMERA_SHARE = 0.15
_GROUND_SHARE = 0.15
_DEPTH_PER_BASELINE = 30.0
_VIEW_SHARE = 0.5
_NOTHING = np.zeros((0, 3))


def serve_player(
    player: Player | LivePlayer, *, host: str, port: int, truth: Trajectory | None, name: str
) -> ViewServer:
    """Serve a player's page, at its first frame or where it is; see `gvo.viz.view.serve`."""
    view = open_server(host, port, title=f"gvo {name or player.source.info.name}".strip())
    view.on_close(Page(view.viser, player, truth=truth).close)
    if isinstance(player, LivePlayer):
        player.is_watched = lambda: bool(view.viser.get_clients())
    elif player.frame_view is None:
        player.seek(player.first_index)
    return view


class Page:
    """Shows what a player does, and controls it.

    Parameters
    ----------
    server : viser.ViserServer
    player : Player or LivePlayer
    truth : Trajectory or None
        Of the camera, in any world.
    """

    def __init__(
        self, server: viser.ViserServer, player: Player | LivePlayer, *, truth: Trajectory | None
    ) -> None:
        self._server, self._player = server, player
        self._truth = None if truth is None else TruthPath(truth)
        # Refused loops and global poses come at the end of a run.
        self._absent = {"global", "refused loops"} | ({"truth"} if truth is None else set())
        self._shown_cloud: tuple[int, int] | None = None
        self._placed_for: int | None = None
        self._refusal = ""
        self.scene = Scene(server.scene)
        self._add_frame_panel()
        self._add_main_panel()
        self._painter = panels.Painter(self._draw_newest, idle=self._show_state)
        self._unsubscribe = player.subscribe(lambda frame: self._painter.offer())
        if player.frame_view is not None:
            self._painter.offer()

    def close(self) -> None:
        """Unsubscribe from the player and end the threads of the page."""
        self._unsubscribe()
        self._painter.close()
        self.controls.close()

    def settle(self) -> None:
        """Wait until the last frame that the player showed is drawn."""
        self._painter.settle()

    def draw(self, frame: FrameView) -> None:
        """Draw a frame, and what was known with it."""
        with self._server.atomic():
            self._place(frame)
            self.playback.show(frame.index)
            self.numbers.content = panels.numbers_html(self._rows(frame))
            self._show_state()
            self._overlay.image = _rgb(frame.overlay)
            self.scene.show_image(_rgb(frame.image))
            self.scene.show_points(*frame.cloud)
            self.scene.show_pose(frame.T_world_frame)
            self._draw_paths()
            self._draw_window(frame)
            self._view.show_pose(frame.T_world_frame)

    def _draw_newest(self) -> None:
        frame = self._player.frame_view
        if frame is not None:
            self.draw(frame)

    def _add_frame_panel(self) -> None:
        gui = self._server.gui
        with panels.add_frame_panel(self._server):
            empty = np.full((90, 160, 3), 230, dtype=np.uint8)
            self._overlay = gui.add_image(empty, format="jpeg", jpeg_quality=_JPEG_QUALITY)
            self.message = gui.add_html(panels.message_html(""))  # in sight, whatever is unfolded
            self.numbers = gui.add_html(panels.numbers_html({"frame": "the first is coming"}))
            hidden = {*self._absent}
            gui.add_html(panels.legend_html(name for name in COLOURS if name not in hidden))

    def _add_main_panel(self) -> None:
        gui = self._server.gui
        player = self._player
        if isinstance(player, LivePlayer):
            self.playback: Any = panels.PauseButtons(gui, player, before=self.flush)
        else:
            self.playback = panels.Playback(gui, player, before=self.flush)
        self._view = panels.ViewPoint(self._server, "-y", is_following=True)
        if not isinstance(player, LivePlayer):
            gui.add_button(
                "restart from here",
                hint="Begin anew at this frame, with the parameters as they are",
            ).on_click(lambda _: self._restart(player))
        gui.add_button(
            "save as YAML", hint="For gvo run --config; the browser saves the file"
        ).on_click(self._on_save)
        self._state = gui.add_html(panels.state_html(player_state(self._player)))
        self._sigmas = panels.add_scene_controls(gui, self.scene, self._absent, _START_SIGMAS)
        self._sigmas.on_update(lambda _: self._painter.offer())
        with gui.add_folder("Parameters", expand_by_default=False):
            self.controls = ParameterControls(
                gui, self._player.config, apply=self._player.reconfigure, say=self._say
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
        self._state.content = panels.state_html(player_state(self._player))
        problems = [problem for problem in (self._refusal, self._player.fault) if problem]
        self.message.content = panels.message_html("; ".join(problems))

    def _restart(self, player: Player) -> None:
        self.flush()
        player.restart()

    def _on_save(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self.save(event.client)

    def save(self, client: viser.ClientHandle) -> None:
        """Send the configuration to a browser as a file."""
        self.flush()
        content = describe_configuration(self.controls.config).encode()
        client.send_file_download(FILE_NAME, content, save_immediately=True)

    def _rows(self, frame: FrameView) -> dict[str, str]:
        status = frame.status or "skipped"
        rows = panels.frame_rows(frame.index, self._player.n_frames, frame.stamp_ns, status)
        if frame.reason:
            rows["reason"] = frame.reason
        return rows if frame.result is None else rows | panels.result_rows(frame.result)

    def _place(self, frame: FrameView) -> None:
        """Choose sizes and view by what the first frame sees."""
        if self._placed_for == self._player.first_index:
            return
        self._placed_for = self._player.first_index
        camera = self._player.source.info.camera
        depth = _depth_of(frame, camera)
        self.scene.set_camera(camera.width, camera.height, camera.fy, size_m=_CAMERA_SHARE * depth)
        ground = frame.T_world_frame[:3, 3] - _GROUND_SHARE * depth * panels.UP["-y"]
        self.scene.show_ground(ground, panels.grid_cell(0.1 * depth))
        self._view.look_along(frame.T_world_frame, _VIEW_SHARE * depth)

    def _draw_paths(self) -> None:
        paths = {name: self._player.history.path(name) for name in ("raw", "causal", "smoothed")}
        for name, (_, positions) in paths.items():
            self.scene.show_path(name, positions)
        if self._truth is not None:
            self.scene.show_path("truth", self._truth.until(*paths["causal"]))

    def _draw_window(self, frame: FrameView) -> None:
        poses = frame.window_poses
        keyframes = [poses[stamp] for stamp in frame.keyframes if stamp in poses]
        self.scene.show_keyframes(np.array(keyframes).reshape(-1, 4, 4))
        self.scene.show_links({**_link_lines(frame), "loops": self._player.history.loop_lines()})
        stamps = [stamp for stamp in frame.window_covariances if stamp in poses]
        self.scene.show_ellipsoids(
            np.array([poses[stamp] for stamp in stamps]).reshape(-1, 4, 4),
            np.array([frame.window_covariances[stamp] for stamp in stamps]).reshape(-1, 6, 6),
            float(self._sigmas.value),
        )
        # The accumulated points change with keyframes alone.
        newest = frame.keyframes[-1] if frame.keyframes else 0
        if self._shown_cloud != (newest, self._player.first_index):
            self._shown_cloud = (newest, self._player.first_index)
            self.scene.show_cloud(*self._player.history.accumulated_cloud())


def player_state(player: Player | LivePlayer) -> str:
    """Return what a player is doing, in a word."""
    if player.is_playing:
        return "playing"
    if player.is_busy:
        return "working"
    is_last = player.is_finished and player.index + 1 >= player.n_done
    return "at the end" if is_last else "paused"


def _depth_of(frame: FrameView, camera: StereoCamera | PinholeCamera) -> float:
    """Return the median depth of what is seen, metres; a guess where nothing is."""
    points_cam, _ = frame.cloud
    if len(points_cam) > 0:
        return float(np.median(points_cam[:, 2]))
    return _DEPTH_PER_BASELINE * getattr(camera, "baseline", 0.05)


def _link_lines(frame: FrameView) -> dict[str, FloatArray]:
    """Return the frame's links as lines (n, 2, 3), by how they are drawn."""
    lines: dict[str, list[FloatArray]] = {}
    for link in frame.links:
        if link.reference_ns in frame.window_poses:
            start = frame.window_poses[link.reference_ns][:3, 3]
            name = "keyframe link" if link.kind == "keyframe" else link.kind
            ends = np.stack([start, frame.T_world_frame[:3, 3]])
            lines.setdefault(name if link.is_accepted else "refused", []).append(ends)
    return {name: np.stack(ends) for name, ends in lines.items()}


def _rgb(image: ImageArray) -> ImageArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


class TruthPath:
    """Aligns the truth with a growing estimate.

    Where the truth has a rotation at the first frame, the first poses are aligned, so that drift
    shows; else all positions are, by a rigid motion.

    Parameters
    ----------
    truth : Trajectory
        In any world, stamped by the estimate's clock.
    """

    def __init__(self, truth: Trajectory) -> None:
        self._truth = truth
        self._first_ns: int | None = None
        self._moved: Trajectory | None = None

    def until(self, stamps_ns: IntArray, positions_world: FloatArray) -> FloatArray:
        """Return the truth's positions (m, 3) between the first and last stamp, metres.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (n,)
            Of the estimate; its first frame is the world.
        positions_world : ndarray of float64, shape (n, 3)
            Metres.
        """
        if len(stamps_ns) == 0:
            return _NOTHING
        if self._first_ns != int(stamps_ns[0]):
            self._first_ns = int(stamps_ns[0])
            self._moved = self._aligned_at_first(stamps_ns[:1])
        moved = self._moved or self._fitted(stamps_ns, positions_world)
        if moved is None:
            return _NOTHING
        is_in = (moved.stamps_ns >= stamps_ns[0]) & (moved.stamps_ns <= stamps_ns[-1])
        return np.asarray(moved.positions[is_in])

    def _aligned_at_first(self, first_ns: IntArray) -> Trajectory | None:
        stamps_ns = self._truth.stamps_ns
        if not self._truth.has_rotations or len(stamps_ns) == 0:
            return None
        if not stamps_ns[0] <= first_ns[0] <= stamps_ns[-1]:
            return None
        T_truth_first = self._truth.interpolate(first_ns).T_world_frame[0]
        return self._truth.moved(se3.invert(T_truth_first))

    def _fitted(self, stamps_ns: IntArray, positions_world: FloatArray) -> Trajectory | None:
        estimate = Trajectory.of_positions(stamps_ns, positions_world)
        try:
            rows_truth, rows = associate(self._truth, estimate)
        except TrajectoryError:
            return None
        fit = alignment(estimate.select(rows), self._truth.select(rows_truth), "se3")
        return fit.apply(self._truth)
