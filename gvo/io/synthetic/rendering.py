"""Rectangles rendered: visibility, depth, images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gvo.geometry.camera import PinholeCamera
from gvo.geometry.se3 import invert, transform_points
from gvo.io.synthetic.scene import Scene
from gvo.types import BoolArray, DepthArray, FloatArray, ImageArray, IntArray

SampleArray: TypeAlias = NDArray[np.float32]
IndexArray: TypeAlias = NDArray[np.int16]
Plane: TypeAlias = tuple[FloatArray, FloatArray]

NOTHING = -1
_NEAR_M = 0.05
_SMALL_BOX = 20_000  # pixels: not worth a closer look
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
    forms = np.vstack([view.inverse_depth, np.full(3, np.nan)])  # the last row: nothing
    a, b, c = forms[find_visible(view)].transpose(2, 0, 1)
    u, v = np.arange(camera.width), np.arange(camera.height)[:, np.newaxis]
    return np.asarray(1.0 / (a * u + b * v + c), dtype=np.float32)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The rectangles one camera may see, as linear forms of the pixel (u, v, 1).

    Parameters
    ----------
    scene : Scene
    camera : PinholeCamera
    indices : ndarray of int64, shape (n,)
        Of the rectangles in the scene.
    inverse_depth : ndarray of float64, shape (n, 3)
        1/z in 1/m.
    texels_s, texels_t : ndarray of float64, shape (n, 3)
        Texture coordinates over z, texels per metre.
    inside : ndarray of float64, shape (n, 4 or 5, 3)
        All not negative inside of the rectangle, and beyond the plane that cuts the view.
    corners : ndarray of float64, shape (n, 4, 3)
        In the camera frame, metres.
    """

    scene: Scene
    camera: PinholeCamera
    indices: IntArray
    inverse_depth: FloatArray
    texels_s: FloatArray
    texels_t: FloatArray
    inside: FloatArray
    corners: FloatArray


def look(
    scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera, *, beyond: Plane | None = None
) -> View:
    """Keep the rectangles in view and express them as linear forms of the pixel.

    Parameters
    ----------
    scene : Scene
        In the map frame, metres.
    T_map_cam : ndarray of float64, shape (4, 4)
        Maps camera coordinates to the map, metres.
    camera : PinholeCamera
        Of the image.
    beyond : (ndarray of float64, ndarray of float64), optional
        Point and normal of a plane, `map` frame: only what lies on the side that the normal
        points to is seen.

    Returns
    -------
    View
        What the camera may see.
    """
    T_cam_map = invert(T_map_cam)
    R, K_inverse = T_cam_map[:3, :3], np.linalg.inv(camera.K)
    origins = transform_points(T_cam_map, scene.origins)
    axes_s, axes_t = scene.axes_s @ R.T, scene.axes_t @ R.T
    distances = _dots(normals := np.cross(axes_s, axes_t), origins)
    corners = _corners(origins, axes_s * scene.sizes[:, :1], axes_t * scene.sizes[:, 1:])
    keep = np.flatnonzero(_faces(scene, distances) & _is_in_frustum(corners, camera))
    inverse_depth = (normals[keep] / distances[keep, np.newaxis]) @ K_inverse
    s, t = (
        axes @ K_inverse - _dots(axes, origins[keep])[:, np.newaxis] * inverse_depth
        for axes in (axes_s[keep], axes_t[keep])
    )
    width, height = scene.sizes[keep].T[..., np.newaxis]
    inside = [s, width * inverse_depth - s, t, height * inverse_depth - t]
    if beyond is not None:
        point, normal = R @ beyond[0] + T_cam_map[:3, 3], R @ beyond[1]
        inside.append(normal @ K_inverse - (normal @ point) * inverse_depth)
    return View(
        scene=scene,
        camera=camera,
        indices=keep,
        inverse_depth=inverse_depth,
        texels_s=scene.texels_per_m[keep, :1] * s + scene.texel_offsets[keep, :1] * inverse_depth,
        texels_t=scene.texels_per_m[keep, 1:] * t + scene.texel_offsets[keep, 1:] * inverse_depth,
        inside=np.stack(inside, axis=1),
        corners=corners[keep],
    )


def _faces(scene: Scene, distances: FloatArray) -> BoolArray:
    """Tell which rectangles turn a visible side to the camera, by their distances along normals."""
    return np.asarray((distances > 1e-9) | (scene.is_two_sided & (distances < -1e-9)))


def _corners(origins: FloatArray, edges_s: FloatArray, edges_t: FloatArray) -> FloatArray:
    return np.stack(
        [origins, origins + edges_s, origins + edges_s + edges_t, origins + edges_t], axis=1
    )


def _is_in_frustum(corners: FloatArray, camera: PinholeCamera) -> BoolArray:
    """Tell which rectangles do not lie wholly beyond one side of the frustum."""
    x, y, z = np.moveaxis(corners, -1, 0)
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    sides = [u + z, camera.width * z - u, v + z, camera.height * z - v, z - _NEAR_M]
    return np.asarray(np.all([np.any(side > 0, axis=1) for side in sides], axis=0))


