"""Scenes in which something moves, or in which a mirror hangs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import invert
from gvo.io.synthetic.rendering import (
    NOTHING,
    SampleArray,
    View,
    find_visible,
    look,
    refine,
    render_depth,
    render_image,
)
from gvo.io.synthetic.scene import Scene
from gvo.types import BoolArray, DepthArray, FloatArray

_BEHIND_M = 1e-6
# A point of it, and its normal; in the map, metres.
Plane: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingScene:
    """A scene whose rectangles from `n_still` on move as one body: a `Scenery`.

    Those are given in the frame of the body; `path` returns T_map_body for seconds since the start.
    """

    scene: Scene
    n_still: int
    path: Callable[[float], FloatArray]

    def at(self, elapsed_s: float) -> Scene:
        """Return the scene as it is so many seconds after the start, in the map."""
        T_map_body = self.path(elapsed_s)
        moving = slice(self.n_still, None)
        origins, axes_s, axes_t = (
            array.copy() for array in (self.scene.origins, self.scene.axes_s, self.scene.axes_t)
        )
        origins[moving] = se3.transform_points(T_map_body, origins[moving])
        for axes in (axes_s, axes_t):
            axes[moving] = axes[moving] @ T_map_body[:3, :3].T
        return replace(self.scene, origins=origins, axes_s=axes_s, axes_t=axes_t)

    def image(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> SampleArray:
        return render_image(look(self.at(elapsed_s), T_map_cam, camera))

    def depth(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> DepthArray:
        return render_depth(look(self.at(elapsed_s), T_map_cam, camera))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorScene:
    """A moving scene of which the first rectangle that moves reflects the rest: a `Scenery`.

    The glass must be black. Depth is that of what is seen in it, or with `is_dusty` of the glass.
    """

    moving: MovingScene
    is_dusty: bool

    def image(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> SampleArray:
        view, reflection = self._views(elapsed_s, T_map_cam, camera)
        image = render_image(view)
        fine = self._is_glass(refine(view)).astype(np.float32)
        shares = 0.25 * (fine[::2, ::2] + fine[::2, 1::2] + fine[1::2, ::2] + fine[1::2, 1::2])
        # What the black glass covers of a pixel is left to the reflection.
        return np.asarray(image + shares * render_image(reflection)) if shares.any() else image

    def depth(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> DepthArray:
        view, reflection = self._views(elapsed_s, T_map_cam, camera)
        depth = render_depth(view)
        if self.is_dusty:
            return depth
        return np.where(self._is_glass(view), render_depth(reflection), depth)

    def _views(
        self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera
    ) -> tuple[View, View]:
        scene = self.moving.at(elapsed_s)
        virtual, plane = reflect(scene, self.moving.n_still)
        return look(scene, T_map_cam, camera), look_beyond(plane, virtual, T_map_cam, camera)

    def _is_glass(self, view: View) -> BoolArray:
        indices = np.append(view.indices, NOTHING)  # the last: where nothing is visible
        return np.asarray(indices[find_visible(view)] == self.moving.n_still)


def look_beyond(plane: Plane, scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera) -> View:
    """Return the view of what lies on the side of a plane that its normal points to."""
    T_cam_map = invert(T_map_cam).reshape(-1, 4, 4)
    view = look(scene, T_map_cam, camera)
    R = T_cam_map[..., :3, :3]
    point, normal = R @ plane[0] + T_cam_map[..., :3, 3], R @ plane[1]
    offset = np.asarray(np.einsum("...j,...j->...", normal, point))[..., np.newaxis, np.newaxis]
    form = (normal @ np.linalg.inv(camera.K))[..., np.newaxis, :] - offset * view.inverse_depth
    inside = np.concatenate([view.inside, form[..., np.newaxis, :]], axis=-2)
    return replace(view, inside=inside)


def reflect(scene: Scene, mirror: int) -> tuple[Scene, Plane]:
    """Return what is seen in the rectangle `mirror`: the scene behind its plane, and that plane.

    Reflections lie on the side that the normal points to. Parts of rectangles that reach through
    the plane come to lie before it and are to be cut off.
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
    offsets = scene.texel_offsets + np.column_stack([widths, np.zeros_like(widths)])
    virtual = replace(
        scene,
        origins=(starts[kept] - point) @ H + point,
        axes_s=-(scene.axes_s[kept] @ H),
        axes_t=scene.axes_t[kept] @ H,
        sizes=scene.sizes[kept],
        is_two_sided=scene.is_two_sided[kept],
        textures=scene.textures[kept],
        texels_per_m=scene.texels_per_m[kept] * [-1.0, 1.0],
        texel_offsets=offsets[kept],
        has_mask=scene.has_mask[kept],
        gains=scene.gains[kept],
    )
    return virtual, (point, normal)
