"""The scene of the page: camera, lines, points and ellipsoids, sent only where they changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvo.types import FloatArray, ImageArray, IntArray
from gvo.viz.palette import ESTIMATES, LINKS, LOOP_STYLES, OTHERS, REFERENCE, REFUSED, rgb

COLOURS = {
    **ESTIMATES,
    "truth": REFERENCE,
    "keyframes": LINKS["keyframe"],
    "step": LINKS["step"],
    "keyframe link": LINKS["keyframe"],
    "depth": LINKS["depth"],
    "refused": REFUSED,
    **{name: style.color for name, style in LOOP_STYLES.items()},
    "ellipsoids": OTHERS[3],
}
"""By name of what is drawn."""

_PATH_CHUNK = 256
_CLOUD_CHUNK = 8192
Up = Literal["-y", "+z"]
_LINES = {
    **dict.fromkeys(("step", "keyframe link", "depth", "refused"), "links"),
    **dict.fromkeys(("loops", "refused loops"), "loops"),
}
"""Kinds of lines between poses."""
_PATHS = ("raw", "causal", "smoothed", "global", "truth")
# Where in the scene each layer hangs; what is below a hidden node is hidden.
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


def add_points(
    scene: viser.SceneApi, node: str, points: NDArray[Any], colours: NDArray[Any], size_m: float
) -> Any:  # noqa: ANN401 - a handle of viser's
    """Add round points of shape (n, 3), metres, with colours (n, 3), RGB."""
    return scene.add_point_cloud(
        node,
        points,
        colours,
        point_size=size_m,
        point_shape="circle",
        point_shading="flat",
        precision="float32",
    )


class Segments:
    """Lines of one colour, all sent anew.

    Parameters
    ----------
    scene : viser.SceneApi
    node : str
        Where they are in the scene.
    colour : str
        As "#RRGGBB".
    thickness_px : float
    """

    def __init__(
        self, scene: viser.SceneApi, node: str, colour: str, *, thickness_px: float = 2.0
    ) -> None:
        self._scene, self._node = scene, node
        self._colour = rgb(colour)
        self._thickness_px = thickness_px
        self._handle: Any = None

    def show(self, segments: FloatArray) -> None:
        """Draw lines of shape (n, 2, 3), metres."""
        if len(segments) == 0:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is not None:
            self._handle.points = segments.astype(np.float32)
        else:
            self._handle = self._scene.add_line_segments(
                self._node,
                segments.astype(np.float32),
                self._colour,
                thickness=self._thickness_px,
                thickness_units="screen",
            )


class Path:
    """A line in chunks; the truth is dashed. Parameters as of `Segments`."""

    def __init__(self, scene: viser.SceneApi, node: str, colour: str, *, is_dashed: bool) -> None:
        self._scene, self._node, self._colour = scene, node, colour
        self._is_dashed = is_dashed
        self._corners = ChunkedArray(_PATH_CHUNK, n_shared=1)
        self._chunks: dict[int, Segments] = {}

    def show(self, positions: FloatArray) -> None:
        """Draw corners of shape (n, 3), metres."""
        for number, corners in self._corners.update(positions.astype(np.float32)).items():
            segments = np.stack([corners[:-1], corners[1:]], axis=1)
            if self._is_dashed:
                # Two of three are drawn, and all of a few.
                segments = segments[(np.arange(len(segments)) % 3 != 2) | (len(segments) < 3)]
            if number not in self._chunks:
                thickness_px = 2.0 if self._is_dashed else 3.0
                self._chunks[number] = Segments(
                    self._scene, f"{self._node}/{number}", self._colour, thickness_px=thickness_px
                )
            self._chunks[number].show(segments)


class Cloud:
    """Points in chunks, so that those that stay are sent once."""

    def __init__(self, scene: viser.SceneApi, node: str) -> None:
        self._scene, self._node = scene, node
        self._rows = ChunkedArray(_CLOUD_CHUNK)
        self._handles: dict[int, Any] = {}

    def show(
        self, points: NDArray[np.float32], colours: NDArray[np.uint8], *, size_m: float
    ) -> None:
        """Draw points of shape (n, 3), metres, with colours (n, 3), RGB."""
        rows = np.concatenate([points, colours.astype(np.float32)], axis=1)
        for number, chunk in self._rows.update(rows).items():
            if number in self._handles:
                self._handles.pop(number).remove()
            if len(chunk) > 0:
                colours = chunk[:, 3:].astype(np.uint8)
                self._handles[number] = add_points(
                    self._scene, f"{self._node}/{number}", chunk[:, :3], colours, size_m
                )


class ChunkedArray:
    """Cuts rows into chunks of equal size and finds those that differ from before.

    Parameters
    ----------
    size : int
        Rows of a chunk.
    n_shared : int
        Rows that a chunk shares with the next: 1 where the rows are corners of a line.
    """

    def __init__(self, size: int, *, n_shared: int = 0) -> None:
        self._size, self._n_shared = size, n_shared
        self._rows: NDArray[Any] | None = None

    def update(self, rows: NDArray[Any]) -> dict[int, NDArray[Any]]:
        """Return the chunks of rows (n, m) that changed, by number; an empty one went away."""
        before = rows[:0] if self._rows is None else self._rows
        self._rows = rows.copy()
        n_same = _common_prefix(before, rows)
        if n_same == len(before) == len(rows):
            return {}
        first = max(0, n_same - self._n_shared) // self._size
        last = (max(len(before), len(rows)) - 1) // self._size
        return {number: self._chunk(rows, number) for number in range(first, last + 1)}

    def _chunk(self, rows: NDArray[Any], number: int) -> NDArray[Any]:
        start = number * self._size
        chunk = rows[start : start + self._size + self._n_shared]
        return chunk if len(chunk) > self._n_shared else chunk[:0]


def _common_prefix(before: NDArray[Any], after: NDArray[Any]) -> int:
    n = min(len(before), len(after))
    differs = np.any(before[:n] != after[:n], axis=1)
    return int(np.argmax(differs)) if differs.any() else n


class Scene:
    """What is drawn in 3-D; sends only what changed.

    Parameters
    ----------
    scene : viser.SceneApi
    up : {"-y", "+z"}
        Which axis of the world points up: -y where the world is the first camera.
    """

    def __init__(self, scene: viser.SceneApi, *, up: Up = "-y") -> None:
        self._scene, self.up = scene, up
        scene.set_up_direction(up)
        scene.world_axes.visible = False
        self._camera = scene.add_frame("/camera", show_axes=False)
        self._nodes = {
            layer: scene.add_frame(node, show_axes=False) for layer, node in _NODES.items()
        }
        self._paths = {
            name: Path(scene, _NODES[name], COLOURS[name], is_dashed=name == "truth")
            for name in _PATHS
        }
        self._cloud = Cloud(scene, _NODES["cloud"])
        self._links = {
            name: Segments(scene, f"{_NODES[layer]}/{name.replace(' ', '_')}", COLOURS[name])
            for name, layer in _LINES.items()
        }
        self._keyframes = Segments(scene, "/keyframes/cameras", COLOURS["keyframes"])
        self._ellipsoids: Any = None
        self._frustum: Any = None
        self._points: Any = None
        self._size = 1.0
        self._aspect, self._fov = 4 / 3, 1.0

    def set_camera(self, width: int, height: int, fy: float, *, size_m: float) -> None:
        """Set the shape of the camera; its image is drawn at a distance of `size_m`.

        Parameters
        ----------
        width, height : int
            Pixels.
        fy : float
            Focal length, pixels.
        size_m : float
            Metres.
        """
        self._aspect, self._fov = width / height, 2.0 * np.arctan2(0.5 * height, fy)
        self._size = size_m
        self._frustum = self._scene.add_camera_frustum(
            "/camera/image/frustum",
            float(self._fov),
            float(self._aspect),
            scale=_frustum_scale(float(self._fov), float(self._aspect), size_m),
            thickness=2.0,
            thickness_units="screen",
            color=rgb(COLOURS["causal"]),
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
            plane="xz" if self.up == "-y" else "xy",
            cell_size=cell_m,
            section_size=10.0 * cell_m,
            cell_color=(232, 232, 232),
            section_color=(205, 205, 205),
            shadow_opacity=0.0,
            infinite_grid=True,
            fade_distance=_N_GRID_CELLS * cell_m,
            position=center,
        )

    def show_path(self, name: str, positions_world: FloatArray) -> None:
        """Draw a path: raw, causal, smoothed, global or truth.

        Parameters
        ----------
        positions_world : ndarray of float64, shape (n, 3)
            Metres.
        """
        self._paths[name].show(positions_world)

    def show_pose(self, T_world_frame: FloatArray) -> None:
        """Move the camera, with its image and points."""
        self._camera.wxyz = quaternions_wxyz(T_world_frame[np.newaxis, :3, :3])[0]
        self._camera.position = T_world_frame[:3, 3]

    def show_image(self, image: ImageArray | None) -> None:
        """Show an RGB image (h, w, 3) in the camera."""
        if self._frustum is not None:
            self._frustum.image = image

    def show_points(self, points_cam: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        """Draw the points of the current frame, shape (n, 3), metres, in the camera frame."""
        if len(points_cam) == 0:  # the browser complains of clouds without points
            if self._points is not None:
                self._points.remove()
                self._points = None
            return
        if self._points is None:
            self._points = add_points(
                self._scene, "/camera/points/cloud", points_cam, colours, 0.035 * self._size
            )
            return
        self._points.points = points_cam
        self._points.colors = colours

    def show_cloud(self, points_world: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        """Draw the accumulated points, shape (n, 3), metres, in the world."""
        self._cloud.show(points_world, colours, size_m=0.025 * self._size)

    def show_keyframes(self, T_world_keyframes: FloatArray) -> None:
        """Draw small cameras at poses of shape (n, 4, 4), metres."""
        corners = _frustum_corners(self._fov, self._aspect, 0.35 * self._size)
        homogeneous = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=2)
        segments = np.einsum("nij,ekj->neki", T_world_keyframes, homogeneous)[..., :3]
        self._keyframes.show(segments.reshape(-1, 2, 3))

    def show_links(self, segments: Mapping[str, FloatArray]) -> None:
        """Draw lines between poses, shape (n, 2, 3), metres, by a name of `_LINES`."""
        for name, node in self._links.items():
            node.show(segments.get(name, _NO_LINES))

    def show_ellipsoids(
        self, T_world_frame: FloatArray, covariances: FloatArray, n_sigmas: float
    ) -> None:
        """Draw the covariances of positions; see `position_ellipsoids`."""
        if self._ellipsoids is not None:
            self._ellipsoids.remove()
            self._ellipsoids = None
        if len(T_world_frame) == 0:
            return
        half_axes, quaternions = position_ellipsoids(T_world_frame, covariances, n_sigmas)
        vertices, faces = unit_sphere()
        self._ellipsoids = self._scene.add_batched_meshes_simple(
            "/ellipsoids/meshes",
            vertices,
            faces,
            quaternions,
            T_world_frame[:, :3, 3],
            batched_scales=np.maximum(half_axes, 1e-6).astype(np.float32),
            batched_colors=rgb(COLOURS["ellipsoids"]),
            opacity=0.4,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def set_visible(self, layer: str, is_visible: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._nodes[layer].visible = is_visible


def _frustum_scale(fov: float, aspect: float, depth: float) -> float:
    """Return viser's scale, by the volume, of a frustum that is `depth` metres deep."""
    return float(depth * np.cbrt(aspect * np.tan(0.5 * fov) ** 2 / 3.0))