def _dots(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the inner products of rows."""
    return np.asarray(np.einsum("ij,ij->i", first, second))


def refine(view: View) -> View:
    """Return the view of an image of twice the width and height.

    Parameters
    ----------
    view : View
        From the same pose.

    Returns
    -------
    View
        Its linear forms take pixels of the larger image.
    """
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
    """Return the nearest rectangle at each pixel.

    Parameters
    ----------
    view : View
        Of h x w pixels.

    Returns
    -------
    ndarray of int16, shape (h, w)
        Index into the view; -1: nothing.
    """
    nearest = np.zeros((view.camera.height, view.camera.width), dtype=np.float32)
    visible = np.full(nearest.shape, NOTHING, dtype=np.int16)
    first, last, upper_bounds = _bounds(view)
    # Front to back, cut-outs last: what is hidden is found out early.
    for k in np.lexsort((-upper_bounds, view.scene.has_mask[view.indices])):
        box = slice(first[k, 1], last[k, 1]), slice(first[k, 0], last[k, 0])
        behind = nearest[box]
        if behind.size > 0 and behind.min() < upper_bounds[k]:
            _draw(view, int(k), _shrink(view, int(k), box, nearest), nearest, visible)
    return visible


def _draw(
    view: View, k: int, box: tuple[slice, slice], nearest: SampleArray, visible: IndexArray
) -> None:
    """Enter rectangle k into the buffers where it is the nearest one."""
    v, u = (np.arange(part.start, part.stop) for part in box)
    a, b, c = view.inverse_depth[k]
    inverse_depths = np.add.outer((b * v + c).astype(np.float32), (a * u).astype(np.float32))
    mask = inverse_depths > nearest[box]
    left, right = _row_spans(view.inside[k], v, view.camera.width)
    columns = u.astype(np.int16)
    mask &= columns >= left[:, np.newaxis]
    mask &= columns <= right[:, np.newaxis]
    if view.scene.has_mask[view.indices[k]]:
        _cut_out(view, k, (u, v), inverse_depths, mask)
    np.copyto(nearest[box], inverse_depths, where=mask)
    np.copyto(visible[box], np.int16(k), where=mask)


def _shrink(
    view: View, k: int, box: tuple[slice, slice], nearest: SampleArray
) -> tuple[slice, slice]:
    """Leave rows out, above and below, where all is nearer than the rectangle can be."""
    rows, columns = box
    if (rows.stop - rows.start) * (columns.stop - columns.start) < _SMALL_BOX:
        return box
    a, b, c = view.inverse_depth[k]
    reach = b * np.arange(rows.start, rows.stop) + c
    reach += max(a * columns.start, a * (columns.stop - 1))
    used = np.flatnonzero(nearest[box].min(axis=1) < reach)
    if len(used) == 0:
        return slice(0, 0), columns
    return slice(rows.start + int(used[0]), rows.start + int(used[-1]) + 1), columns


def _bounds(view: View) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the boxes (u, v) around rectangles, shapes (n, 2), and their largest 1/z."""
    nexts = np.roll(view.corners, -1, axis=1)
    z, z_next = view.corners[..., 2:], nexts[..., 2:]
    is_crossing = (z < _NEAR_M) != (z_next < _NEAR_M)
    shares = (_NEAR_M - z) / np.where(is_crossing, z_next - z, 1.0)
    crossings = view.corners + shares * (nexts - view.corners)
    points = np.concatenate([view.corners, crossings], axis=1)
    is_used = np.concatenate([z >= _NEAR_M, is_crossing], axis=1)
    pixels = view.camera.project(np.where(is_used, points, [0.0, 0.0, 1.0]))
    size = np.array([view.camera.width, view.camera.height])
    first = np.floor(np.where(is_used, pixels, np.inf).min(axis=1)).clip(0, size)
    last = np.ceil(np.where(is_used, pixels, -np.inf).max(axis=1) + 1).clip(0, size)
    slopes = view.inverse_depth[:, :2]
    over_box = np.maximum(slopes * first, slopes * last).sum(axis=1) + view.inverse_depth[:, 2]
    over_points = (1.0 / np.where(is_used, points[..., 2:], np.inf)).max(axis=(1, 2))
    return first.astype(np.int64), last.astype(np.int64), np.minimum(over_box, over_points)


def _row_spans(inside: FloatArray, rows: IntArray, width: int) -> tuple[IndexArray, IndexArray]:
    """Return the first and the last column inside of a rectangle for each row."""
    a, b, c = inside.T[..., np.newaxis]
    offsets = b * rows + c
    slopes = np.where(a == 0, 1e-300, a)  # all of the row, or nothing
    with np.errstate(over="ignore"):
        bounds = -offsets / slopes
    is_lower = slopes[:, 0] > 0
    lower = bounds[is_lower].max(axis=0, initial=0.0)
    upper = bounds[~is_lower].min(axis=0, initial=width - 1.0)
    left, right = np.minimum(np.ceil(lower), width), np.maximum(np.floor(upper), -1)
    return left.astype(np.int16), right.astype(np.int16)


def _cut_out(
    view: View,
    k: int,
    pixels: tuple[IntArray, IntArray],
    inverse_depths: SampleArray,
    mask: BoolArray,
) -> None:
    """Clear the mask over columns and rows where the texture of rectangle k is transparent."""
    u, v = pixels
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # beyond the rectangle
        depths = np.reciprocal(inverse_depths)
        s, t = (
            np.add.outer((b * v + c).astype(np.float32), (a * u).astype(np.float32)) * depths
            for a, b, c in (view.texels_s[k], view.texels_t[k])
        )
        # One level for the whole rectangle: left and right then see the same outline.
        per_pixel = np.linalg.norm([view.texels_s[k, :2], view.texels_t[k, :2]], axis=1).max()
        level = round(np.log2(max(view.corners[k, :, 2].mean() * per_pixel, 1.0)))
        mask &= view.scene.atlas.is_opaque(int(view.scene.textures[view.indices[k]]), level, s, t)


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
