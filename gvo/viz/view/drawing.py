"""Draws a scene on the page: camera, lines, points and ellipsoids."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.geometry.camera import PinholeCamera
from gvo.types import FloatArray, ImageArray, IntArray
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


class _Lines:
    """Lines of one colour."""

    def __init__(
        self, scene: viser.SceneApi, node: str, colour: str, *, thickness_px: float = 2.0
    ) -> None:
        self._scene, self._node = scene, node
        self._colour, self._thickness_px = rgb(colour), thickness_px
        self._handle: Any = None

    def show(self, lines: FloatArray) -> None:
        """Draw lines of shape (n, 2, 3), metres."""
        if len(lines) == 0:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is not None:
            self._handle.points = lines.astype(np.float32)
        else:
            self._handle = self._scene.add_line_segments(
                self._node,
                lines.astype(np.float32),
                self._colour,
                thickness=self._thickness_px,
                thickness_units="screen",
            )


class _Points:
    """Round points; none at all where there are none, of which browsers complain."""

    def __init__(self, scene: viser.SceneApi, node: str) -> None:
        self._scene, self._node = scene, node
        self._handle: Any = None

    def show(self, cloud: Cloud, size_m: float) -> None:
        """Draw points."""
        points, colours = cloud
        if len(points) == 0:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is not None:
            self._handle.points, self._handle.colors = points, colours
        else:
            self._handle = self._scene.add_point_cloud(
                self._node,
                points,
                colours,
                point_size=size_m,
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )


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
            name: _Lines(scene, f"{_NODES[name]}/line", DRAWN[name], thickness_px=3.0)
            for name in _PATHS
        }
        self._links = {
            name: _Lines(scene, f"/links/{name.replace(' ', '_')}", DRAWN[name]) for name in _LINKS
        }
        self._loops = _Lines(scene, "/loops/loops", DRAWN["loops"])
        self._keyframes = _Lines(scene, "/keyframes/cameras", DRAWN["keyframes"])
        self._points = _Points(scene, "/camera/points/cloud")
        self._cloud = _Points(scene, "/cloud/points")
        self._ellipsoids: Any = None
        self._frustum: Any = None
        self._size = 1.0
        self._aspect, self._fov = 4 / 3, 1.0

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
        self._paths[name].show(lines)

    def show_camera(self, T_world_frame: FloatArray, image: ImageArray) -> None:
        """Move the camera with what hangs on it, and show an RGB image (h, w, 3) in it."""
        self._camera.wxyz = Rotation.from_matrix(T_world_frame[:3, :3]).as_quat(scalar_first=True)
        self._camera.position = T_world_frame[:3, 3]
        if self._frustum is not None:
            self._frustum.image = image

    def show_points(self, cloud_cam: Cloud) -> None:
        """Draw the points of the current frame, in the camera frame."""
        self._points.show(cloud_cam, _POINT_SHARE * self._size)

    def show_cloud(self, cloud_world: Cloud) -> None:
        """Draw the points of all keyframes, in the world."""
        self._cloud.show(cloud_world, _CLOUD_SHARE * self._size)

    def show_loops(self, lines: FloatArray) -> None:
        """Draw the loops so far, lines of shape (n, 2, 3), metres."""
        self._loops.show(lines)

    def show_scene(self, scene: Scene, n_sigmas: float) -> None:
        """Draw keyframes as small cameras, links, and ellipsoids of the window's poses."""
        corners = _frustum_edges(self._fov, self._aspect, _KEYFRAME_SHARE * self._size)
        poses = np.array([each.T_world_frame for each in scene.keyframes]).reshape(-1, 4, 4)
        edges = np.einsum("nij,ekj->neki", poses[:, :3, :3], corners) + poses[:, None, None, :3, 3]
        self._keyframes.show(edges.reshape(-1, 2, 3))
        for name, lines in self._links.items():
            lines.show(scene.lines.get(name, _NO_LINES))
        self._show_ellipsoids(ellipsoids(scene.window, n_sigmas))

    def _show_ellipsoids(self, found: Ellipsoids) -> None:
        if self._ellipsoids is not None:
            self._ellipsoids.remove()
            self._ellipsoids = None
        if len(found.centres) == 0:
            return
        vertices, faces = _unit_sphere()
        self._ellipsoids = self._scene.add_batched_meshes_simple(
            "/ellipsoids/meshes",
            vertices,
            faces,
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


def _unit_sphere(n_rings: int = 10) -> tuple[NDArray[np.float64], IntArray]:
    """Return the corners (v, 3) and triangles (f, 3) of a sphere of radius 1."""
    n_around = 2 * n_rings
    polar = np.linspace(0.0, np.pi, n_rings + 1)
    around = np.linspace(0.0, 2.0 * np.pi, n_around, endpoint=False)
    z = np.repeat(np.cos(polar), n_around)
    x = np.outer(np.sin(polar), np.cos(around)).ravel()
    y = np.outer(np.sin(polar), np.sin(around)).ravel()
    ring, step = np.divmod(np.arange(n_rings * n_around), n_around)
    a = ring * n_around + step
    b = ring * n_around + (step + 1) % n_around
    lower = np.stack([a, a + n_around, b], axis=1)
    upper = np.stack([b, a + n_around, b + n_around], axis=1)
    return np.stack([x, y, z], axis=1), np.concatenate([lower, upper])
