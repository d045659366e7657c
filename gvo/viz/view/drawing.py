"""Draws a scene on the page: camera, lines, points and ellipsoids."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, ImageArray
from gvo.viz.palette import DRAWN, rgb
from gvo.viz.scene import Scene, ellipsoids
from gvo.viz.view.clouds import Cloud

# Where in the scene each line hangs; what is below a hidden node is hidden.
_PATHS = ("raw", "causal", "smoothed", "truth")
_LINKS = ("step", "keyframe link", "depth", "imu", "refused")
_NODES = {
    **{name: f"/world/paths/{name}" for name in _PATHS},
    "keyframes": "/world/keyframes",
    "links": "/world/links",
    "loops": "/world/loops",
    "ellipsoids": "/world/ellipsoids",
    "image": "/world/camera/image",
    "points": "/world/camera/points",
    "cloud": "/world/cloud",
    "ground": "/world/ground",
}
LAYERS = tuple(_NODES)
"""What can be hidden, by name."""
_NO_LINES = np.zeros((0, 2, 3))
_N_GRID_CELLS = 100
# Sizes, as shares of the distance at which the camera's image is drawn.
_POINT_SHARE, _CLOUD_SHARE, _KEYFRAME_SHARE = 0.035, 0.025, 0.35
_SPHERE = trimesh.creation.icosphere(subdivisions=3)


class Drawing:
    """What is drawn in 3-D, in the world of the first camera.

    An empty node is removed: browsers complain of it.

    Attributes
    ----------
    world : viser.FrameHandle
        What all hangs on: where it is placed, the browsers see the world.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        scene.set_up_direction("-y")
        scene.world_axes.visible = False
        self.world = scene.add_frame("/world", show_axes=False)
        self._camera = scene.add_frame("/world/camera", show_axes=False)
        self._layers = {
            layer: scene.add_frame(node, show_axes=False) for layer, node in _NODES.items()
        }
        self._frustum: viser.CameraFrustumHandle | None = None
        self._size = 1.0
        self._corners = np.zeros((4, 3))

    def set_camera(self, camera: PinholeCamera, size_m: float) -> None:
        """Set the shape of the camera; its image is drawn at a distance of `size_m`, metres."""
        self._size = size_m
        aspect = camera.width / camera.height
        half_height = 0.5 * camera.height / camera.fy
        x, y = aspect * half_height, half_height
        self._corners = np.array([[-x, -y, 1.0], [x, -y, 1.0], [x, y, 1.0], [-x, y, 1.0]])
        self._frustum = self._scene.add_camera_frustum(
            "/world/camera/image/frustum",
            2.0 * float(np.arctan(half_height)),
            aspect,
            # viser states the size of a frustum by its volume.
            scale=size_m * float(np.cbrt(aspect * half_height**2 / 3.0)),
            thickness=2.0,
            thickness_units="screen",
            color=rgb(DRAWN["causal"]),
            format="jpeg",
            jpeg_quality=80,
            cast_shadow=False,
            receive_shadow=False,
        )

    def show_ground(self, center: FloatArray, cell_m: float) -> None:
        """Draw a grid through a position (3,) of the world, thick lines ten cells apart."""
        self._scene.add_grid(
            "/world/ground/grid",
            width=_N_GRID_CELLS * cell_m,
            height=_N_GRID_CELLS * cell_m,
            plane="xz",
            cell_size=cell_m,
            section_size=10.0 * cell_m,
            cell_color=(232, 232, 232),
            section_color=(205, 205, 205),
            shadow_opacity=0.0,
            infinite_grid=True,
            fade_distance=_N_GRID_CELLS * cell_m,
            position=center,
        )

    def show_path(self, name: str, positions: FloatArray) -> None:
        """Draw raw, causal, smoothed or truth (dashed) through positions (n, 3), metres."""
        lines = np.stack([positions[:-1], positions[1:]], axis=1)
        if name == "truth" and len(lines) > 2:
            lines = lines[np.arange(len(lines)) % 3 != 2]
        self._show_lines(f"{_NODES[name]}/line", lines, DRAWN[name], 3.0)

    def show_camera(self, T_world_frame: FloatArray, image: ImageArray) -> None:
        """Move the camera with what hangs on it, and show an RGB image (h, w, 3) in it."""
        self._camera.wxyz = Rotation.from_matrix(T_world_frame[:3, :3]).as_quat(scalar_first=True)
        self._camera.position = T_world_frame[:3, 3]
        if self._frustum is not None:
            self._frustum.image = image

    def show_points(self, cloud_cam: Cloud) -> None:
        """Draw the points of the current frame, in the camera frame."""
        self._show_cloud("/world/camera/points/cloud", cloud_cam, _POINT_SHARE)

    def show_cloud(self, cloud_world: Cloud) -> None:
        """Draw the points of all keyframes, in the world."""
        self._show_cloud("/world/cloud/points", cloud_world, _CLOUD_SHARE)

    def show_loops(self, lines: FloatArray) -> None:
        """Draw the loops so far, lines of shape (n, 2, 3), metres."""
        self._show_lines("/world/loops/loops", lines, DRAWN["loops"])

    def show_scene(self, scene: Scene, n_sigmas: float) -> None:
        """Draw keyframes as small cameras, links, and ellipsoids of the window's poses."""
        edges = self._camera_edges([each.T_world_frame for each in scene.keyframes])
        self._show_lines("/world/keyframes/cameras", edges, DRAWN["keyframes"])
        for name in _LINKS:
            node = f"/world/links/{name.replace(' ', '_')}"
            self._show_lines(node, scene.lines.get(name, _NO_LINES), DRAWN[name])
        self._show_ellipsoids(scene, n_sigmas)

    def _camera_edges(self, poses: list[FloatArray]) -> FloatArray:
        """Return the edges (n, 2, 3) of small cameras at poses (4, 4)."""
        far = _KEYFRAME_SHARE * self._size * self._corners
        rays = np.stack([np.zeros_like(far), far], axis=1)
        rim = np.stack([far, np.roll(far, -1, axis=0)], axis=1)
        edges = np.concatenate([rays, rim])
        placed = [edges @ T[:3, :3].T + T[:3, 3] for T in poses]
        return np.concatenate([_NO_LINES, *placed])

    def _show_ellipsoids(self, scene: Scene, n_sigmas: float) -> None:
        node = "/world/ellipsoids/meshes"
        found = ellipsoids(scene.window, n_sigmas)
        self._scene.remove_by_name(node)
        if len(found.centres) == 0:
            return
        self._scene.add_batched_meshes_simple(
            node,
            np.asarray(_SPHERE.vertices),
            np.asarray(_SPHERE.faces),
            np.roll(found.quaternions_xyzw, 1, axis=1),
            found.centres,
            batched_scales=np.maximum(found.half_axes, 1e-6).astype(np.float32),
            batched_colors=rgb(DRAWN["ellipsoids"]),
            opacity=0.4,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _show_lines(
        self, node: str, lines: FloatArray, colour: str, thickness_px: float = 2.0
    ) -> None:
        """Draw lines (n, 2, 3) of one colour."""
        options = {"colors": rgb(colour), "thickness": thickness_px, "thickness_units": "screen"}
        points = lines.astype(np.float32)
        self._show(self._scene.add_line_segments, node, {"points": points}, options)

    def _show_cloud(self, node: str, cloud: Cloud, size_share: float) -> None:
        """Draw round points (n, 3) in their colours."""
        options = {
            "point_size": size_share * self._size,
            "point_shape": "circle",
            "point_shading": "flat",
            "precision": "float32",
        }
        arrays: dict[str, NDArray[Any]] = {"points": cloud[0], "colors": cloud[1]}
        self._show(self._scene.add_point_cloud, node, arrays, options)

    def _show(
        self,
        add: Callable[..., object],
        node: str,
        arrays: dict[str, NDArray[Any]],
        options: dict[str, Any],
    ) -> None:
        """Add a node, or give it other arrays, which is less work for a browser."""
        handle = self._scene.get_handle_by_name(node)
        is_empty = len(arrays["points"]) == 0
        if handle is None and not is_empty:
            add(node, **arrays, **options)
        elif handle is not None and is_empty:
            handle.remove()
        elif handle is not None:
            for name, array in arrays.items():
                setattr(handle, name, array)

    def set_visible(self, layer: str, is_visible: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._layers[layer].visible = is_visible