def _frustum_corners(fov: float, aspect: float, depth: float) -> FloatArray:
    """Return the 8 edges (8, 2, 3) of a camera, in its frame."""
    y = depth * np.tan(0.5 * fov)
    x = aspect * y
    far = np.array([[-x, -y, depth], [x, -y, depth], [x, y, depth], [-x, y, depth]])
    rays = np.stack([np.zeros_like(far), far], axis=1)
    rim = np.stack([far, np.roll(far, -1, axis=0)], axis=1)
    return np.concatenate([rays, rim])


def position_ellipsoids(
    T_world_frame: FloatArray, covariances: FloatArray, n_sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return the half axes and orientations of the positions' ellipsoids.

    Parameters
    ----------
    T_world_frame : ndarray of float64, shape (n, 4, 4)
        Poses, metres.
    covariances : ndarray of float64, shape (n, 6, 6)
        Of (rx, ry, rz, tx, ty, tz), right perturbation, in the camera frame.
    n_sigmas : float
        Half axes are so many standard deviations.

    Returns
    -------
    half_axes : ndarray of float64, shape (n, 3)
        Metres, the smallest first.
    quaternions_wxyz : ndarray of float64, shape (n, 4)
        Of the axes in the world.
    """
    variances, axes_cam = np.linalg.eigh(covariances[:, 3:, 3:])
    axes_world = T_world_frame[:, :3, :3] @ axes_cam
    axes_world[:, :, 2] *= np.sign(np.linalg.det(axes_world))[:, np.newaxis]
    half_axes = n_sigmas * np.sqrt(np.maximum(variances, 0.0))
    return half_axes, quaternions_wxyz(axes_world)


def quaternions_wxyz(rotations: FloatArray) -> FloatArray:
    """Return unit quaternions (n, 4), w first, of rotation matrices (n, 3, 3)."""
    return Rotation.from_matrix(rotations).as_quat(scalar_first=True)


def position_sigmas(T_world_frame: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviations (3,) of a position along the axes of the world, metres."""
    R = T_world_frame[:3, :3]
    return np.asarray(np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T)))


def unit_sphere(n_rings: int = 10) -> tuple[FloatArray, IntArray]:
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
