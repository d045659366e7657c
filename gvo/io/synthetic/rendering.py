"""Rectangles rendered: visibility, depth, images.

A camera has one pose, or one for each row of its image: that of a rolling shutter. All of a
row's pixels, and the samples in them, are seen from the row's pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import invert, transform_points
from gvo.io.synthetic.scene import Scene
from gvo.kernels.rendering import write_places, write_spans, write_visible
from gvo.types import BoolArray, DepthArray, FloatArray, ImageArray, IntArray

SampleArray: TypeAlias = NDArray[np.float32]
IndexArray: TypeAlias = NDArray[np.int16]

NOTHING = -1
_NEAR_M = 0.05
_CULLED_ROWS = 8  # what is in view is found out from the poses of every eighth row


@dataclass(frozen=True, slots=True)
class StillScene:
    """A scene in which nothing moves, as a `Scenery`."""

    scene: Scene

    def image(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> SampleArray:
        """Render grey values, the same at any time."""
        return render_image(look(self.scene, T_map_cam, camera))

    def depth(self, elapsed_s: float, T_map_cam: FloatArray, camera: PinholeCamera) -> DepthArray:
        """Render depth, the same at any time."""
        return render_depth(look(self.scene, T_map_cam, camera))


def render_image(view: View) -> SampleArray:
    """Render a grey image without noise, by four samples for the pixels where surfaces meet."""
    shape = (view.camera.height, view.camera.width)
    fine = find_visible(refine(view))
    corners = [fine[i::2, j::2].ravel() for i in (0, 1) for j in (0, 1)]
    v, u = np.indices(shape, dtype=np.float32)
    pixels = np.stack([u.ravel(), v.ravel()])
    image = _shade(view, corners[0], pixels)
    is_mixed = np.any([corner != corners[0] for corner in corners[1:]], axis=0)
    offsets = [np.array([[j], [i]], dtype=np.float32) for i in (-0.25, 0.25) for j in (-0.25, 0.25)]
    samples = [
        _shade(view, corner[is_mixed], np.compress(is_mixed, pixels, axis=1) + offset)
        for corner, offset in zip(corners, offsets, strict=True)
    ]
    image[is_mixed] = 0.25 * sum(samples)
    return image.reshape(shape)


def render_depth(view: View) -> DepthArray:
    """Render the exact depth (m) at the centre of each pixel; NaN where there is nothing."""
    v, u = np.indices((view.camera.height, view.camera.width), sparse=True)
    nothing = np.full((len(view.inverse_depth), 1, 3), np.nan)
    forms = np.concatenate([view.inverse_depth, nothing], axis=1)  # where visible is -1
    a, b, c = np.moveaxis(forms[v * len(forms) // view.camera.height, find_visible(view)], -1, 0)
    return np.asarray(1.0 / (a * u + b * v + c), dtype=np.float32)


def to_uint8(grey: SampleArray) -> ImageArray:
    """Round and clip grey values."""
    return np.asarray(cv2.convertScaleAbs(np.maximum(grey, 0.0)), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The rectangles one camera may see, as linear forms of the pixel (u, v, 1).

    Forms are those of the whole image, n_rows 1, or of each of its rows: of a rolling shutter.

    Parameters
    ----------
    scene : Scene
    camera : PinholeCamera
    indices : ndarray of int64, shape (n,)
        Of the rectangles in the scene.
    inverse_depth : ndarray of float64, shape (n_rows, n, 3)
        1/z in 1/m.
    texels_s, texels_t : ndarray of float64, shape (n_rows, n, 3)
        Texture coordinates over z, texels per metre.
    inside : ndarray of float64, shape (n_rows, n, m, 3)
        All m forms (one for each side) are not negative inside of the rectangle.
    corners : ndarray of float64, shape (n, 4, 3)
        In the camera frame, of the middle row, metres.
    """

    scene: Scene
    camera: PinholeCamera
    indices: IntArray
    inverse_depth: FloatArray
    texels_s: FloatArray
    texels_t: FloatArray
    inside: FloatArray
    corners: FloatArray


