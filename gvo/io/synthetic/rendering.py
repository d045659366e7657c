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
from gvo.types import BoolArray, DepthArray, FloatArray, ImageArray, IntArray

SampleArray: TypeAlias = NDArray[np.float32]
IndexArray: TypeAlias = NDArray[np.int16]
_Box: TypeAlias = tuple[slice, slice]
_Pixels: TypeAlias = tuple[IntArray, IntArray]
_Span: TypeAlias = tuple[IndexArray, IndexArray]

NOTHING = -1
_NEAR_M = 0.05
_SMALL_BOX = 20_000  # pixels: not worth a closer look
_BAND_SAMPLES = 24_000  # samples shaded at once: their temporaries stay in the cache
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
    fine = find_visible(refine(view))
    corners = [np.ascontiguousarray(fine[i::2, j::2]) for i in (0, 1) for j in (0, 1)]
    image = shade_rows(view, corners[0])
    is_mixed = np.any([corner != corners[0] for corner in corners[1:]], axis=0)
    v, u = np.nonzero(is_mixed)
    total = np.zeros(len(u), dtype=np.float32)
    for k, corner in enumerate(corners):
        columns = (u + (0.5 * (k % 2) - 0.25)).astype(np.float32)
        total += _shade(view, corner[v, u], columns, v, below=0.5 * (k // 2) - 0.25)
    image[v, u] = 0.25 * total
    return image


def render_depth(view: View) -> DepthArray:
    """Render the exact depth (m) at the centre of each pixel; NaN where there is nothing."""
    camera = view.camera
    u, v = np.arange(camera.width), np.arange(camera.height)[:, np.newaxis]
    nothing = np.full((*view.inverse_depth.shape[:-2], 1, 3), np.nan)
    forms = np.concatenate([view.inverse_depth, nothing], axis=-2)  # where visible is -1
    visible = find_visible(view)
    a, b, c = np.moveaxis(forms[v, visible] if view.is_rolling else forms[visible], -1, 0)
    return np.asarray(1.0 / (a * u + b * v + c), dtype=np.float32)


def to_uint8(grey: SampleArray) -> ImageArray:
    """Round and clip grey values."""
    return np.asarray(cv2.convertScaleAbs(np.maximum(grey, 0.0)), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The rectangles one camera may see, as linear forms of the pixel (u, v, 1).

    The forms of a rolling shutter have one more axis, the first: they differ from row to row.

    Parameters
    ----------
    scene : Scene
    camera : PinholeCamera
    indices : ndarray of int64, shape (n,)
        Of the rectangles in the scene.
    inverse_depth : ndarray of float64, shape (n, 3) or (height, n, 3)
        1/z in 1/m.
    texels_s, texels_t : ndarray of float64, shape (n, 3) or (height, n, 3)
        Texture coordinates over z, texels per metre.
    inside : ndarray of float64, shape (n, m, 3) or (height, n, m, 3)
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

    @property
    def is_rolling(self) -> bool:
        """Whether each row has forms of its own."""
        return self.inverse_depth.ndim == 3

    def of_middle_row(self, forms: FloatArray) -> FloatArray:
        """Return forms (n, ..., 3) of the image, or of its middle row."""
        return forms[self.camera.height // 2] if self.is_rolling else forms

    def along_rows(self, forms: FloatArray, k: int, rows: IntArray) -> tuple[FloatArray, ...]:
        """Return slopes along u, (1 or n_rows), and values at u = 0, (n_rows), of rectangle k."""
        a, b, c = forms[rows, k].T if self.is_rolling else forms[k, :, np.newaxis]
        return a, b * rows + c


def look(scene: Scene, T_map_cam: FloatArray, camera: PinholeCamera) -> View:
    """Express the rectangles in view as linear forms of the pixel, of one pose or of each row."""
    T_cam_map, K_inverse = invert(T_map_cam), np.linalg.inv(camera.K)
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
    T_middle = T_cam_map if T_cam_map.ndim == 2 else np.asarray(T_cam_map[len(T_cam_map) // 2])
    return View(
        scene=scene,
        camera=camera,
        indices=keep,
        inverse_depth=inverse_depth,
        texels_s=scene.texels_per_m[keep, :1] * s + scene.texel_offsets[keep, :1] * inverse_depth,
        texels_t=scene.texels_per_m[keep, 1:] * t + scene.texel_offsets[keep, 1:] * inverse_depth,
        inside=np.stack(inside, axis=-2),
        corners=_corners(scene, keep, T_middle),
    )


def _in_view(scene: Scene, T_cam_map: FloatArray, camera: PinholeCamera) -> IntArray:
    """Return the indices of the rectangles that may be seen."""
    everything = np.arange(len(scene.origins))
    is_seen = np.zeros(len(everything), dtype=np.bool_)
    poses = T_cam_map.reshape(-1, 4, 4)
    for pose in [*poses[::_CULLED_ROWS], poses[-1]] if len(poses) > 1 else poses:
        normals = np.cross(scene.axes_s, scene.axes_t) @ pose[:3, :3].T
        distances = _dots(normals, transform_points(pose, scene.origins))
        corners = _corners(scene, everything, pose)
        is_seen |= _faces(scene.is_two_sided, distances) & _is_in_frustum(corners, camera)
    return np.flatnonzero(is_seen)


def _faces(is_two_sided: BoolArray, distances: FloatArray) -> BoolArray:
    """Tell which rectangles turn a visible side to the camera, by their distances along normals."""
    return np.asarray((distances > 1e-9) | (is_two_sided & (distances < -1e-9)))


def _corners(scene: Scene, indices: IntArray, T_cam_map: FloatArray) -> FloatArray:
    """Return the corners of rectangles in the camera frame, shape (n, 4, 3)."""
    R = T_cam_map[:3, :3]
    origins = transform_points(T_cam_map, scene.origins[indices])
    edges_s = scene.axes_s[indices] @ R.T * scene.sizes[indices, :1]
    edges_t = scene.axes_t[indices] @ R.T * scene.sizes[indices, 1:]
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
    return np.asarray(np.einsum("...j,...j->...", first, second))


def refine(view: View) -> View:
    """Return the view of an image of twice the width and height; two rows share a pose."""
    M = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])

    def refined(forms: FloatArray) -> FloatArray:
        return np.repeat(forms @ M, 2, axis=0) if view.is_rolling else forms @ M

    return replace(
        view,
        camera=scale_camera(view.camera, 2.0),
        inverse_depth=refined(view.inverse_depth),
        texels_s=refined(view.texels_s),
        texels_t=refined(view.texels_t),
        inside=refined(view.inside),
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
    nearest = np.zeros((view.camera.height, view.camera.width), dtype=np.float32)
    visible = np.full(nearest.shape, NOTHING, dtype=np.int16)
    spans = _row_spans(view)
    first, last, upper_bounds = _bounds_by_rows(view, *spans) if view.is_rolling else _bounds(view)
    # Front to back, cut-outs last: what is hidden is found out early.
    for k in np.lexsort((-upper_bounds, view.scene.has_mask[view.indices])):
        box = slice(first[k, 1], last[k, 1]), slice(first[k, 0], last[k, 0])
        behind = nearest[box]
        if behind.size > 0 and behind.min() < upper_bounds[k]:
            box = _shrink(view, int(k), box, nearest)
            left, right = (bounds[k, box[0], np.newaxis] for bounds in spans)
            _draw(view, int(k), box, (left, right), nearest, visible)
    return visible


def _draw(
    view: View, k: int, box: _Box, span: _Span, nearest: SampleArray, visible: IndexArray
) -> None:
    """Enter rectangle k into the buffers where it is the nearest one."""
    v, u = (np.arange(part.start, part.stop) for part in box)
    inverse_depths = _evaluate(view, view.inverse_depth, k, (u, v))
    mask = inverse_depths > nearest[box]
    columns = u.astype(np.int16)
    mask &= columns >= span[0]
    mask &= columns <= span[1]
    if view.scene.has_mask[view.indices[k]]:
        _cut_out(view, k, (u, v), inverse_depths, mask)
    np.copyto(nearest[box], inverse_depths, where=mask)
    np.copyto(visible[box], np.int16(k), where=mask)


def _evaluate(view: View, forms: FloatArray, k: int, pixels: _Pixels) -> SampleArray:
    """Return a form of rectangle k at all columns and rows, shape (n_rows, n_columns)."""
    u, v = pixels
    slopes, offsets = view.along_rows(forms, k, v)
    along = (slopes[:, np.newaxis] * u).astype(np.float32)
    return np.asarray(offsets.astype(np.float32)[:, np.newaxis] + along)


def _shrink(view: View, k: int, box: _Box, nearest: SampleArray) -> _Box:
    """Leave rows out, above and below, where all is nearer than the rectangle can be."""
    rows, columns = box
    if (rows.stop - rows.start) * (columns.stop - columns.start) < _SMALL_BOX:
        return box
    slopes, reach = view.along_rows(view.inverse_depth, k, np.arange(rows.start, rows.stop))
    reach += np.maximum(slopes * columns.start, slopes * (columns.stop - 1))
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


def _bounds_by_rows(
    view: View, left: IndexArray, right: IndexArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the same for a rolling shutter, of which no corner has one place in the image."""
    n = len(view.indices)
    first, last = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
    upper_bounds = np.zeros(n)
    for k in range(n):
        rows = np.flatnonzero(left[k] <= right[k])
        if len(rows) == 0:
            continue
        start, end = left[k, rows], right[k, rows]
        slopes, reach = view.along_rows(view.inverse_depth, k, rows)
        first[k], last[k] = (start.min(), rows[0]), (end.max() + 1, rows[-1] + 1)
        upper_bounds[k] = (reach + np.maximum(slopes * start, slopes * end)).max()
    return first, last, upper_bounds


def _row_spans(view: View) -> _Span:
    """Return the first and the last column inside of each rectangle, shapes (n, height)."""
    width, height = view.camera.width, view.camera.height
    rows = np.arange(height)
    lower = np.zeros((len(view.indices), height))
    upper = np.full(lower.shape, width - 1.0)
    for side in range(view.inside.shape[-2]):
        forms = view.inside[..., side, :].T  # (3, n), of a rolling shutter (3, n, height)
        a, b, c = forms if view.is_rolling else forms[..., np.newaxis]
        slopes = np.where(a == 0, 1e-300, a)  # all of the row, or nothing
        with np.errstate(over="ignore"):
            bounds = -(b * rows + c) / slopes
        np.maximum(lower, bounds, out=lower, where=slopes > 0)
        np.minimum(upper, bounds, out=upper, where=slopes <= 0)
    left, right = np.minimum(np.ceil(lower), width), np.maximum(np.floor(upper), -1)
    return left.astype(np.int16), right.astype(np.int16)


def _cut_out(
    view: View, k: int, pixels: _Pixels, inverse_depths: SampleArray, mask: BoolArray
) -> None:
    """Clear the mask over columns and rows where the texture of rectangle k is transparent."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # beyond the rectangle
        depths = np.reciprocal(inverse_depths)
        s, t = (
            _evaluate(view, forms, k, pixels) * depths for forms in (view.texels_s, view.texels_t)
        )
        # One level for the whole rectangle: left and right then see the same outline.
        slopes = [view.of_middle_row(each)[k, :2] for each in (view.texels_s, view.texels_t)]
        per_pixel = np.linalg.norm(slopes, axis=1).max()
        level = round(np.log2(max(view.corners[k, :, 2].mean() * per_pixel, 1.0)))
        mask &= view.scene.atlas.is_opaque(int(view.scene.textures[view.indices[k]]), level, s, t)


def shade_rows(view: View, visible: IndexArray) -> SampleArray:
    """Shade one sample at the centre of each pixel."""
    height, width = view.camera.height, view.camera.width
    image = np.empty((height, width), dtype=np.float32)
    u = np.arange(width, dtype=np.float32)
    n_rows = max(1, _BAND_SAMPLES // width)
    for start in range(0, height, n_rows):
        rows = np.arange(start, min(start + n_rows, height))[:, np.newaxis]
        image[start : start + n_rows] = _shade(view, visible[start : start + n_rows], u, rows)
    return image


def _shade(
    view: View, visible: IndexArray, u: SampleArray, rows: IntArray, *, below: float = 0.0
) -> SampleArray:
    """Look the texture of the visible rectangles up at columns u, so far below rows' middles."""
    scene, n = view.scene, len(view.indices)
    if n == 0:
        return np.full(visible.shape, scene.light.haze_grey, dtype=np.float32)
    v = (rows + below).astype(np.float32)
    first, last = (int(rows.min()), int(rows.max())) if rows.size else (0, 0)
    by_row = (rows - first) * n + visible if view.is_rolling else visible

    def gather(values: FloatArray) -> list[SampleArray]:
        # Where nothing is visible another rectangle fills in, and is painted over.
        is_by_row = values.ndim == 3
        table = values[first : last + 1].reshape(-1, 3) if is_by_row else values
        indices = by_row if is_by_row else visible
        return [column.take(indices, mode="wrap") for column in table.astype(np.float32).T]

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
