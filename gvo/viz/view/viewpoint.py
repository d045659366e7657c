"""From where the scene is seen, in each browser."""

from __future__ import annotations

import time

import numpy as np
import viser

from gvo.types import FloatArray

UP: FloatArray = np.array([0.0, -1.0, 0.0])
"""Unit vector of the world that points up: it is the first camera."""

# The view that a browser reports is up to date so long after it was moved.
_REST_S = 1.0


class ViewPoint:
    """Moves the view of each browser with the camera.

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
        server.on_client_connect(self._show_start)

    def look_along(self, T_world_frame: FloatArray, distance_m: float) -> None:
        """Look from behind and above along the camera's axis, also in browsers that come later."""
        forward = T_world_frame[:3, 2] - UP * (T_world_frame[:3, 2] @ UP)
        norm = float(np.linalg.norm(forward))
        forward = forward / norm if norm > 1e-6 else T_world_frame[:3, 0]
        self._last = T_world_frame[:3, 3].copy()
        target = distance_m * forward
        self._start = 0.6 * distance_m * UP - target, target
        initial = self._server.initial_camera
        initial.near, initial.far = 0.002 * distance_m, 1000.0 * distance_m
        initial.up = UP
        initial.position, initial.look_at = (self._last + each for each in self._start)
        for client in self._server.get_clients().values():
            client.camera.near, client.camera.far = initial.near, initial.far
            self._show_start(client)
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

    def _show_start(self, client: viser.ClientHandle) -> None:
        """Give a browser the first view, at the camera; its own report may be older."""
        if self._start is not None:
            position, target = self._start
            self._offsets[client.client_id] = target
            client.camera.position, client.camera.look_at = (
                self._last + position,
                self._last + target,
            )