def look(scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera) -> View:
    """Express the rectangles in view as linear forms of the pixel, of one pose or of each row."""
    T_cam_map, K_inverse = invert(T_map_cam).reshape(-1, 4, 4), np.linalg.inv(camera.K)
    keep = _in_view(scene, T_cam_map, camera)
    R = T_cam_map[..., :3, :3]
    origins = transform_points(T_cam_map, scene.origins[keep])
    axes_s, axes_t = (axes[keep] @ np.swapaxes(R, -1, -2) for axes in (scene.axes_s, scene.axes_t))
    distances = _dots(normals := np.cross(axes_s, axes_t), origins)
    faces = _faces(scene.is_two_sided[keep], distances)
    inverse_depth = (normals / np.where(faces, distances, np.inf)[..., np.newaxis]) @ K_inverse
    s, t = (
        axes @ K_inverse - _dots(axes, origins)[..., np.newaxis] * inverse_depth
        for axes in (axes_s, axes_t)
    )
    width, height = scene.sizes[keep].T[..., np.newaxis]
    inside = [s, width * inverse_depth - s, t, height * inverse_depth - t]
    T_middle = T_cam_map[len(T_cam_map) // 2]
    return View(
        scene=scene,
        camera=camera,
        indices=keep,
        inverse_depth=inverse_depth,
        texels_s=scene.texels_per_m[keep, :1] * s + scene.texel_offsets[keep, :1] * inverse_depth,
        texels_t=scene.texels_per_m[keep, 1:] * t + scene.texel_offsets[keep, 1:] * inverse_depth,
        inside=np.stack(inside, axis=-2),
        corners=transform_points(T_middle, _corners(scene)[keep]),
    )


def _in_view(scene: Scene, T_cam_map: FloatArray, camera: PinholeCamera) -> IntArray:
    """Return the indices of the rectangles that do not lie wholly beyond a side of the frustum."""
    poses = T_cam_map[[*range(0, len(T_cam_map), _CULLED_ROWS), -1]]
    sides = np.array(
        [
            [camera.fx, 0.0, camera.cx + 1.0],
            [-camera.fx, 0.0, camera.width - camera.cx],
            [0.0, camera.fy, camera.cy + 1.0],
            [0.0, -camera.fy, camera.height - camera.cy],
            [0.0, 0.0, 1.0],
        ]
    )
    limits = [0.0, 0.0, 0.0, 0.0, _NEAR_M] - poses[:, :3, 3] @ sides.T
    is_seen = np.ones((len(poses), len(scene.origins)), dtype=np.bool_)
    corners = np.ascontiguousarray(np.moveaxis(_corners(scene), 0, -1))
    for k, side in enumerate(np.moveaxis(sides @ poses[:, :3, :3], 1, 0)):
        heights = np.max([side @ corner for corner in corners], axis=0)
        is_seen &= heights > limits[:, k, np.newaxis]
    return np.flatnonzero(is_seen.any(axis=0))


def _faces(is_two_sided: BoolArray, distances: FloatArray) -> BoolArray:
    """Tell which rectangles turn a visible side to the camera, by their distances along normals."""
    return np.asarray((distances > 1e-9) | (is_two_sided & (distances < -1e-9)))


def _corners(scene: Scene) -> FloatArray:
    """Return the corners of rectangles in the map, shape (n, 4, 3)."""
    edges_s, edges_t = scene.axes_s * scene.sizes[:, :1], scene.axes_t * scene.sizes[:, 1:]
    steps = [np.zeros_like(edges_s), edges_s, edges_s + edges_t, edges_t]
    return np.asarray(scene.origins[:, np.newaxis] + np.stack(steps, axis=1))


def _dots(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the inner products of rows."""
    return np.asarray(np.einsum("...j,...j->...", first, second))


def refine(view: View) -> View:
    """Return the view of an image of twice the width and height; two rows share a pose."""
    M = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    return replace(
        view,
        camera=scale_camera(view.camera, 2.0),
        inverse_depth=view.inverse_depth @ M,
        texels_s=view.texels_s @ M,
        texels_t=view.texels_t @ M,
        inside=view.inside @ M,
    )


def scale_camera(camera: PinholeCamera, scale: float) -> PinholeCamera:
    """Return the camera with images of another size; pixel (0, 0) stays the first's centre."""
    return PinholeCamera(
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=scale * (camera.cx + 0.5) - 0.5,
        cy=scale * (camera.cy + 0.5) - 0.5,
        width=round(scale * camera.width),
        height=round(scale * camera.height),
    )


def find_visible(view: View) -> IndexArray:
    """Return the index (in the view) of the nearest rectangle at each pixel; -1: nothing."""
    atlas, indices, depths = view.scene.atlas, view.indices, view.corners[..., 2]
    width, height = view.camera.width, view.camera.height
    forms = view.inverse_depth, view.texels_s, view.texels_t
    spans, reach = np.empty((len(indices), height, 2), dtype=np.int16), np.empty(len(indices))
    write_spans(view.inverse_depth, view.inside, width, spans, reach)
    if len(view.inverse_depth) == 1:
        reach = 1.0 / np.maximum(depths.min(axis=1), _NEAR_M)
    # Front to back, cut-outs last: what is hidden is found out early.
    order = np.lexsort((-reach, view.scene.has_mask[indices]))
    # One level for the whole rectangle: left and right then see the same outline.
    middle = len(view.texels_s) // 2
    per_pixel = np.linalg.norm([form[middle, :, :2] for form in forms[1:]], axis=-1).max(axis=0)
    levels = np.rint(np.log2(np.maximum(depths.mean(axis=1) * per_pixel, 1.0)))
    cuts = atlas.cuts(view.scene.textures[indices], levels.astype(np.int64))
    nearest = np.zeros((height, width), dtype=np.float32)
    visible = np.full(nearest.shape, NOTHING, dtype=np.int16)
    write_visible(order, spans, *forms, cuts, atlas.masks, atlas.size, nearest, visible)
    return visible


def _shade(view: View, visible: IndexArray, pixels: SampleArray) -> SampleArray:
    """Look the texture of the visible rectangles up at pixels (2, m), (u, v)."""
    scene, atlas, light = view.scene, view.scene.atlas, view.scene.light
    places, depths = np.empty_like(pixels), np.empty(len(visible), dtype=np.float32)
    forms = view.inverse_depth, view.texels_s, view.texels_t
    corners, sizes = atlas.corners[scene.textures[view.indices]], (atlas.size, view.camera.height)
    write_places(visible, pixels, *forms, corners, atlas.starts, *sizes, places, depths)
    gains = np.append(scene.gains[view.indices], 0.0).astype(np.float32)
    grey = atlas.sample(*places) * gains[visible]
    if np.isfinite(light.haze_m):
        clear = np.exp(depths * np.float32(-1.0 / light.haze_m))
        grey = light.haze_grey + (grey - light.haze_grey) * clear
    grey[visible == NOTHING] = light.haze_grey
    return np.asarray(grey, dtype=np.float32)
