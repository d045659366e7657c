"""The panels of the page: numbers, playback, layers, the view of the camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
import viser

from gvo._text import html_text
from gvo.trajectory.trajectory import format_stamp
from gvo.types import FloatArray
from gvo.viz.palette import DRAWN
from gvo.viz.scene import Scene, position_sigmas
from gvo.viz.view.drawing import LAYERS, Drawing
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.newest import FrameView
from gvo.viz.view.player import Player

MAIN_WIDTH_PX = 330
FRAME_WIDTH_PX = 430

UP: FloatArray = np.array([0.0, -1.0, 0.0])
"""Unit vector of the world that points up: it is the first camera."""

# The view that a browser reports is up to date so long after it was moved.
_REST_S = 1.0
_CELL = "padding:0 0.75em 0 0;text-align:left;vertical-align:top;font-weight:400"
_NUMBER = "font-variant-numeric:tabular-nums;overflow-wrap:anywhere;width:100%"
_MEANINGS = {
    "raw": "chain of frame-to-frame registrations",
    "causal": "pose when the frame arrived; the camera",
    "smoothed": "pose when the frame left the window",
    "truth": "ground truth (dashed)",
    "keyframes": "keyframes of the window",
    "step": "link to the frame before",
    "keyframe link": "link to a keyframe",
    "depth": "link by depth alone",
    "refused": "link that the window refused",
    "loops": "a place seen again",
    "ellipsoids": "position covariances",
}

SPEEDS: dict[str, float | None] = {f"{speed:g} x": speed for speed in (0.25, 0.5, 1.0, 2.0, 4.0)}
SPEEDS["fastest"] = None


def add_frame_panel(server: viser.ViserServer) -> Any:  # noqa: ANN401 - a tab of viser's
    """Return the tab of the panel beside the scene."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(MAIN_WIDTH_PX)
    panel = server.gui.add_panel()
    tab = panel.add_tab("frame")
    panel.dock_left()
    panel.set_width(FRAME_WIDTH_PX)
    return tab


def add_scene_controls(
    gui: viser.GuiApi, drawing: Drawing, without: Collection[str], n_sigmas: int
) -> Any:  # noqa: ANN401 - a slider of viser's
    """Add the size of the ellipsoids, which is returned, and a check box for each layer."""
    sigmas = gui.add_slider(
        "ellipsoid sigmas", 1, 100, 1, n_sigmas, hint="Half axes of the ellipsoids"
    )
    with gui.add_folder("Show", expand_by_default=False):
        for layer in LAYERS:
            if layer not in without:
                box = gui.add_checkbox(layer, True)
                box.on_update(
                    lambda event: drawing.set_visible(event.target.label, event.target.value)
                )
    return sigmas


def grid_cell(size_m: float) -> float:
    """Return the power of ten at or below a size, metres."""
    return float(10.0 ** np.floor(np.log10(size_m)))


class ViewPoint:
    """From where the scene is seen, in each browser.

    A browser reports its view late, by the time that drawing takes. While the view follows the
    camera, only direction and distance are taken from the report.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.follow = server.gui.add_checkbox(
            "follow camera", True, hint="Move the view with the camera"
        )
        self._last = np.zeros(3)
        # Relative to the camera: first position and target, and the target of each browser.
        self._start: tuple[FloatArray, FloatArray] | None = None
        self._offsets: dict[int, FloatArray] = {}
        self._moved_s = -np.inf
        server.on_client_connect(self._catch_up)

    def look_along(self, T_world_frame: FloatArray, distance_m: float) -> None:
        """Look from behind and above along the camera's axis, also in browsers that come later."""
        forward = T_world_frame[:3, 2] - UP * (T_world_frame[:3, 2] @ UP)
        norm = float(np.linalg.norm(forward))
        forward = forward / norm if norm > 1e-6 else T_world_frame[:3, 0]
        self._last = start = T_world_frame[:3, 3].copy()
        step = distance_m * forward
        self._look(start - step + 0.6 * distance_m * UP, start + step, distance_m)

    def _look(self, position: FloatArray, target: FloatArray, distance_m: float) -> None:
        initial = self._server.initial_camera
        initial.near, initial.far = 0.002 * distance_m, 1000.0 * distance_m
        initial.up = UP
        initial.position, initial.look_at = position, target
        self._start = position - self._last, target - self._last
        for number, client in self._server.get_clients().items():
            client.camera.near, client.camera.far = initial.near, initial.far
            client.camera.position, client.camera.look_at = position, target
            self._offsets[number] = self._start[1]
        self._moved_s = time.monotonic()

    def show_pose(self, T_world_frame: FloatArray) -> None:
        """Move the view with the camera, if it follows."""
        before, self._last = self._last, T_world_frame[:3, 3].copy()
        if not self.follow.value:
            return
        is_at_rest = time.monotonic() - self._moved_s > _REST_S
        self._moved_s = time.monotonic()
        for number, client in self._server.get_clients().items():
            if is_at_rest or number not in self._offsets:  # it may have been shifted by hand
                self._offsets[number] = client.camera.look_at - before
            target = self._last + self._offsets[number]
            position = target + client.camera.position - client.camera.look_at
            client.camera.position, client.camera.look_at = position, target

    def _catch_up(self, client: viser.ClientHandle) -> None:
        """Give a browser that connects later the first view, at the camera."""
        if self._start is not None and self.follow.value:
            # Its report may be older than the view that it was given.
            position, target = (self._last + offset for offset in self._start)
            self._offsets[client.client_id] = self._start[1]
            client.camera.position, client.camera.look_at = position, target


