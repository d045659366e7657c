"""Scenes in which something moves, or in which a mirror hangs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.io.synthetic.rendering import (
    NOTHING,
    IndexArray,
    Plane,
    SampleArray,
    find_visible,
    look,
    render_depth,
    render_image,
)
from gvo.io.synthetic.rendering import refine as refine_view
from gvo.io.synthetic.scene import Scene
from gvo.types import BoolArray, DepthArray, FloatArray

_BEHIND_M = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingScene:
    """A scene of which some rectangles move as one body, and one may be a mirror.

    Parameters
    ----------
    scene : Scene
        Its last rectangles, those that move, in the frame of the body; all else in the map.
    n_still : int, optional
        So many rectangles stand still; default: all.
    path : callable, optional
        Returns T_map_body, shape (4, 4), for seconds since the start.
    mirror : int, optional
        Index of the rectangle that reflects the rest. Its texture must be black.
    """

    scene: Scene
    n_still: int | None = None
    path: Callable[[float], FloatArray] | None = None
    mirror: int | None = None

    def at(self, elapsed_s: float) -> Scene:
        """Return the scene as it is so many seconds after the start, in the map."""
        if self.path is None or self.n_still is None:
            return self.scene
        T_map_body = self.path(elapsed_s)
        moving = slice(self.n_still, None)
        origins, axes_s, axes_t = (
            array.copy() for array in (self.scene.origins, self.scene.axes_s, self.scene.axes_t)
        )
        origins[moving] = se3.transform_points(T_map_body, origins[moving])
        for axes in (axes_s, axes_t):
            axes[moving] = axes[moving] @ T_map_body[:3, :3].T
        return replace(self.scene, origins=origins, axes_s=axes_s, axes_t=axes_t)

    def render_image(
        self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera
    ) -> SampleArray:
        """Render a grey image without noise, with reflections; as `rendering.render_image`."""
        scene = self.at(elapsed_s)
        image = render_image(scene, T_map_cam, camera)
        if self.mirror is None:
            return image
        fine = self._is_glass(scene, T_map_cam, camera, is_fine=True).astype(np.float32)
        shares = 0.25 * (fine[::2, ::2] + fine[::2, 1::2] + fine[1::2, ::2] + fine[1::2, 1::2])
        if not shares.any():
            return image
        virtual, plane = reflect(scene, self.mirror)
        # The glass is black: what it covers of a pixel is left to the reflection.
        return np.asarray(image + shares * render_image(virtual, T_map_cam, camera, beyond=plane))

    def render_depth(
        self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera, *, is_reflected: bool
    ) -> DepthArray:
        """Render the exact depth of a mirror's glass, or of what is seen in it, and of the rest.

        As `rendering.render_depth`.
        """
        scene = self.at(elapsed_s)
        depth = render_depth(scene, T_map_cam, camera)
        if self.mirror is None or not is_reflected:
            return depth
        virtual, plane = reflect(scene, self.mirror)
        is_glass = self._is_glass(scene, T_map_cam, camera, is_fine=False)
        return np.where(is_glass, render_depth(virtual, T_map_cam, camera, beyond=plane), depth)

    def _is_glass(
        self, scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera, *, is_fine: bool
    ) -> BoolArray:
        """Tell where the mirror is seen; at twice the resolution where that is asked for."""
        view = look(scene, T_map_cam, camera)
        visible: IndexArray = find_visible(refine_view(view) if is_fine else view)
        indices = np.append(view.indices, NOTHING)  # the last: where nothing is visible
        return np.asarray(indices[visible] == self.mirror)


def reflect(scene: Scene, mirror: int) -> tuple[Scene, Plane]:
    """Return what is seen in a mirror: the scene behind its plane, and that plane.

    Parameters
    ----------
    scene : Scene
    mirror : int
        Index of a rectangle.

    Returns
    -------
    scene : Scene
        What lies at least partly before the mirror, reflected.
    plane : (ndarray of float64, ndarray of float64)
        Point and normal: reflections lie on the side that the normal points to. Parts of
        rectangles that reach through the plane come to lie before it and are to be cut off.
    """
    point = scene.origins[mirror]
    normal = np.cross(scene.axes_s[mirror], scene.axes_t[mirror])
    edges_s = scene.axes_s * scene.sizes[:, :1]
    edges_t = scene.axes_t * scene.sizes[:, 1:]
    corners = [scene.origins, scene.origins + edges_s, scene.origins + edges_t]
    corners.append(corners[1] + edges_t)
    heights = np.stack([(corner - point) @ normal for corner in corners])
    kept = np.flatnonzero((heights < -_BEHIND_M).any(axis=0))
    H = np.eye(3) - 2.0 * np.outer(normal, normal)
    # Rows of the texture run the other way, so that the front stays the front.
    starts = scene.origins + edges_s
    widths = scene.sizes[:, 0] * scene.texels_per_m[:, 0]
    flipped = np.array([-1.0, 1.0])
    offsets = scene.texel_offsets + np.column_stack([widths, np.zeros_like(widths)])
    virtual = replace(
        scene,
        origins=(starts[kept] - point) @ H + point,
        axes_s=-(scene.axes_s[kept] @ H),
        axes_t=scene.axes_t[kept] @ H,
        sizes=scene.sizes[kept],
        is_two_sided=scene.is_two_sided[kept],
        textures=scene.textures[kept],
        texels_per_m=scene.texels_per_m[kept] * flipped,
        texel_offsets=offsets[kept],
        has_mask=scene.has_mask[kept],
        gains=scene.gains[kept],
    )
    return virtual, (point, normal)
