"""What both pages have: panels, numbers, playback, layers, the view of the camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
import viser

from gvo._text import html_text
from gvo.trajectory.trajectory import format_stamp
from gvo.types import FloatArray, FrameResult
from gvo.viz.view.live import LivePlayer
from gvo.viz.view.player import Player, RunPlayer
from gvo.viz.view.scene import COLOURS, LAYERS, Scene, Up, position_sigmas

Playable: TypeAlias = Player | RunPlayer
"""What goes to any of its frames, at any speed."""

MAIN_WIDTH_PX = 330
FRAME_WIDTH_PX = 430

UP: dict[Up, FloatArray] = {"-y": np.array([0.0, -1.0, 0.0]), "+z": np.array([0.0, 0.0, 1.0])}
"""Unit vectors of the world that point up."""

# The view that a browser reports is up to date so long after it was moved.
_REST_S = 1.0
_CELL = "padding:0 0.75em 0 0;text-align:left;vertical-align:top;font-weight:400"
_NUMBER = "font-variant-numeric:tabular-nums;overflow-wrap:anywhere;width:100%"
_MEANINGS = {
    "raw": "chain of frame-to-frame registrations",
    "causal": "pose when the frame arrived; the camera",
    "smoothed": "pose when the frame left the window",
    "global": "optimum of all that was measured, loops closed",
    "truth": "ground truth (dashed)",
    "keyframes": "keyframes of the window",
    "step": "link to the frame before",
    "keyframe link": "link to a keyframe",
    "depth": "link by depth alone",
    "refused": "link that the window refused",
    "loops": "a place seen again",
    "refused loops": "a place that is none, or another one",
    "ellipsoids": "position covariances",
}

SPEEDS: dict[str, float | None] = {f"{speed:g} x": speed for speed in (0.25, 0.5, 1.0, 2.0, 4.0)}
SPEEDS["fastest"] = None

_PERIOD_S = 1.0 / 15.0  # at least, from drawing to drawing
_IDLE_S = 0.25


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
    gui: viser.GuiApi, scene: Scene, without: Collection[str], n_sigmas: int
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
                    lambda event: scene.set_visible(event.target.label, event.target.value)
                )
    return sigmas


def grid_cell(size_m: float) -> float:
    """Return the power of ten at or below a size, metres."""
    return float(10.0 ** np.floor(np.log10(size_m)))


class ViewPoint:
    """From where the scene is seen, in each browser.

    A browser reports its view late, by the time that drawing takes. While the view follows the
    camera, only direction and distance are taken from the report.

    Parameters
    ----------
    server : viser.ViserServer
    up : {"-y", "+z"}
        Which axis of the world points up.
    is_following : bool
        Whether the view moves with the camera at first.
    """

    def __init__(self, server: viser.ViserServer, up: Up, *, is_following: bool) -> None:
        self._server = server
        self._up = UP[up]
        self.follow = server.gui.add_checkbox(
            "follow camera", is_following, hint="Move the view with the camera"
        )
        self._last = np.zeros(3)
        # Relative to the camera: first position and target, and the target of each browser.
        self._start: tuple[FloatArray, FloatArray] | None = None
        self._offsets: dict[int, FloatArray] = {}
        self._moved_s = -np.inf
        server.on_client_connect(self._catch_up)

    def look_along(self, T_world_frame: FloatArray, distance_m: float) -> None:
        """Look from behind and above along the camera's axis, also in browsers that come later.

        Parameters
        ----------
        T_world_frame : ndarray of float64, shape (4, 4)
            Pose of the camera, metres.
        distance_m : float
            From the camera.
        """
        forward = T_world_frame[:3, 2] - self._up * (T_world_frame[:3, 2] @ self._up)
        norm = float(np.linalg.norm(forward))
        forward = forward / norm if norm > 1e-6 else T_world_frame[:3, 0]
        self._last = start = T_world_frame[:3, 3].copy()
        step = distance_m * forward
        self.look(start - step + 0.6 * distance_m * self._up, start + step, distance_m)

    def look_down(self, positions_world: FloatArray) -> None:
        """Look from above and aside at all positions, shape (n, 3), metres."""
        lowest, highest = positions_world.min(axis=0), positions_world.max(axis=0)
        center = 0.5 * (lowest + highest)
        reach = max(0.1, float(np.linalg.norm(highest - lowest)))
        aside = np.roll(self._up, 1)
        self.look(center + reach * (0.9 * self._up - 0.5 * np.abs(aside)), center, reach)

    def look(self, position: FloatArray, target: FloatArray, distance_m: float) -> None:
        """Look from a position at a target, both of shape (3,), metres, in the world."""
        initial = self._server.initial_camera
        initial.near, initial.far = 0.002 * distance_m, 1000.0 * distance_m
        initial.up = self._up
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
    """Return a table; the cell of a name is found as `[data-gvo="name"]`.

    Parameters
    ----------
    rows : mapping of str to str
        Value by label; a unit in brackets is not part of the name.
    """
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
    colour = COLOURS["refused"]
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


def legend_html(names: Iterable[str]) -> str:
    """Return the colours and their meanings."""
    entries = "".join(
        '<div style="display:flex;align-items:center;gap:0.6em">'
        f'<span style="flex:none;width:1.4em;border-top:3px {_line(name)} {COLOURS[name]}"></span>'
        f"<span><b>{name}</b> {html_text(_MEANINGS[name])}</span></div>"
        for name in names
    )
    return (
        '<div data-gvo="legend" style="margin:0.3em 0.75em 0.6em;font-size:0.8em;'
        f'line-height:1.5">{entries}</div>'
    )


def _line(name: str) -> str:
    return "dashed" if name == "truth" else "solid"


def result_rows(result: FrameResult) -> dict[str, str]:
    """Return the numbers of a frame, value by label."""
    total = sum(result.stage_ms.values())
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in result.stage_ms.items())
    estimate = result.causal
    refused = sum(not link.is_accepted for link in result.links)
    return {
        "keypoints": f"{result.n_keypoints}",
        "matches": f"{result.n_matches}",
        "inliers": f"{result.n_inliers}",
        "links": f"{result.n_links}" + (f" ({refused} refused)" if refused else ""),
        "keyframes": f"{len(result.keyframes_ns)}",
        "ms": f"{total:.1f} ({stages})",
        **pose_rows(estimate.T_world_frame, estimate.covariance),
    }


def pose_rows(T_world_frame: FloatArray, covariance: FloatArray | None) -> dict[str, str]:
    """Return position and standard deviations, value by label."""
    rows = {"position [m]": ", ".join(f"{value:.3f}" for value in T_world_frame[:3, 3])}
    if covariance is not None:
        sigmas = position_sigmas(T_world_frame, covariance)
        turn = np.degrees(np.sqrt(np.trace(covariance[:3, :3])))
        rows["sigma [m]"] = ", ".join(f"{value:.4f}" for value in sigmas)
        rows["turn sigma [deg]"] = f"{turn:.3f}"
    return rows


def frame_rows(index: int, n_frames: int, stamp_ns: int, status: str) -> dict[str, str]:
    """Return which frame it is, value by label."""
    return {
        "frame": f"{index} of {n_frames}",
        "stamp [s]": format_stamp(stamp_ns),
        "status": status,
    }


class PauseButtons:
    """Buttons and a key for what goes on by itself.

    Parameters
    ----------
    gui : viser.GuiApi
        Where they are added.
    playable : Player, RunPlayer or LivePlayer
    before : callable
        Called before each command, so that changes until then count.
    """

    _LABEL = "picture"
    _NAMES: tuple[str, ...] = ("play", "pause")

    def __init__(
        self, gui: viser.GuiApi, playable: Playable | LivePlayer, *, before: Callable[[], None]
    ) -> None:
        self._shown, self._before = playable, before
        buttons = gui.add_button_group(self._LABEL, self._NAMES)
        buttons.on_click(lambda event: self.press(event.target.value))
        gui.add_command("play or pause", hotkey="P").on_trigger(lambda _: self.toggle())

    def press(self, name: str) -> None:
        """Do what a button does."""
        self._before()
        getattr(self._shown, name)()

    def toggle(self) -> None:
        """Play, or pause where it plays."""
        self.press("pause" if self._shown.is_playing else "play")

    def show(self, index: int) -> None:
        """Take the number of the frame that is shown."""


class Playback(PauseButtons):
    """Buttons, keys, slider and speed of what can be played.

    Parameters
    ----------
    gui, playable, before
        As of `PauseButtons`.
    """

    _LABEL = "recording"
    _NAMES = ("play", "pause", "step")

    def __init__(
        self, gui: viser.GuiApi, playable: Playable, *, before: Callable[[], None]
    ) -> None:
        super().__init__(gui, playable, before=before)
        self._playable = playable
        last = max(1, playable.n_frames - 1)
        self.frame: Any = gui.add_slider("frame", 0, last, 1, 0, hint="Frame that is shown")
        self.speed: Any = gui.add_dropdown(
            "speed", tuple(SPEEDS), initial_value="1 x", hint="1 x: as fast as it was recorded"
        )
        self.frame.on_update(self.on_seek)
        self.speed.on_update(self.on_speed)
        gui.add_command("step", hotkey="N").on_trigger(lambda _: self.press("step"))

    def show(self, index: int) -> None:
        """Move the slider to the frame that is shown."""
        last = max(1, self._playable.n_frames - 1, index)
        if self.frame.max != last:
            self.frame.max = last
        self.frame.value = max(0, index)

    def on_seek(self, event: viser.GuiEvent[Any]) -> None:
        """Go where a client moved the slider."""
        if event.client_id is not None:  # not the program's own change
            self._before()
            self._playable.seek(int(self.frame.value))

    def on_speed(self, event: viser.GuiEvent[Any]) -> None:
        """Play as fast as a client chose."""
        if event.client_id is not None:
            self._playable.set_speed(SPEEDS[self.speed.value])


class Painter:
    """Draws on a thread of its own, at a limited rate; skips what is out of date by then.

    Parameters
    ----------
    draw : callable
        Draws the newest that there is.
    idle : callable, optional
        Called four times a second while there is nothing to draw.
    """

    def __init__(
        self, draw: Callable[[], None], *, idle: Callable[[], None] = lambda: None
    ) -> None:
        self._draw, self._idle = draw, idle
        self._state = threading.Condition()
        self._n_offered = self._n_drawn = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="gvo view", daemon=True)
        self._thread.start()

    def offer(self) -> None:
        """Ask for drawing."""
        with self._state:
            self._n_offered += 1
            self._state.notify_all()

    def settle(self) -> None:
        """Wait until all that was offered is drawn."""
        with self._state:
            wanted = self._n_offered
            self._state.wait_for(lambda: self._n_drawn >= wanted or self._is_closed)

    def close(self) -> None:
        """End the thread; the last offer may stay undrawn."""
        with self._state:
            self._is_closed = True
            self._state.notify_all()
        self._thread.join()

    def _is_due(self) -> bool:
        return self._is_closed or self._n_offered > self._n_drawn

    def _run(self) -> None:
        try:
            self._draw_until_closed()
        finally:  # also where drawing failed, so that nobody waits for it
            with self._state:
                self._is_closed = True
                self._state.notify_all()

    def _draw_until_closed(self) -> None:
        while True:
            with self._state:
                self._state.wait_for(self._is_due, timeout=_IDLE_S)
                if self._is_closed:
                    return
                is_new, wanted = self._is_due(), self._n_offered
            if not is_new:
                self._idle()
                continue
            start = time.monotonic()
            self._draw()
            with self._state:
                self._n_drawn = wanted
                self._state.notify_all()
                rest_s = max(0.0, _PERIOD_S - (time.monotonic() - start))
                self._state.wait_for(lambda: self._is_closed, timeout=rest_s)
