"""From where the scene is seen."""

from __future__ import annotations

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from gvo.geometry import se3
from gvo.types import FloatArray

UP: FloatArray = np.array([0.0, -1.0, 0.0])
"""Unit vector of the world that points up: it is the first camera."""

# Below this share of the horizon in its axis, a camera looks up or down and has no heading.
_LEAST_HORIZONTAL = 0.1


class ViewPoint:
    """Moves and turns the world, so that the camera stays where the browsers look.

    Each browser keeps a view of its own: turned, shifted, and zoomed by hand.
    """

    def __init__(self, server: viser.ViserServer, world: viser.FrameHandle) -> None:
        self._server, self._world = server, world
        self.follow = server.gui.add_checkbox(
            "follow camera", True, hint="Move and turn the view with the camera"
        )
        self._heading = np.array([0.0, 0.0, 1.0])

    def look_along(self, distance_m: float) -> None:
        """Look from behind and above along the camera's heading, in all browsers."""
        target = np.array([0.0, 0.0, distance_m])
        initial = self._server.initial_camera
        initial.near, initial.far = 0.002 * distance_m, 1000.0 * distance_m
        initial.up = UP
        initial.position, initial.look_at = 0.6 * distance_m * UP - target, target
        for client in self._server.get_clients().values():
            client.camera.near, client.camera.far = initial.near, initial.far
            client.camera.position, client.camera.look_at = initial.position, initial.look_at

    def show_pose(self, T_world_frame: FloatArray) -> None:
        """Have the camera in the middle, its heading ahead, if the view follows it."""
        if not self.follow.value:
            return
        ahead = T_world_frame[:3, 2] - UP * (T_world_frame[:3, 2] @ UP)
        if (norm := float(np.linalg.norm(ahead))) > _LEAST_HORIZONTAL:
            self._heading = ahead / norm
        axes = np.column_stack([np.cross(-UP, self._heading), -UP, self._heading])
        T_view_world = se3.invert(se3.make_transform(axes, T_world_frame[:3, 3]))
        quaternion = Rotation.from_matrix(T_view_world[:3, :3]).as_quat(scalar_first=True)
        self._world.wxyz, self._world.position = quaternion, T_view_world[:3, 3]