def numbers_html(rows: Mapping[str, str]) -> str:
    """Return a table of values by label; the cell of "name [unit]" is `[data-gvo="name"]`."""
    lines = "".join(
        f'<tr><th style="{_CELL};white-space:nowrap;opacity:0.65">{html_text(label)}</th>'
        f'<td style="{_CELL};{_NUMBER}" data-gvo="{html_text(label.partition(" [")[0])}">'
        f"{html_text(value)}</td></tr>"
        for label, value in rows.items()
    )
    return (
        '<table style="margin:0.3em 0.75em;font-size:0.85em;line-height:1.45;'
        f'border-collapse:collapse">{lines}</table>'
    )


def message_html(text: str) -> str:
    """Return one line that stands out; hidden without text."""
    colour = DRAWN["refused"]
    style = (
        f"margin:0 0.75em 0.5em;padding:0.3em 0.6em;font-size:0.85em;border-left:3px solid {colour}"
    )
    shown = style if text else "display:none"
    return f'<div role="status" data-gvo="message" style="{shown}">{html_text(text)}</div>'


def state_html(text: str) -> str:
    """Return what the player is doing."""
    return (
        '<div style="margin:0 0.75em 0.5em;font-size:0.85em;opacity:0.65" '
        f'data-gvo="player">{html_text(text)}</div>'
    )


def legend_html(without: Collection[str]) -> str:
    """Return the colours and their meanings."""
    entries = "".join(
        '<div style="display:flex;align-items:center;gap:0.6em">'
        f'<span style="flex:none;width:1.4em;border-top:3px {_line(name)} {DRAWN[name]}"></span>'
        f"<span><b>{name}</b> {html_text(meaning)}</span></div>"
        for name, meaning in _MEANINGS.items()
        if name not in without
    )
    return (
        '<div data-gvo="legend" style="margin:0.3em 0.75em 0.6em;font-size:0.8em;'
        f'line-height:1.5">{entries}</div>'
    )


def _line(name: str) -> str:
    return "dashed" if name == "truth" else "solid"


def frame_rows(frame: FrameView, n_frames: int) -> dict[str, str]:
    """Return the numbers of a frame, value by label."""
    status = "skipped" if frame.result is None else str(frame.result.status)
    rows = {
        "frame": f"{frame.index} of {n_frames}",
        "stamp [s]": format_stamp(frame.stamp_ns),
        "status": status,
    }
    if frame.reason:
        rows["reason"] = frame.reason
    return rows if frame.scene is None else rows | _scene_rows(frame.scene)


def _scene_rows(scene: Scene) -> dict[str, str]:
    counts, estimate = scene.counts, scene.poses["causal"]
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in scene.stage_ms.items())
    turn_deg = np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))
    refused = f" ({counts['refused']} refused)" if counts["refused"] else ""
    return {
        **{name: f"{counts[name]}" for name in ("keypoints", "matches", "inliers")},
        "links": f"{counts['links']}{refused}",
        "keyframes": f"{counts['keyframes']}",
        "ms": f"{sum(scene.stage_ms.values()):.1f} ({stages})",
        "position [m]": ", ".join(f"{value:.3f}" for value in estimate.T_world_frame[:3, 3]),
        "sigma [m]": ", ".join(f"{value:.4f}" for value in position_sigmas(estimate)),
        "turn sigma [deg]": f"{turn_deg:.3f}",
    }


class Playback:
    """Buttons, keys and speed of a player; of a running camera only whether its frames are shown.

    `before` is called before each command, so that changes until then count.
    """

    def __init__(
        self, gui: viser.GuiApi, player: Player | LivePlayer, *, before: Callable[[], None]
    ) -> None:
        self._player, self._before = player, before
        is_live = isinstance(player, LivePlayer)
        names = ("play", "pause") if is_live else ("play", "pause", "step")
        buttons = gui.add_button_group("picture" if is_live else "recording", names)
        buttons.on_click(lambda event: self.press(event.target.value))
        gui.add_command("play or pause", hotkey="P").on_trigger(lambda _: self.toggle())
        if not isinstance(player, LivePlayer):
            self._add_speed(gui, player)
            self._add_restart(gui, player)
            gui.add_command("step", hotkey="N").on_trigger(lambda _: self.press("step"))

    def _add_speed(self, gui: viser.GuiApi, player: Player) -> None:
        self.speed: Any = gui.add_dropdown(
            "speed", tuple(SPEEDS), initial_value="1 x", hint="1 x: as fast as it was recorded"
        )
        self.speed.on_update(lambda _: player.set_speed(SPEEDS[self.speed.value]))

    def _add_restart(self, gui: viser.GuiApi, player: Player) -> None:
        last = max(1, player.n_frames - 1)
        self.start: Any = gui.add_slider("first frame", 0, last, 1, 0, hint="Where to restart")
        gui.add_button(
            "restart", hint="Begin anew at the first frame, with the parameters as they are"
        ).on_click(lambda _: self.restart())

    def press(self, name: str) -> None:
        """Do what a button does."""
        self._before()
        getattr(self._player, name)()

    def toggle(self) -> None:
        """Play, or pause where it plays."""
        self.press("pause" if self._player.is_playing else "play")

    def restart(self) -> None:
        """Begin anew at the frame that is chosen."""
        self._before()
        if not isinstance(self._player, LivePlayer):
            self._player.restart(int(self.start.value))
