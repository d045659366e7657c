"""Render textured rectangles: exact depth, anti-aliased images."""

from __future__ import annotations

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.sources.scene import Scene
from gvo.sources.visibility import (
    NOTHING,
    IndexArray,
    Plane,
    SampleArray,
    View,
    find_visible,
    look,
    refine,
)
from gvo.types import DepthArray, FloatArray, ImageArray

_BAND_SAMPLES = 24_000  # samples shaded at once: their temporaries stay in the cache


def render_image(
    scene: Scene,
    T_map_cam: FloatArray,
    camera: PinholeCamera,
    *,
    is_antialiased: bool = True,
    beyond: Plane | None = None,
) -> SampleArray:
    """Render a grey image without noise.

    Parameters
    ----------
    scene : Scene
        Rectangles in the `map` frame, metres.
    T_map_cam : ndarray of float64, shape (4, 4)
        Maps camera coordinates to the map, metres.
    camera : PinholeCamera
    is_antialiased : bool
        Four samples for the pixels where surfaces meet; otherwise one for each pixel.
    beyond : (ndarray of float64, ndarray of float64), optional
        Point and normal of a plane that cuts away what is before it, see `look`.

    Returns
    -------
    ndarray of float32, shape (height, width)
        Grey values, 0 to 255 where the light does not exceed the texture's.
    """
    view = look(scene, T_map_cam, camera, beyond=beyond)
    if not is_antialiased:
        return _shade_rows(view, find_visible(view))
    fine = find_visible(refine(view))
    corners = [np.ascontiguousarray(fine[i::2, j::2]) for i in (0, 1) for j in (0, 1)]
    image = _shade_rows(view, corners[0])
    is_mixed = np.any([corner != corners[0] for corner in corners[1:]], axis=0)
    v, u = np.nonzero(is_mixed)
    total = np.zeros(len(u), dtype=np.float32)
    for k, corner in enumerate(corners):
        rows = (v + (0.5 * (k // 2) - 0.25)).astype(np.float32)
        columns = (u + (0.5 * (k % 2) - 0.25)).astype(np.float32)
        total += _shade(view, corner[v, u], columns, rows)
    image[v, u] = 0.25 * total
    return image


def render_depth(
    scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera, *, beyond: Plane | None = None
) -> DepthArray:
    """Render the exact depth at the centre of each pixel.

    Parameters
    ----------
    scene : Scene
        Rectangles in the `map` frame, metres.
    T_map_cam : ndarray of float64, shape (4, 4)
        Maps camera coordinates to the map, metres.
    camera : PinholeCamera
    beyond : (ndarray of float64, ndarray of float64), optional
        Point and normal of a plane that cuts away what is before it, see `look`.

    Returns
    -------
    ndarray of float32, shape (height, width)
        Metres along the optical axis, NaN where there is nothing.
    """
    view = look(scene, T_map_cam, camera, beyond=beyond)
    visible = find_visible(view)
    forms = np.vstack([view.inverse_depth, np.full(3, np.nan)])  # the last row: nothing
    a, b, c = forms[visible].transpose(2, 0, 1)
    u, v = np.arange(camera.width), np.arange(camera.height)[:, np.newaxis]
    return np.asarray(1.0 / (a * u + b * v + c), dtype=np.float32)


def _shade_rows(view: View, visible: IndexArray) -> SampleArray:
    """Shade one sample at the centre of each pixel."""
    height, width = view.camera.height, view.camera.width
    image = np.empty((height, width), dtype=np.float32)
    u = np.arange(width, dtype=np.float32)
    n_rows = max(1, _BAND_SAMPLES // width)
    for start in range(0, height, n_rows):
        v = np.arange(start, min(start + n_rows, height), dtype=np.float32)[:, np.newaxis]
        image[start : start + n_rows] = _shade(view, visible[start : start + n_rows], u, v)
    return image


def _shade(view: View, visible: IndexArray, u: SampleArray, v: SampleArray) -> SampleArray:
    """Look the texture of the visible rectangles up at samples (u, v)."""
    scene = view.scene
    if len(view.indices) == 0:
        return np.full(visible.shape, scene.light.haze_grey, dtype=np.float32)

    def gather(values: FloatArray) -> list[SampleArray]:
        # Where nothing is visible the last rectangle fills in, and is painted over.
        return [column.take(visible, mode="wrap") for column in values.astype(np.float32).T]

    a, b, c = gather(view.inverse_depth)
    inverse_depths = np.maximum(a * u + b * v + c, np.float32(1e-9))
    depths: SampleArray = np.reciprocal(inverse_depths)
    corners = scene.atlas.corners[scene.textures[view.indices]]
    positions = []
    for forms, corner in zip((view.texels_s, view.texels_t), gather(corners), strict=True):
        f_u, f_v, f_1 = gather(forms)
        texels = (f_u * u + f_v * v + f_1) * depths
        footprints = np.maximum(np.abs(f_u - texels * a), np.abs(f_v - texels * b)) * depths
        positions.append(scene.atlas.locate(texels, footprints) + corner)
    (gains,) = gather(scene.gains[view.indices, np.newaxis])
    grey = scene.atlas.sample(*positions) * gains
    if np.isfinite(scene.light.haze_m):
        clear = np.exp(depths * np.float32(-1.0 / scene.light.haze_m))
        grey = scene.light.haze_grey + (grey - scene.light.haze_grey) * clear
    grey[visible == NOTHING] = scene.light.haze_grey
    return np.asarray(grey, dtype=np.float32)


def to_uint8(grey: SampleArray) -> ImageArray:
    """Round and clip grey values.

    Parameters
    ----------
    grey : ndarray of float32, shape (h, w)
        Any values.

    Returns
    -------
    ndarray of uint8, shape (h, w)
        0 to 255.
    """
    return np.asarray(cv2.convertScaleAbs(np.maximum(grey, 0.0)), dtype=np.uint8)
