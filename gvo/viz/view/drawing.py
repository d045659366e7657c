"""Draws a scene on the page: camera, lines, points and ellipsoids."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, ImageArray
from gvo.viz.palette import DRAWN, rgb
from gvo.viz.scene import Ellipsoids, Scene, ellipsoids
from gvo.viz.view.clouds import Cloud

# Where in the scene each line hangs; what is below a hidden node is hidden.
_PATHS = ("raw", "causal", "smoothed", "truth")
_LINKS = ("step", "keyframe link", "depth", "refused")
_NODES = {
    **{name: f"/paths/{name}" for name in _PATHS},
    "keyframes": "/keyframes",
    "links": "/links",
    "loops": "/loops",
    "ellipsoids": "/ellipsoids",
    "image": "/camera/image",
    "points": "/camera/points",
    "cloud": "/cloud",
    "ground": "/ground",
}
LAYERS = tuple(_NODES)
"""What can be hidden, by name."""
_NO_LINES = np.zeros((0, 2, 3))
_N_GRID_CELLS = 100
_JPEG_QUALITY = 80
# Sizes, as shares of the distance at which the camera's image is drawn.
_POINT_SHARE, _CLOUD_SHARE, _KEYFRAME_SHARE = 0.035, 0.025, 0.35


class _Node:
    """A node that is there while it has something to draw: browsers complain of empty ones."""

    def __init__(self, add: Callable[..., Any], *names: str) -> None:
        self._add, self._names = add, names
        self._handle: Any = None

    def show(self, *arrays: NDArray[Any]) -> None:
        """Draw the arrays of those names."""
        if self._handle is None and len(arrays[0]) > 0:
            self._handle = self._add(*arrays)
        elif self._handle is not None and len(arrays[0]) == 0:
            self._handle.remove()
            self._handle = None
        elif self._handle is not None:
            for name, array in zip(self._names, arrays, strict=True):
                setattr(self._handle, name, array)


class Drawing:
    """What is drawn in 3-D, in the world of the first camera."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        scene.set_up_direction("-y")
        scene.world_axes.visible = False
        self._camera = scene.add_frame("/camera", show_axes=False)
        self._nodes = {
            layer: scene.add_frame(node, show_axes=False) for layer, node in _NODES.items()
        }
        self._paths = {
            name: self._lines(f"{_NODES[name]}/line", DRAWN[name], 3.0) for name in _PATHS
        }
        self._links = {
            name: self._lines(f"/links/{name.replace(' ', '_')}", DRAWN[name]) for name in _LINKS
        }
        self._loops = self._lines("/loops/loops", DRAWN["loops"])
        self._keyframes = self._lines("/keyframes/cameras", DRAWN["keyframes"])
        self._points = self._cloud_node("/camera/points/cloud", _POINT_SHARE)
        self._cloud = self._cloud_node("/cloud/points", _CLOUD_SHARE)
        self._ellipsoids: Any = None
        self._frustum: Any = None
        self._size = 1.0
        self._aspect, self._fov = 4 / 3, 1.0

    def _lines(self, node: str, colour: str, thickness_px: float = 2.0) -> _Node:
        """Return a node of lines (n, 2, 3) of one colour."""
        add = partial(
            self._scene.add_line_segments,
            node,
            colors=rgb(colour),
            thickness=thickness_px,
            thickness_units="screen",
        )
        return _Node(add, "points")

    def _cloud_node(self, node: str, size_share: float) -> _Node:
        """Return a node of round points (n, 3) and their colours."""

        def add(points: NDArray[Any], colours: NDArray[Any]) -> Any:  # noqa: ANN401 - a handle
            return self._scene.add_point_cloud(
                node,
                points,
                colours,
                point_size=size_share * self._size,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )

        return _Node(add, "points", "colors")

    def set_camera(self, camera: PinholeCamera, size_m: float) -> None:
        """Set the shape of the camera; its image is drawn at a distance of `size_m`, metres."""
        self._aspect = camera.width / camera.height
        self._fov = 2.0 * float(np.arctan2(0.5 * camera.height, camera.fy))
        self._size = size_m
        # viser states the size of a frustum by its volume.
        scale = size_m * float(np.cbrt(self._aspect * np.tan(0.5 * self._fov) ** 2 / 3.0))
        self._frustum = self._scene.add_camera_frustum(
            "/camera/image/frustum",
            self._fov,
            self._aspect,
            scale=scale,
            thickness=2.0,
            thickness_units="screen",
            color=rgb(DRAWN["causal"]),
            format="jpeg",
            jpeg_quality=_JPEG_QUALITY,
            cast_shadow=False,
            receive_shadow=False,
        )

    def show_ground(self, center: FloatArray, cell_m: float) -> None:
        """Draw a grid through a position (3,) of the world, thick lines ten cells apart."""
        self._scene.add_grid(
            "/ground/grid",
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
        self._paths[name].show(lines.astype(np.float32))

    def show_camera(self, T_world_frame: FloatArray, image: ImageArray) -> None:
        """Move the camera with what hangs on it, and show an RGB image (h, w, 3) in it."""
        self._camera.wxyz = Rotation.from_matrix(T_world_frame[:3, :3]).as_quat(scalar_first=True)
        self._camera.position = T_world_frame[:3, 3]
        if self._frustum is not None:
            self._frustum.image = image

    def show_points(self, cloud_cam: Cloud) -> None:
        """Draw the points of the current frame, in the camera frame."""
        self._points.show(*cloud_cam)

    def show_cloud(self, cloud_world: Cloud) -> None:
        """Draw the points of all keyframes, in the world."""
        self._cloud.show(*cloud_world)

    def show_loops(self, lines: FloatArray) -> None:
        """Draw the loops so far, lines of shape (n, 2, 3), metres."""
        self._loops.show(lines.astype(np.float32))

    def show_scene(self, scene: Scene, n_sigmas: float) -> None:
        """Draw keyframes as small cameras, links, and ellipsoids of the window's poses."""
        corners = _frustum_edges(self._fov, self._aspect, _KEYFRAME_SHARE * self._size)
        poses = np.array([each.T_world_frame for each in scene.keyframes]).reshape(-1, 4, 4)
        edges = np.einsum("nij,ekj->neki", poses[:, :3, :3], corners) + poses[:, None, None, :3, 3]
        self._keyframes.show(edges.reshape(-1, 2, 3).astype(np.float32))
        for name, lines in self._links.items():
            lines.show(scene.lines.get(name, _NO_LINES).astype(np.float32))
        self._show_ellipsoids(ellipsoids(scene.window, n_sigmas))

    def _show_ellipsoids(self, found: Ellipsoids) -> None:
        if self._ellipsoids is not None:
            self._ellipsoids.remove()
            self._ellipsoids = None
        if len(found.centres) == 0:
            return
        sphere = trimesh.creation.icosphere(subdivisions=3)
        self._ellipsoids = self._scene.add_batched_meshes_simple(
            "/ellipsoids/meshes",
            np.asarray(sphere.vertices),
            np.asarray(sphere.faces),
            np.roll(found.quaternions_xyzw, 1, axis=1),
            found.centres,
            batched_scales=np.maximum(found.half_axes, 1e-6).astype(np.float32),
            batched_colors=rgb(DRAWN["ellipsoids"]),
            opacity=0.4,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def set_visible(self, layer: str, is_visible: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._nodes[layer].visible = is_visible


def _frustum_edges(fov: float, aspect: float, depth: float) -> FloatArray:
    """Return the 8 edges (8, 2, 3) of a camera, in its frame."""
    y = depth * np.tan(0.5 * fov)
    x = aspect * y
    far = np.array([[-x, -y, depth], [x, -y, depth], [x, y, depth], [-x, y, depth]])
    rays = np.stack([np.zeros_like(far), far], axis=1)
    rim = np.stack([far, np.roll(far, -1, axis=0)], axis=1)
    return np.concatenate([rays, rim])
