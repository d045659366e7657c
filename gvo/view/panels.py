"""What both pages have: where the panels are, which layers are shown, the view of the camera."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import viser

from gvo.types import FloatArray
from gvo.view.scene import Scene, Up

MAIN_WIDTH_PX = 330
FRAME_WIDTH_PX = 430
UP: dict[Up, FloatArray] = {"-y": np.array([0.0, -1.0, 0.0]), "+z": np.array([0.0, 0.0, 1.0])}
"""Unit vectors of the world that point up."""


def add_frame_panel(server: viser.ViserServer) -> Any:  # noqa: ANN401 - a tab of viser's
    """Return the tab of the panel beside the scene."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(MAIN_WIDTH_PX)
    panel = server.gui.add_panel()
    tab = panel.add_tab("frame")
    panel.dock_left()
    panel.set_width(FRAME_WIDTH_PX)
    return tab


def add_layer_switches(gui: viser.GuiApi, scene: Scene, layers: Iterable[str]) -> None:
    """Add a check box for each layer of the scene."""
    with gui.add_folder("Show", expand_by_default=False):
        for layer in layers:
            box = gui.add_checkbox(layer, True)
            box.on_update(lambda event: scene.set_visible(event.target.label, event.target.value))


def grid_cell(size_m: float) -> float:
    """Return the power of ten at or below a size, metres."""
    return float(10.0 ** np.floor(np.log10(size_m)))


# Browsers that were not moved for so long are where they say that they are.
_REST_S = 1.0


class ViewPoint:
    """From where the scene is seen.

    What a browser says of its view is late, as much as it takes to draw: while it follows, only
    the direction and distance are taken from it, and what it looks at is known here.

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
        # What is looked at, from the camera: at first (with from where), and of each browser.
        self._start: tuple[FloatArray, FloatArray] | None = None
        self._offsets: dict[int, FloatArray] = {}
        self._moved_s = -np.inf
        server.on_client_connect(self._catch_up)

    def look_along(self, T_world_cam: FloatArray, distance_m: float) -> None:
        """Look from behind and above along the camera's axis; also whoever connects later.

        Parameters
        ----------
        T_world_cam : ndarray of float64, shape (4, 4)
            Pose of the camera, metres.
        distance_m : float
            From the camera.
        """
        forward = T_world_cam[:3, 2] - self._up * (T_world_cam[:3, 2] @ self._up)
        norm = float(np.linalg.norm(forward))
        forward = forward / norm if norm > 1e-6 else T_world_cam[:3, 0]
        self._last = start = T_world_cam[:3, 3].copy()
        self.look(
            start - distance_m * forward + 0.6 * distance_m * self._up,
            start + distance_m * forward,
            distance_m,
        )

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

    def show_pose(self, T_world_cam: FloatArray) -> None:
        """Move the view with the camera, if it follows."""
        before, self._last = self._last, T_world_cam[:3, 3].copy()
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
        """Bring a browser that comes later to where the first one began, by the camera."""
        if self._start is not None and self.follow.value:
            # What it says of its view may be from before it heard of any.
            position, target = (self._last + offset for offset in self._start)
            self._offsets[client.client_id] = self._start[1]
            client.camera.position, client.camera.look_at = position, target
